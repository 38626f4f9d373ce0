"""Clips and terrain for tools that carry people's motion over to humanoid robots.

Clips have a steady rate in a world with +z up and the floor at 0: readers of the humanoid chain
take what they get as 30 frames a second, whatever the file says, and know no gaps. Each span in
which a person is seen becomes a clip, resampled between the frames.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.skeleton import BODY, JOINTS
from mover.bodies.skinning import SkinnedBody, zero_pose
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.records import record
from mover.core.run import Run
from mover.core.types import Bodies, BodyPose, Mesh
from mover.geometry.rotations import axis_angle, rotation_vectors
from mover.io.export.finished import Exported, Finished
from mover.io.export.people import Track, seen_from_to, tracks_of
from mover.io.export.posed import (
    Motion,
    all_angles,
    motion_of,
    pelvis_of,
    rows_of,
    skin_of,
)
from mover.io.export.solids import AXES, Solid, floor_height, mesh_bytes, numbers, solids_of
from mover.io.files.npz import write_npz

RATE = 30.0  # [1/s], what GMR and Holosoma take every clip for
PELVIS = (0.003, -0.351, 0.012)
"""Of SMPL-X's mean shape in its own axes [m]: `trans` counts from there."""
MEAN_HEIGHT, HEIGHT_STEP = 1.66, 0.1
"""[m], of SMPL-X's mean shape, and for one unit of its first shape coefficient, as GMR has it."""
BETAS = 16  # shape coefficients of AMASS


@record
class Clip:
    """One person while they are seen."""

    name: str
    time: Float[Tensor, " steps"]
    """Since the first frame of the file [s]."""
    joints: Float[Tensor, "steps joints 3"]
    """Of `JOINTS` [m], NaN where the body has no such joint."""
    height: float
    """Of the person standing straight [m]."""


@record
class PosedClip:
    """The same as parameters of SMPL-X."""

    clip: Clip
    angles: Float[Tensor, "steps 55 3"]
    trans: Float[Tensor, "steps 3"]
    betas: Float[Tensor, " betas"]
    gender: str
    exact: bool
    """Whether the result's bodies are SMPL-X's own; else only angles, height and pelvis agree."""


def clips_of(finished: Finished) -> tuple[Clip, ...] | str:
    """Everybody's joints, or why they are not known."""
    bodies = finished.bodies
    if bodies is None:
        return "the result has no bodies"
    if bodies.joints is None or not set(BODY) <= set(bodies.joint_names):
        return "the result's bodies have no joints of the names that SMPL-X gives them"
    floor = floor_height(finished.scene)
    known = [bodies.joint_names.index(n) if n in bodies.joint_names else -1 for n in JOINTS]
    places = bodies.joints.double()[:, known] @ AXES.mT
    places = places - torch.tensor([0.0, 0.0, floor], dtype=torch.float64)
    places[:, torch.tensor(known) < 0] = torch.nan
    motion = motion_of(finished)
    found: list[Clip] = []
    for track, name, time in _spans(bodies):
        rows = places[track.rows].reshape(len(track.rows), -1).numpy()
        joints = torch.from_numpy(_between(rows, track.time, time)).reshape(len(time), -1, 3)
        height = _height(bodies, motion, track)
        found.append(Clip(name, time, joints, height))
    return tuple(found)


def posed_clips_of(finished: Finished) -> tuple[PosedClip, ...] | str:
    """Everybody's parameters, or why they are not known."""
    motion, clips = motion_of(finished), clips_of(finished)
    if isinstance(motion, str) or isinstance(clips, str):
        return motion if isinstance(motion, str) else str(clips)
    assert finished.bodies is not None
    spans = _spans(finished.bodies)
    return tuple(
        _posed(motion, track, clip) for clip, (track, _, _) in zip(clips, spans, strict=True)
    )


