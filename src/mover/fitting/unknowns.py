"""A body model reduced to what a fit looks at, what is solved of it, and L-BFGS over all frames.

Of the skin only the vertices that are keypoints are moved, so that hundreds of frames cost a few
milliseconds.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS, spots_of
from mover.bodies.skeleton import BODY
from mover.bodies.skinning import SkinnedBody, pose_joints, vertex_subset, widths_of
from mover.bodies.transfer import solved
from mover.core.observe import Energy
from mover.core.records import record, rows_of
from mover.fitting.priors import kind_of, spreads
from mover.geometry.rotations import axis_angle


@record
class Rig:
    """Joints, keypoint vertices, and how keypoints are mixed of both."""

    model: SkinnedBody
    """The body with its keypoint vertices only; of the open body only the joints that are used."""
    mix: Float[Tensor, "keypoints points"]
    """Share of each joint, then of each vertex, in each keypoint."""
    keypoints: Int[Tensor, " keypoints"]
    """Index of the keypoints in their layout: those that are used and that the model has."""
    names: tuple[str, ...]  #: of these keypoints
    bones: Int[Tensor, " keypoints"]
    """The joint whose rotation carries each keypoint: of a joint, its parent."""


@record
class Points:
    """Where a body's points are [m]."""

    keypoints: Float[Tensor, "bodies keypoints 3"]
    joints: Float[Tensor, "bodies joints 3"]


def rig_of(model: SkinnedBody, layout: str, used: Bool[Tensor, " layout"]) -> Rig:
    """The rig of the keypoints of a layout that are `used`."""
    spots = spots_of(model, layout)
    index = torch.nonzero(used.cpu() & spots.there)[:, 0]
    names = tuple(LAYOUTS[layout][k] for k in index.tolist())
    vertex, share, joint = spots.vertex[index], spots.share[index], spots.joint[index]
    needed = torch.unique(vertex[joint < 0])
    small = vertex_subset(model, needed)
    on_body = not any(kind_of(name) == "hand" or "jaw" in name for name in names)
    if small.pose_dirs is None and on_body:  # none of its vertices follows another joint
        part, n = rows_of(small, torch.arange(len(BODY)), "joints"), len(BODY)
        small = dataclasses.replace(
            part, joint_names=small.joint_names[:n], parents=small.parents[:n],
            weights=part.weights / part.weights.sum(1, keepdim=True),
        )  # fmt: skip
    count = len(small.parents)
    mix = torch.zeros(len(index), count + len(needed))
    is_joint = joint >= 0
    mix[is_joint, joint[is_joint]] = 1
    column = count + torch.searchsorted(needed, vertex)
    rows = torch.nonzero(~is_joint)[:, 0]
    mix[rows] = mix[rows].scatter_add(1, column[rows], share[rows])
    parents = torch.tensor(small.parents).clamp_min(0)
    first = torch.searchsorted(needed, vertex[:, 0].contiguous()).clamp_max(len(needed) - 1)
    bones = torch.where(is_joint, parents[joint.clamp_min(0)], small.weights[first].argmax(1))
    return Rig(small, mix, index, names, bones)


HAND = 45
NO_FLOOR = torch.zeros(0)
NO_OFFSETS = torch.zeros(0, 0, 3)


@record
class Unknowns:
    """One row a body, one shape a person."""

    turn: Float[Tensor, "bodies 3"]  #: turns the root's first guess, in camera axes [rad]
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


@dataclass(frozen=True)
class PosePrior:
    """How a code becomes the angles of a body."""

    decode: Callable[[Float[Tensor, "bodies code"]], Float[Tensor, "bodies angles"]]
    """From codes to angles [rad]."""
    width: int
    """Numbers of a code, which are normally distributed; 0: the code is the angles themselves."""


ANGLES = PosePrior(lambda code: code, 0)
"""No learned prior: ranges of motion, a resting pose, and the pose to start from."""


