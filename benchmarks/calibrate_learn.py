"""What `calibrate.py` learns from rooms with known truth."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.explanation import UNKNOWNS, Explanation, Facts
from mover.core.records import record
from mover.evaluate.calibration import GROWING, KIND_OF, Calibration, growth
from mover.evaluate.explanation import LEVEL, NORMAL, explain, ways_of
from mover.geometry.rotations import wrap
from mover.stages.objects.starts import MOVED, TURNED

POWERS = tuple(0.25 * k for k in range(13))  # of the misfit, that are tried
ROLLS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.13, 0.09, 0.06, 0.04, 0.03, 0.02, 0.01, 0.0)
"""Shares of the floor's factor that are tried for the roll."""
SHARES = tuple(0.01 * 1.2**k for k in range(30))  # weights that are tried
SCALES = tuple(1e-3 * 1.1**k for k in range(100))  # factors that are tried for likelihoods
COUNTS = 0.1  # alternatives from this probability on belong to what holds 90 %
YAW = UNKNOWNS.index("yaw")

Way = Float[Tensor, "7"]
"""A direction in the space of the unknowns, of length one."""


@record
class Judged:
    """What was stated of the objects of a room, and what is true."""

    facts: tuple[Facts, ...]
    truth: Float[Tensor, "objects 7"]


@record
class Cases:
    """Errors of one kind, and what was stated of them before calibration."""

    own: Float[Tensor, " cases"]
    """Variances that the kind's factor multiplies; above zero."""
    rest: Float[Tensor, " cases"]
    """Variances by the camera."""
    whole: Float[Tensor, " cases"]
    """Variances by scale and lens of the room, which have no factor."""
    errors: Float[Tensor, " cases"]
    """To the nearest of the result and its likely alternatives."""
    growth: Float[Tensor, " cases"]
    """By the misfit of the silhouette."""

    def grown(self, power: float) -> "Cases":
        """The same with variances that grow with the misfit."""
        return replace(self, own=self.own * self.growth ** (2 * power))


def learn(rooms: list[Judged]) -> Calibration:
    """Alternatives and floor first, then roll, growth with the misfit and a factor for each kind.

    The roll's factor and the powers are those under which the errors are likeliest.
    """
    pairs = [(f, t) for room in rooms for f, t in zip(room.facts, room.truth, strict=True)]
    share = learn_share([([a.rise for a in f.alternatives], _nearest(f, t)) for f, t in pairs])
    plain = explain([f for f, _ in pairs], Calibration(share=share))
    told = list(zip(plain, (t for _, t in pairs), strict=True))
    height = _factor(cases_of(told, "height"), 0.0)
    factors, powers = {"height": height}, dict[str, float]()
    for kind in GROWING:
        cases = cases_of(told, kind)
        cameras = [r * height for r in ROLLS] if kind == "sideways" else [height]
        tried = [(camera, power) for camera in cameras for power in POWERS]
        camera, powers[kind] = min(tried, key=lambda way: _unlikely(cases, *way))
        factors[kind] = _factor(cases.grown(powers[kind]), camera)
        if kind == "sideways":
            factors["roll"] = camera
    return Calibration(factors, powers, share, True)


def _unlikely(cases: Cases, camera: float, power: float) -> float:
    rest = camera**2 * cases.rest + cases.whole
    return surprise(cases.grown(power).own, rest, cases.errors)


def _factor(cases: Cases, camera: float) -> float:
    """The factor with which the ranges of these cases hold; that of the camera is settled."""
    square = (cases.errors / NORMAL).square() - camera**2 * cases.rest - cases.whole
    return learn_factor((square.clamp_min(0) / cases.own).sqrt().tolist(), LEVEL)


def cases_of(told: list[tuple[Explanation, Float[Tensor, "7"]]], kind: str) -> Cases:
    """The errors of a kind. Unknowns that are not free have none.

    The doubt of a height is all the camera's, and counts as its own.
    """
    rows: list[tuple[float, ...]] = []
    for e, truth in told:
        for way in ways_of(e.facts.place)[[k == kind for k in KIND_OF]]:
            parts = (e.facts.covariance, e.facts.tilt, e.facts.whole)
            own, tilt, whole = (float(way @ c @ way) for c in parts)
            if kind == "height":
                own, tilt = own + tilt, 0.0
            if own > 0:
                error = min(offs(e, way, truth))
                rows.append((own, tilt, whole, error, growth(e.facts.overlap)))
    return Cases(*torch.tensor(rows, dtype=torch.float64).reshape(-1, 5).unbind(-1))


