"""What was solved, as bodies."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ..bodies import BodyModel
from ..bodies.correspondence import Model
from ..bodies.skinning import shaped, widths_of
from ..bodies.smpl_model import FLAT, SmplBody, skin_of_model
from ..geometry.camera import project
from ..types import Bodies, BodyPose, Keypoints
from .energy import Seen
from .prior import PosePrior
from .unknowns import Frame, Unknowns, hand_angles, pelvis_of, points_of, turns_of

CHUNK = 128  # rows that are posed at once


def pose_of(at: Unknowns, frame: Frame, model: Model, prior: PosePrior) -> BodyPose:
    """Parameters of the fitted bodies."""
    angles = prior.decode(at.code)
    skin = skin_of_model(model)
    assert skin is not None
    width = widths_of(skin)["body_pose"]
    body = torch.cat([angles, angles.new_zeros(len(angles), width - angles.shape[1])], -1)
    betas = at.betas[frame.person]
    rest = shaped(skin, betas)[1][:, 0]
    extra: dict[str, Tensor] = {}
    if at.face.shape[1]:
        extra = {"jaw_pose": at.face[:, :3], "expression": at.face[:, 3:]}
    if at.face.shape[1] and isinstance(model, SmplBody):
        count = at.face.shape[1] - 3
        dirs = model.expression_joint_dirs[0, :, :count].to(rest)
        rest = rest + at.face[:, 3:] @ dirs.mT
    if at.hands.shape[1]:
        extra["left_hand_pose"], extra["right_hand_pose"] = (
            hand_angles(frame.rig, at.hands, side) for side in (0, 1)
        )
        extra[FLAT] = body.new_ones(len(body), 1)
    return BodyPose(
        model=model.name,
        gender=model.gender if isinstance(model, SmplBody) else "neutral",
        betas=betas,
        global_orient=_vectors(turns_of(at, frame, angles)[:, 0]),
        body_pose=body,
        transl=pelvis_of(at) - rest,
        extra=extra,
    )


def _vectors(turns: Float[Tensor, "bodies 3 3"]) -> Float[Tensor, "bodies 3"]:
    """Axis-angle vectors of rotations [rad]."""
    from scipy.spatial.transform import Rotation

    vectors = Rotation.from_matrix(turns.detach().double().cpu().numpy()).as_rotvec()
    return torch.from_numpy(vectors).to(turns)


def rows_of_pose(pose: BodyPose, rows: Tensor) -> BodyPose:
    """Some rows of parameters."""
    extra = {name: value[rows] for name, value in pose.extra.items()}
    return BodyPose(
        pose.model, pose.gender, pose.betas[rows], pose.global_orient[rows],
        pose.body_pose[rows], pose.transl[rows], extra,
    )  # fmt: skip


def rows_of_bodies(bodies: Bodies, rows: Tensor) -> Bodies:
    """Some rows of bodies."""
    return dataclasses.replace(
        bodies,
        verts=bodies.verts[rows],
        joints=None if bodies.joints is None else bodies.joints[rows],
        frame=bodies.frame[rows],
        person=bodies.person[rows],
        pose=None if bodies.pose is None else rows_of_pose(bodies.pose, rows),
    )


def bodies_of(pose: BodyPose, model: BodyModel, keypoints: Keypoints) -> Bodies:
    """Meshes and joints, in the camera frame."""
    with torch.no_grad():
        parts = [
            model.posed(rows_of_pose(pose, rows))
            for rows in torch.arange(len(pose.transl)).split(CHUNK)
        ]
    return Bodies(
        verts=torch.cat([verts for verts, _ in parts]),
        faces=model.faces,
        joints=torch.cat([joints for _, joints in parts]),
        joint_names=model.joint_names,
        frame=keypoints.frame,
        person=keypoints.person,
        fps=keypoints.fps,
        space="camera",
        pose=pose,
    )


def miss_of(at: Unknowns, frame: Frame, seen: Seen, prior: PosePrior) -> Float[Tensor, " bodies"]:
    """Root mean square distance of the keypoints that are seen from their projections [px]."""
    with torch.no_grad():
        pixels = project(points_of(at, frame, prior.decode).keypoints, seen.K)
    there = (seen.weight > 0).to(pixels)
    squared = (pixels - seen.pixels).square().sum(-1) * there
    return (squared.sum(1) / there.sum(1).clamp_min(1)).sqrt()
