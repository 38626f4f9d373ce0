"""Matches a human mesh of unknown topology and pose to the open body, vertex by vertex.

1. Walking distances to head, hands and feet say roughly where a vertex lies (`intrinsic`).
2. From that come places of the joints, and the limbs of the open body are laid over the mesh's.
3. Distances are the same for left and right. The way in which the limbs fit best can.
4. The vertex of the open body that is nearest and of like direction gives a vertex its part.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Int

from mover.bodies.limbs import (
    LANDMARKS,
    LIMBS,
    SIDED,
    Walks,
    ends,
    landmark_rings,
    limb_frames,
    limb_of,
    match_ends,
    naturalness,
    thin,
)
from mover.bodies.skin import model_parts
from mover.bodies.skinning import open_body, zero_pose
from mover.geometry.mesh import vertex_normals

Array = np.ndarray

NEAR = 40
"""Candidates looked at for each vertex."""
WORST_MATCH = 0.13
"""Mismatch of the distances between head, hands and feet; real people give .01 to .08."""
WORST_FIT = 60.0
"""A vertex that fits worse belongs to no part."""
ROUNDS = 3
FEWEST = 20
"""Vertices of a limb that are enough to lay it again."""
REACH = 0.05
"""A normal counts as much as a place that far from the middle [m]."""
SAMPLED = 1500
"""Vertices that distinguish left from right."""
SPREAD = (0.06, 0.05, 0.5)
"""Typical mismatch of walking distances [m], of places along a limb [m], and of normals."""


@dataclass(frozen=True)
class Atlas:
    """The open body in its zero pose: what unknown meshes are matched to."""

    verts: Float[Array, "verts 3"]
    normals: Float[Array, "verts 3"]
    walks: Walks
    part: Int[Array, " verts"]
    limb: Int[Array, " verts"]
    """Index into `LIMBS` of the limb that moves each vertex."""
    rings: Float[Array, "verts landmarks"]
    """1 where a vertex lies around a landmark."""


@dataclass(frozen=True)
class Matched:
    """What was found out about an unknown mesh."""

    part: Int[Array, " verts"]
    rings: Int[Array, "landmarks members"]


@dataclass(frozen=True)
class Near:
    """Candidates for some vertices of an unknown mesh."""

    rows: Int[Array, " rows"]
    index: Int[Array, "rows candidates"]
    """Vertices of the open body."""
    cost: Float[Array, "rows candidates"]
    """Mismatch of the walking distances."""


@dataclass(frozen=True)
class Frames:
    """How each of `LIMBS` lies: x_zero = back @ (x - start) / size + origin."""

    back: Float[Array, "limbs 3 3"]
    start: Float[Array, "limbs 3"]
    origin: Float[Array, "limbs 3"]


@dataclass(frozen=True)
class PosedMesh:
    """An unknown mesh in one pose."""

    verts: Float[Array, "verts 3"]
    normals: Float[Array, "verts 3"]


@cache
def atlas() -> Atlas:
    """The open body, measured."""
    model = open_body()
    verts, joints = (x[0].double() for x in model.posed(zero_pose(1, model)))
    place = dict(zip(model.joint_names, joints.numpy(), strict=True))
    goals = np.stack([
        verts[verts[:, 1].argmax()].numpy(),
        *(place[f"{side}_middle3"] for side in ("left", "right")),
        *(place[f"{side}_foot"] + [0, 0, 0.1] for side in ("left", "right")),
    ])  # fmt: skip
    points = verts.numpy()
    tips, far = ends(points, model.faces.numpy())
    order = np.linalg.norm(points[tips][None] - goals[:, None], axis=-1).argmin(1)
    return Atlas(
        verts=points,
        normals=vertex_normals(verts, model.faces).numpy(),
        walks=Walks(tips[order], far[:, order]),
        part=model_parts(model).numpy(),
        limb=limb_of(model),
        rings=landmark_rings(model),
    )


def match(meshes: Float[Array, "meshes verts 3"], faces: Int[Array, "faces 3"]) -> Matched | None:
    """Match a human mesh, seen in one or more poses, to the open body.

    Vertices that hang together with nothing (eyes, teeth) get no part. None: no whole human body.
    """
    known = atlas()
    model = known.walks.far[known.walks.tips]
    tries = [match_ends(mesh, faces, model) for mesh in meshes]
    found, size, mismatch = min(tries, key=lambda item: item[2])
    if not mismatch < WORST_MATCH:
        return None
    normals = vertex_normals(torch.from_numpy(meshes), torch.from_numpy(faces)).numpy()
    linked = np.nonzero(np.isfinite(found.far[:, 0]))[0]
    posed = [PosedMesh(v[linked], n[linked]) for v, n in zip(meshes, normals, strict=True)]
    tips, far = np.searchsorted(linked, found.tips), found.far[linked] / size
    some = np.arange(0, len(linked), max(1, len(linked) // SAMPLED))
    guesses = [Walks(tips[order], far[:, order]) for order in SIDED]
    walks = min(guesses, key=lambda walks: _misfit(posed, walks, size, some))
    rings = known.rings[_nearest(walks.far, known.walks.far, 1)[:, 0]]
    near = _near(walks, np.arange(len(linked)))
    laid = [_fit(mesh, walks, near, rings, size) for mesh in posed]
    rings = np.mean([known.rings[chosen] for chosen, _ in laid], axis=0)
    part = np.stack([np.where(cost < WORST_FIT, known.part[chosen], -1) for chosen, cost in laid])
    counts = np.stack([(part == p).sum(0) for p in range(-1, int(known.part.max()) + 1)])
    best = np.full(meshes.shape[1], -1)
    best[linked] = counts.argmax(0) - 1
    return Matched(best, linked[thin(posed[0].verts, rings)])


def _nearest(
    query: Float[Array, "queries dims"], points: Float[Array, "points dims"], count: int
) -> Int[Array, "queries count"]:
    from scipy.spatial import KDTree

    return np.asarray(KDTree(points).query(query, k=count)[1]).reshape(len(query), count)


def _landmarks(
    mesh: Float[Array, "verts 3"], rings: Float[Array, "verts landmarks"]
) -> dict[str, Float[Array, "3"]]:
    """Middle of each ring of vertices [m]."""
    share = rings / rings.sum(0).clip(min=1)
    return dict(zip(LANDMARKS, share.T @ mesh, strict=True))


def _fit(
    mesh: PosedMesh, walks: Walks, near: Near, rings: Float[Array, "verts landmarks"], size: float
) -> tuple[Int[Array, " verts"], Float[Array, " verts"]]:
    """Lay the limbs over the mesh by landmarks, then again by what fits."""
    frames = _frames(mesh, walks, rings)
    laid = _lay(mesh, near, frames, size)
    for _ in range(ROUNDS):
        frames = _refitted(mesh, laid[0], frames, size)
        laid = _lay(mesh, near, frames, size)
    return laid


def _misfit(posed: list[PosedMesh], walks: Walks, size: float, rows: Int[Array, " rows"]) -> float:
    """How badly the limbs of the open body fit, and bend, if left and right are as in `walks`."""
    known = atlas()
    rings = known.rings[_nearest(walks.far, known.walks.far, 1)[:, 0]]
    near = _near(walks, rows)
    costs = [_lay(m, near, _frames(m, walks, rings), size)[1] for m in posed]
    bent = [naturalness(_landmarks(m.verts, rings), m.verts[walks.tips]) for m in posed]
    return float(np.minimum(costs, WORST_FIT).mean() - np.mean(bent))


def _frames(mesh: PosedMesh, walks: Walks, rings: Float[Array, "verts landmarks"]) -> Frames:
    """The limbs' turn back into the zero pose and their starts, from landmarks."""
    known = atlas()
    here = limb_frames(_landmarks(mesh.verts, rings), mesh.verts[walks.tips])
    there = limb_frames(_landmarks(known.verts, known.rings), known.verts[known.walks.tips])
    return Frames(
        back=np.stack([there[n][0] @ here[n][0].T for n in LIMBS]),
        start=np.stack([here[n][1] for n in LIMBS]),
        origin=np.stack([there[n][1] for n in LIMBS]),
    )


