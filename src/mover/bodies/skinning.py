r"""Skinned bodies: from shape and pose to vertices and joints, batched, differentiable.

    T(β, ψ, θ) = template + shape(β) + expression(ψ) + correctives · (R(θ) - 1),
    M(β, ψ, θ) = skinned(T, J(template + shape + expression), θ) + transl

after Loper et al. 2015 (Eq. 2 to 10), Romero et al. 2017 and Pavlakos et al. 2019 (Sec. 3.1); the
open body has neither expression nor correctives. Written from the papers; no SMPL file is shipped.
"""

import dataclasses
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.errors import InputError
from mover.core.records import record, rows_of
from mover.core.types import BodyPose
from mover.geometry.rotations import axis_angle

ASSETS = Path(__file__).parent / "assets"
AT_ONCE = 8  # bodies that are skinned together: what fits a processor's cache
HAND_POSES = ("left_hand_pose", "right_hand_pose")
FLAT = "flat_hand_mean"
"""Key of `BodyPose.extra`: not zero where hands are turned from flat, not from the mean hand."""


Posed = tuple[Float[Tensor, "bodies verts 3"], Float[Tensor, "bodies joints 3"]]
"""Vertices and joints of bodies [m]."""
Turns = Float[Tensor, "bodies joints 3 3"]
"""Rotations of the joints."""


@record
class Hands:
    """The space of hand poses; the first axis is left, right."""

    mean: Float[Tensor, "2 45"]  #: axis-angle vectors of a relaxed hand [rad]
    components: Float[Tensor, "2 components 45"]
    """Principal components of hand poses, one a row [rad]."""


@record
class FacePoints:
    """The 51 inner points of the face, on triangles of the skin."""

    vertex: Int[Tensor, "points 3"]
    share: Float[Tensor, "points 3"]


@record
class SkinnedBody:
    """A body whose skin follows its joints; zero pose = T-pose, +y up, +z front."""

    name: str
    faces: Int[Tensor, "faces 3"]
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    """Index of each joint's parent, always an earlier one; -1 for the root."""
    verts: Float[Tensor, "verts 3"]  #: the rest shape [m]
    joints: Float[Tensor, "joints 3"]  #: places of the joints in the rest shape [m]
    weights: Float[Tensor, "verts joints"]
    """Share of each joint in the motion of a vertex; rows sum to 1."""
    shape_dirs: Float[Tensor, "verts 3 shape"]
    """Displacement of the rest shape for one unit of each shape coefficient [m]."""
    joint_dirs: Float[Tensor, "joints 3 shape"]  #: the same for the joints [m]
    tpose: Float[Tensor, "joints 3 3"]
    """Turns the parts of the rest shape, bone by bone, into the zero pose."""

    pose_dirs: Float[Tensor, "features verts 3"] | None = None
    """Displacement for each number of the rotations less identity, joint by joint [m]."""
    expression_dirs: Float[Tensor, "verts 3 expression"] | None = None
    """Displacement for one unit of each coefficient of the expression [m]."""
    expression_joint_dirs: Float[Tensor, "joints 3 expression"] | None = None
    """The same for the joints [m]."""
    hands: Hands | None = None
    face: FacePoints | None = None
    gender: str = "neutral"

    def posed(self, pose: BodyPose) -> Posed:
        """Vertices and joints of people in these poses [m], as the smplx package gives them.

        Hands may be 45 angles or fewer principal components; both are added to the mean hand
        unless `pose.extra["flat_hand_mean"]` says that the hands are turned from flat ones.

        Raises:
            InputError: If the numbers of coefficients or angles are not this model's (here, and in
                all functions below that look at these).
        """
        turns = axis_angle(angles_of(self, with_full_hands(self, pose)))
        verts, joints = self.rest(turns, pose.betas, pose.extra.get("expression"))
        return skinned(self, turns, verts, joints, pose.transl)

    def rest(
        self,
        turns: Turns,
        betas: Float[Tensor, "bodies shape"],
        face: Float[Tensor, "bodies expression"] | None,
    ) -> Posed:
        """Rest shape and joints with the correctives of pose and expression [m]."""
        verts, joints = shaped(self, betas)
        most = 0 if self.expression_dirs is None else self.expression_dirs.shape[-1]
        if face is not None and self.expression_dirs is not None and most:
            assert self.expression_joint_dirs is not None
            count = face.shape[-1]
            if count > most:
                found = f"has {count} columns, the model '{self.name}' knows {most}"
                raise InputError(f"'expression' {found}")
            dirs = self.expression_dirs[..., :count].to(verts)
            verts = verts + torch.einsum("vik,bk->bvi", dirs, face.to(verts))
            dirs = self.expression_joint_dirs[..., :count].to(verts)
            joints = joints + torch.einsum("jik,bk->bji", dirs, face.to(verts))
        if self.pose_dirs is None:
            return verts, joints
        features = (turns[:, 1:] - torch.eye(3).to(turns)).flatten(1)
        moved = features @ self.pose_dirs.to(verts).flatten(1)
        return verts + moved.reshape(verts.shape), joints

    def joints_in(self, pose: BodyPose) -> Float[Tensor, "bodies joints 3"]:
        """The joints that `posed` finds, without the skin [m]."""
        return vertex_subset(self, torch.zeros(1, dtype=torch.long)).posed(pose)[1]


