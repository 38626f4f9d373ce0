"""People's bodies by their parameters: bones with skin, and motions in the keys of AMASS.

AMASS and the tools around SMPL-X keep one npz a person, at a constant rate.
"""

import dataclasses
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies import load_model
from mover.bodies.skinning import SkinnedBody
from mover.core.errors import InputError
from mover.core.records import record, rows_of
from mover.core.types import Bodies, BodyPose
from mover.geometry.rotations import axis_angle, rot_x, rotation_vectors, similarity
from mover.io.capture.pose_file import moved, pelvis_of
from mover.io.export.finished import GAP, BodyForm, Exported, Finished, Up, clock_of, tracks_of
from mover.io.files.fields import write_npz
from mover.io.people.tools import HANDS

SAME = 0.01  # [m], a similarity that leaves more did not make the result's body
SKIN_MISS = 0.02  # [m], the most that a skinned body may miss the result's mesh


@record
class Motion:
    """Parameters of bodies, row by row, in the world."""

    pose: BodyPose
    size: Float[Tensor, " bodies"]
    """Factor by which each body grew about its pelvis; 1 where the parameters say it all."""


def motion_of(finished: Finished) -> Motion | str:
    """The parameters of the result's bodies, or why there are none.

    A result that was moved and sized as a whole takes over the capture's parameters: its root is
    turned, its pelvis is where the result has it.
    """
    bodies, given = finished.bodies, finished.given
    if bodies is None:
        return "the result has no bodies"
    if bodies.pose is not None:
        return Motion(bodies.pose, torch.ones(len(bodies.verts)))
    if given is None:
        return "bodies.npz has no parameters; --capture names the capture that has them"
    if given.pose is None:
        return "the capture's bodies.npz has no parameters that reproduce its meshes"
    same = given.verts.shape == bodies.verts.shape
    if not (same and (given.frame == bodies.frame).all() and (given.person == bodies.person).all()):
        return "the capture's bodies are not those of the result"
    pose = given.pose
    start, end = given.verts.double(), bodies.verts.double()
    size, turn, shift = similarity(start, end)
    miss = size[:, None, None] * start @ turn.mT + shift[:, None] - end
    if (off := float(miss.norm(dim=-1).max())) > SAME:
        return f"the result's bodies are not those of the capture, by {off:.3f} m"
    offset = pelvis_of(pose)
    pelvis = (pose.transl + offset).double()
    there = size[:, None] * (turn @ pelvis[..., None])[..., 0] + shift
    root = rotation_vectors(turn @ axis_angle(pose.global_orient.double()))
    moved = dataclasses.replace(
        pose, global_orient=root.to(pose.transl), transl=there.to(pose.transl) - offset
    )
    return Motion(moved, size.to(pose.transl))


def all_angles(pose: BodyPose) -> Float[Tensor, "bodies joints 3"]:
    """Axis-angle vectors of all 55 joints in SMPL-X's order; what is not given as angles is 0."""
    rows = pose.global_orient.shape[0]
    angles = torch.zeros(rows, 165).to(pose.global_orient)
    angles[:, :3], angles[:, 3:66] = pose.global_orient, pose.body_pose[:, :63]
    for name, (start, end) in HANDS["smplx"].items():
        given = pose.extra.get(name)
        if given is not None and given.shape[-1] == end - start:  # PCA weights of hands have less
            angles[:, start:end] = given
    return angles.reshape(rows, 55, 3)


def skin_of(pose: BodyPose, bodies: Bodies) -> SkinnedBody | None:
    """The skinned model of the bodies; None: it has no skin, other vertices or other joints."""
    model = load_model(pose.model, pose.gender)
    if not isinstance(model, SkinnedBody) or model.pose_dirs is not None:
        return None
    fits = len(model.parents) == 55 and len(model.verts) == bodies.verts.shape[1]
    return model if fits else None


