"""room.xml: the room for MuJoCo, furniture as free bodies of convex parts.

People are a mocap body for each joint, with a keyframe for each frame of the video. Objects are
drawn in one colour: textures are in scene.glb and in USD.
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
from mover.core.records import record, rows_of
from mover.core.run import Run
from mover.core.types import Bodies, Camera, Mesh, Scene, SceneObject
from mover.geometry.rotations import axis_angle
from mover.io.export.finished import BodyForm, Exported, Finished
from mover.io.export.people import FPS, Track, tracks_of
from mover.io.export.posed import Skinned, all_angles, rest_of, skin_for
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

STEP = 0.002  # [s]
VISUAL, COLLISION = "meshes/visual", "meshes/collision"
RESERVED = "world"
INFLUENCES = 8
BODY = 22
"""Joints of the body in SMPL-X's order; then jaw, eyes, and fifteen joints of each hand."""
HANDS = 25
AWAY = -10.0  # [m], height of a person who is not seen
RADIUS = {
    "index": 0.009, "middle": 0.009, "ring": 0.009, "pinky": 0.009, "thumb": 0.009,
    "pelvis": 0.1, "spine": 0.11, "neck": 0.05, "head": 0.09, "hip": 0.075, "knee": 0.055,
}  # fmt: skip
"""Of the bone at a joint whose name has this in it [m]."""
OTHER_RADIUS = 0.04  # [m]
TIP = 0.02  # [m], length of a bone that ends in no joint


def export_mjcf(finished: Finished, folder: Path, body: BodyForm = "auto") -> Exported:
    """Write `mjcf/room.xml` and its meshes.

    Args:
        finished: The result.
        folder: Gets the folder `mjcf`.
        body: none: without people; else they are mocap bodies where their joints are known.
    """
    solids = solids_of(finished.scene, Run(finished.out))
    root, meshes = mjcf_of(finished.scene, solids)
    notes = ["+z is up and the floor is at 0", ", ".join(f"{s.id} {s.mass:.0f} kg" for s in solids)]
    figures = "no people" if body == "none" else figures_of(finished)
    if isinstance(figures, str):
        notes.append("no people" if body == "none" else f"no people: {figures}")
    else:
        assert finished.bodies is not None
        count = _add_figures(root, figures, finished.bodies)
        how = f"{count} keyframes, frame_<number>, move them"
        notes.append(f"people are mocap bodies that touch nothing; {how}")
    if any(item.segments for item in finished.scene.objects):
        _add_stays(root, finished, solids)
        notes.append("qpos of each keyframe puts the furniture where it then stands")
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
    default = SubElement(root, "default")
    unseen = {"contype": "0", "conaffinity": "0", "mass": "0"}
    for kind, geom in {
        "collide": {"type": "mesh", "group": "3", "friction": numbers(FRICTION), "condim": "4"},
        "person": {"type": "capsule", "group": "1", **unseen},
        "look": {"type": "mesh", "group": "2", **unseen},
    }.items():
        SubElement(SubElement(default, "default", {"class": kind}), "geom", geom)
    asset, world = SubElement(root, "asset"), SubElement(root, "worldbody")
    lamp = {"ambient": "0.4 0.4 0.4", "diffuse": "0.5 0.5 0.5"}
    SubElement(SubElement(root, "visual"), "headlight", lamp)
    SubElement(world, "light", pos="0 0 4", dir="0 0 -1", diffuse="0.5 0.5 0.5")
    _add_camera(world, scene.camera, floor_height(scene))
    size = 5.0 + max((float(s.place[:2].abs().max()) for s in solids), default=0.0)
    ground = {"name": "ground", "type": "plane", "size": f"{size:g} {size:g} 0.1"}
    SubElement(world, "geom", ground, rgba="0.86 0.85 0.83 1", friction=numbers(FRICTION))
    meshes: dict[str, bytes] = {}
    for index, (item, solid) in enumerate(zip(scene.objects, solids, strict=True)):
        body, name = _add_solid(world, solid), body_name(solid)
        shapes = [(f"{COLLISION}/{name}_{k}.obj", hull) for k, hull in enumerate(solid.hulls)]
        drawn = [(f"{VISUAL}/{name}.obj", _seen(item))] if looks else []
        for file, mesh in [*shapes, *drawn]:
            meshes[file] = mesh_bytes(mesh)
            part = file.removesuffix(".obj").replace("/", "_")
            SubElement(asset, "mesh", name=part, file=file, inertia="shell")
            geom = {"class": "collide", "mesh": part}
            if file.startswith(VISUAL):
                geom = {"class": "look", "mesh": part, "rgba": numbers((*colour(index), 1.0))}
            SubElement(body, "geom", geom)
    return root, meshes


def _seen(item: SceneObject) -> Mesh:
    """The mesh of an object in its own axes, +z up, at its size."""
    stretch = AXES * item.scale.detach().cpu().double()
    return Mesh(item.mesh.verts.detach().cpu().double() @ stretch.mT, item.mesh.faces.cpu())


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


def _pose_of(solid: Solid) -> tuple[float, ...]:
    """Position [m] and quaternion (w, x, y, z), as a free joint has them."""
    half = torch.tensor(solid.yaw / 2, dtype=torch.float64)
    return (*solid.place.tolist(), float(half.cos()), 0.0, 0.0, float(half.sin()))


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
    """Furniture where it stands, in the keyframes of people, else in one for each change."""
    scene, bodies = finished.scene, finished.bodies
    keys = root.find("keyframe")
    if keys is None:
        keys = SubElement(root, "keyframe")
        first, fps = 0, FPS
        if bodies is not None:
            first, fps = int(bodies.frame.min()), bodies.fps or FPS
        for frame in sorted({s.frame for item in scene.objects for s in item.segments}):
            time = f"{max(0.0, (frame - first) / fps):.6g}"
            SubElement(keys, "key", name=f"frame_{frame}", time=time)
    pairs = list(zip(scene.objects, solids, strict=True))
    for key in keys:
        frame = int(key.attrib["name"].removeprefix("frame_"))
        stands = [moved_to(solid, item, frame) for item, solid in pairs if solid.free]
        key.set("qpos", numbers(value for solid in stands for value in _pose_of(solid)))


