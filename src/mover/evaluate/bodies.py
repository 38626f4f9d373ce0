"""Whether bodies are true and fit their scene: errors, footing, collision and contact.

Errors are measured in the gravity-aligned worlds of the scenes, without alignment. Collision and
contact are those of each body with the furniture of its own scene; the floor is left out.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.parts import SOLES, members, parts_of
from mover.bodies.skeleton import BODY
from mover.core.records import fingerprint, record, rows_of
from mover.core.types import Bodies, Camera, Keypoints, Mesh, SceneObject
from mover.evaluate.scene import Metric
from mover.geometry.placement import StandingMesh, standing_meshes
from mover.geometry.rotations import similarity
from mover.geometry.volume import signed_distance
from mover.geometry.watertight import close_mesh
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
