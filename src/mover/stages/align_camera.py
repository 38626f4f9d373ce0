r"""Find the camera's pitch and roll and the ground from feet at rest (Sec. 3.2).

Minimises L_feet (terms/feet.py) over pitch, roll, the ground's height and one offset a person, with
rho falling from 10 cm to 2 cm, and a weak prior on the first guess of the tilt.

Departure: In the paper every point has the same vote. Here every place where a person stood has one
           (it grows with the frames spent there, up to a limit), because the feet of one pose are
           wrong together.
What no foot can tell: the size of the people. If all of them are too large and too far by the same
factor, so is the depth of the ground; this is not part of the covariance.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.camera import pitch_roll, tilted, to_world
from ..minimize import Observer, Step, silent
from ..records import record
from ..terms.feet import Soles
from ..types import Camera
from .plane_fit import Fit, Prior, Votes, covariance_of, fit_plane, vote

WIDE = (1.0, 0.3)  # [m], first scales where the guess may be far off
SIZE_PRIOR = 0.1  # [m], offset of people of a wrong size from the floor of a known height
UNKNOWN_HEIGHT = 1.5  # [m], of a camera about which nothing is known
LOOSE_TILT, LOOSE_GROUND = math.radians(1.0), 0.03  # [rad], [m], spreads that deserve a warning
NARROW = 0.3  # [m], a walk that is less wide is a line
LARGE_OFFSET = 0.05  # [m], a body that floats that much has a wrong depth or size


@record
class AlignInputs:
    """Feet at rest, and what is known of the camera."""

    soles: Soles
    camera: Camera
    """Intrinsics, and the first guess of pitch and roll."""
    ground: float | None
    """First guess of the floor's height [m]."""
    camera_height: float | None
    """Known height of the camera above the floor [m]."""


@dataclass(frozen=True)
class AlignConfig:
    """How feet make a floor; the paper has sigmas (0.1,), no priors, one vote a point."""

    sigmas: tuple[float, ...] = (0.1, 0.06, 0.035, 0.02)
    """Scales of the Geman-McClure price, one descent after the other [m]."""
    tilt_prior: float = math.radians(4.0)
    """How far off the first pitch and roll usually are [rad]; inf: no prior."""
    offset_prior: float = 0.03
    """How far a person usually floats because of a wrong depth [m]; 0: not at all."""
    votes: Literal["places", "points"] = "places"
    """What counts once: a place where a person stood, or a point."""
    steps: int = 60
    """Most Gauss-Newton steps for each scale."""


@record
class Alignment:
    """Where the floor is."""

    camera: Camera
    ground: float
    """Height of the floor in the world [m]."""
    covariance: Float[Tensor, "3 3"]
    """Of pitch [rad], roll [rad] and ground [m]."""
    offsets: dict[str, float]
    """By track, how far a person floats above the floor [m]."""
    warnings: tuple[str, ...]


def align_camera(
    inputs: AlignInputs, config: AlignConfig = AlignConfig(), observe: Observer = silent
) -> Alignment:
    """Level the world: turn the camera and move the floor until still feet stand on it.

    What the feet cannot tell (a straight walk, one frame) stays at the first guess, is large in the
    covariance, and gives a warning. A known camera height fixes the ground.
    """
    soles, camera = inputs.soles, inputs.camera
    if not len(soles.person):
        return _without_feet(inputs, config)
    first = torch.stack(pitch_roll(camera.R_cam_world.double()))
    votes = vote(soles, config.votes)
    fit = _best_fit(inputs, config, votes, first)
    observe(Step("align_camera", 0, 1))
    spread = covariance_of(fit, votes)
    people = [str(p) for p in votes.people.tolist()]
    ground = float(fit.at[2]) if inputs.camera_height is None else -inputs.camera_height
    found = Alignment(
        camera=_turned(camera, fit.at),
        ground=ground,
        covariance=spread.to(camera.K),
        offsets=dict(zip(people, fit.at[3:].tolist(), strict=True)),
        warnings=(),
    )
    warnings = (*_weak(found, votes), *_surprising(found, first, config))
    return dataclasses.replace(found, warnings=warnings)


