"""URDF: one file for each piece of furniture, and one for the whole room as fixed obstacles."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from mover.core.colours import colour
from mover.core.files import replacing
from mover.core.run import Run
from mover.io.export.finished import Exported, Finished
from mover.io.export.looks import Look, looks_of
from mover.io.export.mjcf import COLLISION, VISUAL
from mover.io.export.shell import (
    GUESSED,
    HEIGHT,
    Wall,
    Walls,
    slab,
    wall_notes,
)
from mover.io.export.solids import Solid, mesh_bytes, numbers, solids_of

SLAB = 0.1  # [m], thickness of the floor
FLOOR = 20.0  # [m], its width
BASE, FLOOR_LINK = "room", "floor"


def export_urdf(finished: Finished, folder: Path, walls: Walls = "none") -> Exported:
    """Write `urdf/<id>.urdf` (a loose body each) and `urdf/room.urdf` (everything fixed).

    Args:
        finished: The result.
        folder: Gets the folder `urdf`.
        walls: Whether `room.urdf` has walls that are guessed.
    """
    solids, home = solids_of(finished.scene, Run(finished.out)), folder / "urdf"
    seen = [
        looks_of(piece, colour(index), piece.id)
        for index, piece in enumerate(finished.scene.objects)
    ]
    files = [home / "room.urdf"]
    for solid, looks in zip(solids, seen, strict=True):
        for k, hull in enumerate(solid.hulls):
            _save(home / COLLISION / f"{solid.id}_{k}.stl", mesh_bytes(hull, "stl"))
        for name, content in (item for look in looks for item in look.files(VISUAL).items()):
            _save(home / name, content)
        robot = _robot(solid.id)
        _add_link(robot, solid, looks)
        files.append(home / f"{_apart(solid.id)}.urdf")
        _save(files[-1], _text(robot))
    room, notes = _room(solids, seen), ("room.urdf holds every piece still",)
    if walls == "guess":
        shell = finished.shell()
        _add_walls(room, shell)
        notes += wall_notes(shell)
    _save(files[0], _text(room))
    return Exported(tuple(files), ("+z is up and the floor is at 0", *notes))


def _apart(name: str) -> str:
    """The file name of a piece; `room` is taken."""
    return name if name.casefold() != BASE else f"{name}_"


def _robot(name: str) -> Element:
    """The root; MuJoCo is told to leave the folders of meshes in their names."""
    robot = Element("robot", name=name)
    SubElement(SubElement(robot, "mujoco"), "compiler", strippath="false", discardvisual="false")
    return robot


def _room(solids: Sequence[Solid], seen: Sequence[Sequence[Look]]) -> Element:
    robot = _robot(BASE)
    _add_box(robot, FLOOR_LINK, (0, 0, -SLAB / 2), (FLOOR, FLOOR, SLAB))
    for solid, looks in zip(solids, seen, strict=True):
        _add_link(robot, solid, looks)
        _fix(robot, _link(solid), solid.place.tolist(), solid.yaw)
    return robot


def _add_box(robot: Element, name: str, middle: Sequence[float], size: Sequence[float]) -> None:
    """A link that is seen and collides as a box."""
    link = SubElement(robot, "link", name=name)
    for kind in ("visual", "collision"):
        shape = SubElement(link, kind)
        SubElement(shape, "origin", xyz=numbers(middle), rpy="0 0 0")
        SubElement(SubElement(shape, "geometry"), "box", size=numbers(size))


def _fix(robot: Element, link: str, place: Sequence[float], yaw: float) -> None:
    """Hold a link still on the floor."""
    joint = SubElement(robot, "joint", name=f"{link}_joint", type="fixed")
    SubElement(joint, "parent", link=FLOOR_LINK)
    SubElement(joint, "child", link=link)
    SubElement(joint, "origin", xyz=numbers(place), rpy=numbers((0, 0, yaw)))


def _add_walls(robot: Element, walls: Sequence[Wall]) -> None:
    """Boxes that stand still, named as guessed."""
    for k, wall in enumerate(walls):
        (x, z), (length, thick), yaw = slab(wall)
        _add_box(robot, f"{GUESSED}_{k}", (0, 0, HEIGHT / 2), (length, thick, HEIGHT))
        _fix(robot, f"{GUESSED}_{k}", (x, -z, 0), yaw)


def _link(solid: Solid) -> str:
    """Name of its link; `floor` and those of walls are taken, and MuJoCo keeps `world`."""
    taken = solid.id in (FLOOR_LINK, "world") or solid.id.startswith(GUESSED)
    return f"{solid.id}_" if taken else solid.id


def _add_link(robot: Element, solid: Solid, looks: Sequence[Look]) -> None:
    link = SubElement(robot, "link", name=_link(solid))
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=numbers(solid.centre.tolist()), rpy="0 0 0")
    SubElement(inertial, "mass", value=f"{solid.mass:.8g}")
    i = solid.inertia.tolist()
    moments = {"ixx": i[0][0], "iyy": i[1][1], "izz": i[2][2]}
    moments |= {"ixy": i[0][1], "ixz": i[0][2], "iyz": i[1][2]}
    SubElement(inertial, "inertia", {key: f"{value:.8g}" for key, value in moments.items()})
    for look in looks:
        visual = SubElement(link, "visual")
        mesh = SubElement(visual, "geometry")
        SubElement(mesh, "mesh", filename=f"{VISUAL}/{look.name}.obj")
        material = SubElement(visual, "material", name=look.name)
        SubElement(material, "color", rgba=numbers(look.rgba))
        if look.picture:
            SubElement(material, "texture", filename=f"{VISUAL}/{look.image}.png")
    for k in range(len(solid.hulls)):
        shape = SubElement(SubElement(link, "collision"), "geometry")
        SubElement(shape, "mesh", filename=f"{COLLISION}/{solid.id}_{k}.stl")


def _text(robot: Element) -> bytes:
    indent(robot)
    return b'<?xml version="1.0"?>\n' + tostring(robot, encoding="utf-8") + b"\n"


def _save(path: Path, content: bytes) -> None:
    with replacing(path) as part:
        part.write_bytes(content)