def _spans(bodies: Bodies) -> list[tuple[Track, str, Float[Tensor, " steps"]]]:
    """Track, name of the clip and its moments, for every span in which somebody is seen."""
    found: list[tuple[Track, str, Tensor]] = []
    for track in tracks_of(bodies):
        spans = seen_from_to(track)
        for k, (start, end) in enumerate(spans):
            name = f"person_{track.person}" + (f"_{k}" if len(spans) > 1 else "")
            steps = max(1, int((end - start) * RATE + 1e-6) + 1)
            time = start + torch.arange(steps, dtype=torch.float64) / RATE
            found.append((track, name, time))
    return found


def _between(
    rows: NDArray[Any], known: Float[Tensor, " rows"], asked: Float[Tensor, " steps"]
) -> NDArray[np.float64]:
    """Values on straight lines between the rows."""
    columns = [np.interp(asked.numpy(), known.numpy(), column) for column in rows.T]
    return np.stack(columns, -1)


def _turned_between(
    vectors: Float[Tensor, "rows joints 3"],
    known: Float[Tensor, " rows"],
    asked: Float[Tensor, " steps"],
) -> Float[Tensor, "steps joints 3"]:
    """Axis-angle vectors on the shortest ways between the rows."""
    from scipy.spatial.transform import Rotation, Slerp

    if len(known) == 1:
        return vectors.double().expand(len(asked), -1, -1)
    times = np.clip(asked.numpy(), float(known[0]), float(known[-1]))
    flat = vectors.double().numpy()
    joints = [
        Slerp(known.numpy(), Rotation.from_rotvec(flat[:, k]))(times).as_rotvec()
        for k in range(flat.shape[1])
    ]
    return torch.from_numpy(np.stack(joints, 1))


def _height(bodies: Bodies, motion: Motion | str, track: Track) -> float:
    """Of the body in its zero pose at its size; of the tallest frame where that is not known."""
    if not isinstance(motion, str):
        model, pose = skin_of(motion.pose, bodies), rows_of(motion.pose, track.rows[:1])
        if model is not None:
            return _standing(model, pose) * float(motion.size[track.rows].mean())
    verts = bodies.verts[track.rows][..., 1]
    return float((verts.amax(1) - verts.amin(1)).max())


def _standing(model: SkinnedBody, pose: BodyPose) -> float:
    verts, _ = model.posed(dataclasses.replace(zero_pose(1, model), betas=pose.betas))
    return float(verts[..., 1].max() - verts[..., 1].min())


def _posed(motion: Motion, track: Track, clip: Clip) -> PosedClip:
    pose = rows_of(motion.pose, track.rows)
    angles = _turned_between(all_angles(pose), track.time, clip.time)
    turned = rotation_vectors(AXES @ axis_angle(angles[:, 0]))
    angles = torch.cat([turned[:, None], angles[:, 1:]], 1)
    exact = pose.model == "smplx"
    pelvis = clip.joints[:, 0]
    betas = torch.zeros(max(BETAS, pose.betas.shape[1] if exact else 0), dtype=torch.float64)
    if exact:
        betas[: pose.betas.shape[1]] = pose.betas.double().mean(0)
        pelvis = pelvis - pelvis_of(pose)[:1].double()
    else:
        betas[0] = (clip.height - MEAN_HEIGHT) / HEIGHT_STEP
        pelvis = pelvis - torch.tensor(PELVIS, dtype=torch.float64)
    return PosedClip(clip, angles, pelvis, betas, pose.gender, exact)


# The files.


MOCAP_STEPS = 4  # Holosoma reads every fourth row of a climb's .npy, which has 120 a second
FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")


def _mocap_joints() -> tuple[str, ...]:
    """Our joint for each of the 53 of Holosoma's `mocap` layout, in its order."""
    names = ["pelvis", "spine1", "spine2", "neck", "head"]
    for side in ("left", "right"):
        names += [f"{side}_{part}" for part in ("collar", "shoulder", "elbow", "wrist")]
        names += [f"{side}_{finger.lower()}{k}" for finger in FINGERS for k in (1, 2, 3)]
    for side in ("left", "right"):
        names += [f"{side}_{part}" for part in ("hip", "knee", "ankle", "foot")]
    return (*names, "left_foot", "right_foot")


