"""Parts of a human mesh of unknown topology: matched to the open body, vertex by vertex.

1. Walking distances to head, hands and feet say roughly where a vertex lies (`intrinsic`).
2. From that come places of the joints, and the limbs of the open body are laid over the mesh's.
3. Distances cannot tell left from right. The way in which the limbs fit best can.
4. The vertex of the open body that is nearest and of like direction gives a vertex its part.
"""

import logging
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.bone_frames import (
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
from mover.bodies.skin import PARTS, lowest_soles, model_parts
from mover.bodies.skinning import SkinnedBody, open_body, zero_pose
from mover.bodies.smpl_files import KINDS, load_smpl
from mover.bodies.smpl_model import skin_of_model
from mover.core.errors import InputError
from mover.core.records import fingerprint, record
from mover.core.types import Bodies
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
"""Vertices that tell left from right."""
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
    price: Float[Array, "rows candidates"]
    """Mismatch of the walking distances."""


@dataclass(frozen=True)
class Frames:
    """How each of `LIMBS` lies: x_zero = back @ (x - start) / size + origin."""

    back: Float[Array, "limbs 3 3"]
    start: Float[Array, "limbs 3"]
    origin: Float[Array, "limbs 3"]


@dataclass(frozen=True)
class Posed:
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
    posed = [Posed(v[linked], n[linked]) for v, n in zip(meshes, normals, strict=True)]
    tips, far = np.searchsorted(linked, found.tips), found.far[linked] / size
    some = np.arange(0, len(linked), max(1, len(linked) // SAMPLED))
    guesses = [Walks(tips[order], far[:, order]) for order in SIDED]
    walks = min(guesses, key=lambda walks: _misfit(posed, walks, size, some))
    rings = known.rings[_nearest(walks.far, known.walks.far, 1)[:, 0]]
    near = _near(walks, np.arange(len(linked)))
    laid = [_fit(mesh, walks, near, rings, size) for mesh in posed]
    rings = np.mean([known.rings[chosen] for chosen, _ in laid], axis=0)
    part = np.stack([np.where(price < WORST_FIT, known.part[chosen], -1) for chosen, price in laid])
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
    mesh: Posed, walks: Walks, near: Near, rings: Float[Array, "verts landmarks"], size: float
) -> tuple[Int[Array, " verts"], Float[Array, " verts"]]:
    """Lay the limbs over the mesh by landmarks, then again by what fits."""
    frames = _frames(mesh, walks, rings)
    laid = _lay(mesh, near, frames, size)
    for _ in range(ROUNDS):
        frames = _refitted(mesh, laid[0], frames, size)
        laid = _lay(mesh, near, frames, size)
    return laid


def _misfit(posed: list[Posed], walks: Walks, size: float, rows: Int[Array, " rows"]) -> float:
    """How badly the limbs of the open body fit, and bend, if left and right are as in `walks`."""
    known = atlas()
    rings = known.rings[_nearest(walks.far, known.walks.far, 1)[:, 0]]
    near = _near(walks, rows)
    prices = [_lay(m, near, _frames(m, walks, rings), size)[1] for m in posed]
    bent = [naturalness(_landmarks(m.verts, rings), m.verts[walks.tips]) for m in posed]
    return float(np.minimum(prices, WORST_FIT).mean() - np.mean(bent))


def _frames(mesh: Posed, walks: Walks, rings: Float[Array, "verts landmarks"]) -> Frames:
    """The limbs' turn back into the zero pose and their starts, from landmarks."""
    known = atlas()
    here = limb_frames(_landmarks(mesh.verts, rings), mesh.verts[walks.tips])
    there = limb_frames(_landmarks(known.verts, known.rings), known.verts[known.walks.tips])
    return Frames(
        back=np.stack([there[n][0] @ here[n][0].T for n in LIMBS]),
        start=np.stack([here[n][1] for n in LIMBS]),
        origin=np.stack([there[n][1] for n in LIMBS]),
    )


def _refitted(mesh: Posed, chosen: Int[Array, " verts"], frames: Frames, size: float) -> Frames:
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
    mesh: Posed, near: Near, frames: Frames, size: float
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
    price = (
        near.price
        + np.square(place[row[:, None], limb] - known.verts[near.index]).sum(-1) / SPREAD[1] ** 2
        + np.square(facing - known.normals[near.index]).sum(-1) / SPREAD[2] ** 2
    )
    best = price.argmin(1)
    chosen = near.index[row, best]
    agree = np.einsum("vi,vi->v", facing[row, best], known.normals[chosen]) > 0
    return chosen, np.where(agree, price[row, best], np.inf)


# Parts of a body that touch things: soles, seat, thighs, back, palms, forearms.
#
# Of a skinned body they follow from the weights and from normals and heights in the zero pose, so
# that no list of vertices is shipped. Meshes of unknown topology are matched to the open body.


log = logging.getLogger(__name__)


POSES = 4
"""Poses that vote on the parts of an unknown mesh."""


@record
class Parts:
    """Which part of the body each vertex belongs to."""

    part_of: Int[Tensor, " verts"]
    """Index into `PARTS`; -1: none."""
    rings: Int[Tensor, "landmarks members"]
    """Vertices around each of `LANDMARKS`: their mean is about where the joint is. Empty where the
    mesh could not be matched to a human body."""


def members(parts: Parts, *names: str) -> Bool[Tensor, " verts"]:
    """Which vertices belong to one of these parts."""
    wanted = torch.tensor([PARTS.index(n) for n in names], device=parts.part_of.device)
    return torch.isin(parts.part_of, wanted)


def parts_of(bodies: Bodies, up_cam: Float[Tensor, "3"] | None = None) -> Parts:
    """Parts of these bodies: by the model's skin where it is known, else by geometry.

    Args:
        bodies: People with one topology, in any poses.
        up_cam: Direction of up in the frame of `bodies`; a level camera or +y of the world if not
            given. Asked only of a mesh that cannot be matched to a human body: its soles are what
            lies lowest.
    """
    found = _find(bodies, up_cam)
    device = bodies.verts.device
    return Parts(found.part_of.to(device), found.rings.to(device))


def _find(bodies: Bodies, up_cam: Float[Tensor, "3"] | None) -> Parts:
    model = known_model(bodies.faces, bodies.verts.shape[1]) or _users_model(bodies)
    if model is not None:
        return _of_model(model)
    if bodies.verts.shape[0] == 0:
        return _unmatched(torch.full((bodies.verts.shape[1],), -1))
    rows = torch.linspace(0, bodies.verts.shape[0] - 1, POSES).round().long().unique()
    meshes = bodies.verts[rows].detach().cpu().double()
    faces = bodies.faces.detach().cpu()
    found = _matched(meshes, faces)
    if found is not None:
        return Parts(torch.from_numpy(found.part), torch.from_numpy(found.rings))
    log.warning("the bodies' mesh does not look like a whole person: only its soles are looked for")
    default = (0.0, -1.0, 0.0) if bodies.space == "camera" else (0.0, 1.0, 0.0)
    up = torch.tensor(default) if up_cam is None else up_cam.detach().cpu()
    return _unmatched(lowest_soles(meshes, faces, up.to(meshes)))


def _matched(
    meshes: Float[Tensor, "meshes verts 3"], faces: Int[Tensor, "faces 3"]
) -> Matched | None:
    """`match`, once for the same poses: many ask, of the people of one capture."""
    key = fingerprint(meshes, faces)
    if key not in _matches:
        while len(_matches) >= MOST_MATCHES:
            _matches.pop(next(iter(_matches)), None)
        _matches[key] = match(meshes.numpy(), faces.numpy())
    return _matches[key]


MOST_MATCHES = 16
_matches: dict[str, Matched | None] = {}


def known_model(faces: Int[Tensor, "faces 3"], verts: int) -> SkinnedBody | None:
    """The shipped body with exactly this topology, if there is one."""
    for model in (open_body("small"), open_body("full")):
        if model.verts.shape[0] == verts and torch.equal(model.faces, faces.cpu()):
            return model
    return None


def _users_model(bodies: Bodies) -> SkinnedBody | None:
    """The skin of the user's licensed model, where its files are there and fit these bodies."""
    named = [] if bodies.pose is None else [(bodies.pose.model, bodies.pose.gender)]
    count = bodies.verts.shape[1]
    for name, gender in [*named, *((n, "neutral") for n, k in KINDS.items() if k.verts == count)]:
        try:
            skin = skin_of_model(load_smpl(name, gender)) if name in KINDS else None
        except InputError:
            continue
        if skin is not None and torch.equal(skin.faces, bodies.faces.cpu()):
            return skin
    return None


def _of_model(model: SkinnedBody) -> Parts:
    rings = thin(model.verts.numpy(), landmark_rings(model))
    return Parts(model_parts(model), torch.from_numpy(rings))


def _unmatched(part_of: Int[Tensor, " verts"]) -> Parts:
    return Parts(part_of, torch.zeros((0, 0), dtype=torch.long))