def misses(motion: Motion, model: SkinnedBody, bodies: Bodies) -> float:
    """How far a skinned model in this motion is off the meshes at most [m]."""
    worst = 0.0
    for rows in torch.arange(len(bodies.verts)).split(128):
        verts, joints = model.posed(rows_of(motion.pose, rows))
        root = joints[:, :1]
        sized = root + motion.size[rows, None, None] * (verts - root)
        worst = max(worst, float((sized - bodies.verts[rows]).norm(dim=-1).max()))
    return worst


@record
class Skinned:
    """Bones of all people, each person with one shape."""

    motion: Motion
    model: SkinnedBody
    """With as many weights a vertex as the format draws."""
    miss: float
    """How far the skin is off the meshes of the result at most [m]."""


def bones_for(finished: Finished, body: BodyForm, influences: int) -> Skinned | str:
    """The bones on which people move as was asked, or why they move by shapes.

    Each person gets one shape, and each vertex `influences` joints; what that loses is measured.

    Raises:
        InputError: If bones are asked for and there are none.
    """
    bodies = finished.bodies
    if bodies is None or body in ("morph", "none"):
        return "it was not asked for"
    motion = motion_of(finished)
    skin = motion if isinstance(motion, str) else _skin_for(motion, bodies, influences)
    if isinstance(skin, str) and body == "skin":
        raise InputError(f"--body skin: {skin}")
    return skin


def _skin_for(motion: Motion, bodies: Bodies, influences: int) -> Skinned | str:
    model = skin_of(motion.pose, bodies)
    if model is None:
        return f"the model {motion.pose.model!r} has no bones that are known here"
    share, joint = model.weights.topk(influences, dim=1)
    weights = torch.zeros_like(model.weights).scatter(1, joint, share / share.sum(1, keepdim=True))
    simple = dataclasses.replace(model, weights=weights)
    betas = motion.pose.betas.clone()
    for track in tracks_of(bodies):
        betas[track.rows] = betas[track.rows].mean(0)
    posed = Motion(dataclasses.replace(motion.pose, betas=betas), motion.size)
    miss = misses(posed, simple, bodies)
    if not miss <= SKIN_MISS:
        return f"its bones miss the result's meshes by {miss:.3f} m"
    return Skinned(posed, simple, miss)


def rest_of(skin: Skinned, row: int) -> tuple[Float[Tensor, "verts 3"], Float[Tensor, "joints 3"]]:
    """Vertices and joints of a row's person in the rest shape [m]."""
    betas, model = skin.motion.pose.betas[row], skin.model
    count = len(betas)
    verts = model.verts + model.shape_dirs[..., :count] @ betas
    return verts, model.joints + model.joint_dirs[..., :count] @ betas


PARTS = {"pose_body": (3, 66), "pose_jaw": (66, 69), "pose_eye": (69, 75), "pose_hand": (75, 165)}
"""Columns of the 165 angles of SMPL-X under the names that AMASS gives its parts."""


def export_amass(finished: Finished, folder: Path, up: Up = "y") -> Exported:
    """Write `amass_<person>.npz` with AMASS' keys; with z up, (x, y, z) becomes (x, -z, y).

    Rows have equal steps of time. Frames that lack the person are interpolated, but for gaps longer
    than `GAP` and than two usual steps: there a new file, `amass_<person>_<first frame>.npz`.

    Raises:
        InputError: If the parameters of the bodies are not known.
    """
    motion, bodies = motion_of(finished), finished.bodies
    if isinstance(motion, str):
        raise InputError(f"--to amass: {motion}")
    assert bodies is not None
    files, notes = list[Path](), list[str]()
    if (model := skin_of(motion.pose, bodies)) is not None:
        off = misses(motion, model, bodies)
        notes.append(f"the parameters give the result's meshes within {off:.4f} m")
    if float((motion.size - 1).abs().max()) > 1e-3:
        sizes = f"{float(motion.size.min()):.3f} to {float(motion.size.max()):.3f}"
        notes.append(f"bodies are {sizes} times the size that their betas say ('size')")
    if up == "z":
        turn = rot_x(torch.tensor(torch.pi / 2)).expand(len(motion.size), 3, 3)
        motion = Motion(moved(motion.pose, turn, torch.zeros(len(motion.size), 3)), motion.size)
    for track in tracks_of(bodies):
        steps, fps, filled = track.frame.diff(), clock_of(bodies)[1], 0
        long = steps > max(GAP * fps, 2 * float(steps.median()) if len(steps) else 0.0)
        cuts, step = long.nonzero()[:, 0] + 1, math.gcd(*steps[~long].tolist()) or 1
        pieces = (x.tensor_split(cuts) for x in (track.frame, track.rows))
        for frame, rows in zip(*pieces, strict=True):
            every = torch.arange(int(frame[0]), int(frame[-1]) + 1, step)
            name = f"amass_{track.person}" + (f"_{int(frame[0]):06d}" if len(cuts) else "")
            files.append(folder / f"{name}.npz")
            more = {"up_axis": np.array(up), "person": np.array(track.person)}
            even = _even(motion, rows, frame, every)
            write_npz({**_arrays(even, every, fps / step), **more}, files[-1])
            filled += len(every) - len(frame)
        if filled:
            notes.append(f"person {track.person}: {filled} frames without the person interpolated")
        if len(cuts):
            notes.append(f"person {track.person}: {len(cuts) + 1} files, cut at long gaps")
    return Exported(tuple(files), tuple(notes))