MOCAP = _mocap_joints()


def export_gmr(finished: Finished, folder: Path) -> Exported:
    """Write `gmr/<person>.npz`, as GMR reads SMPL-X motions.

    Raises:
        InputError: If the parameters of the bodies are not known.
    """
    clips, files = _all_posed(finished, "gmr"), list[Path]()
    for posed in clips:
        files.append(folder / "gmr" / f"{posed.clip.name}.npz")
        write_npz(_smplx(posed), files[-1])
    return Exported(tuple(files), _notes(clips))


def export_amass(finished: Finished, folder: Path) -> Exported:
    """Write `amass/<person>_stageii.npz` with all keys of AMASS' SMPL-X files but the markers'.

    Raises:
        InputError: If the parameters of the bodies are not known.
    """
    clips, files = _all_posed(finished, "amass"), list[Path]()
    for posed in clips:
        whole = posed.angles.reshape(len(posed.angles), -1).float().numpy()
        arrays = {
            **_smplx(posed),
            "surface_model_type": np.array("smplx"),
            "mocap_time_length": np.array(len(whole) / RATE),
            "poses": whole,
            "num_betas": np.array(len(posed.betas)),
            "pose_hand": whole[:, 75:],
            "pose_jaw": whole[:, 66:69],
            "pose_eye": whole[:, 69:75],
        }
        files.append(folder / "amass" / f"{posed.clip.name}_stageii.npz")
        write_npz(arrays, files[-1])
    return Exported(tuple(files), _notes(clips))


def _all_posed(finished: Finished, name: str) -> tuple[PosedClip, ...]:
    clips = posed_clips_of(finished)
    if isinstance(clips, str):
        raise InputError(f"--to {name}: {clips}")
    return clips


def _smplx(posed: PosedClip) -> dict[str, NDArray[Any]]:
    return {
        "gender": np.array(posed.gender),
        "mocap_frame_rate": np.array(RATE),
        "trans": posed.trans.float().numpy(),
        "root_orient": posed.angles[:, 0].float().numpy(),
        "pose_body": posed.angles[:, 1:22].reshape(len(posed.angles), 63).float().numpy(),
        "betas": posed.betas.float().numpy(),
    }


def _notes(clips: Sequence[PosedClip]) -> tuple[str, ...]:
    notes = [f"{RATE:g} frames a second, +z is up and the floor is at 0"]
    if not all(posed.exact for posed in clips):
        notes.append(
            "the bodies are not SMPL-X's: angles, pelvis and height agree, the shape is its mean"
        )
    return tuple(notes)


def export_holosoma(finished: Finished, folder: Path) -> Exported:
    """Write `holosoma/`: a clip of 22 joints for each person, and a climb over the furniture.

    `<person>.npz` is for `--task-type robot_only --data_format smplx`; the folder `<person>` is for
    `--task-type climbing`: 53 joints 120 times a second, and the furniture as convex pieces.

    Raises:
        InputError: If the joints of the bodies are not known.
    """
    clips = clips_of(finished)
    if isinstance(clips, str):
        raise InputError(f"--to holosoma: {clips}")
    solids, files = solids_of(finished.scene, Run(finished.out)), list[Path]()
    terrain = _terrain(solids)
    for clip in clips:
        home = folder / "holosoma"
        files.append(home / f"{clip.name}.npz")
        joints = clip.joints[:, : len(BODY)].float().numpy()
        arrays = {"global_joint_positions": joints, "height": np.array(clip.height)}
        write_npz(arrays, files[-1])
        files.append(home / clip.name / f"{clip.name}.npy")
        with replacing(files[-1]) as part, part.open("wb") as stream:
            np.save(stream, _as_mocap(clip.joints))
        for name, content in terrain.items():
            with replacing(home / clip.name / name) as part:
                part.write_bytes(content)
    note = f"{RATE:g} frames a second (a climb {MOCAP_STEPS * RATE:g}), +z is up, the floor is at 0"
    scene = (
        "a climb also needs the robot's own scene file with box_assets.xml and box_body.xml in it"
    )
    return Exported(tuple(files), (note, scene))


