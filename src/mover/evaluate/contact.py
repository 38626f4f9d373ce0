"""Whether people and furniture fit: collision and contact.

Each body is measured against the furniture of its own scene; the floor is left out.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import fingerprint, record, rows_of
from mover.core.types import Bodies, Mesh, SceneObject
from mover.evaluate.bodies import shared_rows
from mover.evaluate.scene import Metric
from mover.geometry.placement import StandingMesh, standing_meshes
from mover.geometry.volume import signed_distance
from mover.geometry.watertight import close_mesh

Furniture = Sequence[StandingMesh]
BLOCK = 64  # bodies that are measured at once: memory stays that of these


@record
class Nearness:
    """How the vertices of some bodies lie to the furniture; inf where nothing is near."""

    signed: Float[Tensor, "bodies verts"]
    """Signed distance to the object that the vertex is deepest in or nearest to [m]."""
    surface: Float[Tensor, "bodies verts"]  #: Distance to the nearest surface [m]


@record
class Touch:
    """Bodies beside the furniture of their scene, and the same bodies in the true one."""

    near: Nearness  #: All bodies that are judged
    shared: Nearness | None  #: Those that the truth knows as well, vertex by vertex; None: no truth
    true_shared: Nearness | None
    reach: float  #: A vertex touches what is at most so far away [m]


@record
class TrueTouch:
    """Some true bodies beside the true furniture."""

    bodies: Bodies
    near: Nearness


def non_collision(touch: Touch) -> float:
    """Share of a body's vertices that are inside no object, mean over bodies (the paper's)."""
    return float((touch.near.signed >= 0).double().mean(-1).mean())


def contact(touch: Touch) -> float:
    """Share of the bodies of which at least one vertex is inside an object (the paper's)."""
    return float((touch.near.signed < 0).any(-1).double().mean())


def contact_f1(touch: Touch) -> float | None:
    """F1 score of the vertices that touch furniture, over all bodies; 1 if none should or does."""
    if touch.shared is None or touch.true_shared is None:
        return None
    found, true = touch.shared.surface <= touch.reach, touch.true_shared.surface <= touch.reach
    both, either = int((found & true).sum()), int(found.sum() + true.sum())
    return 2 * both / either if either else 1.0


TOUCH_METRICS: dict[str, Metric[Touch]] = {
    "non_collision": Metric("Body outside furniture", "share", 1.0, non_collision),
    "contact": Metric("Bodies that touch furniture", "share", 1.0, contact),
    "contact_f1": Metric("Contact F1", "", 1.0, contact_f1),
}


def close_meshes(objects: Iterable[SceneObject]) -> dict[str, Mesh]:
    """The closed proxies of all meshes by the fingerprint of the mesh; equal ones only once."""
    meshes = {fingerprint(item.mesh): item.mesh for item in objects}
    return {key: close_mesh(mesh) for key, mesh in meshes.items()}


def furniture_of(objects: Iterable[SceneObject], closed: Mapping[str, Mesh]) -> list[StandingMesh]:
    """The closed proxies of the objects at their positions in the world, and when."""
    solid = (replace(item, mesh=closed[fingerprint(item.mesh)]) for item in objects)
    return [there for item in solid for there in standing_meshes(item)]


def gather_truth(
    truth: Bodies, furniture: Furniture, judged: Bodies, count: int, reach: float
) -> TrueTouch | None:
    """True bodies beside the true furniture: at most `count` of those that are to be judged."""
    rows = shared_rows(truth, judged)[0]
    if len(rows) == 0 or truth.verts.shape[1] != judged.verts.shape[1]:
        return None
    bodies = rows_of(replace(truth, pose=None), rows[evenly(len(rows), count)])
    return TrueTouch(bodies, nearness(bodies.verts, bodies.frame, furniture, reach))


def gather_touch(
    bodies: Bodies, furniture: Furniture, truth: TrueTouch | None, count: int, reach: float
) -> Touch:
    """Bodies beside the furniture of their scene, in one world: at most `count`, spread evenly.

    Those that the truth knows are measured as well. Within `reach` [m] a vertex touches.
    """
    picked = evenly(len(bodies.frame), count)
    near = nearness(bodies.verts[picked], bodies.frame[picked], furniture, reach)
    rows = true_rows = picked[:0]
    if truth is not None and bodies.verts.shape[1] == truth.bodies.verts.shape[1]:
        rows, true_rows = shared_rows(bodies, truth.bodies)
    if truth is None or len(rows) == 0:
        return Touch(near, None, None, reach)
    same = torch.equal(rows, picked)
    shared = near if same else nearness(bodies.verts[rows], bodies.frame[rows], furniture, reach)
    true = Nearness(truth.near.signed[true_rows], truth.near.surface[true_rows])
    return Touch(near, shared, true, reach)


def nearness(
    verts: Float[Tensor, "bodies verts 3"],
    frame: Int[Tensor, " bodies"],
    furniture: Furniture,
    reach: float,
) -> Nearness:
    """Distances of body vertices [m] to closed meshes, exact up to `reach` [m] from their boxes.

    Furniture that is moved is measured where it stands in the frame of each body.
    """
    signed = torch.full_like(verts[..., 0], torch.inf)
    surface = signed.clone()
    for first in range(0, len(verts), BLOCK):
        part = slice(first, first + BLOCK)
        points, deep, near = verts[part], signed[part], surface[part]  # filled in place
        for there in furniture:  # one tree for each mesh: there is no batched exact distance
            mesh, now = there.mesh, there.when(frame[part])
            low, high = mesh.verts.amin(0) - reach, mesh.verts.amax(0) + reach
            close = ((points >= low) & (points <= high)).all(-1) & now[:, None]
            if bool(close.any()):
                distance = signed_distance(points[close], mesh.verts, mesh.faces).to(signed)
                deep[close] = torch.minimum(deep[close], distance)
                near[close] = torch.minimum(near[close], distance.abs())
    return Nearness(signed, surface)


def evenly(rows: int, count: int) -> Int[Tensor, " picked"]:
    """At most `count` of so many rows, spread evenly, the first and the last among them."""
    if rows <= count:
        return torch.arange(rows)
    return torch.linspace(0, rows - 1, count, dtype=torch.float64).round().long()
