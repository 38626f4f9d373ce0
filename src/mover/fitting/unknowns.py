"""L-BFGS over all frames at once."""

import dataclasses
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.skinning import widths_of
from mover.bodies.smpl_model import SmplBody
from mover.core.observe import Energy
from mover.core.records import record
from mover.fitting.rig import Points, Rig, move
from mover.geometry.rotations import axis_angle

# What is solved, and what it means: joints' rotations, shapes, places.


HAND = 45


@record
class Unknowns:
    """One row a body, one shape a person."""

    turn: Float[Tensor, "bodies 3"]
    """Turns the root's first guess, in camera axes [rad]."""
    code: Float[Tensor, "bodies code"]
    """The pose of the body: its angles [rad], or the code of a learned prior."""
    place: Float[Tensor, "bodies 3"]
    """The pelvis: x / z, y / z, and the logarithm of its depth."""
    betas: Float[Tensor, "people shape"]
    hands: Float[Tensor, "bodies hands"]
    """Left, then right; zero columns where no hands are fitted."""
    face: Float[Tensor, "bodies face"]
    """Jaw [rad], then expression; zero columns where no face is fitted."""


SCALES = {"turn": 0.2, "code": 0.3, "place": (0.01, 0.01, 0.05), "betas": 1.0, "hands": 0.5,
          "face": 0.3}  # fmt: skip
"""How far each usually moves: the solver works in these units."""

Decode = Callable[[Float[Tensor, "bodies code"]], Float[Tensor, "bodies angles"]]


@record
class Frame:
    """What turns unknowns into a body, and is not solved."""

    rig: Rig
    root: Float[Tensor, "bodies 3 3"]
    """First guess of the root's rotation, in camera axes."""
    person: Int[Tensor, " bodies"]
    """Row of `betas`."""


def pelvis_of(at: Unknowns) -> Float[Tensor, "bodies 3"]:
    """Place of the pelvis in camera axes [m]."""
    depth = at.place[:, 2:].exp()
    return torch.cat([at.place[:, :2] * depth, depth], -1)


def place_of(pelvis: Float[Tensor, "bodies 3"]) -> Float[Tensor, "bodies 3"]:
    """The unknown of a place in camera axes [m]."""
    depth = pelvis[:, 2:].clamp_min(0.2)
    return torch.cat([pelvis[:, :2] / depth, depth.log()], -1)


def points_of(at: Unknowns, frame: Frame, decode: Decode) -> Points:
    """Keypoints and joints of the bodies, in camera axes [m]."""
    expression = at.face[:, 3:] if at.face.shape[1] > 3 else None
    turns = turns_of(at, frame, decode(at.code))
    return move(frame.rig, turns, at.betas[frame.person], pelvis_of(at), expression)


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
    return torch.tensor(SCALES[name], dtype=value.dtype, device=value.device)


EVERYTHING = ("turn", "code", "place", "betas", "hands", "face")


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
