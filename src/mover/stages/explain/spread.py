"""How the terms of Eq. 1 pull at a result, and how they bend around it.

Unknowns of an object, in their order: x, y, z of the middle of its base [m], yaw [rad], and the
logarithms of its three scales. Gradients are exact; their change over a step that is as large as
the doubts one wants to tell (centimetres) gives the curvature, so that the ruggedness of pixels
and the corners of one-sided prices are averaged out.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.observe import Energy
from mover.core.records import record
from mover.core.types import Camera, Layout
from mover.geometry.camera import pitch_roll, tilted, to_camera
from mover.geometry.placement import LOWEST, hit_floor

STEPS = (0.03, 0.03, 0.03, 0.05, 0.03, 0.03, 0.03)  # of the differences [m, rad, 1]


@record
class Bend:
    """Each term at the result, to second order; terms are named in `terms`."""

    terms: tuple[str, ...]
    value: Float[Tensor, "terms objects"]
    slope: Float[Tensor, "terms objects 7"]
    """Gradient, averaged over the steps [1/m, 1/rad, 1]."""
    curve: Float[Tensor, "terms objects 7 7"]
    """Second derivatives."""


def bend_at(energy: Callable[[Layout], Energy], layout: Layout) -> Bend:
    """Values, gradients and second derivatives of every term for every object.

    All objects take their steps at once. No term couples two objects but for the height of a
    carrier, which lifts its load: the load's price then belongs to the carrier as well.
    """
    steps = torch.tensor(STEPS, dtype=torch.float64)
    moves = torch.cat([torch.zeros(1, 7), torch.diag(steps), -torch.diag(steps)]).to(steps)
    free = (vector(layout).double() + moves[:, None]).to(layout.yaw).requires_grad_()
    parts = energy(unvector(free)).parts
    slopes = torch.stack([_slope(part, free) for part in parts.values()]).double()
    plus, minus = slopes[:, 1:8], slopes[:, 8:]
    curve = ((plus - minus) / (2 * steps[:, None, None])).permute(0, 2, 3, 1)
    value = torch.stack([part[0].detach().double() for part in parts.values()])
    middle = (slopes[:, 0] + plus.mean(1) + minus.mean(1)) / 3
    return Bend(tuple(parts), value, middle, (curve + curve.mT) / 2)


def vector(layout: Layout) -> Float[Tensor, "*starts objects 7"]:
    """The unknowns of each object as one row."""
    return torch.cat([layout.t_world_object, layout.yaw.unsqueeze(-1), layout.log_scale], -1)


def unvector(rows: Float[Tensor, "*starts objects 7"]) -> Layout:
    """The inverse of `vector`."""
    return Layout(rows[..., :3], rows[..., 3], rows[..., 4:])


def _slope(part: Tensor, free: Tensor) -> Tensor:
    if not part.requires_grad:
        return torch.zeros_like(free)
    return torch.autograd.grad(
        part.sum(), free, retain_graph=True, allow_unused=True, materialize_grads=True
    )[0]


# How far an object may stand from its result before the evidence objects.
#
# Laplace:   p(theta) ~ exp(-E(theta) / T - |theta / sigma|^2 / 2), sigma the spread of a parameter
#            of which nothing is known; the covariance is the inverse of H / T + sigma^-2.
# Heat:      T = E + T_0, an object's own residual: of a shape that does not fit, a given rise of
#            the energy says less (as in `refine_camera`). Calibration multiplies what comes out.
# Measured:  a Hessian says nothing of one-sided and bounded prices. So the energy is looked
#            up along the axes of the first covariance, on both sides, until it has risen by T / 2.
#            A tenth of the first covariance is added: where the energy is flat at the result, the
#            walls around say where the object may be, not where it is.


UNKNOWN = (0.5, 0.5, 0.5, 0.6, 0.15, 0.15, 0.15)  # sigma [m, m, m, rad, 1, 1, 1]
COLD = 0.02  # T_0, the residual of a shape that fits
FLAT = 0.1  # share of the Laplace covariance that is added to the measured one
LOOKS = 4  # at the energy, along each half axis
STRETCH = 2.5  # by which a look may be farther or nearer than the one before


def heat_of(energy: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """The rise of the energy that counts as one."""
    return energy.double() + COLD


def measured(
    energy: Callable[[Layout], Energy],
    layout: Layout,
    curve: Float[Tensor, "objects 7 7"],
    heat: Float[Tensor, " objects"],
    free: Bool[Tensor, "objects 7"],
) -> Float[Tensor, "objects 7 7"]:
    """Covariance of the unknowns [m, rad, 1]; zero for those that are not free.

    The length of each axis of Laplace's is looked up in the energy, and a little of it is added.
    Directions in which the energy falls count as flat: there only sigma bounds the spread.
    """
    values, axes = _axes(curve, heat, free)
    length = (1 + values.clamp_min(0)).rsqrt().repeat(1, 2)  # objects 14: both sides
    ways = torch.cat([axes, -axes], -1).permute(2, 0, 1) * _sigma()  # 14 objects 7
    base, start = vector(layout).double(), energy(layout).per_item.double()
    for _ in range(LOOKS):
        there = base + ways * length.mT.unsqueeze(-1) * free
        with torch.no_grad():
            rise = energy(unvector(there.to(layout.yaw))).per_item.double() - start
        told = rise.mT.clamp_min(0) / heat[:, None] + length.square() / 2
        length = length * (0.5 / told).sqrt().clamp(1 / STRETCH, STRETCH)
        length = length.clamp(1e-3, 1.0)
    seen = length.square().unflatten(1, (2, 7)).mean(1)
    return _assembled(seen + FLAT / (1 + values.clamp_min(0)), axes, free)


def _sigma() -> Float[Tensor, "7"]:
    return torch.tensor(UNKNOWN, dtype=torch.float64)


def _axes(curve: Tensor, heat: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues and eigenvectors in units of sigma."""
    sigma = _sigma() * free
    scaled = curve.double() * sigma[:, :, None] * sigma[:, None, :] / heat[:, None, None]
    values, axes = torch.linalg.eigh(scaled)
    return values, axes


