"""A body model reduced to what a fit looks at, what is solved of it, and L-BFGS over all frames.

The joints are turned level by level down the tree (all knees at once), and of the skin only the
vertices that are keypoints are moved, so that hundreds of frames cost a few milliseconds.
"""

import dataclasses
import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS, spots_of
from mover.bodies.skeleton import BODY
from mover.bodies.skinning import SkinnedBody, shaped, widths_of
from mover.bodies.smpl_model import Model, SmplBody, skin_of_model, vertex_subset
from mover.core.observe import Energy
from mover.core.records import record
from mover.fitting.limits import spreads
from mover.geometry.rotations import axis_angle

HISTORY = 100
"""Steps that L-BFGS remembers: all poses jointly constrain the heights, which converge slowly."""


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
    bones: Int[Tensor, " keypoints"]
    """The joint whose rotation carries each keypoint: of a joint, its parent."""

    @property
    def skin(self) -> SkinnedBody:
        """Rest shape, tree and weights."""
        return self.model.skin if isinstance(self.model, SmplBody) else self.model


@record
class Points:
    """Where a body's points are [m]."""

    keypoints: Float[Tensor, "bodies keypoints 3"]
    joints: Float[Tensor, "bodies joints 3"]


FAR = ("index", "middle", "ring", "pinky", "thumb", "jaw")
"""Keypoints that no part of the 22 joints moves."""


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
    on_body = all(n in BODY or not any(part in n for part in FAR) for n in names)
    if isinstance(small, SkinnedBody) and on_body:
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
    parents = torch.tensor(skin.parents).clamp_min(0)
    first = torch.searchsorted(needed, vertex[:, 0].contiguous()).clamp_max(len(needed) - 1)
    bones = torch.where(is_joint, parents[joint.clamp_min(0)], skin.weights[first].argmax(1))
    return Rig(small, levels, above, mix, index, bones)


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
    lasting: Float[Tensor, "bodies keypoints 3"] | None = None,
) -> Points:
    """Keypoints and joints of bodies whose pelvis is at a place [m], differentiable in all.

    `lasting` moves each keypoint in the axes of its bone [m].
    """
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
    keypoints = rig.mix.to(both) @ both + shift
    if lasting is not None:
        keypoints = keypoints + (world[:, rig.bones] @ lasting[..., None])[..., 0]
    return Points(keypoints, places + shift)


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


# What is solved, and what it means: joints' rotations, shapes, places.


HAND = 45
NO_FLOOR = torch.zeros(0)
NO_OFFSETS = torch.zeros(0, 0, 3)


@record
class Unknowns:
    """One row a body, one shape a person."""

    turn: Float[Tensor, "bodies 3"]
    """Turns the root's first guess, in camera axes [rad]."""
    code: Float[Tensor, "bodies code"]
    """The pose of the body: its angles [rad], or the code of a learned prior."""
    place: Float[Tensor, "bodies 3"]
    """The pelvis: x / z, y / z, and the logarithm of its depth for a person of the usual size."""
    betas: Float[Tensor, "people shape"]
    hands: Float[Tensor, "bodies hands"]
    """Left, then right; zero columns where no hands are fitted."""
    face: Float[Tensor, "bodies face"]
    """Jaw [rad], then expression; zero columns where no face is fitted."""
    floor: Float[Tensor, " floor"] = NO_FLOOR
    """Two slopes of the floor, and its height along upright from the camera under people of the
    usual size [m]; or none."""
    offset: Float[Tensor, "owners keypoints 3"] = NO_OFFSETS
    """Of each person: how far the detector's keypoints lie lastingly from the model's, in the axes
    of their bones [m]; no keypoints where that is not fitted."""


BEND = 0.3  # [rad]
SCALES = {"turn": 0.2, "code": BEND, "place": (0.01, 0.01, 0.05), "betas": 1.0, "hands": 0.5,
          "face": 0.3, "offset": 0.02, "floor": 0.03}  # fmt: skip
"""How far each usually moves: the solver works in these units."""
BENDS = tuple(1 / math.hypot(1 / s, 1 / BEND) for s in spreads(1, torch.zeros(1))[0].tolist())
"""The same for angles, most of which people turn less than keypoints could tell."""

Decode = Callable[[Float[Tensor, "bodies code"]], Float[Tensor, "bodies angles"]]


@record
class Frame:
    """What turns unknowns into a body, and is not solved."""

    rig: Rig
    root: Float[Tensor, "bodies 3 3"]
    """First guess of the root's rotation, in camera axes."""
    person: Int[Tensor, " bodies"]
    """Row of `betas`."""
    growth: Float[Tensor, " shape"] | None = None
    """What each number of the shape adds to the logarithm of the depth: who is taller and farther
    looks the same, so that shapes alone would hardly move. None: nothing."""


def log_depth(at: Unknowns, frame: Frame) -> Float[Tensor, " bodies"]:
    """Logarithm of the depth of the pelvis [m]."""
    return at.place[:, 2] + grown(at, frame)[frame.person]


def grown(at: Unknowns, frame: Frame) -> Float[Tensor, " people"]:
    """Logarithm of how much taller than usual people are, whose depths are counted so."""
    if frame.growth is None:
        return at.betas.new_zeros(len(at.betas))
    return at.betas @ frame.growth[: at.betas.shape[1]]


def floor_of(at: Unknowns, frame: Frame) -> Float[Tensor, " floor"]:
    """Slopes of the floor, and its height along upright from the camera [m]."""
    return torch.cat([at.floor[:2], at.floor[2:] * grown(at, frame).mean().exp()])


