"""Parts of a human mesh of unknown topology: matched to the open body, vertex by vertex.

1. Walking distances to head, hands and feet say roughly where a vertex lies (`intrinsic`).
2. From that come places of the joints; toes, knees and elbows tell front from back, and so left
   from right.
3. Each limb of the open body is laid over the mesh's; the nearest vertex of like direction gives
   its part.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Int

from ..geometry.mesh import vertex_normals
from .intrinsic import TIPS, Walks, ends, match_ends, mirrored
from .limbs import LANDMARKS, LIMBS, landmark_rings, limb_frames, limb_of, thin
from .skin import model_parts
from .skinning import open_body, zero_pose

Array = np.ndarray

NEAR = 40
"""Candidates looked at for each vertex."""
WORST_MATCH = 0.13
"""Mismatch of the distances between head, hands and feet; real people give .01 to .08."""
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
    rough = _nearest(found.far / size, known.walks.far, 1)[:, 0]
    rings = known.rings[rough]
    if _frontness(meshes, rings, found.tips) < 0:
        found = mirrored(found)
        rough = _nearest(found.far / size, known.walks.far, 1)[:, 0]
        rings = known.rings[rough]
    part = np.stack([_assign(mesh, faces, found, rings, size) for mesh in meshes])
    counts = np.stack([(part == p).sum(0) for p in range(-1, int(known.part.max()) + 1)])
    best = counts.argmax(0) - 1
    best[~np.isfinite(found.far[:, 0])] = -1
    return Matched(best, thin(meshes[0], rings))


def _nearest(
    query: Float[Array, "queries dims"], points: Float[Array, "points dims"], count: int
) -> Int[Array, "queries count"]:
    from scipy.spatial import KDTree

    finite = np.where(np.isfinite(query), query, 1e3)
    return np.asarray(KDTree(points).query(finite, k=count)[1]).reshape(len(query), count)


def _landmarks(
    mesh: Float[Array, "verts 3"], rings: Float[Array, "verts landmarks"]
) -> dict[str, Float[Array, "3"]]:
    """Middle of each ring of vertices [m]."""
    share = rings / rings.sum(0).clip(min=1)
    return dict(zip(LANDMARKS, share.T @ mesh, strict=True))


def _frontness(
    meshes: Float[Array, "meshes verts 3"],
    rings: Float[Array, "verts landmarks"],
    tips: Int[Array, "5"],
) -> float:
    """How far toes and knees point forward and elbows backward [m], if left is left."""
    total = 0.0
    for mesh in meshes:
        at = _landmarks(mesh, rings)
        across = at["left_hip"] - at["right_hip"] + at["left_shoulder"] - at["right_shoulder"]
        hips = (at["left_hip"] + at["right_hip"]) / 2
        front = np.cross(across, at["neck"] - hips)
        front = front / np.linalg.norm(front)
        for side in ("left", "right"):
            toe = mesh[tips[TIPS.index(f"{side}_foot")]]
            hip, knee, ankle = (at[f"{side}_{n}"] for n in ("hip", "knee", "ankle"))
            shoulder, elbow, wrist = (at[f"{side}_{n}"] for n in ("shoulder", "elbow", "wrist"))
            total += front @ (toe - ankle) + front @ (knee - (hip + ankle) / 2)
            total -= front @ (elbow - (shoulder + wrist) / 2)
    return float(total)


def _assign(
    mesh: Float[Array, "verts 3"],
    faces: Int[Array, "faces 3"],
    found: Walks,
    rings: Float[Array, "verts landmarks"],
    size: float,
) -> Int[Array, " verts"]:
    """Part of each vertex: that of the vertex of the open body that fits it best, if one does."""
    known = atlas()
    tensor = torch.from_numpy(mesh)
    normals = vertex_normals(tensor, torch.from_numpy(faces)).numpy()
    here = limb_frames(_landmarks(mesh, rings), mesh[found.tips])
    there = limb_frames(_landmarks(known.verts, known.rings), known.verts[known.walks.tips])
    candidates = _nearest(found.far / size, known.walks.far, NEAR)
    limb = known.limb[candidates]
    turn = np.stack([here[n][0] @ there[n][0].T for n in LIMBS])
    start_here = np.stack([here[n][1] for n in LIMBS])
    start_there = np.stack([there[n][1] for n in LIMBS])
    back = turn[limb].swapaxes(-1, -2)
    place = (back @ (mesh[:, None] - start_here[limb])[..., None])[..., 0] / size
    facing = (back @ normals[:, None, :, None])[..., 0]
    walked = np.where(np.isfinite(found.far), found.far, 0)[:, None] / size
    price = (
        np.square(walked - known.walks.far[candidates]).sum(-1) / SPREAD[0] ** 2
        + np.square(place + start_there[limb] - known.verts[candidates]).sum(-1) / SPREAD[1] ** 2
        + np.square(facing - known.normals[candidates]).sum(-1) / SPREAD[2] ** 2
    )
    row, best = np.arange(len(mesh)), price.argmin(1)
    chosen = candidates[row, best]
    agree = np.einsum("vi,vi->v", facing[row, best], known.normals[chosen]) > 0
    return np.where(agree, known.part[chosen], -1)
