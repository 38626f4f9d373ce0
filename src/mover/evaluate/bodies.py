"""How far the bodies are from the true ones, and how they stand on the floor of their scene.

Both are measured in the gravity-aligned worlds of their scenes, without alignment.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.parts import SOLES, members, parts_of
from mover.bodies.skeleton import BODY
from mover.core.records import record
from mover.core.types import Bodies, Camera, Keypoints
from mover.evaluate.scene import Metric
from mover.geometry.rotations import similarity
from mover.io.capture.pose_file import into_camera
from mover.stages.camera.find_foot_contacts import FootContactInputs, find_foot_contacts
from mover.stages.config import FootContactConfig


@record
class Standing:
    """The soles of all bodies above the floor of their scene."""

    heights: Float[Tensor, "bodies soles"]
    """Height of each sole vertex above the floor, negative below [m]."""
    tolerance: float  #: How far a sole may be under the floor before it counts [m]


@record
class Twins:
    """Points of the bodies and of their true counterparts; None where they do not correspond."""

    verts: tuple[Float[Tensor, "bodies verts 3"], Float[Tensor, "bodies verts 3"]] | None
    joints: tuple[Float[Tensor, "bodies joints 3"], Float[Tensor, "bodies joints 3"]] | None


def ground_penetration_frequency(standing: Standing) -> float:
    """Share of the sole vertices of all bodies that are under the floor."""
    return float((standing.heights < -standing.tolerance).double().mean())


def ground_penetration_distance(standing: Standing) -> float:
    """Mean depth of those sole vertices that are under the floor [m]; 0 where none is."""
    below = standing.heights < -standing.tolerance
    return float(-standing.heights[below].mean()) if bool(below.any()) else 0.0


GROUND_METRICS: dict[str, Metric[Standing]] = {
    "ground_penetration_frequency": Metric(
        "Soles under the floor", "share", 0.0, ground_penetration_frequency
    ),
    "ground_penetration_distance": Metric(
        "Depth of soles under the floor", "m", 0.0, ground_penetration_distance
    ),
}
POSE_METRICS: dict[str, Metric[Twins]] = {
    "pje": Metric("Error of the joints", "m", 0.0, lambda t: _distance(t.joints)),
    "v2v": Metric("Error of the body's surface", "m", 0.0, lambda t: _distance(t.verts)),
    "p_pje": Metric(
        "Error of the joints, aligned", "m", 0.0, lambda t: _distance(t.joints, aligned=True)
    ),
    "p_v2v": Metric(
        "Error of the body's surface, aligned", "m", 0.0, lambda t: _distance(t.verts, aligned=True)
    ),
}
"""Mean distances of corresponding points [m], without any alignment; aligned: after the best
similarity transform of each body."""


def soles_of(bodies: Bodies, camera: Camera) -> Int[Tensor, " soles"]:
    """Indices of the vertices under the feet; empty where their mesh is unknown."""
    up_world = torch.tensor([0.0, 1.0, 0.0]).to(bodies.verts)
    up_cam = camera.R_cam_world[:, 1].to(bodies.verts)
    parts = parts_of(bodies, up_cam if bodies.space == "camera" else up_world)
    return members(parts, *SOLES).nonzero()[:, 0]


def feet_places(
    bodies: Bodies, camera: Camera, named: Float[Tensor, "bodies verts"] | None = None
) -> Float[Tensor, "points 1 3"]:
    """Foot contacts in the world [m]: soles among those that are named (paper: by POSA).

    Where none are, those of still, straight legs, as `find_foot_contacts` estimates them.
    """
    R = camera.R_cam_world.to(bodies.verts)
    seen = into_camera(bodies, R)
    sound = torch.ones(len(bodies.frame), dtype=torch.bool)
    inputs = FootContactInputs(seen, parts_of(seen, R[:, 1]), sound, camera, named)
    feet = find_foot_contacts(inputs, FootContactConfig(given=True))
    return (feet.points_cam @ R)[:, None]


def gather_twins(bodies: Bodies, truth: Bodies) -> Twins | None:
    """Points of the bodies that the truth knows; None: it knows none of them."""
    rows, true_rows = shared_rows(bodies, truth)
    if len(rows) == 0:
        return None
    same = bodies.verts.shape[1] == truth.verts.shape[1]
    verts = (bodies.verts[rows], truth.verts[true_rows]) if same else None
    common = [name for name in bodies.joint_names if name in truth.joint_names]
    common = [name for name in common if name in BODY] or common  # of the body, where there are any
    if not common or bodies.joints is None or truth.joints is None:
        return Twins(verts, None)
    ours, theirs = ([b.joint_names.index(n) for n in common] for b in (bodies, truth))
    return Twins(verts, (bodies.joints[rows][:, ours], truth.joints[true_rows][:, theirs]))


def procrustes(
    points: Float[Tensor, "*batch points 3"], target: Float[Tensor, "*batch points 3"]
) -> Float[Tensor, "*batch points 3"]:
    """The points after the rotation, scale and shift that bring them nearest to the target."""
    size, turn, shift = similarity(points, target)
    return size[..., None, None] * points @ turn.mT + shift.unsqueeze(-2)


def shared_rows(
    bodies: Bodies, truth: Bodies | Keypoints
) -> tuple[Int[Tensor, " rows"], Int[Tensor, " rows"]]:
    """Rows of the two that are the same person in the same frame."""
    there = {key: row for row, key in enumerate(_keys(truth))}
    rows = [(row, there[key]) for row, key in enumerate(_keys(bodies)) if key in there]
    pairs = torch.tensor(rows, dtype=torch.long).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _keys(bodies: Bodies | Keypoints) -> list[tuple[int, int]]:
    return list(zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True))


AT_ONCE = 16  # bodies that are aligned together: what fits a processor's cache


def _distance(pair: tuple[Tensor, Tensor] | None, *, aligned: bool = False) -> float | None:
    """Mean distance of corresponding points [m], as they are or after each body's similarity."""
    if pair is None:
        return None
    total, count = 0.0, pair[0][..., 0].numel()
    for some, there in zip(*(points.split(AT_ONCE) for points in pair), strict=True):
        moved = procrustes(some, there) if aligned else some
        total += float((moved - there).norm(dim=-1).double().sum())
    return total / count if count else math.nan