def _nearest(facts: Facts, truth: Float[Tensor, "7"]) -> int:
    """Which of the result (0) and its alternatives is nearest to the truth."""
    rows = torch.stack([facts.place, *(a.place for a in facts.alternatives)]) - truth
    away = rows[:, [0, 2]].norm(dim=-1) / MOVED
    return int((away.square() + (wrap(rows[:, 3]) / TURNED).square()).argmin())


def in_turn(groups: list[list[Judged]]) -> list[Calibration]:
    """For each group of rooms what is learnt on all others."""
    rest = (groups[:k] + groups[k + 1 :] for k in range(len(groups)))
    return [learn([room for group in some for room in group]) for some in rest]


def learn_factor(needed: Sequence[float], level: float) -> float:
    """The factor with which intervals hold a share `level` of errors (split conformal prediction).

    Args:
        needed: For each error the least factor with which its interval holds it.
        level: The probability that an interval holds.

    Raises:
        ValueError: If there are too few errors for that probability.
    """
    rank = math.ceil(level * (len(needed) + 1) - 1e-9)
    if rank > len(needed):
        raise ValueError(f"learn_factor: {len(needed)} errors are too few for {level:.0%}")
    return sorted(needed)[rank - 1]


def surprise(
    own: Float[Tensor, " errors"], rest: Float[Tensor, " errors"], errors: Float[Tensor, " errors"]
) -> float:
    """How unlikely errors are whose variances are said to be `own` times some factor plus `rest`.

    Errors count as Student's t with two degrees of freedom: a wrong yaw is as wrong as can be, and
    must not decide alone. The factor is the one with which they are likeliest.
    """
    square = torch.tensor(SCALES, dtype=torch.float64).square()[:, None] * own + rest
    square = square.clamp_min(1e-12)
    each = square.log() / 2 + 1.5 * (1 + errors.square() / square / 2).log()
    return float(each.sum(1).min())


def learn_share(cases: Sequence[tuple[Sequence[float], int]]) -> float:
    """The weight of alternatives under which it was likeliest that the true ones were true.

    Args:
        cases: For each object the rises of its alternatives, and which one is nearest to the
            truth, counted from 1; 0: the result itself. Objects without alternatives say nothing.
    """
    told = [(rises, true) for rises, true in cases if rises]

    def unlikely(share: float) -> float:
        total = 0.0
        for rises, true in told:
            weights = [1.0, *(share * math.exp(-max(r, 0.0)) for r in rises)]
            total -= math.log(weights[true] / sum(weights))
        return total

    return min(SHARES, key=unlikely) if told else 1.0


def spread_along(explanation: Explanation, way: Way) -> float:
    """Spread about the result in one direction."""
    return float((way @ explanation.covariance @ way).clamp_min(0).sqrt())


def held(explanation: Explanation, way: Way, truth: Float[Tensor, "7"]) -> bool:
    """Whether a range holds the truth in one direction, about the result or an alternative."""
    return min(offs(explanation, way, truth)) <= NORMAL * spread_along(explanation, way)


def offs(explanation: Explanation, way: Way, truth: Float[Tensor, "7"]) -> list[float]:
    """Distance of the truth in one direction from the result and each likely alternative."""
    likely = [o.place for o in explanation.others if o.probability >= COUNTS]
    return [
        abs(float(_between(place, truth) @ way)) for place in (explanation.facts.place, *likely)
    ]


def width(explanation: Explanation, way: Way) -> float:
    """Full width of what holds 90 % in one direction: overlaps count once."""
    half = NORMAL * spread_along(explanation, way)
    likely = [o.place for o in explanation.others if o.probability >= COUNTS]
    middles = [0.0, *(float(_between(explanation.facts.place, p) @ way) for p in likely)]
    total, reach = 0.0, -math.inf
    for middle in sorted(middles):
        total += max(0.0, middle + half - max(middle - half, reach))
        reach = max(reach, middle + half)
    return min(total, 2 * math.pi) if bool(way[YAW] != 0) else total


def _between(start: Float[Tensor, "7"], end: Float[Tensor, "7"]) -> Float[Tensor, "7"]:
    """From one place to another, the shorter way round."""
    off = end.double() - start.double()
    off[YAW] = wrap(off[YAW])
    return off