def _best_fit(
    inputs: AlignInputs, config: AlignConfig, votes: Votes, first: Float[Tensor, "2"]
) -> Fit:
    """The better of two descents: from the first guess, and from the plane through most feet."""
    known = None if inputs.camera_height is None else -inputs.camera_height
    offset = config.offset_prior
    prior = Prior(first, config.tilt_prior, offset if known is None else SIZE_PRIOR, known)
    height = votes.soles.points_cam @ tilted(first[0], first[1])[:, 1]
    guesses = [g for g in (known, inputs.ground) if g is not None] or [float(height.median())]
    start = torch.cat([first, first.new_tensor(guesses[:1]), first.new_zeros(len(votes.people))])
    away = torch.cat([first, height.median()[None], torch.zeros_like(start[3:])])
    return min(
        fit_plane(votes, prior, start, config.sigmas, config.steps),
        fit_plane(votes, prior, away, (*WIDE, *config.sigmas), config.steps),
        key=lambda fit: fit.price,
    )


def _turned(camera: Camera, at: Float[Tensor, " unknowns"]) -> Camera:
    return dataclasses.replace(camera, R_cam_world=tilted(at[0], at[1]).to(camera.R_cam_world))


def _without_feet(inputs: AlignInputs, config: AlignConfig) -> Alignment:
    """The first guess, unchanged."""
    camera, tilt = inputs.camera, min(config.tilt_prior, math.radians(10))
    warning = "no feet were found: pitch and roll stay at their first guess"
    if inputs.camera_height is not None:
        ground, spread = -inputs.camera_height, 0.01
    elif inputs.ground is not None:
        ground, spread = inputs.ground, 0.1
    else:
        ground, spread = -UNKNOWN_HEIGHT, 0.5
        warning += f", and the floor is taken to be {UNKNOWN_HEIGHT} m below the camera"
    covariance = torch.tensor([tilt**2, tilt**2, spread**2]).diag().to(camera.K)
    return Alignment(
        _turned(camera, torch.stack(pitch_roll(camera.R_cam_world.double()))),
        ground,
        covariance,
        {},
        (warning,),
    )


def _weak(found: Alignment, votes: Votes) -> tuple[str, ...]:
    """Warnings about what the feet cannot tell."""
    pitch, roll, ground = found.covariance.diag().double().sqrt().tolist()
    loose = [
        f"{name} is uncertain by {math.degrees(spread):.1f} degrees"
        for name, spread in (("pitch", pitch), ("roll", roll))
        if spread > LOOSE_TILT
    ]
    if ground > LOOSE_GROUND:
        loose.append(f"the ground is uncertain by {100 * ground:.0f} cm")
    return (
        *votes.soles.warnings,
        *([f"{_cause(found, votes)}: {', '.join(loose)}"] if loose else []),
    )


def _cause(found: Alignment, votes: Votes) -> str:
    """Why the feet leave the camera loose."""
    world = to_world(votes.soles.points_cam, found.camera.R_cam_world.double())[:, [0, 2]]
    spread = torch.linalg.svdvals(world - world.mean(0)) * (2 / len(world) ** 0.5)
    if len(votes.soles.frame.unique()) == 1:
        return "feet were found in a single frame"
    if float(spread[0]) < NARROW:
        return "the feet stood in one place"
    if float(spread[1]) < NARROW:
        return f"people walked along a line ({100 * float(spread[1]):.0f} cm wide)"
    return "the feet say little about the camera"


def _surprising(
    found: Alignment, first: Float[Tensor, "2"], config: AlignConfig
) -> tuple[str, ...]:
    """Warnings about what contradicts what was believed."""
    warnings: list[str] = []
    pitch, roll = pitch_roll(found.camera.R_cam_world.double())
    turned = float(torch.stack([pitch, roll]).sub(first).norm())
    if turned > 2.5 * config.tilt_prior:
        warnings.append(f"the feet turn the camera by {math.degrees(turned):.0f} degrees")
    for person, offset in found.offsets.items():
        if abs(offset) > LARGE_OFFSET:
            side = "above" if offset > 0 else "below"
            warnings.append(
                f"person {person} stands {100 * abs(offset):.0f} cm {side} the floor: "
                "the body's depth or size is wrong"
            )
    return tuple(warnings)
