"""Find the camera's pitch and roll and the ground from feet at rest (Sec. 3.2).

Minimises L_feet (terms/feet.py) over pitch, roll, the ground's height and one offset a person, with
rho falling from 10 cm to 2 cm, and a weak prior on the first guess of the tilt: robust Gauss-Newton
with its covariance.

Departure: In the paper every point has the same vote. Here every place where a person stood has one
           (it grows with the frames spent there, up to a limit), because the feet of one pose are
           wrong together.
What no foot constrains: the size of the people. If all of them are too large and too far by the
same factor, so is the depth of the ground: people of unknown size widen its variance.
"""

import dataclasses
import math
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Camera
from mover.energy.human_terms import TILT_TAIL, FootContacts, feet_term, heights, tilt_prior, up_cam
from mover.geometry.camera import pitch_roll, tilted, to_world
from mover.stages.config import AlignConfig
from mover.stages.posterior import Gaussian, diagonal

STEP_NOISE = 0.015  # [m], of a sole's height, new in every frame
PLACE_NOISE = 0.01  # [m], of a sole's height, the same in a place
PLACE = 0.15  # [m], soles nearer than this stand in one place
FIXED = 1e-3  # [m], spread of what is known
CAUTION = 1.4  # variance of the robust fit over that of least squares, feet with 1-2 cm of noise
BELIEF = 2.0  # frames, and places, that the noise above is worth when the spread is estimated
ROUGH = 8  # steps are enough before the last scale
FLAT = math.radians(45)  # [rad], no tilt is less certain than this
WIDE = (1.0, 0.3)  # [m], first scales where the guess may be far off
SIZE_PRIOR = 0.1  # [m], offset of people of a wrong size from the floor of a known height
LEVEL = math.radians(8), math.radians(2)  # [rad], pitch and roll on shelves and tripods
UNKNOWN_HEIGHT = 1.5  # [m], of a camera about which nothing is known
LOOSE_TILT, LOOSE_GROUND = math.radians(1.0), 0.03  # [rad], [m], spreads that deserve a warning
ODD = 2.5  # standard deviations of the tilt that was known, from which there is a warning
NARROW = 0.3  # [m], a walk that is less wide is a line
LARGE_OFFSET = 0.05  # [m], a body that floats that much has a wrong depth or size


@record
class Votes:
    """Sole points with their weight; float64."""

    foot_contacts: FootContacts
    people: Int[Tensor, " people"]
    """Tracks, sorted."""
    person_of: Int[Tensor, " soles"]
    """Index into `people`."""
    row_of: Int[Tensor, " soles"]
    """Points of one foot in one frame share a row."""
    place_of: Int[Tensor, " soles"]
    """Rows of one person on one spot share a place."""
    weight: Float[Tensor, " soles"]
    """One over the variance of the height [1/m²]."""


def vote(foot_contacts: FootContacts, by: Literal["places", "points", "sum"]) -> Votes:
    """Give every sole point its weight: places share theirs among all frames spent there."""
    if by == "sum":  # as printed: of all points together, here by their mean
        points, first = foot_contacts.points_cam.mean(0, keepdim=True), slice(1)
        who = {name: getattr(foot_contacts, name)[first] for name in ("person", "frame")}
        foot_contacts = dataclasses.replace(foot_contacts, points_cam=points, **who)
    points = foot_contacts.points_cam.detach().cpu().double()
    frame, person = foot_contacts.frame.cpu(), foot_contacts.person.cpu()
    people, person_of = person.unique(return_inverse=True)
    _, row_of = torch.stack([frame, person], -1).unique(dim=0, return_inverse=True)
    place_of = _places(points, person_of, row_of)
    per_row = row_of.bincount()
    weight = per_row.double().mean().reciprocal().expand(len(points)) / STEP_NOISE**2
    if by == "places":
        place_of_row = torch.zeros_like(per_row).scatter(0, row_of, place_of)
        stay = place_of_row.bincount()[place_of].double()
        weight = 1 / (STEP_NOISE**2 + stay * PLACE_NOISE**2) / per_row[row_of]
    contacts = dataclasses.replace(foot_contacts, points_cam=points, person=person, frame=frame)
    return Votes(contacts, people, person_of, row_of, place_of, weight)


