"""People in MuJoCo: a mocap body for each joint, and a keyframe for each frame of the video."""

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.colours import person_colour
from mover.core.records import record
from mover.core.types import Bodies
from mover.geometry.rotations import axis_angle
from mover.io.export.finished import Finished
from mover.io.export.people import FPS, tracks_of
from mover.io.export.posed import all_angles, rows_of
from mover.io.export.skin import Skin, rest_of, skin_for
from mover.io.export.solids import AXES, floor_height, numbers

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