def _even(
    motion: Motion, rows: Int[Tensor, " rows"], frame: Int[Tensor, " rows"],
    every: Int[Tensor, " frames"],
) -> Motion:  # fmt: skip
    """The motion of one person in every frame: between its rows it goes the straight way."""
    after = torch.searchsorted(frame, every)
    before = (after - 1).clamp_min(0)
    share = (1 - (frame[after] - every) / (frame[after] - frame[before]).clamp_min(1))[:, None]

    def straight(values: Tensor) -> Tensor:
        return torch.lerp(values[rows[before]], values[rows[after]], share.to(values))

    def turned(values: Tensor) -> Tensor:
        start, end = (axis_angle(values[rows[k]].reshape(-1, 3).double()) for k in (before, after))
        way = rotation_vectors(start.mT @ end) * share.repeat_interleave(values.shape[1] // 3, 0)
        turns = rotation_vectors(start @ axis_angle(way)).reshape(len(every), -1)
        return torch.where(share < 1, turns.to(values), values[rows[after]])

    pose, joints = motion.pose, (3, 45)  # numbers of jaw, eye and hand; other numbers are no turns
    even = replace(
        pose, betas=straight(pose.betas), transl=straight(pose.transl),
        global_orient=turned(pose.global_orient), body_pose=turned(pose.body_pose),
        extra={k: (turned if x.shape[1] in joints else straight)(x) for k, x in pose.extra.items()},
    )  # fmt: skip
    return Motion(even, straight(motion.size[:, None])[:, 0])


def _arrays(motion: Motion, frame: Int[Tensor, " frames"], fps: float) -> dict[str, NDArray[Any]]:
    """One person; rows are frames of the video, whose numbers are in `frame`."""
    pose = motion.pose
    if pose.model == "smpl":  # all angles in the model's own order
        angles = torch.cat([pose.global_orient, pose.body_pose], -1)
    else:
        angles = all_angles(pose).flatten(1)
        if pose.model == "smplh":  # has no jaw and no eyes
            angles = torch.cat([angles[:, :66], angles[:, 75:]], -1)
    poses, rate = angles.numpy(), np.array(fps)
    shape = pose.betas.double().mean(0).numpy()
    parts = PARTS.items() if poses.shape[1] == 165 else ()
    return {
        "trans": pose.transl.numpy(), "root_orient": pose.global_orient.numpy(),
        "poses": poses, "betas": shape, "num_betas": np.array(len(shape)),
        "gender": np.array(pose.gender), "mocap_framerate": rate, "mocap_frame_rate": rate,
        "surface_model_type": np.array(pose.model), "frame": frame.numpy(),
        "size": motion.size.numpy(),
        **{name: values.numpy() for name, values in pose.extra.items()},
        **{name: poses[:, start:end] for name, (start, end) in parts},
    }  # fmt: skip