def _places(
    points: Float[Tensor, "soles 3"],
    person_of: Int[Tensor, " soles"],
    row_of: Int[Tensor, " soles"],
) -> Int[Tensor, " soles"]:
    """Number the spots where people stood: a row joins the first spot of its person near it."""
    rows = int(row_of.max()) + 1
    ones = torch.ones(len(points), dtype=points.dtype)
    count = torch.zeros(rows, dtype=points.dtype).index_add(0, row_of, ones)
    centre = points.new_zeros(rows, 3).index_add(0, row_of, points) / count[:, None]
    owner = torch.zeros(rows, dtype=torch.long).scatter(0, row_of, person_of)
    spots, owners, place = centre[:0], owner[:0], torch.zeros(rows, dtype=torch.long)
    for row in range(rows):  # one after the other: a row may found the spot of later ones
        near = ((spots - centre[row]).norm(dim=-1) < PLACE) & (owners == owner[row])
        if bool(near.any()):
            place[row] = near.long().argmax()
            continue
        place[row] = len(spots)
        spots = torch.cat([spots, centre[row : row + 1]])
        owners = torch.cat([owners, owner[row : row + 1]])
    return place[row_of]


@record
class PlanePrior:
    """What is known before any foot is seen."""

    first: Float[Tensor, "2"]
    """Pitch and roll [rad]."""
    tilt: float
    """How far off they are [rad]."""
    offset: float
    """How far people float [m]."""
    ground: float | None
    """Height of the floor, where it is known [m]."""


@record
class PlaneFit:
    """A minimum: pitch, roll, ground, then the offset of each person."""

    at: Float[Tensor, " unknowns"]
    cost: float
    sigma: float
    """Scale of the robust cost at the end [m]."""
    prior: PlanePrior


def cost_of(
    at: Float[Tensor, " unknowns"], votes: Votes, prior: PlanePrior, sigma: float
) -> Float[Tensor, ""]:
    """What the fit minimises: L_feet in units of its noise, plus the priors, in nats."""
    offsets = at[3:][votes.person_of]
    feet = feet_term(votes.foot_contacts, tilted(at[0], at[1]), at[2], offsets, sigma)
    total = 0.5 * sigma**2 * (votes.weight * feet).sum()
    total = total + tilt_prior(at[0], at[1], prior.first, prior.tilt)
    total = total + 0.5 * (at[3:] / max(prior.offset, FIXED)).square().sum()
    if prior.ground is not None:
        total = total + 0.5 * ((at[2] - prior.ground) / FIXED).square()
    return total


def fit_plane(
    votes: Votes,
    prior: PlanePrior,
    start: Float[Tensor, " unknowns"],
    sigmas: tuple[float, ...],
    steps: int,
) -> PlaneFit:
    """Descend from `start` with one scale of the robust cost after the other."""
    at = start
    for sigma in sigmas:
        at = _descend(votes, prior, at, sigma, steps if sigma == sigmas[-1] else min(steps, ROUGH))
    return PlaneFit(at, float(cost_of(at, votes, prior, sigmas[-1])), sigmas[-1], prior)


def _descend(
    votes: Votes, prior: PlanePrior, at: Float[Tensor, " unknowns"], sigma: float, steps: int
) -> Float[Tensor, " unknowns"]:
    """Levenberg-Marquardt with the weights of Geman-McClure."""
    damping, value = 1e-3, float(cost_of(at, votes, prior, sigma))
    centre = torch.cat([prior.first, at[2:3], torch.zeros_like(at[3:])])
    for _ in range(steps):
        residual, slope = _linear(at, votes)
        centre[2] = at[2] if prior.ground is None else prior.ground
        pull = votes.weight / (1 + (residual / sigma).square()).square()
        trust = _prior_weights(at, prior)
        hessian = slope.mT @ (pull[:, None] * slope) + trust.diag()
        gradient = slope.mT @ (pull * residual) + trust * (at - centre)
        while damping < 1e8:
            change = torch.linalg.solve(hessian + damping * hessian.diag().diag(), gradient)
            lower = float(cost_of(at - change, votes, prior, sigma))
            if lower <= value:
                break
            damping *= 5
        else:
            return at
        at, damping, gain, value = at - change, damping / 5, value - lower, lower
        if gain < 1e-9 * (1 + value):
            return at
    return at