def _assembled(square: Tensor, axes: Tensor, free: Tensor) -> Tensor:
    sigma = _sigma() * free
    inner = axes @ (square.unsqueeze(-1) * axes.mT)
    return inner * sigma[:, :, None] * sigma[:, None, :]


def moves_without(
    slope: Float[Tensor, "terms 7"],
    curve: Float[Tensor, "terms 7 7"],
    heat: Float[Tensor, ""],
    free: Bool[Tensor, "7"],
) -> Float[Tensor, "terms 7"]:
    """Where an object would go without each of the terms: one Newton step [m, rad, 1].

    At most twice the spread of an unknown of which nothing is known: farther the step says nothing.
    """
    rest = curve.sum(0) - curve
    sigma = _sigma() * free
    some = free.expand(len(curve), 7)
    values, axes = _axes(rest, heat.expand(len(curve)), some)
    pull = (slope / heat * sigma).unsqueeze(-1)
    step = axes @ ((axes.mT @ pull) / (1 + values.clamp_min(0)).unsqueeze(-1))
    step = step[..., 0]
    return sigma * step * (2 / step.norm(dim=-1, keepdim=True).clamp_min(2))


def by_tilt(
    layout: Layout, camera: Camera, ground: float, tilt: Float[Tensor, "3 3"]
) -> Float[Tensor, "objects 7 7"]:
    """What the doubt about pitch, roll [rad] and floor [m] (their covariance) adds.

    Objects move along their rays on the floor.
    """
    base = layout.t_world_object.double()
    matrix = camera.R_cam_world.double()
    pitch, roll = pitch_roll(matrix)
    at = torch.stack([pitch, roll, torch.tensor(ground, dtype=torch.float64)])
    rays = to_camera(base, matrix)

    def stands(at: Tensor) -> Tensor:
        return hit_floor(rays, tilted(at[0], at[1]), at[2])

    slope = torch.autograd.functional.jacobian(stands, at)
    low = -base[:, 1] > 2 * LOWEST * base.norm(dim=-1)
    slope = slope * low[:, None, None]
    added = torch.zeros(len(base), 7, 7, dtype=torch.float64)
    added[:, :3, :3] = slope @ tilt.double() @ slope.mT
    return added


def by_whole(
    layout: Layout, camera: Camera, scale: float, focal: float
) -> Float[Tensor, "objects 7 7"]:
    """What the doubt about the scale of the whole room and about its lens adds.

    With the scale all places and sizes grow. With the lens all depths do, and nothing else, since
    the picture stays; pitch and floor are found anew, so that what stands stays on the floor.

    Args:
        layout: Where the objects stand.
        camera: That sees them.
        scale: Standard deviation of the logarithm of the scale.
        focal: The same of the focal length.
    """
    base, axis = layout.t_world_object.double(), camera.R_cam_world.double()[2]
    larger, deeper = (torch.zeros(len(base), 7, dtype=torch.float64) for _ in range(2))
    larger[:, :3], larger[:, 4:] = base, 1
    deeper[:, :3] = (base @ axis)[:, None] * axis
    deeper[:, 1] = 0
    slopes = torch.stack([scale * larger, focal * deeper], -1)
    return slopes @ slopes.mT
