r"""A learned prior of the pose: VPoser's decoder, with the user's own weights.

It makes a body's pose from 32 normal numbers:

    z -> linear(32, h) -> leaky ReLU -> linear(h, h) -> leaky ReLU -> linear(h, 6 J)
      -> J x two columns -> Gram-Schmidt -> rotations

after Pavlakos et al. 2019 (Sec. 3.3), from the checkpoint of the first version
(`bodyprior_dec_fc1` ...) or of the second (`vp_model.decoder_net.` ...). The network is
reimplemented from its description; no weights are shipped.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies.transfer import solved
from mover.core.errors import InputError
from mover.core.observe import Energy
from mover.core.pickles import load_weights
from mover.core.records import record
from mover.fitting.unknowns import ANGLES, PosePrior
from mover.geometry.rotations import axis_angle

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
