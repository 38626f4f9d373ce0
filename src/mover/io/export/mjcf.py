"""room.xml: the room for MuJoCo, furniture as free bodies of convex parts, without people.

Objects are drawn in one colour: textures are in scene.glb and in USD.
"""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import torch

from mover.core.colours import colour
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.types import Mesh, Scene
from mover.io.export.finished import Exported, Finished
from mover.io.export.solids import AXES, FRICTION, Solid, floor_height, moved_to, solids_of

STEP = 0.002  # [s]
VISUAL, COLLISION = "meshes/visual", "meshes/collision"
RESERVED = "world"


def export_mjcf(finished: Finished, folder: Path) -> Exported:
    """Write `mjcf/room.xml` and its meshes."""
    solids = solids_of(finished.scene, Run(finished.out))
    root, meshes = mjcf_of(finished.scene, solids)
    masses = ", ".join(f"{solid.id} {float(f'{solid.mass:.2g}'):g} kg" for solid in solids)
    notes = ["+z is up and the floor is at 0", masses, "no people"]
    if any(item.segments for item in finished.scene.objects):
        _add_stays(root, finished, solids)
        notes.append("qpos of a keyframe, frame_<number>, puts furniture where it then stands")
    home = folder / "mjcf"
    for name, content in {**meshes, "room.xml": text_of(root).encode()}.items():
        with replacing(home / name) as part:
            part.write_bytes(content)
    return Exported((home / "room.xml",), tuple(notes))


def text_of(root: Element) -> str:
    """The model as a file has it."""
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def mjcf_of(
    scene: Scene, solids: Sequence[Solid], looks: bool = True
) -> tuple[Element, dict[str, bytes]]:
    """The model, and its mesh files by name; with `looks` also the meshes that are only seen."""
    import trimesh
    from trimesh.exchange.obj import export_obj

    root = Element("mujoco", model="room")
    SubElement(root, "compiler", angle="radian", autolimits="true")
    option = SubElement(root, "option", timestep=f"{STEP}", integrator="implicitfast")
    option.set("cone", "elliptic")
    SubElement(option, "flag", multiccd="enable")
    default = SubElement(root, "default")
    unseen = {"contype": "0", "conaffinity": "0", "mass": "0"}
    for kind, geom in {
        "collide": {"type": "mesh", "group": "3", "friction": numbers(FRICTION), "condim": "4"},
        "look": {"type": "mesh", "group": "2", **unseen},
    }.items():
        SubElement(SubElement(default, "default", {"class": kind}), "geom", geom)
    asset, world = SubElement(root, "asset"), SubElement(root, "worldbody")
    lamp = {"ambient": "0.4 0.4 0.4", "diffuse": "0.5 0.5 0.5"}
    SubElement(SubElement(root, "visual"), "headlight", lamp)
    SubElement(world, "light", pos="0 0 4", dir="0 0 -1", diffuse="0.5 0.5 0.5")
    camera = scene.camera  # MuJoCo's cameras look along -z with +y up
    turn = AXES @ camera.R_cam_world.detach().cpu().double().mT
    axes = numbers((*turn[:, 0].tolist(), *(-turn[:, 1]).tolist()))
    lens = 2 * math.degrees(math.atan(camera.height / (2 * float(camera.K[1, 1]))))
    eye = {"name": "camera", "pos": numbers((0, 0, -floor_height(scene))), "xyaxes": axes}
    SubElement(world, "camera", eye, fovy=f"{lens:.8g}")
    size = 5.0 + max((float(s.position[:2].abs().max()) for s in solids), default=0.0)
    ground = {"name": "ground", "type": "plane", "size": f"{size:g} {size:g} 0.1"}
    SubElement(world, "geom", ground, rgba="0.86 0.85 0.83 1", friction=numbers(FRICTION))
    meshes: dict[str, bytes] = {}
    for index, (item, solid) in enumerate(zip(scene.objects, solids, strict=True)):
        body, name = _add_solid(world, solid), body_name(solid)
        shapes = [(f"{COLLISION}/{name}_{k}.obj", hull) for k, hull in enumerate(solid.hulls)]
        stretch = AXES * item.scale.detach().cpu().double()
        shape = Mesh(item.mesh.verts.detach().cpu().double() @ stretch.mT, item.mesh.faces.cpu())
        drawn = [(f"{VISUAL}/{name}.obj", shape)] if looks else []
        for file, mesh in [*shapes, *drawn]:
            drawing = trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), process=False)
            meshes[file] = export_obj(drawing, include_normals=False, header="").encode()
            part = file.removesuffix(".obj").replace("/", "_")
            SubElement(asset, "mesh", name=part, file=file, inertia="shell")
            geom = {"class": "collide", "mesh": part}
            if file.startswith(VISUAL):
                geom = {"class": "look", "mesh": part, "rgba": numbers((*colour(index), 1.0))}
            SubElement(body, "geom", geom)
    return root, meshes


def numbers(values: Iterable[float]) -> str:
    """Decimals with a space between them."""
    return " ".join(f"{value:.8g}" for value in values)


def body_name(solid: Solid) -> str:
    """Its id, but for the one name that MuJoCo keeps for itself."""
    return solid.id if solid.id != RESERVED else f"{solid.id}_"


def _pose_of(solid: Solid) -> tuple[float, ...]:
    """Position [m] and quaternion (w, x, y, z), as a free joint has them."""
    half = torch.tensor(solid.yaw / 2, dtype=torch.float64)
    return (*solid.position.tolist(), float(half.cos()), 0.0, 0.0, float(half.sin()))


def _add_solid(world: Element, solid: Solid) -> Element:
    """A body with its mass, and a joint where it is free."""
    name, pose = body_name(solid), _pose_of(solid)
    body = SubElement(world, "body", name=name, pos=numbers(pose[:3]), quat=numbers(pose[3:]))
    if solid.free:
        SubElement(body, "freejoint", name=name)
    i = solid.inertia
    full = (i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
    mass = {"pos": numbers(solid.centre.tolist()), "mass": f"{solid.mass:.8g}"}
    SubElement(body, "inertial", mass, fullinertia=numbers([float(v) for v in full]))
    return body


def _add_stays(root: Element, finished: Finished, solids: Sequence[Solid]) -> None:
    """A keyframe for each change, with the furniture where it then stands."""
    keys, objects = SubElement(root, "keyframe"), finished.scene.objects
    first, fps = finished.clock
    for frame in sorted({s.frame for item in objects for s in item.segments}):
        pairs = zip(objects, solids, strict=True)
        stands = [moved_to(solid, item, frame) for item, solid in pairs if solid.free]
        key = {"name": f"frame_{frame}", "time": f"{max(0.0, (frame - first) / fps):.6g}"}
        key["qpos"] = numbers(value for solid in stands for value in _pose_of(solid))
        SubElement(keys, "key", key)