def _refitted(mesh: PosedMesh, chosen: Int[Array, " verts"], frames: Frames, size: float) -> Frames:
    """The limbs' frames that bring matched vertices and normals together best (Kabsch)."""
    known = atlas()
    back, start, origin = frames.back.copy(), frames.start.copy(), frames.origin.copy()
    for limb in range(len(LIMBS)):
        mine = known.limb[chosen] == limb
        if mine.sum() < FEWEST:
            continue
        here, there = mesh.verts[mine], known.verts[chosen[mine]]
        start[limb], origin[limb] = here.mean(0), there.mean(0)
        spread = (here - start[limb]).T / size @ (there - origin[limb])
        spread = spread + REACH**2 * mesh.normals[mine].T @ known.normals[chosen[mine]]
        u, _, vt = np.linalg.svd(spread)
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
        back[limb] = vt.T @ flip @ u.T
    return Frames(back, start, origin)


def _near(walks: Walks, rows: Int[Array, " rows"]) -> Near:
    """The vertices of the open body that lie about as far from its ends as `rows` do."""
    known = atlas().walks.far
    far = walks.far[rows]
    index = _nearest(far, known, NEAR)
    return Near(rows, index, np.square(far[:, None] - known[index]).sum(-1) / SPREAD[0] ** 2)


def _lay(
    mesh: PosedMesh, near: Near, frames: Frames, size: float
) -> tuple[Int[Array, " rows"], Float[Array, " rows"]]:
    """The vertex of the open body that fits each row of `near` best, and how badly it does.

    The limbs of the open body are laid over those of the mesh; a vertex fits by its place along the
    limb, its normal and its walking distances.
    """
    known = atlas()
    row = np.arange(len(near.rows))
    limb = known.limb[near.index]
    from_start = (mesh.verts[near.rows, None] - frames.start) / size
    place = np.einsum("lij,vlj->vli", frames.back, from_start) + frames.origin
    facing = np.einsum("lij,vj->vli", frames.back, mesh.normals[near.rows])[row[:, None], limb]
    cost = (
        near.cost
        + np.square(place[row[:, None], limb] - known.verts[near.index]).sum(-1) / SPREAD[1] ** 2
        + np.square(facing - known.normals[near.index]).sum(-1) / SPREAD[2] ** 2
    )
    best = cost.argmin(1)
    chosen = near.index[row, best]
    agree = np.einsum("vi,vi->v", facing[row, best], known.normals[chosen]) > 0
    return chosen, np.where(agree, cost[row, best], np.inf)
