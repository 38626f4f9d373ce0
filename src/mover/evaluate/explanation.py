"""Explanations: the evidence of an object in sentences, in calibrated numbers, and as JSON."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.explanation import (
    UNKNOWNS,
    Bound,
    Explanation,
    Facts,
    Other,
    Passing,
    Pull,
    Range,
    TouchingBody,
)
from mover.energy.objective import SCENE_TERMS
from mover.evaluate.calibration import KIND_OF, Calibration, growth
from mover.geometry.rotations import wrap

NORMAL = 1.6448536269514722  # half width of the range that holds 90 % of a normal distribution
LEVELS = ((0.03, "well known"), (0.08, "known"), (0.15, "uncertain"))
WORST = "very uncertain"
TERMS = {term.name: term.word for term in SCENE_TERMS}
GUESSES = ("distance", "given")  # terms of what the initial scene says
PRIORS = ("scale", *GUESSES)  # terms that are no evidence of this room
LITTLE = 0.1  # share of a term in what tells a distance, below which it is not named
FELT = (0.02, math.radians(2))  # moves [m] and turns [rad] from which on an absence is told
LOOSE = 0.5  # [m], a bound with more room than that holds nothing


def verdict_of(facts: Facts, covariance: Float[Tensor, "7 7"]) -> str:
    """How certain the distance of an object is, and what tells it."""
    if facts.pinned:
        return "pinned by the user"
    ray = ways_of(facts.place)[0]
    half = NORMAL * float((ray @ covariance @ ray).clamp_min(0).sqrt())
    word = next((name for limit, name in LEVELS if half < limit), WORST)
    about = f"distance {word} (±{_length(half)}, 90 %)"
    told = sorted((p for p in facts.pulls if p.constrains >= LITTLE), key=lambda p: -p.constrains)
    evidence = [p for p in told if p.term not in PRIORS]
    if not evidence and any(p.term in GUESSES for p in told):
        return f"{about}: nothing that is seen tells it, it stays about where it was given"
    if not evidence:
        return f"{about}: nothing but its size tells it"
    named = [f"{_name(p.term)} ({100 * p.constrains:.0f} %)" for p in told]
    return f"{about}: told by {_listed(named)}"


def sentences_of(facts: Facts, others: Sequence[Other]) -> tuple[str, ...]:
    """Each piece of evidence in a sentence, the strongest kinds first."""
    return (
        *(_bound(b) for b in facts.bounds),
        *(_touch(t) for t in facts.touches),
        *_passing(facts.passing),
        *_image(facts),
        _stands(facts.support),
        *_absences(facts.pulls),
        *(_other(facts.place, o) for o in others),
    )


def _bound(bound: Bound) -> str:
    near = bound.side == "near"
    limit = f"not {'nearer' if near else 'farther'} than {bound.depth:.2f} m"
    who = f"frame {bound.frame}, person {bound.person}" if bound.frame >= 0 else "a person"
    how = "passed in front of it" if near else "was hidden by it"
    if bound.slack < -0.005:
        side = "nearer" if near else "farther"
        where = f"its surface there is {_length(-bound.slack)} {side} than that"
    else:
        loose = ": no hold" if bound.slack > LOOSE else ""
        where = f"{_length(max(bound.slack, 0.0))} of room{loose}"
    return f"{limit}: {who} {how} ({where})"


def _touch(touch: TouchingBody) -> str:
    first, last = touch.frames[0]
    when = f"frame {first}" if first == last else f"frames {first}-{last}"
    more = f" and {len(touch.frames) - 1} more times" if len(touch.frames) > 1 else ""
    whose = "hand" if touch.hand else {"seat": "seat", "back": "back"}.get(touch.part, "body")
    return (
        f"its {touch.part} touches person {touch.person}'s {whose} in {when}{more}"
        f" (gap {100 * touch.gap:.1f} cm)"
    )


def _passing(passing: Passing | None) -> Iterator[str]:
    if passing is None:
        return
    if passing.frame < 0:
        yield f"free space: nobody came nearer than {_length(passing.distance)}"
        return
    who = f"person {passing.person} in frame {passing.frame}"
    side = f"its {passing.side}" + (" side" if passing.side in ("left", "right") else "")
    if passing.distance < 0:
        yield f"free space: {who} is {_length(-passing.distance)} inside {side}"
    else:
        yield f"free space: {who} at {_length(passing.distance)} from {side}"


def _image(facts: Facts) -> Iterator[str]:
    if facts.overlap is None:
        yield "no mask: its silhouette is not compared"
    else:
        yield f"its silhouette: IoU {facts.overlap:.2f}".replace("0.", ".")
    if facts.hidden_sides:
        noun = "side" if len(facts.hidden_sides) == 1 else "sides"
        verb = "is" if len(facts.hidden_sides) == 1 else "are"
        yield f"the {_listed(facts.hidden_sides)} {noun} of its box {verb} not seen"


def _stands(support: str) -> str:
    if support == "free":
        return "stands on nothing: its height is free"
    return f"stands on {'the floor' if support == 'ground' else support}"


def _absences(pulls: Sequence[Pull]) -> Iterator[str]:
    """What would happen without the two terms whose absence is felt most."""
    felt = sorted(pulls, key=lambda p: -_felt(p))[:2]
    for pull in felt:
        if _felt(pull) < 1:
            continue
        parts: list[str] = []
        if _moved(pull) >= FELT[0]:
            parts.append(f"move {_length(_moved(pull))}")
        if abs(float(pull.move[3])) >= FELT[1]:
            parts.append(f"turn {math.degrees(abs(float(pull.move[3]))):.0f}°")
        yield f"without {_name(pull.term)} it would {' and '.join(parts)}"


def _felt(pull: Pull) -> float:
    return max(_moved(pull) / FELT[0], abs(float(pull.move[3])) / FELT[1])


def _moved(pull: Pull) -> float:
    return float(pull.move[[0, 2]].norm())


def _other(place: Float[Tensor, "7"], other: Other) -> str:
    there = other.place
    moved = float((there[:3] - place[:3]).norm())
    turned = math.degrees(abs(float(wrap(there[3] - place[3]))))
    parts = [f"{_length(moved)} away"] if moved >= FELT[0] else []
    parts += [f"turned by {turned:.0f}°"] if turned >= 2 else []
    way = " and ".join(parts) or "of another size"
    return f"may also stand {way} ({100 * other.probability:.0f} %)"


def _name(term: str) -> str:
    return TERMS.get(term, term.replace("_", " "))


def _listed(words: Sequence[str]) -> str:
    return " and ".join((", ".join(words[:-1]), words[-1])) if len(words) > 1 else words[0]


def _length(metres: float) -> str:
    """Centimetres below a metre."""
    if metres >= 0.995:
        return f"{metres:.1f} m"
    return f"{100 * metres:.1f} cm" if metres < 0.02 else f"{100 * metres:.0f} cm"


LEVEL = 0.9  # probability of a range
UNLIKELY = 0.02  # alternatives below this probability are not told


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

    Spreads grow with a power of the misfit of an object's silhouette. What is not known of scale
    and lens is stated where it is found, and counts as it is.
    """
    known, ways, grown = calibration.factors, ways_of(facts.place), growth(facts.overlap)
    own = {kind: known[kind] * grown ** calibration.powers.get(kind, 0.0) for kind in KIND_OF}
    factor = _along(ways, [own[kind] for kind in KIND_OF])
    tilt = _along(ways, [known["roll" if k == "sideways" else "height"] for k in KIND_OF])
    return factor @ facts.covariance @ factor.mT + tilt @ facts.tilt @ tilt.mT + facts.whole


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


