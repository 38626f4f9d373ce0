"""room.xml: the room for MuJoCo, furniture as free bodies of convex pieces.

People are a mocap body for each joint, with a keyframe for each frame of the video.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.colours import colour, person_colour
from mover.core.files import replacing
from mover.core.records import record
from mover.core.run import Run
from mover.core.types import Bodies, Camera, Scene
from mover.geometry.rotations import axis_angle
from mover.io.export.finished import BodyForm, Exported, Finished
from mover.io.export.looks import Look, looks_of
from mover.io.export.people import FPS, tracks_of
from mover.io.export.posed import Skin, all_angles, rest_of, rows_of, skin_for
from mover.io.export.shell import GUESSED, HEIGHT, Wall, Walls, slab, wall_notes
from mover.io.export.solids import (
    AXES,
    FRICTION,
    Solid,
    floor_height,
    mesh_bytes,
    moved_to,
    numbers,
    solids_of,
)

INFLUENCES = 8
BODY = 22
"""Joints of the body in SMPL-X's order; then jaw, eyes, and fifteen joints of each hand."""
HANDS = 25
AWAY = -10.0  # [m], height of a person who is not seen
RADIUS = {"pelvis": 0.1, "spine": 0.11, "neck": 0.05, "head": 0.09, "hip": 0.075, "knee": 0.055}
OTHER_RADIUS, FINGER_RADIUS = 0.04, 0.009  # [m]
TIP = 0.02  # [m], length of a bone that ends in no joint


@record
class Figure:
    """One person in the simulator's axes, joint by joint."""

    person: int
    frame: Int[Tensor, " frames"]
    names: tuple[str, ...]
    places: Float[Tensor, "frames joints 3"]
    """The floor is at zero [m]."""
    turns: Float[Tensor, "frames joints 4"]
    """Quaternions (w, x, y, z) from the axes of the zero pose, +y up, +z front."""
    bones: tuple[tuple[int, tuple[float, float, float]], ...]
    """Joint, and where its bone ends in its own axes [m]."""


def figures_of(finished: Finished) -> tuple[Figure, ...] | str:
    """Everybody, or why their joints are not known."""
    skin = skin_for(finished, INFLUENCES)
    if isinstance(skin, str) or finished.bodies is None:
        return skin if isinstance(skin, str) else "the result has no bodies"
    hands = bool(all_angles(skin.motion.pose)[:, HANDS:].any())
    joints = [*range(BODY), *(range(HANDS, 55) if hands else ())]
    floor = floor_height(finished.scene)
    return tuple(
        _figure(skin, (track.person, track.rows, track.frame), joints, floor)
        for track in tracks_of(finished.bodies)
    )


def _figure(
    skin: Skin, which: tuple[int, Tensor, Tensor], joints: Sequence[int], floor: float
) -> Figure:
    """One person: number, rows and frames of their track."""
    person, rows, frame = which
    pose, model = rows_of(skin.motion.pose, rows), skin.model
    _, places = model.posed(pose)
    root = places[:, :1]
    places = (root + skin.motion.size[rows, None, None] * (places - root)).double() @ AXES.mT
    places = places - torch.tensor([0.0, 0.0, floor], dtype=torch.float64)
    names = [f"person_{person}_{model.joint_names[joint]}" for joint in joints]
    _, rest = rest_of(skin, int(rows[0]))
    size = float(skin.motion.size[rows].mean())
    return Figure(
        person, frame, tuple(names), places[:, list(joints)],
        world_turns(all_angles(pose).double(), model.parents)[:, list(joints)],
        tuple(_bones(skin, size * rest, joints)),
    )  # fmt: skip


def world_turns(
    angles: Float[Tensor, "frames joints 3"], parents: Sequence[int]
) -> Float[Tensor, "frames joints 4"]:
    """Quaternions (w, x, y, z) of all joints in a world with +z up."""
    from scipy.spatial.transform import Rotation

    turns = axis_angle(angles).unbind(1)
    world: list[Tensor] = []
    for turn, parent in zip(turns, parents, strict=True):
        world.append(turn if parent < 0 else world[parent] @ turn)
    matrices = AXES @ torch.stack(world, 1)
    flat = Rotation.from_matrix(matrices.reshape(-1, 3, 3).numpy()).as_quat()
    found = torch.from_numpy(flat).reshape(*matrices.shape[:2], 4)
    return found[..., [3, 0, 1, 2]]


