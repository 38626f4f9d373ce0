r"""The bodies of the SMPL family (SMPL, SMPL-H, SMPL-X) from arrays of the user's own files.

    T(β, ψ, θ) = template + shape(β) + expression(ψ) + correctives · (R(θ) - 1),
    M(β, ψ, θ) = skinned(T, J(template + shape + expression), θ) + transl

after Loper et al. 2015 (Eq. 2 to 10), Romero et al. 2017 and Pavlakos et al. 2019 (Sec. 3.1).
The mathematics is written from the papers; no file of these models is shipped.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.skinning import SkinnedBody, angles_of, shaped, skinned
from mover.core.errors import InputError
from mover.core.records import record, rows_of
from mover.core.types import BodyPose
from mover.geometry.rotations import axis_angle

HAND_POSES = ("left_hand_pose", "right_hand_pose")
FLAT = "flat_hand_mean"
"""Key of `BodyPose.extra`: not zero where hands are turned from flat, not from the mean hand."""


@record
class Hands:
    """The space of hand poses; the first axis is left, right."""

    mean: Float[Tensor, "2 45"]
    """Axis-angle vectors of a relaxed hand [rad]."""
    components: Float[Tensor, "2 components 45"]
    """Principal components of hand poses, one a row [rad]."""


@record
class FacePoints:
    """The 51 inner points of the face, on triangles of the skin."""

    vertex: Int[Tensor, "points 3"]
    share: Float[Tensor, "points 3"]


@record
class SmplBody:
    """A body of the SMPL family: a skinned body whose rest shape follows pose and expression."""

    skin: SkinnedBody
    """Template, shape space, joints and weights; its rest shape is the T-pose."""
    pose_dirs: Float[Tensor, "features verts 3"]
    """Displacement for each number of the rotations less identity, joint by joint [m]."""
    expression_dirs: Float[Tensor, "verts 3 expression"]
    """Displacement for one unit of each coefficient of the expression [m]."""
    expression_joint_dirs: Float[Tensor, "joints 3 expression"]
    """The same for the joints [m]."""
    hands: Hands | None
    face: FacePoints | None
    gender: str

    @property
    def name(self) -> str:
        """`smpl`, `smplh` or `smplx`."""
        return self.skin.name

    @property
    def faces(self) -> Int[Tensor, "faces 3"]:
        """Triangles of its surface, counter-clockwise from outside."""
        return self.skin.faces

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of its joints, in order."""
        return self.skin.joint_names

    def posed(
        self, pose: BodyPose
    ) -> tuple[Float[Tensor, "bodies verts 3"], Float[Tensor, "bodies joints 3"]]:
        """Vertices and joints of people in these poses [m], as the smplx package gives them.

        Hands may be 45 angles or fewer principal components; both are added to the mean hand
        unless `pose.extra["flat_hand_mean"]` says that the hands are turned from flat ones.

        Raises:
            InputError: If the numbers of coefficients or angles are not this model's.
        """
        turns = axis_angle(angles_of(self.skin, with_full_hands(self, pose)))
        face = pose.extra.get("expression")
        verts, joints = self.rest(turns, pose.betas, face if self.name == "smplx" else None)
        return skinned(self.skin, turns, verts, joints, pose.transl)

    def rest(
        self,
        turns: Float[Tensor, "bodies joints 3 3"],
        betas: Float[Tensor, "bodies shape"],
        face: Float[Tensor, "bodies expression"] | None,
    ) -> tuple[Float[Tensor, "bodies verts 3"], Float[Tensor, "bodies joints 3"]]:
        """Rest shape and joints with the correctives of pose and expression [m].

        Raises:
            InputError: If there are more coefficients than the model knows.
        """
        verts, joints = shaped(self.skin, betas)
        if face is not None:
            count, most = face.shape[-1], self.expression_dirs.shape[-1]
            if count > most:
                found = f"has {count} columns, the model '{self.name}' knows {most}"
                raise InputError(f"'expression' {found}")
            dirs = self.expression_dirs[..., :count].to(verts)
            verts = verts + torch.einsum("vik,bk->bvi", dirs, face.to(verts))
            dirs = self.expression_joint_dirs[..., :count].to(verts)
            joints = joints + torch.einsum("jik,bk->bji", dirs, face.to(verts))
        features = (turns[:, 1:] - torch.eye(3).to(turns)).flatten(1)
        moved = features @ self.pose_dirs.to(verts).flatten(1)
        return verts + moved.reshape(verts.shape), joints


Model = SkinnedBody | SmplBody
"""What `mover.bodies.load_model` gives."""


def with_full_hands(model: SmplBody, pose: BodyPose) -> BodyPose:
    """The same pose with hands as 45 angles each, the mean hand added; SMPL's palms stay straight.

    Raises:
        InputError: If there are more components than the model has.
    """
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


def skin_of_model(model: object) -> SkinnedBody | None:
    """The skin of a body model: template, joints and weights; None if it is not skinned."""
    match model:
        case SkinnedBody():
            return model
        case SmplBody():
            return model.skin
        case _:
            return None


def heights_of(model: object) -> tuple[float, Float[Tensor, " shape"]]:
    """Height of the mean shape, and what each number of the shape adds to it [m]."""
    skin = skin_of_model(model)
    assert skin is not None
    y = skin.verts[:, 1]
    top, sole = int(y.argmax()), int(y.argmin())
    dirs = skin.shape_dirs[top, 1] - skin.shape_dirs[sole, 1]
    return float(y[top] - y[sole]), dirs.float()


def growth_of(model: object) -> Float[Tensor, " shape"]:
    """What each number of the shape adds to the logarithm of a body's height."""
    usual, dirs = heights_of(model)
    return dirs / usual


def vertex_subset(model: object, index: Int[Tensor, " picked"]) -> Model:
    """The model with these vertices only, and without faces; its joints and poses are the same.

    Raises:
        ValueError: If it is no skinned model.
    """
    match model:
        case SkinnedBody():
            return dataclasses.replace(rows_of(model, index, "verts"), faces=model.faces[:0])
        case SmplBody():
            some = rows_of(model, index, "verts")
            skin = dataclasses.replace(some.skin, faces=model.faces[:0])
            return dataclasses.replace(some, skin=skin, face=None)
        case _:
            raise ValueError(
                f"vertex_subset: {type(model).__name__} is none of the skinned body models"
            )
