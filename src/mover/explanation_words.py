"""The evidence of an object in sentences."""

import math
from collections.abc import Iterator, Sequence

from jaxtyping import Float
from torch import Tensor

from .explanation_records import Bound, Facts, Other, Passing, Pull, Touching
from .geometry.rotations import wrap

NORMAL = 1.6448536269514722  # half width of the range that holds 90 % of a normal distribution
LEVELS = ((0.03, "well known"), (0.08, "known"), (0.15, "uncertain"))
WORST = "very uncertain"
TERMS = {
    "bbox": "its box", "silhouette": "its silhouette", "scale": "its size",
    "depth": "who hides whom", "collision": "free space", "contact": "touch", "edge": "its outline",
    "offscreen": "the border of the image", "free_space": "people seen beside it",
    "distance": "the distance it was given", "heading": "where its sitters face",
    "wall": "the line of the furniture beside it",
}  # fmt: skip
PRIORS = ("scale", "distance")  # terms that are no evidence of this room
LITTLE = 0.1  # share of a term in what tells a distance, below which it is not named
FELT = (0.02, math.radians(2))  # moves [m] and turns [rad] from which on an absence is told
LOOSE = 0.5  # [m], a bound with more room than that holds nothing


def verdict_of(facts: Facts, covariance: Float[Tensor, "7 7"]) -> str:
    """How certain the distance of an object is, and what tells it."""
    if facts.pinned:
        return "pinned by the user"
    half = NORMAL * distance_spread(facts.place, covariance)
    word = next((name for limit, name in LEVELS if half < limit), WORST)
    about = f"distance {word} (±{_length(half)}, 90 %)"
    told = sorted((p for p in facts.pulls if p.tells >= LITTLE), key=lambda p: -p.tells)
    evidence = [p for p in told if p.term not in PRIORS]
    if not evidence:
        return f"{about}: nothing but its size tells it"
    named = [f"{_name(p.term)} ({100 * p.tells:.0f} %)" for p in told]
    return f"{about}: told by {_listed(named)}"


def distance_spread(place: Float[Tensor, "7"], covariance: Float[Tensor, "7 7"]) -> float:
    """Spread of the distance from the camera over the floor [m]."""
    flat = place[[0, 2]]
    ray = flat / flat.norm().clamp_min(1e-6)
    inner = covariance[[0, 2]][:, [0, 2]]
    return float((ray @ inner @ ray).clamp_min(0).sqrt())


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


def _touch(touch: Touching) -> str:
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