def vertex_subset(model: object, index: Int[Tensor, " picked"]) -> SkinnedBody:
    """The model with these vertices only, and without faces; its joints and poses are the same.

    Raises:
        ValueError: If it is no skinned model.
    """
    if not isinstance(model, SkinnedBody):
        raise ValueError(f"vertex_subset: {type(model).__name__} is no skinned body model")
    some = rows_of(model, index, "verts")
    return dataclasses.replace(some, faces=model.faces[:0], face=None)


def heights_of(model: object) -> tuple[float, Float[Tensor, " shape"]]:
    """Height of the mean shape, and what each number of the shape adds to it [m]."""
    assert isinstance(model, SkinnedBody)
    y = model.verts[:, 1]
    top, sole = int(y.argmax()), int(y.argmin())
    dirs = model.shape_dirs[top, 1] - model.shape_dirs[sole, 1]
    return float(y[top] - y[sole]), dirs.float()


def growth_of(model: SkinnedBody) -> Float[Tensor, " shape"]:
    """What each number of the shape adds to the logarithm of a body's height."""
    usual, dirs = heights_of(model)
    return dirs / usual


def with_full_hands(model: SkinnedBody, pose: BodyPose) -> BodyPose:
    """The pose with hands as 45 angles each, the mean hand added; SMPL's palms stay straight."""
    body = pose.body_pose
    if model.name == "smpl" and body.shape[-1] == 63:
        body = torch.cat([body, body.new_zeros(len(body), 6)], -1)
    if model.hands is None:
        return dataclasses.replace(pose, body_pose=body)
    bodies = pose.global_orient.shape[0]
    flat = pose.extra.get(FLAT)
    added = 1.0 if flat is None else (flat == 0).to(body).reshape(-1, 1)
    full: dict[str, Tensor] = {}
    for side, name in enumerate(HAND_POSES):
        given = pose.extra.get(name)
        angles = body.new_zeros(bodies, 45) if given is None else given
        if angles.shape[-1] != 45:
            components = model.hands.components[side].to(body)
            if angles.shape[-1] > len(components):
                most = f"the model '{model.name}' knows {len(components)} or 45 angles"
                raise InputError(f"'{name}' has {angles.shape[-1]} columns, {most}")
            angles = angles.to(body) @ components[: angles.shape[-1]]
        full[name] = angles.to(body) + added * model.hands.mean[side].to(body)
    return dataclasses.replace(pose, body_pose=body, extra={**pose.extra, **full})


def skinned(
    model: SkinnedBody,
    turns: Turns,
    verts: Float[Tensor, "bodies verts 3"],
    joints: Float[Tensor, "bodies joints 3"],
    transl: Float[Tensor, "bodies 3"],
) -> Posed:
    """Vertices and joints in a pose, from rest shapes and the rotation of each joint [m]."""
    world, places = pose_joints(model, turns, joints)
    offset = places - torch.einsum("bjik,bjk->bji", world, joints)
    moves = torch.cat([world, offset[..., None]], -1)
    some = (x.split(AT_ONCE) for x in (moves, verts, transl))
    weights, skin = model.weights.to(moves), list[Tensor]()
    for move, rest, shift in zip(*some, strict=True):
        bodies, count = move.shape[:2]
        flat = move.permute(1, 3, 0, 2).reshape(count, bodies * 12)
        x, y, z, put = (weights @ flat).view(-1, 4, bodies, 3).unbind(1)
        at = rest.transpose(0, 1).unsqueeze(-1)
        moved = x * at[:, :, 0] + y * at[:, :, 1] + z * at[:, :, 2] + put + shift
        skin.append(moved.transpose(0, 1).contiguous())
    return torch.cat(skin), places + transl[:, None]


ANGLES = {
    55: ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose",
         "left_hand_pose", "right_hand_pose"),
    52: ("global_orient", "body_pose", "left_hand_pose", "right_hand_pose"),
    24: ("global_orient", "body_pose"),
}  # fmt: skip
"""Names of the angles by the number of joints (SMPL-X, SMPL-H, SMPL), in order."""


def widths_of(model: SkinnedBody) -> dict[str, int]:
    """Number of angles of each part of the pose, in order."""
    count = len(model.parents)
    own = {"body_pose": 69 if count == 24 else 63, "left_hand_pose": 45, "right_hand_pose": 45}
    return {name: own.get(name, 3) for name in ANGLES[count]}