def _linear(
    at: Float[Tensor, " unknowns"], votes: Votes
) -> tuple[Float[Tensor, " soles"], Float[Tensor, "soles unknowns"]]:
    """Heights above the floor [m] and their derivatives."""
    (pitch, roll), points = at[:2], votes.foot_contacts.points_cam
    offset = at[3:][votes.person_of]
    residual = heights(points, tilted(pitch, roll), at[2]) - offset
    up = up_cam(pitch, roll)
    by_pitch = up_cam(pitch + math.pi / 2, roll)
    by_roll = torch.stack([up[1], -up[0], torch.zeros_like(pitch)])
    floats = torch.nn.functional.one_hot(votes.person_of, len(votes.people)).to(points)
    ground = torch.ones_like(residual)
    slope = torch.stack([points @ by_pitch, points @ by_roll, -ground], -1)
    return residual, torch.cat([slope, -floats], -1)


def _prior_weights(at: Float[Tensor, " unknowns"], prior: PlanePrior) -> Float[Tensor, " unknowns"]:
    """One over the variance that the prior gives each unknown, its long tail included."""
    tilt = prior.tilt**-2 / (1 + (at[:2] - prior.first).square().sum() / prior.tilt**2 / TILT_TAIL)
    ground = at.new_tensor([0.0 if prior.ground is None else FIXED**-2])
    floats = torch.full_like(at[3:], max(prior.offset, FIXED) ** -2)
    return torch.cat([tilt.expand(2), ground, floats])


def covariance_of(fit: PlaneFit, votes: Votes) -> Float[Tensor, "3 3"]:
    """Covariance of pitch [rad], roll [rad] and ground [m] from the spread of the feet themselves.

    A sandwich: the curvature of the cost, and the variance of its gradient, in which the frames of
    one place err together. The mean offset of the people counts as known (see align_camera).
    """
    residual, slope = _linear(fit.at, votes)
    rows = votes.row_of.bincount()
    place = torch.zeros_like(rows).scatter(0, votes.row_of, votes.place_of)
    height = residual.new_zeros(len(rows)).index_add(0, votes.row_of, residual) / rows
    lean = slope.new_zeros(len(rows), slope.shape[1]).index_add(0, votes.row_of, slope)
    lean = lean / rows[:, None]
    mass = residual.new_zeros(len(rows)).index_add(0, votes.row_of, votes.weight)
    inlier = height.abs() < max(2 * fit.sigma, 3 * 1.4826 * float(height.abs().median()))
    lean, mass, place = lean[inlier], mass[inlier], place[inlier].unique(return_inverse=True)[1]
    height = height[inlier]
    squared = (height / fit.sigma).square()
    bend = ((1 - 3 * squared) / (1 + squared) ** 3).mean().clamp_min(0.2)
    curvature = bend * lean.mT @ (mass[:, None] * lean)
    # prior weights are never quite nothing here, and people float by zero on average
    weights = _prior_weights(fit.at, fit.prior)
    weights = torch.cat([weights[:2].clamp_min(FLAT**-2), weights[2:].clamp_min(1e-2)])
    common = torch.cat([torch.zeros_like(weights[:3]), torch.ones_like(weights[3:])])
    known = 0.0 if fit.prior.ground is not None else FIXED**-2
    trust = weights.diag() + known * common[:, None] * common
    bread = torch.linalg.inv(curvature + trust)
    freedom = float((bread @ curvature).trace())
    step, spot = _noise(height, place, freedom)
    shared = slope.new_zeros(int(place.max()) + 1, lean.shape[1])
    shared = shared.index_add(0, place, mass[:, None] * lean)
    step, spot = CAUTION * step * bend.square(), CAUTION * spot * bend.square()
    meat = step * lean.mT @ (mass.square()[:, None] * lean) + spot * shared.mT @ shared
    return (bread @ (meat + trust) @ bread)[:3, :3]


def _noise(
    height: Float[Tensor, " rows"], place: Int[Tensor, " rows"], freedom: float
) -> tuple[float, float]:
    """Variance of the feet's heights, new in each frame and shared by a place [m²]."""
    stay = place.bincount().double()
    mean = torch.zeros_like(stay).index_add(0, place, height) / stay
    within = float((height - mean[place]).square().sum())
    step = (within + BELIEF * STEP_NOISE**2) / (float(len(height) - len(stay)) + BELIEF)
    free = max(len(stay) - freedom, 0.0)
    between = float(mean.square().sum()) - step * float(stay.reciprocal().mean()) * free
    spot = (max(between, 0.0) + BELIEF * PLACE_NOISE**2) / (free + BELIEF)
    return step, spot


