r"""Priors of the pose: joint limits, a pose to stay near to, or a learned code.

VPoser's decoder makes a body's pose from 32 normal numbers, with the user's own weights:

    z -> linear(32, h) -> leaky ReLU -> linear(h, h) -> leaky ReLU -> linear(h, 6 J)
      -> J x two columns -> Gram-Schmidt -> rotations

after Pavlakos et al. 2019 (Sec. 3.3). Three kinds of file hold it: the first version's checkpoint
(`bodyprior_dec_fc1` ...), the second's (`vp_model.decoder_net.` ...), and arrays of another
release (`fc1W` ..., where tanh takes the place of the leaky ReLU and the nearest rotation that of
Gram-Schmidt). The network is reimplemented from its description; no weights are shipped.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.observe import Energy
from mover.core.records import BROKEN, record
from mover.fitting.unknowns import lowered
from mover.geometry.rotations import axis_angle

Decode = Callable[[Float[Tensor, "bodies code"]], Float[Tensor, "bodies angles"]]
ENCODING_STEPS = 100


@dataclass(frozen=True)
class PosePrior:
    """How a code becomes the angles of a body."""

    decode: Decode
    """From codes to angles [rad]."""
    width: int
    """Numbers of a code; 0: the code is the angles themselves."""


def same(code: Float[Tensor, "bodies code"]) -> Float[Tensor, "bodies code"]:
    """Angles that are their own code."""
    return code


ANGLES = PosePrior(same, 0)
"""No learned prior: ranges of motion, a resting pose, and the pose to start from."""


def encoded(
    prior: PosePrior, angles: Float[Tensor, "bodies angles"]
) -> Float[Tensor, "bodies code"]:
    """Codes whose bodies turn their joints as these angles do, as far as the prior can."""
    if not prior.width:
        return angles
    goal = axis_angle(angles.unflatten(-1, (-1, 3)))

    def energy(values: dict[str, Tensor]) -> Energy:
        turns = axis_angle(prior.decode(values["code"]).unflatten(-1, (-1, 3)))
        miss = (turns - goal[:, : turns.shape[1]]).square().flatten(1).sum(-1)
        return Energy({"turns": miss, "size": 3e-4 * values["code"].square().sum(-1)})

    start = {"code": angles.new_zeros(len(angles), prior.width)}
    return lowered(energy, start, ENCODING_STEPS)["code"]


BODY_JOINTS = 21
SLOPES = {"v1": 0.2, "v2": 0.01, "arrays": 0.0}
NAMES = {
    "v1": ("bodyprior_dec_fc1", "bodyprior_dec_fc2", "bodyprior_dec_out"),
    "v2": ("decoder_net.0", "decoder_net.3", "decoder_net.5"),
}
"""Layers of the decoder in the checkpoints of both versions."""


@record
class Vposer:
    """Three layers; weights are (out, in)."""

    kind: Literal["v1", "v2", "arrays"]
    weights: tuple[Float[Tensor, "_ _"], ...]
    biases: tuple[Float[Tensor, " _"], ...]


def load_vposer(path: Path) -> Vposer:
    """The decoder of a checkpoint, of a folder with `snapshots/`, or of an .npz file.

    Raises:
        InputError: If there is none, or its layers are not VPoser's.
    """
    file = _file(path)
    state = _arrays(file) if file.suffix == ".npz" else _checkpoint(file)
    if "fc1W" in state:
        layers = [(state[f"fc{k}W"].mT, state[f"fc{k}b"]) for k in (1, 2, 3) if f"fc{k}W" in state]
        kind: Literal["v1", "v2", "arrays"] = "arrays"
    else:
        kind = "v1" if any(NAMES["v1"][0] in key for key in state) else "v2"
        layers = [_layer(state, name, file) for name in NAMES[kind]]
    _check(layers, file)
    weights = tuple(weight.float().contiguous() for weight, _ in layers)
    return Vposer(kind, weights, tuple(bias.float() for _, bias in layers))


def _file(path: Path) -> Path:
    """The newest snapshot of a folder."""
    if path.is_dir():
        found = sorted(p for s in ("*.pt", "*.ckpt", "*.npz") for p in path.rglob(s))
        if not found:
            raise InputError(f"{path}: has no .pt, .ckpt or .npz file, expected VPoser's snapshots")
        return found[-1]
    if not path.exists():
        raise InputError(f"{path}: does not exist, expected VPoser's weights")
    return path


def _arrays(file: Path) -> dict[str, Tensor]:
    import numpy as np

    try:
        with np.load(file, allow_pickle=False) as data:
            return {key: torch.from_numpy(data[key]) for key in data.files}
    except BROKEN as error:
        raise InputError(f"{file.name}: cannot be read as arrays ({error})") from error


def _checkpoint(file: Path) -> dict[str, Tensor]:
    """Tensors by name; nothing else in the file is ever run."""
    try:
        tree: Any = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(f"{file.name}: cannot be read as plain weights ({error})") from error
    if isinstance(tree, Mapping) and isinstance(tree.get("state_dict"), Mapping):
        tree = tree["state_dict"]
    if not isinstance(tree, Mapping):
        raise InputError(f"{file.name}: holds a {type(tree).__name__}, expected named weights")
    return {str(k): v for k, v in tree.items() if isinstance(v, Tensor)}


def _layer(state: dict[str, Tensor], name: str, file: Path) -> tuple[Tensor, Tensor]:
    """Weight and bias of a layer, whatever its prefix."""
    found: list[Tensor] = []
    for part in ("weight", "bias"):
        keys = [key for key in state if key.endswith(f"{name}.{part}")]
        if len(keys) != 1:
            some = ", ".join(sorted(state)[:8]) or "nothing"
            raise InputError(f"{file.name}: has no '{name}.{part}', found {some} ...")
        found.append(state[keys[0]])
    return found[0], found[1]


def _check(layers: list[tuple[Tensor, Tensor]], file: Path) -> None:
    """Three layers that fit each other and end in six numbers for at least 21 joints."""
    shapes = [(tuple(w.shape), tuple(b.shape)) for w, b in layers]
    fits = len(layers) == 3 and all(w.ndim == 2 and b.shape == w.shape[:1] for w, b in layers)
    if fits:
        (a, _), (b, _), (c, _) = layers
        fits = len(a) == b.shape[1] and len(b) == c.shape[1] and len(c) >= 6 * BODY_JOINTS
    if not fits:
        expected = f"3 layers that end in 6 numbers for {BODY_JOINTS} joints or more"
        raise InputError(f"{file.name}: has layers {shapes}, expected {expected}")


def decoded(network: Vposer, code: Float[Tensor, "bodies code"]) -> Float[Tensor, "bodies 21 3 3"]:
    """Rotations of the 21 joints of the body."""
    x, slope = code, SLOPES[network.kind]
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        x = x @ weight.mT.to(x) + bias.to(x)
        if k < 2:
            x = x.tanh() if network.kind == "arrays" else torch.nn.functional.leaky_relu(x, slope)
    if network.kind == "arrays" and x.shape[-1] % 9 == 0 and x.shape[-1] % 6:
        return nearest_rotations(x.unflatten(-1, (-1, 3, 3))[:, :BODY_JOINTS])
    return gram_schmidt(x.unflatten(-1, (-1, 3, 2))[:, :BODY_JOINTS])


def gram_schmidt(columns: Float[Tensor, "*batch 3 2"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations from two columns: the first, the part of the second square to it, their product."""
    first, second = columns.unbind(-1)
    x = torch.nn.functional.normalize(first, dim=-1)
    y = second - (x * second).sum(-1, keepdim=True) * x
    y = torch.nn.functional.normalize(y, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


def nearest_rotations(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotations nearest to matrices."""
    u, _, vt = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vt)[..., None, None]
    ends = torch.cat([torch.ones_like(sign), torch.ones_like(sign), sign], -1)
    return (u * ends) @ vt


def vectors_of(turns: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors of rotations [rad], with finite gradients everywhere below 180 degrees."""
    skew = torch.stack(
        [
            turns[..., 2, 1] - turns[..., 1, 2],
            turns[..., 0, 2] - turns[..., 2, 0],
            turns[..., 1, 0] - turns[..., 0, 1],
        ],
        -1,
    )
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
    """VPoser's prior from its weights; None: no learned prior.

    Raises:
        InputError: If they cannot be used.
    """
    return ANGLES if weights is None else vposer_prior(load_vposer(weights))