def _bones(
    skin: Skin, rest: Float[Tensor, "joints 3"], joints: Sequence[int]
) -> list[tuple[int, tuple[float, float, float]]]:
    """A bone from each joint to every joint below it that is shown, in the zero pose."""
    model, found = skin.model, list[tuple[int, tuple[float, float, float]]]()
    for k, joint in enumerate(joints):
        below = [j for j in joints if model.parents[j] == joint]
        ends = [model.tpose[joint] @ (rest[j] - rest[joint]) for j in below]
        above = model.parents[joint]
        if not ends and above >= 0:
            way = model.tpose[above] @ (rest[joint] - rest[above])
            ends = [TIP * way / way.norm().clamp_min(1e-6)]
        for end in ends:
            x, y, z = end.tolist()
            found.append((k, (x, y, z)))
    return found


def add_figures(root: Element, figures: Sequence[Figure], bodies: Bodies) -> None:
    """Append mocap bodies of capsules, which touch nothing, and the keyframes that move them."""
    world = root.find("worldbody")
    assert world is not None
    for figure in figures:
        tint = numbers((*person_colour(figure.person), 1.0))
        for k, name in enumerate(figure.names):
            place, turn = figure.places[0, k].tolist(), figure.turns[0, k].tolist()
            pose = {"pos": numbers(place), "quat": numbers(turn)}
            body = SubElement(world, "body", pose, name=name, mocap="true")
            for end in (end for joint, end in figure.bones if joint == k):
                shape = {"fromto": numbers((0, 0, 0, *end)), "size": f"{_radius(name):g}"}
                SubElement(body, "geom", {"class": "person", "rgba": tint}, **shape)
    keys, first, fps = SubElement(root, "keyframe"), int(bodies.frame.min()), bodies.fps or FPS
    for frame in bodies.frame.unique().tolist():
        places, turns = zip(*(_at(figure, frame) for figure in figures), strict=True)
        key = {"name": f"frame_{frame}", "time": f"{(frame - first) / fps:.6g}"}
        key["mpos"] = _few(torch.cat(places))
        key["mquat"] = _few(torch.cat(turns))
        SubElement(keys, "key", key)


def _radius(name: str) -> float:
    """Thickness of a bone, by its joint [m]."""
    if any(finger in name for finger in ("index", "middle", "ring", "pinky", "thumb")):
        return FINGER_RADIUS
    return next((size for part, size in RADIUS.items() if part in name), OTHER_RADIUS)


def _at(figure: Figure, frame: int) -> tuple[Tensor, Tensor]:
    """Joints in a frame; those of the nearest frame, far below the floor, where they are unseen."""
    away = (figure.frame - frame).abs()
    row = int(away.argmin())
    down = torch.tensor([0.0, 0.0, AWAY if int(away[row]) else 0.0], dtype=torch.float64)
    return figure.places[row] + down, figure.turns[row]


def _few(values: Tensor) -> str:
    """Decimals to a tenth of a millimetre."""
    return " ".join(f"{value:.4f}".rstrip("0").rstrip(".") for value in values.reshape(-1).tolist())


# The room.


STEP = 0.002  # [s]
VISUAL, COLLISION = "meshes/visual", "meshes/collision"
RESERVED = "world"


def export_mjcf(
    finished: Finished, folder: Path, body: BodyForm = "auto", walls: Walls = "none"
) -> Exported:
    """Write `mjcf/room.xml` and its meshes.

    Args:
        finished: The result.
        folder: Gets the folder `mjcf`.
        body: none: without people; else they are mocap bodies where their joints are known.
        walls: Whether walls are guessed from furniture and people.
    """
    solids = solids_of(finished.scene, Run(finished.out))
    root, meshes = mjcf_of(finished.scene, solids)
    notes = ["+z is up and the floor is at 0", ", ".join(f"{s.id} {s.mass:.0f} kg" for s in solids)]
    notes.append(_add_people(root, finished) if body != "none" else "no people")
    if any(piece.segments for piece in finished.scene.objects):
        add_stays(root, finished, solids)
        notes.append("qpos of each keyframe puts the furniture where it then stands")
    if walls == "guess":
        shell = finished.shell()
        add_walls(root, shell)
        notes += wall_notes(shell)
    home = folder / "mjcf"
    for name, content in meshes.items():
        with replacing(home / name) as part:
            part.write_bytes(content)
    with replacing(home / "room.xml") as part:
        part.write_text(text_of(root))
    return Exported((home / "room.xml",), tuple(notes))


