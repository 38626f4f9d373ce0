"""A body model reduced to what a fit looks at, what is solved of it, and L-BFGS over all frames.

Of the skin only the vertices that are keypoints are moved, so that hundreds of frames cost a few
milliseconds. The pose may be that of VPoser's decoder, with the user's own weights, which makes it
from 32 normal numbers:

    z -> linear(32, h) -> leaky ReLU -> linear(h, h) -> leaky ReLU -> linear(h, 6 J)
      -> J x two columns -> Gram-Schmidt -> rotations

after Pavlakos et al. 2019 (Sec. 3.3), from the checkpoint of the first version
(`bodyprior_dec_fc1` ...) or of the second (`vp_model.decoder_net.` ...). The network is
reimplemented from its description; no weights are shipped.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS, spots_of
from mover.bodies.skeleton import BODY
from mover.bodies.skinning import SkinnedBody, pose_joints, vertex_subset, widths_of
from mover.bodies.smpl_files import solved
from mover.core.errors import InputError
from mover.core.observe import Energy
from mover.core.pickles import load_weights
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


ENCODING_STEPS = 100


def encoded(
    prior: PosePrior, angles: Float[Tensor, "bodies angles"]
) -> Float[Tensor, "bodies code"]:
    """Codes whose bodies turn their joints as these angles do, as far as the prior can."""
    if not prior.width:
        return angles
    goal = axis_angle(angles.unflatten(-1, (-1, 3)))

    def energy(values: dict[str, Tensor]) -> Float[Tensor, ""]:
        turns = axis_angle(prior.decode(values["code"]).unflatten(-1, (-1, 3)))
        miss = (turns - goal[:, : turns.shape[1]]).square().flatten(1).sum(-1)
        return Energy({"turns": miss, "size": 3e-4 * values["code"].square().sum(-1)}).total

    start = {"code": angles.new_zeros(len(angles), prior.width)}
    return solved(start, energy, ENCODING_STEPS)["code"]


BODY_JOINTS = 21
LAYERS = (
    (0.2, ("bodyprior_dec_fc1", "bodyprior_dec_fc2", "bodyprior_dec_out")),
    (0.01, ("decoder_net.0", "decoder_net.3", "decoder_net.5")),
)
"""Slope of the leaky ReLU and names of the layers in the checkpoints of both versions."""


@record
class Vposer:
    """Three layers; weights are (out, in)."""

    slope: float
    weights: tuple[Float[Tensor, "_ _"], ...]
    biases: tuple[Float[Tensor, " _"], ...]


def load_vposer(path: Path) -> Vposer:
    """The decoder of a checkpoint, or of the newest one of a folder with `snapshots/`.

    Raises:
        InputError: If there is none, or its layers are not VPoser's.
    """
    file = path
    if path.is_dir():
        found = sorted(p for s in ("*.pt", "*.ckpt") for p in path.rglob(s))
        if not found:
            raise InputError(f"{path}: has no .pt or .ckpt file, expected VPoser's snapshots")
        file = found[-1]
    state = load_weights(file, "state_dict", "VPoser's weights")
    slope, names = LAYERS[0 if any(LAYERS[0][1][0] in key for key in state) else 1]
    return _network_of(state, slope, names, file.name)


def _network_of(
    state: dict[str, Tensor], slope: float, names: tuple[str, ...], file: str
) -> Vposer:
    """Three layers, whatever the prefix of their names, that fit each other and end in a body."""
    found: list[Tensor] = []
    for name in (f"{layer}.{part}" for layer in names for part in ("weight", "bias")):
        keys = [key for key in state if key.endswith(name)]
        if len(keys) != 1:
            some = ", ".join(sorted(state)[:8]) or "nothing"
            raise InputError(f"{file}: has no '{name}', found {some} ...")
        found.append(state[keys[0]].contiguous())
    layers = list(zip(found[::2], found[1::2], strict=True))
    (a, _), (b, _), (c, _) = layers
    fits = all(weight.ndim == 2 and bias.shape == weight.shape[:1] for weight, bias in layers)
    joined = fits and len(a) == b.shape[1] and len(b) == c.shape[1]
    if not joined or len(c) < 6 * BODY_JOINTS:
        shapes = [(tuple(weight.shape), tuple(bias.shape)) for weight, bias in layers]
        expected = f"3 layers that end in 6 numbers for {BODY_JOINTS} joints or more"
        raise InputError(f"{file}: has layers {shapes}, expected {expected}")
    return Vposer(slope, tuple(found[::2]), tuple(found[1::2]))


def decoded(network: Vposer, code: Float[Tensor, "bodies code"]) -> Float[Tensor, "bodies 21 3 3"]:
    """Rotations of the 21 joints of the body."""
    x = code
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        x = x @ weight.mT.to(x) + bias.to(x)
        if k < 2:
            x = torch.nn.functional.leaky_relu(x, network.slope)
    return gram_schmidt(x.unflatten(-1, (-1, 3, 2))[:, :BODY_JOINTS])


def gram_schmidt(columns: Float[Tensor, "*batch 3 2"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations from two columns: the first, the part of the second square to it, their product."""
    first, second = columns.unbind(-1)
    x = torch.nn.functional.normalize(first, dim=-1)
    y = second - (x * second).sum(-1, keepdim=True) * x
    y = torch.nn.functional.normalize(y, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


def vectors_of(turns: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors of rotations [rad], with finite gradients everywhere below 180 degrees."""
    ends = ((2, 1), (0, 2), (1, 0))
    skew = torch.stack([turns[..., i, j] - turns[..., j, i] for i, j in ends], -1)
    cosine = ((turns.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)
    sine = (skew.square().sum(-1) / 4 + 1e-12).sqrt()
    angle = torch.atan2(sine, cosine)
    return 0.5 * skew * (angle / sine)[..., None]


def vposer_prior(network: Vposer) -> PosePrior:
    """The prior of a decoder: the code is normally distributed."""
    width = network.weights[0].shape[1]

    def decode(code: Float[Tensor, "bodies code"]) -> Float[Tensor, "bodies angles"]:
        return vectors_of(decoded(network, code)).flatten(1)

    return PosePrior(decode, width)


def prior_of(weights: Path | None) -> PosePrior:
    """VPoser's prior from its weights; None: no learned prior."""
    return ANGLES if weights is None else vposer_prior(load_vposer(weights))