@record
class AlignInputs:
    """Feet at rest, and what is known of the camera."""

    foot_contacts: FootContacts
    camera: Camera
    """Intrinsics, and the first guess of pitch and roll."""
    ground: float | None
    """First guess of the floor's height [m]."""
    camera_height: float | None
    """Known height of the camera above the floor [m]."""
    tilt_spread: float | None = None
    """How far off that pitch and roll are [rad]; None: as `AlignConfig` has it."""
    lean: float = 0.0
    """How far the plane under the feet may lean as a whole, an error that all feet share [rad]."""
    size: float = 0.0
    """Standard deviation of the logarithm of the people's size, which moves the floor with them."""


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

    @property
    def posterior(self) -> Gaussian:
        """Pitch [rad], roll [rad] and ground [m]."""
        tilt = torch.stack(pitch_roll(self.camera.R_cam_world))
        mean = torch.cat([tilt, tilt.new_tensor([self.ground])])
        return Gaussian(mean, torch.linalg.inv(self.covariance).to(mean))

    def ground_under(self, camera: Camera) -> tuple[float, float]:
        """The ground of the same feet under a camera of another tilt, and its spread [m]."""
        own = self.posterior
        tilt = torch.stack(pitch_roll(camera.R_cam_world)) - own.mean[:2]
        along = own.precision[2, :2] / own.precision[2, 2]
        return float(own.mean[2] - along @ tilt), float(own.precision[2, 2]) ** -0.5


def align_camera(
    inputs: AlignInputs, config: AlignConfig = AlignConfig(), observe: Observer = silent
) -> Alignment:
    """Level the world: turn the camera and move the floor until still feet stand on it.

    What the feet do not constrain (a straight walk, one frame) stays at the first guess, is large
    in the covariance, and gives a warning. A known camera height fixes the ground.
    """
    feet, camera = inputs.foot_contacts, inputs.camera
    if not len(feet.person):
        return _without_feet(inputs, config)
    votes, first = vote(feet, config.votes), torch.stack(pitch_roll(camera.R_cam_world.double()))
    free = dataclasses.replace(inputs, tilt_spread=None) if inputs.lean else inputs
    fit = _best_fit(free, config, votes, first)
    observe(Step("align_camera", 0, 1))
    at, spread = _with_lean(fit, votes, inputs, first, level=config.level)
    if inputs.camera_height is None:  # people who are larger are farther, and so is their floor
        spread[2, 2] += (inputs.size * at[2]) ** 2
    people = [str(p) for p in votes.people.tolist()]
    found = Alignment(
        camera=_turned(camera, at),
        ground=float(at[2]) if inputs.camera_height is None else -inputs.camera_height,
        covariance=spread.to(camera.K),
        offsets=dict(zip(people, at[3:].tolist(), strict=True)),
        warnings=(),
    )
    known = inputs.tilt_spread or config.tilt_prior
    warnings = (*_weak(found, votes), *_surprising(found, first, known))
    return dataclasses.replace(found, warnings=warnings)


def _with_lean(
    fit: PlaneFit, votes: Votes, inputs: AlignInputs, first: Float[Tensor, "2"], *, level: bool
) -> tuple[Float[Tensor, " unknowns"], Float[Tensor, "3 3"]]:
    """The minimum and its covariance with a lean that all feet share, beside a known tilt.

    The plane turns about the middle of the feet, so that the ground below the camera moves with
    it. Feet are fitted with their full weights, as a robust fit gives them up otherwise.
    """
    at, covariance = fit.at, covariance_of(fit, votes)
    if not inputs.lean:
        return at, covariance
    _, slope = _linear(at, votes)
    middle = (votes.weight[:, None] * slope[:, :2]).sum(0) / votes.weight.sum()
    turns = torch.cat([torch.eye(2, dtype=torch.float64), middle[:, None]], 1)
    covariance = covariance + CAUTION * inputs.lean**2 * turns.mT @ turns
    if inputs.tilt_spread is not None:
        spreads = torch.full_like(first, inputs.tilt_spread)
    elif level:
        usual = first.new_tensor(LEVEL)
        spreads = usual * (1 + ((at[:2] - first) / usual).square() / TILT_TAIL).sqrt()
    else:
        return at, covariance
    wide = torch.nn.functional.pad(spreads, (0, 1), value=torch.inf)  # but for the ground
    known = diagonal(torch.cat([first, first.new_zeros(1)]), wide)
    both = Gaussian(at[:3], torch.linalg.inv(covariance)).times(known)
    return torch.cat([both.mean, at[3:]]), both.covariance