def _add_people(root: Element, finished: Finished) -> str:
    """Append the people's skeletons; what there is to say about them."""
    figures = figures_of(finished)
    if isinstance(figures, str):
        return f"no people: {figures}"
    assert finished.bodies is not None
    add_figures(root, figures, finished.bodies)
    count = len(finished.bodies.frame.unique())
    return (
        f"people are mocap bodies that touch nothing; {count} keyframes, frame_<number>, move them"
    )


def add_stays(root: Element, finished: Finished, solids: Sequence[Solid]) -> None:
    """Furniture where it stands, in the keyframes of people, else in one for each change."""
    scene, bodies = finished.scene, finished.bodies
    keys = root.find("keyframe")
    if keys is None:
        keys = SubElement(root, "keyframe")
        first, fps = 0, FPS
        if bodies is not None:
            first, fps = int(bodies.frame.min()), bodies.fps or FPS
        for frame in sorted({s.frame for piece in scene.objects for s in piece.segments}):
            time = f"{max(0.0, (frame - first) / fps):.6g}"
            SubElement(keys, "key", name=f"frame_{frame}", time=time)
    pairs = list(zip(scene.objects, solids, strict=True))
    for key in keys:
        frame = int(key.attrib["name"].removeprefix("frame_"))
        stands = [moved_to(solid, piece, frame) for piece, solid in pairs if solid.free]
        key.set("qpos", numbers(value for solid in stands for value in pose_of(solid)))


def pose_of(solid: Solid) -> tuple[float, ...]:
    """Place [m] and quaternion (w, x, y, z), as a free joint has them."""
    half = torch.tensor(solid.yaw / 2, dtype=torch.float64)
    return (*solid.place.tolist(), float(half.cos()), 0.0, 0.0, float(half.sin()))


def add_walls(root: Element, walls: Sequence[Wall]) -> None:
    """Boxes that stand still, named as guessed."""
    world = root.find("worldbody")
    assert world is not None
    for k, wall in enumerate(walls):
        (x, z), (length, thick), yaw = slab(wall)
        half = {"size": numbers((length / 2, thick / 2, HEIGHT / 2))}
        place = {"pos": numbers((x, -z, HEIGHT / 2)), "euler": numbers((0, 0, yaw))}
        look = {"type": "box", "rgba": "0.9 0.89 0.86 0.4", "friction": numbers(FRICTION)}
        SubElement(world, "geom", {"name": f"{GUESSED}_{k}", **half, **place, **look})


def text_of(root: Element) -> str:
    """The model as a file has it."""
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def mjcf_of(
    scene: Scene, solids: Sequence[Solid], looks: bool = True
) -> tuple[Element, dict[str, bytes]]:
    """The model, and its mesh files by name.

    Args:
        scene: Gives the camera and the floor.
        solids: Its furniture.
        looks: Whether the meshes that are seen are part of it, beside those that collide.
    """
    root = Element("mujoco", model="room")
    SubElement(root, "compiler", angle="radian", autolimits="true")
    option = SubElement(root, "option", timestep=f"{STEP}", integrator="implicitfast")
    option.set("cone", "elliptic")
    SubElement(option, "flag", multiccd="enable")
    _add_defaults(root)
    asset, world = SubElement(root, "asset"), SubElement(root, "worldbody")
    lamp = {"ambient": "0.4 0.4 0.4", "diffuse": "0.5 0.5 0.5"}
    SubElement(SubElement(root, "visual"), "headlight", lamp)
    SubElement(world, "light", pos="0 0 4", dir="0 0 -1", diffuse="0.5 0.5 0.5")
    _add_camera(world, scene.camera, floor_height(scene))
    size = _reach(solids)
    ground = {"name": "ground", "type": "plane", "size": f"{size:g} {size:g} 0.1"}
    SubElement(world, "geom", ground, rgba="0.86 0.85 0.83 1", friction=numbers(FRICTION))
    meshes: dict[str, bytes] = {}
    for index, (piece, solid) in enumerate(zip(scene.objects, solids, strict=True)):
        body = _add_solid(world, solid)
        meshes |= _add_pieces(asset, body, solid)
        if looks:
            meshes |= _add_looks(asset, body, looks_of(piece, colour(index), body_name(solid)))
    return root, meshes