@record
class Frame:
    """What turns unknowns into a body, and is not solved."""

    rig: Rig
    root: Float[Tensor, "bodies 3 3"]  #: first guess of the root's rotation, in camera axes
    person: Int[Tensor, " bodies"]  #: row of `betas`
    growth: Float[Tensor, " shape"] | None = None
    """What each number of the shape adds to the logarithm of the depth: a taller person farther
    away looks the same, so that shapes alone would hardly move. None: nothing."""
    prior: PosePrior = ANGLES


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


def points_of(at: Unknowns, frame: Frame) -> Points:
    """Keypoints and joints of the bodies, in camera axes [m], differentiable in the unknowns."""
    rig, turns = frame.rig, turns_of(at, frame)
    expression = at.face[:, 3:] if at.face.shape[1] > 3 else None
    verts, joints = rig.model.rest(turns, at.betas[frame.person], expression)
    world, places = pose_joints(rig.model, turns, joints)
    offset = places - (world @ joints[..., None])[..., 0]
    moves = torch.cat([world, offset[..., None]], -1).flatten(2)
    skin = (rig.model.weights.to(moves) @ moves).unflatten(-1, (3, 4))
    moved = (skin[..., :3] @ verts[..., None])[..., 0] + skin[..., 3]
    shift = (pelvis_of(at, frame) - places[:, 0])[:, None]
    both = torch.cat([places, moved], 1)
    keypoints = rig.mix.to(both) @ both + shift
    if at.offset.shape[1]:
        lasting = at.offset[frame.person]
        keypoints = keypoints + (world[:, rig.bones] @ lasting[..., None])[..., 0]
    return Points(keypoints, places + shift)


def turns_of(at: Unknowns, frame: Frame) -> Float[Tensor, "bodies joints 3 3"]:
    """Rotations of all joints of the rig; eyes look straight, SMPL's palms are straight."""
    rig, none = frame.rig, at.turn.new_zeros(len(at.turn), 3)
    parts = [frame.prior.decode(at.code)]
    if len(rig.model.parents) <= 24:
        parts += [none] * (len(rig.model.parents) - 22)
    else:
        jaw = at.face[:, :3] if at.face.shape[1] else none
        own = {"jaw_pose": jaw, "leye_pose": none, "reye_pose": none}
        parts += [own[name] for name in widths_of(rig.model) if name in own]
        parts += [hand_angles(rig, at.hands, side) for side in (0, 1)]
    root = axis_angle(at.turn) @ frame.root
    return torch.cat([root[:, None], axis_angle(torch.cat(parts, -1).unflatten(-1, (-1, 3)))], 1)


def hand_angles(
    rig: Rig, hands: Float[Tensor, "bodies hands"], side: int
) -> Float[Tensor, "bodies 45"]:
    """Angles of a hand from flat [rad]: the mean hand and principal components, or as they are."""
    width = hands.shape[1] // 2
    own = hands[:, side * width : (side + 1) * width]
    if rig.model.hands is not None:
        space = rig.model.hands
        mean = space.mean[side].to(hands).expand(len(hands), -1)
        return mean + own @ space.components[side][:width].to(hands) if width else mean
    return own if width == HAND else hands.new_zeros(len(hands), HAND)


EVERYTHING = ("turn", "code", "place", "betas", "hands", "face", "offset", "floor")
OF_ROWS = tuple(name for name in EVERYTHING if name not in ("betas", "offset", "floor"))


def solve(
    energy: Callable[[Unknowns], Energy],
    start: Unknowns,
    steps: int,
    free: tuple[str, ...] = EVERYTHING,
) -> Unknowns:
    """Lower the energy in the fields `free`; see `solved`."""
    scale = {
        name: torch.tensor(
            BENDS if name == "code" and at.shape[-1] == len(BENDS) else SCALES[name],
            dtype=at.dtype, device=at.device,
        )
        for name in free if (at := getattr(start, name)).numel()
    }  # fmt: skip

    def real(values: dict[str, Tensor]) -> Unknowns:
        return dataclasses.replace(start, **{n: v * scale[n] for n, v in values.items()})

    values = {name: (getattr(start, name) / scale[name]).detach() for name in scale}
    return real(solved(values, lambda v: energy(real(v)).total, steps))
