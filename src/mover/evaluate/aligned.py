"""Overlap of a scene's objects after one similarity: what the scale and position of the whole cost.

A video does not determine how large a room is: people of unknown height and a guessed lens make
all of it too large or too small at once. This separates that error from those of single objects.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.evaluate.scene import Metric, Pair, thick
from mover.geometry.boxes import Box, box_of
from mover.geometry.boxes import iou3d as box_iou
from mover.geometry.rotations import rot_y

FEWEST = 3  # objects: fewer would always fit
ROUNDS = 20  # of weights
NEAR = 0.05  # [m], smaller residuals have the same weight
STRETCH = (0.5, 2.0)  # range of the scale


@record
class Together:
    """All objects of a scene that stand for true ones."""

    pairs: tuple[Pair, ...]
    missing: int
    """True objects that nothing stands for: they count as 0."""


@record
class _Similarity:
    """Upright: turned, scaled and moved."""

    yaw: Float[Tensor, ""]
    scale: Float[Tensor, ""]
    away: Float[Tensor, "3"]


def iou3d_aligned(scene: Together) -> float | None:
    """Mean overlap of the boxes after the similarity that brings most centres together."""
    if len(scene.pairs) < FEWEST:
        return None
    ours = [_double(box_of(pair.estimate)) for pair in scene.pairs]
    true = [_double(box_of(pair.truth)) for pair in scene.pairs]
    by = _fitted(*(torch.stack([box.center for box in boxes]) for boxes in (ours, true)))
    total = 0.0
    for box, aim in zip(ours, true, strict=True):
        centre = by.scale * (rot_y(by.yaw) @ box.center) + by.away
        carried = Box(centre, by.scale * box.size, box.yaw + by.yaw)
        total += float(box_iou(thick(carried), thick(aim)))
    return total / (len(scene.pairs) + scene.missing)


def _double(box: Box) -> Box:
    return Box(box.center.double(), box.size.double(), box.yaw.double())


def _fitted(ours: Float[Tensor, "n 3"], true: Float[Tensor, "n 3"]) -> _Similarity:
    """The similarity with the least sum of distances (reweighted least squares)."""
    weight = torch.ones_like(ours[:, 0])
    found = _weighted(ours, true, weight)
    for _ in range(ROUNDS):
        there = found.scale * (ours @ rot_y(found.yaw).mT) + found.away
        found = _weighted(ours, true, 1 / (there - true).norm(dim=-1).clamp_min(NEAR))
    return found


def _weighted(
    ours: Float[Tensor, "n 3"], true: Float[Tensor, "n 3"], weight: Float[Tensor, " n"]
) -> _Similarity:
    share = (weight / weight.sum())[:, None]
    middle, aim = (share * ours).sum(0), (share * true).sum(0)
    a, b = ours - middle, true - aim
    along = (share[:, 0] * (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2])).sum()
    across = (share[:, 0] * (a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2])).sum()
    yaw = torch.atan2(across, along)
    turned = a @ rot_y(yaw).mT
    scale = (share * turned * b).sum() / (share * turned.square()).sum().clamp_min(1e-12)
    scale = scale.clamp(*STRETCH)
    return _Similarity(yaw, scale, aim - scale * (rot_y(yaw) @ middle))


SCENE_METRICS: dict[str, Metric[Together]] = {
    "iou3d_aligned": Metric("3D overlap after one similarity of all", "", 1.0, iou3d_aligned)
}
