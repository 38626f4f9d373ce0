"""A body model reduced to what a fit looks at: the keypoints that a detector saw, and its joints.

The joints are turned level by level down the tree (all knees at once), and of the skin only the
vertices that are keypoints are moved, so that hundreds of frames cost a few milliseconds.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS, spots_of
from mover.bodies.skeleton import BODY
from mover.bodies.skinning import SkinnedBody, shaped
from mover.bodies.smpl_model import Model, SmplBody, skin_of_model, vertex_subset
from mover.core.records import record


@record
class Rig:
    """Joints in levels, keypoint vertices, and how keypoints are mixed of both."""

    model: SkinnedBody | SmplBody
    """The body with its keypoint vertices only; of the open body only the joints that are used."""
    levels: tuple[tuple[int, ...], ...]
    """Joints by their depth in the tree."""
    above: tuple[tuple[int, ...], ...]
    """Where the parents of the joints of a level are in the level before."""
    mix: Float[Tensor, "keypoints points"]
    """Share of each joint, then of each vertex, in each keypoint."""
    keypoints: Int[Tensor, " keypoints"]
    """Index of the keypoints in their layout: those that are used and that the model has."""

    @property
    def skin(self) -> SkinnedBody:
        """Rest shape, tree and weights."""
        return self.model.skin if isinstance(self.model, SmplBody) else self.model


@record
class Points:
    """Where a body's points are [m]."""

    keypoints: Float[Tensor, "bodies keypoints 3"]
    joints: Float[Tensor, "bodies joints 3"]


def rig_of(model: Model, layout: str, used: Bool[Tensor, " layout"]) -> Rig:
    """The rig of the keypoints of a layout that are `used`.

    Raises:
        ValueError: If there is no such layout.
    """
    spots = spots_of(model, layout)
    index = torch.nonzero(used.cpu() & spots.there)[:, 0]
    vertex, share, joint = spots.vertex[index], spots.share[index], spots.joint[index]
    needed = torch.unique(vertex[joint < 0])
    small = vertex_subset(model, needed)
    names = [LAYOUTS[layout][k] for k in index.tolist()]
    if isinstance(small, SkinnedBody) and all(n in BODY or _on_body(n) for n in names):
        small = _cut(small, len(BODY))
    skin = skin_of_model(small)
    assert skin is not None
    count = len(skin.parents)
    mix = torch.zeros(len(index), count + len(needed))
    is_joint = joint >= 0
    mix[is_joint, joint[is_joint]] = 1
    column = count + torch.searchsorted(needed, vertex)
    rows = torch.nonzero(~is_joint)[:, 0]
    mix[rows] = mix[rows].scatter_add(1, column[rows], share[rows])
    levels, above = _levels(skin.parents)
    return Rig(small, levels, above, mix, index)


def _on_body(name: str) -> bool:
    """Whether a keypoint follows one of the 22 joints of the body."""
    return not any(part in name for part in ("index", "middle", "ring", "pinky", "thumb", "jaw"))


def _cut(skin: SkinnedBody, joints: int) -> SkinnedBody:
    """The body with its first joints only; none of its vertices follows another one."""
    weights = skin.weights[:, :joints]
    return dataclasses.replace(
        skin,
        joint_names=skin.joint_names[:joints],
        parents=skin.parents[:joints],
        joints=skin.joints[:joints],
        weights=weights / weights.sum(1, keepdim=True),
        joint_dirs=skin.joint_dirs[:joints],
        tpose=skin.tpose[:joints],
    )


def _levels(
    parents: tuple[int, ...],
) -> tuple[tuple[tuple[int, ...], ...], tuple[tuple[int, ...], ...]]:
    """Joints by depth, and the places of their parents in the level above."""
    depth = [0] * len(parents)
    for joint, parent in enumerate(parents):
        depth[joint] = depth[parent] + 1 if parent >= 0 else 0
    levels = [tuple(j for j, d in enumerate(depth) if d == k) for k in range(max(depth) + 1)]
    above = [
        tuple(levels[k - 1].index(parents[j]) for j in levels[k]) for k in range(1, len(levels))
    ]
    return tuple(levels), ((), *above)


def move(
    rig: Rig,
    turns: Float[Tensor, "bodies joints 3 3"],
    betas: Float[Tensor, "bodies shape"],
    pelvis: Float[Tensor, "bodies 3"],
    expression: Float[Tensor, "bodies expression"] | None = None,
) -> Points:
    """Keypoints and joints of bodies whose pelvis is at a place [m], differentiable in all."""
    verts, joints = shaped(rig.skin, betas)
    if isinstance(rig.model, SmplBody):
        verts, joints = _corrected(rig.model, turns, verts, joints, expression)
    world, places = _down_the_tree(rig, turns, joints)
    offset = places - (world @ joints[..., None])[..., 0]
    moves = torch.cat([world, offset[..., None]], -1).flatten(2)
    skin = (rig.skin.weights.to(moves) @ moves).unflatten(-1, (3, 4))
    moved = (skin[..., :3] @ verts[..., None])[..., 0] + skin[..., 3]
    shift = (pelvis - places[:, 0])[:, None]
    both = torch.cat([places, moved], 1)
    return Points(rig.mix.to(both) @ both + shift, places + shift)


def _corrected(
    model: SmplBody,
    turns: Float[Tensor, "bodies joints 3 3"],
    verts: Float[Tensor, "bodies verts 3"],
    joints: Float[Tensor, "bodies joints 3"],
    expression: Float[Tensor, "bodies expression"] | None,
) -> tuple[Float[Tensor, "bodies verts 3"], Float[Tensor, "bodies joints 3"]]:
    """The rest shape with the correctives of the pose and the expression."""
    features = (turns[:, 1:] - torch.eye(3).to(turns)).flatten(1)
    verts = verts + (features @ model.pose_dirs.to(verts).flatten(1)).reshape(verts.shape)
    if expression is not None and expression.shape[-1]:
        count = expression.shape[-1]
        dirs = model.expression_dirs[..., :count].to(verts)
        verts = verts + torch.einsum("vik,bk->bvi", dirs, expression)
        joint_dirs = model.expression_joint_dirs[..., :count].to(verts)
        joints = joints + torch.einsum("jik,bk->bji", joint_dirs, expression)
    return verts, joints


def _down_the_tree(
    rig: Rig, turns: Float[Tensor, "bodies joints 3 3"], joints: Float[Tensor, "bodies joints 3"]
) -> tuple[Float[Tensor, "bodies joints 3 3"], Float[Tensor, "bodies joints 3"]]:
    """World rotation (from the rest shape) and place of each joint."""
    tpose = rig.skin.tpose.to(turns)
    parents = torch.tensor([max(p, 0) for p in rig.skin.parents], device=turns.device)
    bones = tpose[parents] @ (joints - joints[:, parents])[..., None]
    first = list(rig.levels[0])
    world, places = [turns[:, first]], [joints[:, first]]
    for level, above in zip(rig.levels[1:], rig.above[1:], strict=True):
        here, up = list(level), list(above)
        parent = world[-1][:, up]
        world.append(parent @ turns[:, here])
        places.append(places[-1][:, up] + (parent @ bones[:, here])[..., 0])
    order = torch.tensor([j for level in rig.levels for j in level], device=turns.device)
    back = torch.argsort(order)
    return torch.cat(world, 1)[:, back] @ tpose, torch.cat(places, 1)[:, back]
