"""Explanations in words and in calibrated numbers."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from .calibration import KIND_OF, Calibration, growth
from .explanation_records import UNKNOWNS, Explanation, Facts, Other, Range
from .explanation_words import NORMAL, sentences_of, verdict_of
from .geometry.rotations import wrap

LEVEL = 0.9  # probability of a range
UNLIKELY = 0.02  # alternatives below this probability are not told
COUNTS = 0.1  # alternatives from this probability on belong to what holds 90 %
YAW = UNKNOWNS.index("yaw")

Way = Float[Tensor, "7"]
"""A direction in the space of the unknowns, of length one."""


def explain(facts: Sequence[Facts], calibration: Calibration) -> tuple[Explanation, ...]:
    """Calibrate the doubts of all objects and put their evidence into words."""
    return tuple(_explained(f, calibration) for f in facts)


def _explained(facts: Facts, calibration: Calibration) -> Explanation:
    covariance = calibrated(facts, calibration)
    spread = covariance.diagonal().clamp_min(0).sqrt()
    others = _others(facts, calibration)
    rows = zip(UNKNOWNS, facts.place.tolist(), spread.tolist(), strict=True)
    return Explanation(
        facts=facts,
        ranges=tuple(Range(n, at - NORMAL * s, at + NORMAL * s, s) for n, at, s in rows),
        covariance=covariance,
        others=others,
        verdict=verdict_of(facts, covariance),
        sentences=sentences_of(facts, others),
        calibrated=calibration.learnt,
    )


def ways_of(place: Float[Tensor, "7"]) -> Float[Tensor, "7 7"]:
    """Directions that are calibrated alike everywhere, in the order of `calibration.KIND_OF`.

    Along the viewing ray over the floor, across it, up, and the other unknowns as they are.
    """
    ways = torch.eye(7, dtype=torch.float64)
    x, z = (place[[0, 2]].double() / place[[0, 2]].double().norm().clamp_min(1e-6)).tolist()
    ways[0, 0], ways[0, 2] = x, z
    ways[2, 0], ways[2, 2] = -z, x
    return ways


def calibrated(facts: Facts, calibration: Calibration) -> Float[Tensor, "7 7"]:
    """The covariance with one factor on the spread of each kind, and the camera's with its own.

    Spreads grow with a power of the misfit of an object's silhouette.
    """
    known, ways, grown = calibration.factors, ways_of(facts.place), growth(facts.overlap)
    own = {kind: known[kind] * grown ** calibration.powers.get(kind, 0.0) for kind in KIND_OF}
    factor = _along(ways, [own[kind] for kind in KIND_OF])
    tilt = _along(ways, [known["roll" if k == "sideways" else "height"] for k in KIND_OF])
    return factor @ facts.covariance @ factor.mT + tilt @ facts.tilt @ tilt.mT


def _along(ways: Float[Tensor, "7 7"], factors: list[float]) -> Float[Tensor, "7 7"]:
    """The matrix that stretches each direction by its factor."""
    return ways.mT @ (torch.tensor(factors, dtype=torch.float64)[:, None] * ways)


def _others(facts: Facts, calibration: Calibration) -> tuple[Other, ...]:
    """Alternatives with their share of the probability."""
    share = [calibration.share * math.exp(-max(a.rise, 0.0)) for a in facts.alternatives]
    total = 1 + sum(share)
    return tuple(
        Other(s / total, a.place)
        for a, s in zip(facts.alternatives, share, strict=True)
        if s / total >= UNLIKELY
    )


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
