"""Parameters of body models in bodies.npz, with the names and meaning of the smplx package."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies import load_model, run_model
from mover.core.errors import InputError
from mover.core.files import reason
from mover.core.records import rows_of
from mover.core.types import Bodies, BodyPose
from mover.geometry.rotations import axis_angle, rotation_vectors
from mover.io.files.fields import At
from mover.io.people.values import vectors

NEEDED = ("betas", "global_orient", "body_pose", "transl")
HANDS = ("left_hand_pose", "right_hand_pose", "flat_hand_mean")
EXTRA = (*HANDS, "jaw_pose", "leye_pose", "reye_pose", "expression")
MODELS = ("smplx", "smplh", "smpl", "makehuman")
GENDERS = ("neutral", "female", "male")
ANGLES = (63, 69)  # of SMPL-X and SMPL-H, of SMPL
SAME = 0.01  # [m], a model that comes so close gives the same meshes
LOOKED_AT = 64  # so many rows are compared, spread over the video
NO_TURN = 1e-6
UNUSABLE = (InputError, ValueError, RuntimeError, KeyError, OSError)
"""What a model raises that is not there, or cannot take the parameters."""


def pose_of(at: At, rows: int) -> BodyPose | None:
    """The parameters among the arrays of a file, None if it has none."""
    if all(at.maybe(key) is None for key in ("model", *NEEDED, *EXTRA)):
        return None

    def word(field: At, choices: tuple[str, ...]) -> str:
        return field.holding(str(field.array((), "text"))).choice(choices)

    def values(field: At, *shape: int | str) -> Tensor:
        return torch.from_numpy(field.array(shape).astype(np.float32))

    model, gender = word(at.get("model"), MODELS), at.maybe("gender")
    angles = values(at.get("body_pose"), rows, "63 or 69")
    if angles.shape[1] not in ANGLES:
        found = f"{angles.shape[1]}"
        at.get("body_pose").refuse(f"{ANGLES[0]} or {ANGLES[1]} angles a row", found)
    extra: dict[str, Tensor] = {}
    for key in EXTRA:  # values for each row; the axes behind the first are joined
        if (field := at.maybe(key)) is not None:
            axes = max(np.ndim(field.value) - 1, 1)
            extra[key] = values(field, rows, *("N" * axes)).flatten(1)
    betas = at.get("betas")  # of one person or of each row
    wide = ("S",) if isinstance(betas.value, np.ndarray) and betas.value.ndim == 1 else (rows, "S")
    return BodyPose(
        model=model, gender="neutral" if gender is None else word(gender, GENDERS),
        betas=values(betas, *wide).expand(rows, -1).clone(),
        global_orient=values(at.get("global_orient"), rows, 3), body_pose=angles,
        transl=values(at.get("transl"), rows, 3), extra=extra,
    )  # fmt: skip


def posed(
    pose: BodyPose, at: At
) -> tuple[
    Float[Tensor, "bodies verts 3"],
    Int[Tensor, "faces 3"],
    Float[Tensor, "bodies joints 3"],
    tuple[str, ...],
]:
    """Meshes and joints of a file that has parameters only.

    Raises:
        InputError: If the model is not to be had or cannot take the parameters.
    """
    try:
        model = load_model(pose.model, pose.gender)
        verts, joints = run_model(model, pose)
    except UNUSABLE as error:
        message = f"{str(pose.model)!r}, which gives no meshes ({reason(error)})"
        at.get("model").refuse("a body model that can be posed, or 'vertices' and 'faces'", message)
    return verts, model.faces, joints, model.joint_names


def reproduces(pose: BodyPose, verts: Float[Tensor, "bodies verts 3"], at: At) -> str | None:
    """Why the model does not give these meshes, None if it does within 1 cm."""
    try:
        model = load_model(pose.model, pose.gender)
        count = min(LOOKED_AT, len(verts))
        index = torch.linspace(0, len(verts) - 1, count).round().long()
        found, _ = run_model(model, rows_of(pose, index))
    except UNUSABLE as error:
        return f"the parameters of '{pose.model}' cannot be used ({reason(error)})"
    if found.shape[1] != verts.shape[1]:
        return f"{pose.model} has {found.shape[1]} vertices, {at.file} has {verts.shape[1]}"
    worst = float((found - verts[index]).norm(dim=-1).max())
    if not worst <= SAME:
        return f"the parameters of '{pose.model}' miss the meshes by up to {worst:.3g} m"
    return None


def into_camera(bodies: Bodies, R_cam_world: Float[Tensor, "3 3"]) -> Bodies:
    """World bodies in the camera frame, parameters included."""
    if bodies.space == "camera":
        return bodies
    R, pose = R_cam_world.to(bodies.verts), bodies.pose
    joints = None if bodies.joints is None else bodies.joints @ R.mT
    if pose is not None:  # the root turns about the pelvis, not about the origin
        pelvis = run_model(load_model(pose.model, pose.gender), pose)[1][:, 0]
        root = rotation_vectors(R @ axis_angle(pose.global_orient))
        transl = (pelvis @ R.mT - (pelvis - pose.transl)).to(pose.transl)
        pose = dataclasses.replace(pose, global_orient=root, transl=transl)
    return dataclasses.replace(
        bodies, verts=bodies.verts @ R.mT, joints=joints, pose=pose, space="camera"
    )


def joined_bodies(parts: Sequence[Bodies]) -> Bodies:
    """Rows of several of one topology together; the last gives what is of all.

    Joints and parameters are kept where all have them and of one kind.
    """
    last = parts[-1]
    poses = [part.pose for part in parts if part.pose is not None]
    kinds = {(p.model, p.gender, p.betas.shape[1], p.body_pose.shape[1],
              *((name, one.shape[1]) for name, one in p.extra.items())) for p in poses}  # fmt: skip
    pose = None
    if len(poses) == len(parts) and len(kinds) == 1:
        rows = {name: torch.cat([getattr(p, name) for p in poses]) for name in NEEDED}
        extra = {name: torch.cat([p.extra[name] for p in poses]) for name in poses[0].extra}
        pose = dataclasses.replace(poses[0], **rows, extra=extra)
    joints = [part.joints for part in parts if part.joints is not None]
    whole = len(joints) == len(parts) and len({part.joint_names for part in parts}) == 1
    spreads = {part.size_spread for part in parts}
    rows = {name: torch.cat([getattr(part, name) for part in parts])
            for name in ("verts", "frame", "person")}  # fmt: skip
    return dataclasses.replace(
        last, **rows, joints=torch.cat(joints) if whole else None, pose=pose,
        joint_names=last.joint_names if whole else (),
        size_spread=last.size_spread if len(spreads) == 1 else None,
        mean_shape=all(part.mean_shape for part in parts),
    )  # fmt: skip


# Parameters of bodies: posed, and moved as rigid bodies, whose root turns about the pelvis.


def pelvis_of(pose: BodyPose) -> Float[Tensor, "bodies 3"]:
    """From `transl` to the pelvis, about which the root turns [m]."""
    zero = torch.zeros_like(pose.transl)
    rest = dataclasses.replace(pose, transl=zero, global_orient=zero)
    return run_model(load_model(pose.model, pose.gender), rest)[1][:, 0]


def moved(pose: BodyPose, R: Float[Tensor, "bodies 3 3"], t: Float[Tensor, "bodies 3"]) -> BodyPose:
    """The parameters of the bodies x' = R x + t; NaN stays NaN.

    Raises:
        InputError: If the body turns and its model, which knows the pelvis, is not at hand.
    """
    if (R - torch.eye(3).to(R)).abs().nan_to_num(0).amax() < NO_TURN:
        return dataclasses.replace(pose, transl=pose.transl + t)
    offset = pelvis_of(pose)
    place = (R @ (offset + pose.transl)[..., None])[..., 0] + t - offset
    whole = (R.double() @ axis_angle(pose.global_orient.double())).numpy()
    root = torch.from_numpy(vectors(whole, At(whole, "the camera"))).to(pose.global_orient)
    return dataclasses.replace(pose, transl=place, global_orient=root)
