"""What `calibrate.py` learns from rooms with known truth."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mover.calibration import (
    GROWING,
    KIND_OF,
    Calibration,
    growth,
    learn_factor,
    learn_share,
    surprise,
)
from mover.explanation import LEVEL, explain, offs, ways_of
from mover.explanation_records import Explanation, Facts
from mover.explanation_words import NORMAL
from mover.geometry.rotations import wrap
from mover.records import record
from mover.stages.starts import MOVED, TURNED

POWERS = tuple(0.25 * k for k in range(13))  # of the misfit, that are tried
ROLLS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.13, 0.09, 0.06, 0.04, 0.03, 0.02, 0.01, 0.0)
"""Shares of the floor's factor that are tried for the roll."""


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
    return surprise(cases.grown(power).own, camera**2 * cases.rest, cases.errors)


def _factor(cases: Cases, camera: float) -> float:
    """The factor with which the ranges of these cases hold; that of the camera is settled."""
    square = (cases.errors / NORMAL).square() - camera**2 * cases.rest
    return learn_factor((square.clamp_min(0) / cases.own).sqrt().tolist(), LEVEL)


def cases_of(told: list[tuple[Explanation, Float[Tensor, "7"]]], kind: str) -> Cases:
    """The errors of a kind. Unknowns that are not free have none.

    The doubt of a height is all the camera's, and counts as its own.
    """
    rows: list[tuple[float, float, float, float]] = []
    for e, truth in told:
        for way in ways_of(e.facts.place)[[k == kind for k in KIND_OF]]:
            own, tilt = (float(way @ c @ way) for c in (e.facts.covariance, e.facts.tilt))
            if kind == "height":
                own, tilt = own + tilt, 0.0
            if own > 0:
                rows.append((own, tilt, min(offs(e, way, truth)), growth(e.facts.overlap)))
    return Cases(*torch.tensor(rows, dtype=torch.float64).reshape(-1, 4).unbind(-1))


def _nearest(facts: Facts, truth: Float[Tensor, "7"]) -> int:
    """Which of the result (0) and its alternatives is nearest to the truth."""
    rows = torch.stack([facts.place, *(a.place for a in facts.alternatives)]) - truth
    away = rows[:, [0, 2]].norm(dim=-1) / MOVED
    return int((away.square() + (wrap(rows[:, 3]) / TURNED).square()).argmin())


def in_turn(groups: list[list[Judged]]) -> list[Calibration]:
    """For each group of rooms what is learnt on all others."""
    rest = (groups[:k] + groups[k + 1 :] for k in range(len(groups)))
    return [learn([room for group in some for room in group]) for some in rest]