def _best_fit(
    inputs: AlignInputs, config: AlignConfig, votes: Votes, first: Float[Tensor, "2"]
) -> PlaneFit:
    """The better of two descents: from the first guess, and from the plane through most feet."""
    known = None if inputs.camera_height is None else -inputs.camera_height
    offset = config.offset_prior
    tilt = inputs.tilt_spread or config.tilt_prior
    prior = PlanePrior(first, tilt, offset if known is None else SIZE_PRIOR, known)
    height = votes.foot_contacts.points_cam @ tilted(first[0], first[1])[:, 1]
    guesses = [g for g in (known, inputs.ground) if g is not None] or [float(height.median())]
    start = torch.cat([first, first.new_tensor(guesses[:1]), first.new_zeros(len(votes.people))])
    away = torch.cat([first, height.median()[None], torch.zeros_like(start[3:])])
    return min(
        fit_plane(votes, prior, start, config.sigmas, config.steps),
        fit_plane(votes, prior, away, (*WIDE, *config.sigmas), config.steps),
        key=lambda fit: fit.cost,
    )


def _turned(camera: Camera, at: Float[Tensor, " unknowns"]) -> Camera:
    return dataclasses.replace(camera, R_cam_world=tilted(at[0], at[1]).to(camera.R_cam_world))


def _without_feet(inputs: AlignInputs, config: AlignConfig) -> Alignment:
    """The first guess, unchanged."""
    camera, tilt = inputs.camera, min(inputs.tilt_spread or config.tilt_prior, math.radians(10))
    warning = "no feet were found: pitch and roll stay at their first guess"
    if inputs.camera_height is not None:
        ground, spread = -inputs.camera_height, 0.01
    elif inputs.ground is not None:
        ground, spread = inputs.ground, 0.1
    else:
        ground, spread = -UNKNOWN_HEIGHT, 0.5
        warning += f", and the floor is taken to be {UNKNOWN_HEIGHT} m below the camera"
    covariance = torch.tensor([tilt**2, tilt**2, spread**2]).diag().to(camera.K)
    unchanged = _turned(camera, torch.stack(pitch_roll(camera.R_cam_world.double())))
    return Alignment(unchanged, ground, covariance, {}, (warning,))


def _weak(found: Alignment, votes: Votes) -> tuple[str, ...]:
    """Warnings about what the feet leave open."""
    pitch, roll, ground = found.covariance.diag().double().sqrt().tolist()
    loose = [
        f"{name} is uncertain by {math.degrees(spread):.1f} degrees"
        for name, spread in (("pitch", pitch), ("roll", roll))
        if spread > LOOSE_TILT
    ]
    if ground > LOOSE_GROUND:
        loose.append(f"the ground is uncertain by {100 * ground:.0f} cm")
    odd = (f"{_cause(found, votes)}: {', '.join(loose)}",) if loose else ()
    return (*votes.foot_contacts.warnings, *odd)


def _cause(found: Alignment, votes: Votes) -> str:
    """Why the feet leave the camera loose."""
    world = to_world(votes.foot_contacts.points_cam, found.camera.R_cam_world.double())[:, [0, 2]]
    spread = torch.linalg.svdvals(world - world.mean(0)) * (2 / len(world) ** 0.5)
    if len(votes.weight) == 1:
        return "all feet count as one point"
    if len(votes.foot_contacts.frame.unique()) == 1:
        return "feet were found in a single frame"
    if float(spread[0]) < NARROW:
        return "the feet stood in one place"
    if float(spread[1]) < NARROW:
        return f"people walked along a line ({100 * float(spread[1]):.0f} cm wide)"
    return "the feet say little about the camera"


def _surprising(found: Alignment, first: Float[Tensor, "2"], known: float) -> tuple[str, ...]:
    """Warnings about what contradicts the prior, a tilt that is known so well [rad]."""
    warnings: list[str] = []
    turned = float(torch.stack(pitch_roll(found.camera.R_cam_world.double())).sub(first).norm())
    if turned > ODD * known:
        warnings.append(
            f"the feet turn the camera by {math.degrees(turned):.1f} degrees, from a tilt that was"
            f" known to {math.degrees(known):.1f}"
        )
    for person, offset in found.offsets.items():
        if abs(offset) > LARGE_OFFSET:
            side = "above" if offset > 0 else "below"
            warnings.append(
                f"person {person} stands {100 * abs(offset):.0f} cm {side} the floor: "
                "the body's depth or size is wrong"
            )
    return tuple(warnings)
