"""What `calibrate.py` learns from rooms with known truth."""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.calibration import KIND_OF, Calibration, learn_factor, learn_share, surprise
from mover.explanation import LEVEL, explain, offs, ways_of
from mover.explanation_records import Explanation, Facts
from mover.explanation_words import NORMAL
from mover.geometry.rotations import wrap
from mover.records import record
from mover.stages.starts import MOVED, TURNED

USED = ("distance", "sideways", "yaw", "size")  # kinds that the table tells
ROLLS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.13)  # shares of the floor's factor that are tried


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
    errors: Float[Tensor, " cases"]
    """To the nearest of the result and its likely alternatives."""


def learn(rooms: list[Judged]) -> Calibration:
    """Alternatives, floor and roll first, then one factor for each kind of unknown.

    The roll's factor is the one under which errors across the ray are likeliest.
    """
    pairs = [(f, t) for room in rooms for f, t in zip(room.facts, room.truth, strict=True)]
    share = learn_share([([a.rise for a in f.alternatives], _nearest(f, t)) for f, t in pairs])
    plain = explain([f for f, _ in pairs], Calibration(share=share))
    told = list(zip(plain, (t for _, t in pairs), strict=True))
    height = _factor(cases_of(told, "height"), 0.0)
    cases = {kind: cases_of(told, kind) for kind in USED}
    across = cases["sideways"]

    def unlikely(share: float) -> float:
        return surprise(across.own, (share * height) ** 2 * across.rest, across.errors)

    roll = min(ROLLS, key=unlikely) * height
    camera = {kind: roll if kind == "sideways" else height for kind in USED}
    factors = {kind: _factor(cases[kind], camera[kind]) for kind in USED}
    return Calibration({**factors, "height": height, "roll": roll}, share, True)


def _factor(cases: Cases, camera: float) -> float:
    """The factor with which the ranges of these cases hold; that of the camera is settled."""
    square = (cases.errors / NORMAL).square() - camera**2 * cases.rest
    return learn_factor((square.clamp_min(0) / cases.own).sqrt().tolist(), LEVEL)


def cases_of(told: list[tuple[Explanation, Float[Tensor, "7"]]], kind: str) -> Cases:
    """The errors of a kind. Unknowns that are not free have none.

    The doubt of a height is all the camera's, and counts as its own.
    """
    rows: list[tuple[float, float, float]] = []
    for e, truth in told:
        for way in ways_of(e.facts.place)[[k == kind for k in KIND_OF]]:
            own, tilt = (float(way @ c @ way) for c in (e.facts.covariance, e.facts.tilt))
            if kind == "height":
                own, tilt = own + tilt, 0.0
            if own > 0:
                rows.append((own, tilt, min(offs(e, way, truth))))
    return Cases(*torch.tensor(rows, dtype=torch.float64).reshape(-1, 3).unbind(-1))


def _nearest(facts: Facts, truth: Float[Tensor, "7"]) -> int:
    """Which of the result (0) and its alternatives is nearest to the truth."""
    rows = torch.stack([facts.place, *(a.place for a in facts.alternatives)]) - truth
    away = rows[:, [0, 2]].norm(dim=-1) / MOVED
    return int((away.square() + (wrap(rows[:, 3]) / TURNED).square()).argmin())


def in_turn(rooms: list[Judged]) -> list[Calibration]:
    """For each room what is learnt on all others."""
    return [learn(rooms[:k] + rooms[k + 1 :]) for k in range(len(rooms))]
