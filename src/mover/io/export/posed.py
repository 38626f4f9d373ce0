"""The parameters of people's bodies in the world of the result, and the skin on their bones."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies import load_model
from mover.bodies.skinning import SkinnedBody
from mover.core.errors import InputError
from mover.core.records import record, rows_of
from mover.core.types import Bodies, BodyPose
from mover.geometry.rotations import axis_angle, rotation_vectors, similarity
from mover.io.capture.pose_file import pelvis_of
from mover.io.export.finished import BodyForm, Finished, tracks_of
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
