"""Where a vertex lies on a body, whatever the pose: walking distances to head, hands and feet.

Distances along the skin hardly change when a person moves, so they distinguish head, hands and
feet of any human mesh, and match its vertices to those of a known one.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mover.bodies.skeleton import FINGERS, SIDES
from mover.bodies.skinning import SkinnedBody

LANDMARKS = (
    "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle", "neck",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
"""Joints that are found on any body."""

ABOVE = {
    "hip": ("pelvis",), "knee": ("hip",), "ankle": ("knee",), "neck": ("spine3",),
    "shoulder": ("collar",), "elbow": ("shoulder",), "wrist": ("elbow",),
}  # fmt: skip
"""The joint whose skin blends with that of each landmark."""

Array = np.ndarray

TIPS = ("head", "left_hand", "right_hand", "left_foot", "right_foot")
"""The five ends of a body."""
CANDIDATES = 8
"""Ends to choose the five from."""
SIDED = ([0, 1, 2, 3, 4], [0, 2, 1, 4, 3], [0, 2, 1, 3, 4], [0, 1, 2, 4, 3])
"""Orders of `TIPS` when left and right of nothing, all, hands or feet change places."""


@dataclass(frozen=True)
class Walks:
    """Distances over the skin of one mesh."""

    tips: Int[Array, "5"]
    """Vertices at the ends of the body, in the order of `TIPS`."""
    far: Float[Array, "verts 5"]
    """From each vertex to each tip [m]; inf where no way leads there."""


def ends(
    verts: Float[Array, "verts 3"], faces: Int[Array, "faces 3"], count: int = CANDIDATES
) -> tuple[Int[Array, " ends"], Float[Array, "verts ends"]]:
    """Vertices far from each other, head, hands and feet among them, and all distances to them [m].

    The belly is often farther from all hands and feet than the head is, hence more than five.
    """
    from scipy.sparse.csgraph import connected_components, dijkstra

    graph = _graph(verts, faces)
    _, label = connected_components(graph, directed=False)
    start = int(np.argmax(label == np.bincount(label).argmax()))  # of the largest component

    def walk(source: int) -> Float[Array, " verts"]:
        return dijkstra(graph, directed=False, indices=source)

    def farthest(far: list[Float[Array, " verts"]]) -> int:
        nearest = np.min(far, axis=0)
        return int(np.argmax(np.where(np.isfinite(nearest), nearest, -1)))

    tips = [farthest([walk(farthest([walk(start)]))])]
    far = [walk(tips[0])]
    while len(tips) < count:
        tips.append(farthest(far))
        far.append(walk(tips[-1]))
    return np.array(tips), np.stack(far, axis=1)


def match_ends(
    verts: Float[Array, "verts 3"], faces: Int[Array, "faces 3"], known: Float[Array, "5 5"]
) -> tuple[Walks, float, float]:
    """Find head, hands and feet by the distances between them in a known body.

    Left and right may be exchanged: distances are the same.

    Returns:
        The walks, the size relative to the known body, and the root mean square of the mismatch of
        the distances between ends relative to their mean.
    """
    tips, far = ends(verts, faces)
    orders = np.array(list(itertools.permutations(range(len(tips)), len(TIPS))))
    here = far[tips][orders[:, :, None], orders[:, None, :]]
    size = ((here * known).sum((1, 2)) / np.square(known).sum()).clip(min=1e-9)
    wrong = np.sqrt(np.square(here / size[:, None, None] - known).mean((1, 2))) / known.mean()
    best = int(np.argmin(wrong))
    order = orders[best]
    return Walks(tips[order], far[:, order]), float(size[best]), float(wrong[best])


def _graph(verts: Float[Array, "verts 3"], faces: Int[Array, "faces 3"]) -> Any:  # noqa: ANN401
    """Sparse matrix of straight distances to neighbours and to their neighbours.

    Vertices at one place (seams) count as one: a tiny step joins them.
    """
    from scipy import sparse

    _, first, same = np.unique(np.round(verts, 7), axis=0, return_index=True, return_inverse=True)
    twin = first[same.ravel()]
    seam = np.nonzero(twin != np.arange(len(verts)))[0]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([twin[ends], np.stack([seam, twin[seam]], axis=1)])
    size = (len(verts), len(verts))
    once = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=size).tocsr()
    once = once + once.T
    pairs = (once + once @ once).tocoo()
    keep = pairs.row < pairs.col
    row, col = pairs.row[keep], pairs.col[keep]
    length = np.maximum(np.linalg.norm(verts[row] - verts[col], axis=1), 1e-9)
    return sparse.coo_matrix((length, (row, col)), shape=size).tocsr()


# The limbs of a body as frames: where each starts and how it is turned against the T-pose.


LIMBS = (
    "trunk", "head",
    *(f"{s}_{n}" for s in SIDES
      for n in ("thigh", "shin", "foot", "upper_arm", "forearm", "hand")),
)  # fmt: skip

CHAIN = {
    "thigh": ("trunk", "hip", "knee"),
    "shin": ("thigh", "knee", "ankle"),
    "foot": ("shin", "ankle", "foot"),
    "upper_arm": ("trunk", "shoulder", "elbow"),
    "forearm": ("upper_arm", "elbow", "wrist"),
    "hand": ("forearm", "wrist", "hand"),
}
"""Limb: (the limb it hangs at, where it starts, where it ends)."""

BENDS = (
    ("shin", "foot", 1.0),
    ("thigh", "shin", -1.0),
    ("upper_arm", "forearm", 0.5),
    ("trunk", "thigh", 0.3),
)
"""A limb, the one that hangs at it, and how surely the second points to the front of the first."""

OWNER = {"hip": "thigh", "knee": "shin", "ankle": "foot", "foot": "foot",
         "shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand",
         **{f"{f}{k}": "hand" for f in FINGERS for k in (1, 2, 3)}}  # fmt: skip


def landmark_rings(model: SkinnedBody) -> Float[Array, "verts landmarks"]:
    """1 where the skin of a landmark blends with the skin above it."""
    weight = dict(zip(model.joint_names, model.weights.T.numpy(), strict=True))
    rings: list[Array] = []
    for name in LANDMARKS:
        side, _, joint = name.rpartition("_")
        above = [f"{side}_{n}" if f"{side}_{n}" in weight else n for n in ABOVE[joint]]
        rings.append(sum(weight[n] for n in above) * weight[name] > 0.12)
    return np.stack(rings, axis=1).astype(float)


def thin(
    mesh: Float[Array, "verts 3"], rings: Float[Array, "verts landmarks"], members: int = 24
) -> Int[Array, "landmarks members"]:
    """So many vertices of each ring, far from each other, so that their mean is its middle."""
    rows: list[Array] = []
    for ring in (rings > 0).T:
        index = np.nonzero(ring)[0] if ring.any() else np.arange(len(mesh))
        points = mesh[index]
        far = np.linalg.norm(points - points.mean(0), axis=1)
        chosen: list[int] = []
        for _ in range(members):
            chosen.append(int(far.argmax()))
            far = np.minimum(far, np.linalg.norm(points - points[chosen[-1]], axis=1))
        rows.append(index[chosen])
    return np.stack(rows)


def limb_of(model: SkinnedBody) -> Int[Array, " verts"]:
    """Index into `LIMBS` for each vertex, by its largest weight."""
    table: list[int] = []
    for name in model.joint_names:
        side, _, joint = name.partition("_")
        if side in SIDES and joint in OWNER:
            table.append(LIMBS.index(f"{side}_{OWNER[joint]}"))
        else:
            high = name in ("neck", "head", "jaw") or "eye" in name
            table.append(LIMBS.index("head" if high else "trunk"))
    return np.array(table)[model.weights.argmax(1).numpy()]


def limb_frames(
    at: dict[str, Float[Array, "3"]], tips: Float[Array, "5 3"]
) -> dict[str, tuple[Float[Array, "3 3"], Float[Array, "3"]]]:
    """Rotation (columns left, up, front) and start [m] of each limb.

    A limb is turned from the one it hangs at by the least angle that gives its direction.
    """
    hips = (at["left_hip"] + at["right_hip"]) / 2
    across = at["left_hip"] - at["right_hip"] + at["left_shoulder"] - at["right_shoulder"]
    up = _unit(at["neck"] - hips)
    left = _unit(across - up * (up @ across))
    trunk = np.stack([left, up, np.cross(left, up)], axis=1)
    frames = {"trunk": (trunk, hips)}
    ends = {**at, **{str(name): tip for name, tip in zip(TIPS, tips, strict=True)}}
    head = _unit(ends["head"] - at["neck"])
    frames["head"] = (_shortest(trunk[:, 1], head) @ trunk, at["neck"])
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        arm, leg = np.array([sign, 0, 0]), np.array([0.0, -1, 0])
        rest = {"upper_arm": arm, "forearm": arm, "hand": arm, "thigh": leg, "shin": leg}
        for limb, (parent, start, stop) in CHAIN.items():
            above = frames[parent if parent == "trunk" else f"{side}_{parent}"][0]
            first = at[f"{side}_{start}"]
            last = ends[f"{side}_{stop}"]
            usual = above @ rest.get(limb, np.array([0.0, -0.35, 0.94]))
            frames[f"{side}_{limb}"] = (_shortest(usual, _unit(last - first)) @ above, first)
    return frames


def naturalness(at: dict[str, Float[Array, "3"]], tips: Float[Array, "5 3"]) -> float:
    """How far limbs bend the way they can: toes, knees, elbows, hips; and no twist of the trunk.

    About 4 for a person whose left is left, about -4 if left and right are exchanged.
    """
    frames = limb_frames(at, tips)
    ends = {**at, **{str(name): tip for name, tip in zip(TIPS, tips, strict=True)}}
    hips = _unit(at["left_hip"] - at["right_hip"])
    total = float(hips @ _unit(at["left_shoulder"] - at["right_shoulder"]))
    for side in SIDES:
        for above, limb, gain in BENDS:
            first, last = (ends[f"{side}_{n}"] for n in CHAIN[limb][1:])
            front = frames["trunk" if above == "trunk" else f"{side}_{above}"][0][:, 2]
            total += gain * float(front @ _unit(last - first))
    return total


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _shortest(start: Float[Array, "3"], end: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation by the least angle that turns one unit vector into another."""
    x, y, z = np.cross(start, end)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / max(1 + float(start @ end), 1e-6)