def _as_mocap(joints: torch.Tensor) -> NDArray[np.float32]:
    """The 53 joints at 120 a second; fingers that are not known lie in the wrist."""
    places = joints[:, [JOINTS.index(name) for name in MOCAP]].clone()
    for k, name in enumerate(MOCAP):
        if bool(places[:, k].isnan().any()):
            side = name.partition("_")[0]
            places[:, k] = joints[:, JOINTS.index(f"{side}_wrist")]
    rows = places.reshape(len(places), -1).numpy()
    steps = np.arange(MOCAP_STEPS * (len(rows) - 1) + 1) / MOCAP_STEPS
    lines = [np.interp(steps, np.arange(len(rows)), column) for column in rows.T]
    return np.stack(lines, -1).reshape(len(steps), -1, 3).astype(np.float32)


def _terrain(solids: Sequence[Solid]) -> dict[str, bytes]:
    """The furniture as Holosoma has terrain: one convex piece a mesh, a link and a geom."""
    pieces = [_placed(hull, solid) for solid in solids for hull in solid.hulls]
    files = {f"box_models/box{k}.obj": mesh_bytes(p, "obj") for k, p in enumerate(pieces, 1)}
    files["multi_boxes.obj"] = mesh_bytes(_joined(pieces), "obj")
    robot = Element("robot", name="multi_boxes")
    SubElement(robot, "link", name="world")
    assets, bodies = Element("mujocoinclude"), Element("mujocoinclude")
    for k in range(1, len(pieces) + 1):
        _add_link(robot, k)
        mesh = {"name": f"box{k}", "file": f"box_models/box{k}.obj", "scale": "1 1 1"}
        SubElement(assets, "mesh", mesh)
        body = SubElement(bodies, "body", name=f"multi_boxes_box{k}_link", pos="0 0 0")
        geom = {"name": f"multi_boxes_link_{k}", "type": "mesh", "mesh": f"box{k}"}
        SubElement(body, "geom", geom, contype="1", conaffinity="1")
    trees = {"multi_boxes.urdf": robot, "box_assets.xml": assets, "box_body.xml": bodies}
    for name, tree in trees.items():
        indent(tree)
        files[name] = tostring(tree, encoding="utf-8") + b"\n"
    return files


def _add_link(robot: Element, k: int) -> None:
    link = SubElement(robot, "link", name=f"multi_boxes_link_{k}")
    for kind in ("visual", "collision"):
        shape = SubElement(SubElement(link, kind), "geometry")
        SubElement(shape, "mesh", filename=f"box_models/box{k}.obj", scale="1 1 1")
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "mass", value="1")
    moments = {"ixx": "1", "iyy": "1", "izz": "1", "ixy": "0", "ixz": "0", "iyz": "0"}
    SubElement(inertial, "inertia", moments)
    joint = SubElement(robot, "joint", name=f"multi_boxes_joint_{k}", type="fixed")
    SubElement(joint, "parent", link="world")
    SubElement(joint, "child", link=f"multi_boxes_link_{k}")
    SubElement(joint, "origin", xyz=numbers((0, 0, 0)), rpy=numbers((0, 0, 0)))


def _placed(hull: Mesh, solid: Solid) -> Mesh:
    """A piece in the room."""
    yaw = torch.tensor(solid.yaw, dtype=torch.float64)
    c, s = float(yaw.cos()), float(yaw.sin())
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Mesh(hull.verts @ turn.mT + solid.place, hull.faces)


def _joined(pieces: Sequence[Mesh]) -> Mesh:
    if not pieces:
        return Mesh(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.long))
    counts = [0, *np.cumsum([len(piece.verts) for piece in pieces]).tolist()]
    faces = [piece.faces + start for piece, start in zip(pieces, counts[:-1], strict=True)]
    return Mesh(torch.cat([piece.verts for piece in pieces]), torch.cat(faces))