def angles_of(model: SkinnedBody, pose: BodyPose) -> Float[Tensor, "bodies joints 3"]:
    """Axis-angle vectors of all joints; parts that are not given stay straight."""
    bodies = pose.global_orient.shape[0]
    given = {**pose.extra, "global_orient": pose.global_orient, "body_pose": pose.body_pose}
    rows: list[Tensor] = []
    for name, width in widths_of(model).items():
        value = given.get(name)
        if value is None:
            value = pose.global_orient.new_zeros(bodies, width)
        if value.shape[-1] != width:
            found = f"has {value.shape[-1]} columns, the model '{model.name}' expects {width}"
            raise InputError(f"'{name}' {found}")
        rows.append(value.to(pose.global_orient))
    return torch.cat(rows, -1).reshape(bodies, -1, 3)


def shaped(model: SkinnedBody, betas: Float[Tensor, "bodies shape"]) -> Posed:
    """Rest shape and joints of each person [m]; shape coefficients that are not given are 0."""
    count, most = betas.shape[-1], model.shape_dirs.shape[-1]
    if count > most and (betas[..., most:] != 0).any():
        raise InputError(
            f"'betas' has {count} columns, the model '{model.name}' knows {most}; expected a file "
            "of the model that knows as many (SMPL-H of 16, SMPL-X 1.1)"
        )
    dirs, joint_dirs = model.shape_dirs[..., :count], model.joint_dirs[..., :count]
    betas = betas[..., :most]
    verts = torch.einsum("vik,bk->bvi", dirs.to(betas), betas)
    joints = torch.einsum("jik,bk->bji", joint_dirs.to(betas), betas)
    return model.verts.to(betas) + verts, model.joints.to(betas) + joints


def pose_joints(
    model: SkinnedBody, turns: Turns, joints: Float[Tensor, "bodies joints 3"]
) -> tuple[Turns, Float[Tensor, "bodies joints 3"]]:
    """World rotation (from the rest shape) and position of each joint, level by level."""
    tpose = model.tpose.to(turns)
    parents = torch.tensor([max(p, 0) for p in model.parents], device=joints.device)
    bones = tpose[parents] @ (joints - joints[:, parents])[..., None]
    levels, above, back = _levels(model.parents)
    world, places = [turns[:, levels[0]]], [joints[:, levels[0]]]
    for level, up in zip(levels[1:], above, strict=True):  # all knees at once
        parent = world[-1][:, up]
        world.append(parent @ turns[:, level])
        places.append(places[-1][:, up] + (parent @ bones[:, level])[..., 0])
    return torch.cat(world, 1)[:, back] @ tpose, torch.cat(places, 1)[:, back]


@lru_cache(maxsize=16)
def _levels(parents: tuple[int, ...]) -> tuple[list[list[int]], list[list[int]], list[int]]:
    """Joints by depth, their parents' index in the level above, and the way back to their order."""
    depth: list[int] = []
    for parent in parents:
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
    levels = [[j for j, d in enumerate(depth) if d == k] for k in range(max(depth) + 1)]
    above = [[levels[k - 1].index(parents[j]) for j in levels[k]] for k in range(1, len(levels))]
    order = [joint for level in levels for joint in level]
    return levels, above, sorted(range(len(order)), key=order.__getitem__)


@cache
def open_body(detail: Literal["small", "full"] = "small") -> SkinnedBody:
    """The body that ships with the package (MakeHuman's, CC0): SMPL-X's joints, T-pose.

    `small` has 5,002 vertices, `full` 13,380; both are closed. The pelvis joint is at `transl`.
    All shape coefficients zero give an adult of 1.70 m.
    """
    name = {"small": "open_body_small.npz", "full": "open_body.npz"}[detail]
    with np.load(ASSETS / name, allow_pickle=False) as data:
        count = len(data["joints"])
        names = ("verts", "joints", "shape_dirs", "joint_dirs", "tpose", "weight")
        array = {name: torch.from_numpy(data[name].astype(np.float32)) for name in names}
        index = torch.from_numpy(data["weight_joint"].astype(np.int64))
        weights = torch.zeros(len(index), count).scatter_add(1, index, array["weight"])
        return SkinnedBody(
            name="makehuman", faces=torch.from_numpy(data["faces"].astype(np.int64)),
            joint_names=tuple(str(n) for n in data["joint_names"]),
            parents=tuple(int(p) for p in data["parents"]),
            weights=weights / weights.sum(1, keepdim=True), verts=array["verts"],
            joints=array["joints"], shape_dirs=array["shape_dirs"], joint_dirs=array["joint_dirs"],
            tpose=array["tpose"],
        )  # fmt: skip


def zero_pose(bodies: int, model: SkinnedBody) -> BodyPose:
    """So many people of the mean shape in the T-pose, pelvis at the origin."""
    like = model.verts
    return BodyPose(
        model=model.name,
        gender="neutral",
        betas=like.new_zeros(bodies, model.shape_dirs.shape[-1]),
        global_orient=like.new_zeros(bodies, 3),
        body_pose=like.new_zeros(bodies, widths_of(model)["body_pose"]),
        transl=like.new_zeros(bodies, 3),
        extra={},
    )