def pelvis_of(at: Unknowns, frame: Frame) -> Float[Tensor, "bodies 3"]:
    """Place of the pelvis in camera axes [m]."""
    depth = log_depth(at, frame).exp()[:, None]
    return torch.cat([at.place[:, :2] * depth, depth], -1)


def place_of(pelvis: Float[Tensor, "bodies 3"]) -> Float[Tensor, "bodies 3"]:
    """The unknown of a place in camera axes [m]."""
    depth = pelvis[:, 2:].clamp_min(0.2)
    return torch.cat([pelvis[:, :2] / depth, depth.log()], -1)


def points_of(at: Unknowns, frame: Frame, decode: Decode) -> Points:
    """Keypoints and joints of the bodies, in camera axes [m]."""
    expression = at.face[:, 3:] if at.face.shape[1] > 3 else None
    turns = turns_of(at, frame, decode(at.code))
    lasting = at.offset[frame.person] if at.offset.shape[1] else None
    return move(frame.rig, turns, at.betas[frame.person], pelvis_of(at, frame), expression, lasting)


def turns_of(
    at: Unknowns, frame: Frame, angles: Float[Tensor, "bodies angles"]
) -> Float[Tensor, "bodies joints 3 3"]:
    """Rotations of all joints of the rig."""
    root = axis_angle(at.turn) @ frame.root
    rest = torch.cat([angles, *_others(at, frame.rig)], -1)
    return torch.cat([root[:, None], axis_angle(rest.unflatten(-1, (-1, 3)))], 1)


def _others(at: Unknowns, rig: Rig) -> list[Tensor]:
    """Angles of jaw, eyes and hands, as the rig's joints follow; SMPL's palms are straight."""
    if len(rig.skin.parents) <= 24:
        return [at.turn.new_zeros(len(at.turn), 3 * (len(rig.skin.parents) - 22))]
    parts: list[Tensor] = []
    none = at.turn.new_zeros(len(at.turn), 3)
    for name in widths_of(rig.skin):
        if name == "jaw_pose":
            parts.append(at.face[:, :3] if at.face.shape[1] else none)
        elif name in ("leye_pose", "reye_pose"):
            parts.append(none)
    return [*parts, *(hand_angles(rig, at.hands, side) for side in (0, 1))]


def hand_angles(
    rig: Rig, hands: Float[Tensor, "bodies hands"], side: int
) -> Float[Tensor, "bodies 45"]:
    """Angles of a hand from flat [rad]: the mean hand and principal components, or as they are."""
    width = hands.shape[1] // 2
    own = hands[:, side * width : (side + 1) * width]
    if isinstance(rig.model, SmplBody) and rig.model.hands is not None:
        space = rig.model.hands
        mean = space.mean[side].to(hands).expand(len(hands), -1)
        return mean + own @ space.components[side][:width].to(hands) if width else mean
    return own if width == HAND else hands.new_zeros(len(hands), HAND)


def with_values(at: Unknowns, values: dict[str, Tensor]) -> Unknowns:
    """The unknowns with some fields from the solver's units."""
    real = {name: value * _scale(name, value) for name, value in values.items()}
    return dataclasses.replace(at, **real)


def to_values(at: Unknowns, free: tuple[str, ...]) -> dict[str, Tensor]:
    """Some fields in the solver's units; fields without columns are left out."""
    found = {name: getattr(at, name) for name in free}
    return {n: (v / _scale(n, v)).detach() for n, v in found.items() if v.numel()}


def _scale(name: str, value: Tensor) -> Tensor:
    if name == "code" and value.shape[-1] == len(BENDS):
        return torch.tensor(BENDS, dtype=value.dtype, device=value.device)
    return torch.tensor(SCALES[name], dtype=value.dtype, device=value.device)


EVERYTHING = ("turn", "code", "place", "betas", "hands", "face", "offset", "floor")
OF_ROWS = tuple(name for name in EVERYTHING if name not in ("betas", "offset", "floor"))


def solve(
    energy: Callable[[Unknowns], Energy],
    start: Unknowns,
    steps: int,
    free: tuple[str, ...] = EVERYTHING,
) -> Unknowns:
    """Lower the energy in the fields `free`.

    Raises:
        ValueError: If the energy is not finite at the start.
    """
    values = to_values(start, free)
    return with_values(start, lowered(lambda v: energy(with_values(start, v)), values, steps))


def lowered(
    energy: Callable[[dict[str, Tensor]], Energy], start: dict[str, Tensor], steps: int
) -> dict[str, Tensor]:
    """Lower an energy of named tensors by L-BFGS with a strong Wolfe line search.

    Raises:
        ValueError: If the energy is not finite at the start.
    """
    values = {n: v.detach().clone().requires_grad_() for n, v in start.items()}
    solver = torch.optim.LBFGS(
        list(values.values()), max_iter=steps, max_eval=2 * steps, history_size=20,
        tolerance_grad=1e-6, tolerance_change=1e-9, line_search_fn="strong_wolfe",
    )  # fmt: skip

    def closure() -> Float[Tensor, ""]:
        solver.zero_grad()
        value = energy(values).total
        torch.autograd.backward(value)
        return value

    first = solver.step(closure)  # pyright: ignore[reportArgumentType]
    if not bool(torch.as_tensor(first).isfinite()):
        raise ValueError("the energy of the bodies is not finite")
    return {n: v.detach() for n, v in values.items()}