def _reach(solids: Sequence[Solid]) -> float:
    """Half of the width of the floor that is drawn [m]."""
    far = max((float(s.place[:2].abs().max()) for s in solids), default=0.0)
    return far + 5.0


def _add_defaults(root: Element) -> None:
    default = SubElement(root, "default")
    collide = SubElement(default, "default", {"class": "collide"})
    SubElement(collide, "geom", type="mesh", group="3", friction=numbers(FRICTION), condim="4")
    person = SubElement(default, "default", {"class": "person"})
    SubElement(person, "geom", type="capsule", group="1", contype="0", conaffinity="0", mass="0")
    look = SubElement(default, "default", {"class": "look"})
    SubElement(look, "geom", type="mesh", group="2", contype="0", conaffinity="0", mass="0")


def _add_camera(world: Element, camera: Camera, floor: float) -> None:
    """At the origin of scene.json; MuJoCo's cameras look along -z with +y up."""
    turn = AXES @ camera.R_cam_world.detach().cpu().double().mT
    x, y = turn[:, 0].tolist(), (-turn[:, 1]).tolist()
    up = 2 * math.degrees(math.atan(camera.height / (2 * float(camera.K[1, 1]))))
    view = {"name": "camera", "pos": numbers((0, 0, -floor)), "xyaxes": numbers((*x, *y))}
    SubElement(world, "camera", view, fovy=f"{up:.8g}")


def body_name(solid: Solid) -> str:
    """Its id, but for the one name that MuJoCo keeps for itself."""
    return solid.id if solid.id != RESERVED else f"{solid.id}_"


def _add_solid(world: Element, solid: Solid) -> Element:
    """A body with its mass, and a joint where it is free."""
    name = body_name(solid)
    pose = pose_of(solid)
    place = {"name": name, "pos": numbers(pose[:3]), "quat": numbers(pose[3:])}
    body = SubElement(world, "body", place)
    if solid.free:
        SubElement(body, "freejoint", name=name)
    i = solid.inertia
    full = (i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
    mass = {"pos": numbers(solid.centre.tolist()), "mass": f"{solid.mass:.8g}"}
    SubElement(body, "inertial", mass, fullinertia=numbers([float(v) for v in full]))
    return body


def _add_pieces(asset: Element, body: Element, solid: Solid) -> dict[str, bytes]:
    """What collides; its mesh files."""
    files: dict[str, bytes] = {}
    for k, hull in enumerate(solid.hulls):
        part = f"{body_name(solid)}_{k}"
        file = f"{COLLISION}/{part}.obj"
        files[file] = mesh_bytes(hull, "obj")
        SubElement(asset, "mesh", name=part, file=file, inertia="shell")
        SubElement(body, "geom", {"class": "collide", "mesh": part})
    return files


def _add_looks(asset: Element, body: Element, looks: Sequence[Look]) -> dict[str, bytes]:
    """What is seen, with materials and pictures; its files."""
    files: dict[str, bytes] = {}
    for look in looks:
        files |= look.files(VISUAL)
        mesh = {"name": look.name, "file": f"{VISUAL}/{look.name}.obj", "inertia": "shell"}
        SubElement(asset, "mesh", mesh)
        material = {"name": look.name, "rgba": numbers(look.rgba)}
        if look.picture:
            if asset.find(f"texture[@name='{look.image}']") is None:
                picture = {"name": look.image, "file": f"{VISUAL}/{look.image}.png"}
                SubElement(asset, "texture", {"type": "2d", **picture})
            material["texture"] = look.image
        SubElement(asset, "material", material)
        geom = {"class": "look", "mesh": look.name, "material": look.name}
        SubElement(body, "geom", geom)
    return files