DIGITS = 6
KEYS = {"constrains": "tells_distance", "move": "move_without", "slack": "room"}
"""Names in the file, where they are not those of the records."""


def scene_fields(explanations: Sequence[Explanation]) -> dict[str, dict[str, Any]]:
    """Fields `explanation` and `uncertainty` of each object, by its id (docs/data.md)."""
    return {
        e.facts.id: {
            "explanation": {"verdict": e.verdict, "evidence": list(e.sentences)},
            "uncertainty": _uncertainty(e),
        }
        for e in explanations
    }


def log_rows(explanations: Sequence[Explanation]) -> list[dict[str, Any]]:
    """All that is known, one row an object, for run.json."""
    return [
        {
            "id": e.facts.id,
            "verdict": e.verdict,
            "evidence": list(e.sentences),
            "uncertainty": _uncertainty(e),
            "energy": _plain(e.facts.energy),
            "pulls": _plain(e.facts.pulls),
            "bounds": _plain(e.facts.bounds),
            "touches": _plain(e.facts.touches),
            "nearest_body": _plain(e.facts.passing),
            "silhouette_iou": _plain(e.facts.overlap),
            "hidden_sides": _plain(e.facts.hidden_sides),
            "pinned": e.facts.pinned,
        }
        for e in explanations
    ]


def _uncertainty(explanation: Explanation) -> dict[str, Any]:
    place = explanation.facts.place
    ranges: dict[str, list[float]] = {}
    for k, r in enumerate(explanation.ranges):
        low, high = r.low, r.high
        if k > 3:  # sizes as factors of the size that the result has
            low, high = (math.exp(v - float(place[k])) for v in (low, high))
        ranges[_key(k)] = _plain((low, high))
    return {
        "level": LEVEL,
        "calibrated": explanation.calibrated,
        "base": _plain(tuple(place[:3].tolist())),
        "ranges": ranges,
        "covariance": [_plain(tuple(row)) for row in explanation.covariance.tolist()],
        "alternatives": [
            {
                "probability": _plain(o.probability),
                "base": _plain(tuple(o.place[:3].tolist())),
                "yaw": _plain(float(wrap(o.place[3]))),
            }
            for o in explanation.others
        ],
    }


def _plain(value: Any) -> Any:  # noqa: ANN401
    """A record as JSON: numbers are rounded, and seven of them are those of the unknowns."""
    match value:
        case float():
            return round(value, DIGITS)
        case tuple():
            return [_plain(v) for v in value]
        case Tensor():
            return {_key(k): _plain(v) for k, v in enumerate(value.tolist())}
        case _ if dataclasses.is_dataclass(value):
            names = [f.name for f in dataclasses.fields(value)]
            return {KEYS.get(name, name): _plain(getattr(value, name)) for name in names}
        case _:
            return value


def _key(index: int) -> str:
    """`x`, `y`, `z`, `yaw`, and the sizes along the axes of the mesh."""
    return UNKNOWNS[index] if index < 4 else f"size_{'xyz'[index - 4]}"
