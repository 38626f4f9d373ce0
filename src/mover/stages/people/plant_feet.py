"""Feet that stand stand still: the last step of the refinement, by least squares in time.

Energies make a sole slide less, and leave a rest, which goes here in three steps:

1. Whole bodies are shifted so that soles at rest keep their position and lie on the floor, and
   seated and lying people are still. Shifts in depth, seen from the camera at the world's origin,
   and in height are cheap, as pictures and bodies of unknown size constrain them least.
2. Each foot is to go where it rested on average; the way there fades in and out between steps.
3. The leg is bent to reach it, as little as it can be, without a turn of the sole.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies import load_model
from mover.bodies.corrected import corrected, no_correction
from mover.bodies.parts import BodyParts, members
from mover.bodies.posture import postures
from mover.bodies.skeleton import BODY, SIDES
from mover.bodies.skinning import vertex_subset
from mover.core.types import Bodies
from mover.energy.body_terms import Neighbours, gather_neighbours
from mover.stages.people.body_evidence import resting_soles

ALONG, ACROSS = 0.015, 0.005  # [m], how far a body may be off in depth or height, and to the side
STEADY = 0.03  # [m/√s], by which such errors change
SWAY = 0.03  # [m], error of a resting sole beside its body's: angles of the leg are off
SINK = 0.01  # [m], the same over the floor
RIGID = 0.01  # [m], the same where no leg can be bent
SLIP, RISE = 0.003, 0.003  # [m], of a sole at rest from frame to frame, and over the floor, at last
STILL = 0.01  # [m], of a seated or lying person, from frame to frame
ON_FLOOR = 0.12  # [m]; a sole at rest that is higher stands on something else
FOOT = 0.03  # [m], how far a foot is off beside its body
FADE = 0.06  # [m/√s], by which that changes
BENT = 0.25  # [rad], usual error of an angle of the leg
REACHED = 0.002  # [m], how near a foot is brought
STEPS = 3  # of Gauss and Newton
SPOTS = 4  # points of a sole
LEG = ("hip", "knee", "ankle")
NUDGE = 1e-3  # [rad], for differences


def plant_feet(bodies: Bodies, parts: BodyParts, floor: float) -> Bodies:
    """The bodies, in the world, with their resting soles still and on the floor [m].

    Unordered images have no rest, and come back as they are.
    """
    near = gather_neighbours(bodies.frame, bodies.person, bodies.fps)
    posture = postures(bodies, parts, floor)
    rest = resting_soles(bodies, parts, posture.lying).double()
    soles = [members(parts, f"{side}_sole").nonzero()[:, 0] for side in SIDES]
    if not len(near.pairs) or not all(len(sole) for sole in soles):
        return bodies
    calm = (posture.sitting | posture.lying).double()
    shift = _shifts(bodies, near, rest, calm, soles, floor)
    moved = corrected(bodies, replace(no_correction(bodies), shift=shift.to(bodies.verts)))
    if bodies.pose is None:
        return moved
    lying = postures(moved, parts, floor).lying
    rest = resting_soles(moved, parts, lying).double()
    ways = torch.stack([
        _way(moved.verts[:, sole], near, rest[:, k], floor) for k, sole in enumerate(soles)
    ])  # fmt: skip
    for k, side in enumerate(SIDES):
        moved = _bend(moved, side, soles[k], ways[k])
    return moved


def _foot(points: Float[Tensor, "bodies sole 3"]) -> Float[Tensor, "bodies 3"]:
    """Middle of a sole at the height of its lowest point [m]."""
    middle = points.double().mean(1)
    low = points[..., 1].double().amin(1)
    return torch.stack([middle[:, 0], low, middle[:, 2]], -1)


class _Chain:
    """Least squares for a vector in each row: unknowns, pairs of them, and their sum."""

    def __init__(self, rows: int, near: Neighbours) -> None:
        self.rows, self.near = rows, near
        self.entries: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]] = []
        self.right = np.zeros((rows, 3))

    def prior(self, at: Float[Tensor, "rows 3 3"], goal: Float[Tensor, "rows 3"]) -> None:
        """Add (x - goal)ᵀ A (x - goal) of each row."""
        blocks = at.numpy()
        self._blocks(np.arange(self.rows), np.arange(self.rows), blocks)
        self.right += np.einsum("rij,rj->ri", blocks, goal.numpy())

    def slow(self, change: float) -> None:
        """What is sought changes by so much [m/√s]."""
        weight = 1 / (change**2 * self.near.gaps.double())
        self._pairs(weight, 1.0, torch.zeros(len(weight), 3, dtype=torch.float64))

    def still(
        self, places: Float[Tensor, "rows 3"], chance: Float[Tensor, " rows"], slip: float,
        up: float = 0.0,
    ) -> None:  # fmt: skip
        """Places [m] that move with the rows rest, by a chance, along the floor and `up`wards."""
        i, j = self.near.pairs.unbind(-1)
        weight = torch.minimum(chance[i], chance[j]) / slip**2
        self._pairs(weight, up, -(places[j] - places[i]))

    def on_floor(
        self, foot: Float[Tensor, "rows 3"], rest: Float[Tensor, " rows"], floor: float, rise: float
    ) -> None:
        """A sole at rest near the floor lies on it, and none is below it."""
        height = foot[:, 1] - floor
        share = torch.where(height < 0, torch.ones_like(rest), rest * (height < ON_FLOOR))
        at, goal = foot.new_zeros(len(foot), 3, 3), torch.zeros_like(foot)
        at[:, 1, 1], goal[:, 1] = share / rise**2, -height
        self.prior(at, goal)

    def _pairs(
        self, weight: Float[Tensor, " pairs"], up: float, goal: Float[Tensor, "pairs 3"]
    ) -> None:
        """Add (x_j - x_i - goal)ᵀ diag(a) (x_j - x_i - goal) of each pair."""
        at = torch.stack([weight, up * weight, weight], -1).numpy()
        i, j = self.near.pairs.numpy().T
        blocks = np.einsum("pi,ij->pij", at, np.eye(3))
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            self._blocks(a, b, sign * blocks)
        pull = at * goal.numpy()
        np.add.at(self.right, j, pull)
        np.add.at(self.right, i, -pull)

    def _blocks(
        self, i: NDArray[np.int64], j: NDArray[np.int64], values: NDArray[np.float64]
    ) -> None:
        axis = np.arange(3)
        row = (3 * i[:, None, None] + axis[:, None]).repeat(3, 2)
        column = (3 * j[:, None, None] + axis).repeat(3, 1)
        self.entries.append((row.ravel(), column.ravel(), values.ravel()))

    def solve(self) -> Float[Tensor, "rows 3"]:
        """The rows with the least sum."""
        from scipy.sparse import csc_matrix
        from scipy.sparse.linalg import spsolve

        row, column, value = (np.concatenate(part) for part in zip(*self.entries, strict=True))
        size = 3 * self.rows
        found = spsolve(csc_matrix((value, (row, column)), shape=(size, size)), self.right.ravel())
        return torch.from_numpy(np.asarray(found).reshape(self.rows, 3))


def _shifts(
    bodies: Bodies,
    near: Neighbours,
    rest: Float[Tensor, "bodies feet"],
    calm: Float[Tensor, " bodies"],
    soles: list[Tensor],
    floor: float,
) -> Float[Tensor, "bodies 3"]:
    """How far each body is moved as a whole [m]."""
    chain, sway = _Chain(len(bodies.frame), near), SWAY if bodies.pose is not None else RIGID
    middle = bodies.verts.double().mean(1)
    x, _, z = middle.unbind(-1)
    side = torch.stack([z, torch.zeros_like(z), -x], -1)
    side = side / side.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    across = side[:, :, None] * side[:, None]
    prior = (torch.eye(3, dtype=torch.float64) - across) / ALONG**2 + across / ACROSS**2
    chain.slow(STEADY)
    chain.prior(prior, torch.zeros_like(middle))
    for k, sole in enumerate(soles):
        foot = _foot(bodies.verts[:, sole])
        chain.still(foot, rest[:, k], sway)
        chain.on_floor(foot, rest[:, k], floor, SINK)
    chain.still(middle, calm, STILL, up=1.0)
    return chain.solve()


def _way(
    points: Float[Tensor, "bodies sole 3"],
    near: Neighbours,
    rest: Float[Tensor, " bodies"],
    floor: float,
) -> Float[Tensor, "bodies 3"]:
    """How far a foot has to go beside its body [m]."""
    foot = _foot(points)
    chain = _Chain(len(foot), near)
    eye = torch.eye(3, dtype=torch.float64).expand(len(foot), 3, 3)
    chain.prior(eye / FOOT**2, torch.zeros_like(foot))
    chain.slow(FADE)
    chain.still(foot, rest, SLIP)
    chain.on_floor(foot, rest, floor, RISE)
    return chain.solve()


def _bend(
    bodies: Bodies, side: str, sole: Int[Tensor, " sole"], way: Float[Tensor, "bodies 3"]
) -> Bodies:
    """Bend a leg so that its sole goes that way, without a turn of the sole (Gauss-Newton)."""
    pose = bodies.pose
    assert pose is not None
    spots = sole[torch.linspace(0, len(sole) - 1, min(SPOTS, len(sole))).long()]
    model = vertex_subset(load_model(pose.model, pose.gender), spots)
    index = [BODY.index(f"{side}_{part}") - 1 for part in LEG]
    columns = torch.tensor([3 * k + axis for k in index for axis in range(3)])
    goal = bodies.verts[:, spots].double() + way[:, None]
    angles = torch.zeros(len(way), len(columns), dtype=torch.float64)

    def placed(change: Tensor) -> Tensor:
        bent = pose.body_pose.clone()
        bent[:, columns] += change.to(bent)
        return model.posed(replace(pose, body_pose=bent))[0].double().flatten(1)

    damp = torch.eye(len(columns), dtype=torch.float64) / BENT**2
    with torch.no_grad():
        for _ in range(STEPS):
            here = placed(angles)
            slope = torch.stack([
                (placed(angles + NUDGE * step) - here) / NUDGE
                for step in torch.eye(len(columns), dtype=torch.float64)
            ], -1)  # fmt: skip
            left = goal.flatten(1) - here
            normal = slope.mT @ slope / REACHED**2 + damp
            right = (slope.mT @ left[..., None])[..., 0] / REACHED**2 - angles / BENT**2
            angles = angles + torch.linalg.solve(normal, right)
    whole = torch.zeros_like(pose.body_pose)
    whole[:, columns] = angles.to(whole)
    return corrected(bodies, replace(no_correction(bodies), angles=whole))
