"""How people move over the floor: sliding and floating feet, and jerky joints."""

import torch
from jaxtyping import Float
from torch import Tensor

from .bodies.parts import members, parts_of
from .metrics_bodies import gather_twins, shared_rows
from .metrics_scene import Metric
from .records import record
from .terms.body_time import Neighbours, gather_neighbours
from .types import Bodies

STEP = 0.1  # [m] over the floor: a sole that is lower may stand


@record
class Gait:
    """The feet and joints of people who move."""

    soles: Float[Tensor, "bodies feet 3"] | None
    """Lowest place of each sole [m]; None: no video or no soles."""
    ground: float | None
    """Height of the floor [m]."""
    near: Neighbours
    joints: Float[Tensor, "twins joints 3"] | None
    """Joints that the truth knows as well [m]."""
    true_joints: Float[Tensor, "twins joints 3"] | None
    twins: Neighbours
    """Which rows of these follow each other."""


def foot_skate(gait: Gait) -> float | None:
    """Mean speed of soles near the floor along it [m/s], the nearer the more it counts (HuMoR)."""
    if gait.soles is None or gait.ground is None or not len(gait.near.pairs):
        return None
    i, j = gait.near.pairs.unbind(-1)
    height = ((gait.soles[i, :, 1] + gait.soles[j, :, 1]) / 2 - gait.ground).clamp_min(0)
    share = 2 - 2 ** (height / STEP).clamp(0, 1)
    way = (gait.soles[j] - gait.soles[i])[..., [0, 2]].norm(dim=-1)
    speed = way / gait.near.gaps.to(way)[:, None]
    slower = speed.argmin(1, keepdim=True)  # the foot that carries; the other may swing
    share, speed = share.gather(1, slower), speed.gather(1, slower)
    return float((share * speed).sum() / share.sum()) if bool(share.sum() > 0) else 0.0


def float_height(gait: Gait) -> float | None:
    """Mean height of the lower sole over the floor [m]; 0 where it is below."""
    if gait.soles is None or gait.ground is None:
        return None
    return float((gait.soles[..., 1].amin(1) - gait.ground).clamp_min(0).mean())


def acceleration_error(gait: Gait) -> float | None:
    """Mean difference of the joints' accelerations [m/s²]."""
    if gait.joints is None or gait.true_joints is None or not len(gait.twins.triples):
        return None
    found, true = (_accelerations(x, gait.twins) for x in (gait.joints, gait.true_joints))
    return float((found - true).norm(dim=-1).mean())


MOTION_METRICS: dict[str, Metric[Gait]] = {
    "foot_skate": Metric("m/s", 0.0, foot_skate),
    "float_height": Metric("m", 0.0, float_height),
    "acceleration_error": Metric("m/s²", 0.0, acceleration_error),
}


def gather_gait(bodies: Bodies, truth: Bodies | None, ground: float | None) -> Gait:
    """Feet and joints of bodies in the world, and of the true ones where they are known."""
    soles = _soles(bodies)
    near = gather_neighbours(bodies.frame, bodies.person, bodies.fps)
    none = gather_neighbours(bodies.frame[:0], bodies.person[:0], bodies.fps)
    twins = None if truth is None else gather_twins(bodies, truth)
    if truth is None or twins is None or twins.joints is None:
        return Gait(soles, ground, near, None, None, none)
    rows, _ = shared_rows(bodies, truth)
    both = gather_neighbours(bodies.frame[rows], bodies.person[rows], bodies.fps)
    return Gait(soles, ground, near, twins.joints, twins.true_joints, both)


def _soles(bodies: Bodies) -> Tensor | None:
    """Middle of each sole at the height of its lowest point [m]."""
    parts = parts_of(bodies)
    found: list[Tensor] = []
    for name in ("left_sole", "right_sole"):
        own = members(parts, name)
        if not own.any():
            return None
        sole = bodies.verts[:, own]
        x, _, z = sole.mean(1).unbind(-1)
        found.append(torch.stack([x, sole[..., 1].amin(1), z], -1))
    return torch.stack(found, 1)


def _accelerations(joints: Tensor, near: Neighbours) -> Tensor:
    """At the middle of three frames [m/s²]."""
    i, j, k = near.triples.unbind(-1)
    before, after = (s[:, None, None] for s in near.steps.to(joints).unbind(-1))
    slope = (joints[k] - joints[j]) / after - (joints[j] - joints[i]) / before
    return 2 * slope / (before + after)