# People, joint by joint.


@record
class Figure:
    """One person in the simulator's axes."""

    person: int
    frame: Int[Tensor, " frames"]
    names: tuple[str, ...]
    places: Float[Tensor, "frames joints 3"]
    """The floor is at zero [m]."""
    turns: Float[Tensor, "frames joints 4"]
    """Quaternions (w, x, y, z) from the axes of the zero pose, +y up, +z front."""
    bones: tuple[tuple[int, tuple[float, ...]], ...]
    """Joint, and where its bone ends in its own axes [m]."""


def figures_of(finished: Finished) -> tuple[Figure, ...] | str:
    """All people, or why their joints are not known."""
    skin = skin_for(finished, INFLUENCES)
    if isinstance(skin, str) or finished.bodies is None:
        return skin if isinstance(skin, str) else "the result has no bodies"
    hands = bool(all_angles(skin.motion.pose)[:, HANDS:].any())
    joints = [*range(BODY), *(range(HANDS, 55) if hands else ())]
    floor = floor_height(finished.scene)
    return tuple(_figure(skin, track, joints, floor) for track in tracks_of(finished.bodies))


def _figure(skin: Skinned, track: Track, joints: list[int], floor: float) -> Figure:
    from scipy.spatial.transform import Rotation

    pose, model = rows_of(skin.motion.pose, track.rows), skin.model
    size = skin.motion.size[track.rows]
    _, places = model.posed(pose)
    root = places[:, :1]
    places = (root + size[:, None, None] * (places - root)).double() @ AXES.mT
    places = places - torch.tensor([0.0, 0.0, floor], dtype=torch.float64)
    world: list[Tensor] = []
    for turn, parent in zip(axis_angle(all_angles(pose).double()).unbind(1), model.parents,
                            strict=True):  # fmt: skip
        world.append(turn if parent < 0 else world[parent] @ turn)
    turns = AXES @ torch.stack([world[joint] for joint in joints], 1)
    quats = torch.from_numpy(Rotation.from_matrix(turns.flatten(0, 1).numpy()).as_quat())
    _, rest = rest_of(skin, int(track.rows[0]))
    return Figure(
        track.person, track.frame,
        tuple(f"person_{track.person}_{model.joint_names[joint]}" for joint in joints),
        places[:, joints], quats[:, [3, 0, 1, 2]].reshape(*turns.shape[:2], 4),
        tuple(_bones(skin, float(size.mean()) * rest, joints)),
    )  # fmt: skip


def _bones(
    skin: Skinned, rest: Float[Tensor, "joints 3"], joints: Sequence[int]
) -> list[tuple[int, tuple[float, ...]]]:
    """A bone from each joint to every joint below it that is shown, in the zero pose."""
    model, found = skin.model, list[tuple[int, tuple[float, ...]]]()
    for k, joint in enumerate(joints):
        below = [j for j in joints if model.parents[j] == joint]
        ends = [model.tpose[joint] @ (rest[j] - rest[joint]) for j in below]
        above = model.parents[joint]
        if not ends and above >= 0:
            way = model.tpose[above] @ (rest[joint] - rest[above])
            ends = [TIP * way / way.norm().clamp_min(1e-6)]
        found += [(k, tuple(end.tolist())) for end in ends]
    return found


def _add_figures(root: Element, figures: Sequence[Figure], bodies: Bodies) -> int:
    """Append mocap bodies of capsules and the keyframes that move them; how many those are."""
    world = root.find("worldbody")
    assert world is not None
    for figure in figures:
        tint = numbers((*person_colour(figure.person), 1.0))
        for k, name in enumerate(figure.names):
            pose = {"pos": numbers(figure.places[0, k].tolist())}
            pose["quat"] = numbers(figure.turns[0, k].tolist())
            body = SubElement(world, "body", pose, name=name, mocap="true")
            size = next((size for part, size in RADIUS.items() if part in name), OTHER_RADIUS)
            for end in (end for joint, end in figure.bones if joint == k):
                shape = {"fromto": numbers((0, 0, 0, *end)), "size": f"{size:g}"}
                SubElement(body, "geom", {"class": "person", "rgba": tint}, **shape)
    keys, first, fps = SubElement(root, "keyframe"), int(bodies.frame.min()), bodies.fps or FPS
    frames = bodies.frame.unique().tolist()
    for frame in frames:
        places, turns = zip(*(_at(figure, frame) for figure in figures), strict=True)
        key = {"name": f"frame_{frame}", "time": f"{(frame - first) / fps:.6g}"}
        for name, values in (("mpos", torch.cat(places)), ("mquat", torch.cat(turns))):
            texts = (f"{value:.4f}" for value in values.flatten().tolist())
            key[name] = " ".join(text.rstrip("0").rstrip(".") for text in texts)
        SubElement(keys, "key", key)
    return len(frames)


def _at(figure: Figure, frame: int) -> tuple[Tensor, Tensor]:
    """Joints in a frame; those of the nearest frame, far below the floor, where they are unseen."""
    away = (figure.frame - frame).abs()
    row = int(away.argmin())
    down = torch.tensor([0.0, 0.0, AWAY if int(away[row]) else 0.0], dtype=torch.float64)
    return figure.places[row] + down, figure.turns[row]
