"""Surfaces against surfaces, as pose benchmarks compare them: ADD-S, and the turn that ICP makes.

Sources: ADD-S is that of PoseCNN (Xiang et al. 2018), taken in both directions and as a share of
the diameter, with the share of objects below 0.1 (SAM 3D, 2025, whose ICP-Rot is `icp_turn`).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.types import Mesh
from mover.geometry.nearest import nearest_points, to_surface
from mover.geometry.rotations import rot_y

POINTS = 1000  # of each surface
ICP_POINTS, STEPS = 400, 25
SETTLED = 1e-5  # [rad], a step of ICP that turns less is the last
CLOSE = 0.1  # of the diameter
ALIKE = 0.02  # of the diameter, by which a turned surface may be off and still look the same ...
MOST = 0.98  # ... at so many of its points
FOLDS = (16, 4, 2)  # turns by a whole circle over these are tried; the first counts as round


def add_s(estimate: Float[Tensor, "points 3"], truth: Float[Tensor, "true 3"]) -> float:
    """Mean distance to the other surface, both ways, as a share of the truth's diameter."""
    away, _ = nearest_points(estimate, truth)
    back, _ = nearest_points(truth, estimate)
    return float((away.mean() + back.mean()) / 2) / max(diameter(truth), 1e-9)


def folds(points: Float[Tensor, "points 3"], mesh: Mesh, middle: Float[Tensor, "3"]) -> int:
    """How many turns about the vertical through its middle leave a surface as it is.

    Args:
        points: On the surface [m].
        mesh: The surface.
        middle: Of its box [m].

    Returns:
        One of `FOLDS`, or 1: it looks the same after a whole circle only.
    """
    limit = ALIKE * diameter(points)
    for fold in FOLDS:
        turn = rot_y(torch.tensor(2 * math.pi / fold)).to(points)
        turned = (points - middle) @ turn.mT + middle
        if float(to_surface(turned, mesh.verts, mesh.faces).quantile(MOST)) < limit:
            return fold
    return 1


def diameter(points: Float[Tensor, "points 3"]) -> float:
    """The largest distance of two points [m]."""
    return float(torch.cdist(points.double(), points.double()).max())


def icp_turn(estimate: Float[Tensor, "points 3"], truth: Float[Tensor, "true 3"]) -> float:
    """Angle by which iterated closest points turn the estimate onto the truth [rad].

    It depends on surfaces alone, not on what somebody calls the front: a round table has none.
    """
    start = estimate.double()[:: max(1, len(estimate) // ICP_POINTS)]
    goal, here = truth.double(), estimate.double()[:: max(1, len(estimate) // ICP_POINTS)]
    for _ in range(STEPS):
        _, index = nearest_points(here, goal)
        turn, away = _rigid(here, goal[index])
        here = here @ turn.mT + away
        if _angle(turn) < SETTLED:
            break
    return _angle(_rigid(start, here)[0])


def _rigid(
    start: Float[Tensor, "points 3"], end: Float[Tensor, "points 3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Rotation and shift that best take `start` to `end`."""
    a, b = start.mean(0), end.mean(0)
    u, _, vt = torch.linalg.svd((end - b).mT @ (start - a))
    flip = torch.ones(3).to(start)
    flip[2] = torch.linalg.det(u @ vt).sign()
    turn = (u * flip) @ vt
    return turn, b - turn @ a


def _angle(turn: Float[Tensor, "3 3"]) -> float:
    """Of a rotation [rad]."""
    skew = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return float(torch.atan2(skew.norm() / 2, (turn.trace() - 1) / 2))
