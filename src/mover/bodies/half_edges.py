"""Neighbours of mesh vertices in the order of a half-edge library, and spirals about them.

Networks on meshes learn weights for "the third neighbour", so the order is part of their format.
Written from a description of the order in which OpenMesh links half-edges; no code is copied.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

NONE = -1


@dataclass
class HalfEdges:
    """Half-edges 2e and 2e + 1 are opposite; those without a face lie on the boundary."""

    out: list[int]
    """An outgoing half-edge of each vertex, on the boundary where there is one; -1: isolated."""
    to: list[int] = field(default_factory=lambda: [])
    after: list[int] = field(default_factory=lambda: [])
    before: list[int] = field(default_factory=lambda: [])
    closed: list[bool] = field(default_factory=lambda: [])
    """Whether the half-edge has a face."""
    named: dict[tuple[int, int], int] = field(default_factory=lambda: {})

    def around(self, vertex: int) -> list[int]:
        """Neighbours of a vertex, clockwise from its stored half-edge."""
        first = self.out[vertex]
        found: list[int] = []
        half = first
        while half != NONE:
            found.append(self.to[half])
            half = self.after[half ^ 1]
            if half == first:
                break
        return found


def half_edges(faces: Int[np.ndarray, "faces 3"], count: int) -> tuple[HalfEdges, int]:
    """Insert triangles in order; the mesh, and how many did not fit and were left out."""
    mesh = HalfEdges([NONE] * count)
    left_out = sum(not _insert(mesh, tuple(row)) for row in faces.tolist())
    return mesh, left_out


def _insert(mesh: HalfEdges, corners: tuple[int, ...]) -> bool:
    """Add one triangle unless it would make the surface branch."""
    if any(mesh.out[v] != NONE and mesh.closed[mesh.out[v]] for v in corners):
        return False
    sides = [(corners[k], corners[(k + 1) % 3]) for k in range(3)]
    halves = [mesh.named.get(side, NONE) for side in sides]
    if any(h != NONE and mesh.closed[h] for h in halves):
        return False
    new = [h == NONE for h in halves]
    links = _patches(mesh, halves)
    if links is None:
        return False
    halves = [_named(mesh, side) for side in sides]
    turned: list[int] = []
    for k in range(3):
        links += _corner(mesh, (halves[k], halves[(k + 1) % 3]), (new[k], new[(k + 1) % 3]), turned)
        mesh.closed[halves[k]] = True
    for a, b in links:
        mesh.after[a], mesh.before[b] = b, a
    for vertex in turned:
        _to_boundary(mesh, vertex)
    return True


def _patches(mesh: HalfEdges, halves: list[int]) -> list[tuple[int, int]] | None:
    """Links that move what lies between two old sides into another gap; None: there is none."""
    links: list[tuple[int, int]] = []
    for k in range(3):
        into, out = halves[k], halves[(k + 1) % 3]
        if NONE in (into, out) or mesh.after[into] == out:
            continue
        gap = mesh.after[out ^ 1] ^ 1
        while mesh.closed[gap]:
            gap = mesh.after[gap] ^ 1
        if gap == into:
            return None
        links += [(gap, mesh.after[into]), (mesh.before[out], mesh.after[gap]), (into, out)]
    return links


def _named(mesh: HalfEdges, side: tuple[int, int]) -> int:
    """The half-edge from one vertex to another, made with its opposite if it is not there."""
    if side not in mesh.named:
        half = len(mesh.to)
        mesh.to += [side[1], side[0]]
        mesh.after += [NONE, NONE]
        mesh.before += [NONE, NONE]
        mesh.closed += [False, False]
        mesh.named |= {side: half, (side[1], side[0]): half + 1}
    return mesh.named[side]


def _corner(
    mesh: HalfEdges, halves: tuple[int, int], new: tuple[bool, bool], turned: list[int]
) -> list[tuple[int, int]]:
    """Links around one corner; its vertex may change its stored half-edge."""
    into, out = halves
    vertex = mesh.to[into]
    outer_in, outer_out = out ^ 1, into ^ 1
    match new:
        case (False, False):
            if mesh.out[vertex] == out:
                turned.append(vertex)
            return []
        case (True, False):
            links = [(mesh.before[out], outer_out)]
            mesh.out[vertex] = outer_out
        case (False, True):
            links = [(outer_in, mesh.after[into])]
            mesh.out[vertex] = mesh.after[into]
        case _ if mesh.out[vertex] == NONE:
            links = [(outer_in, outer_out)]
            mesh.out[vertex] = outer_out
        case _:
            stored = mesh.out[vertex]
            links = [(mesh.before[stored], outer_out), (outer_in, stored)]
    return [*links, (into, out)]


def _to_boundary(mesh: HalfEdges, vertex: int) -> None:
    """Store the first outgoing half-edge without a face, if there is one."""
    first = half = mesh.out[vertex]
    while mesh.closed[half]:
        half = mesh.after[half ^ 1]
        if half == first:
            return
    mesh.out[vertex] = half


def spirals(
    verts: Float[np.ndarray, "verts 3"], faces: Int[np.ndarray, "faces 3"], length: int
) -> Int[np.ndarray, "verts length"]:
    """Each vertex, its ring of neighbours, the ring about that, and so on, cut at `length`.

    Where the rings end before that (or would, one ring on), the nearest vertices stand instead.
    """
    mesh, _ = half_edges(faces, len(verts))
    around = [mesh.around(v) for v in range(len(verts))]
    rows: list[list[int]] = []
    for vertex in range(len(verts)):  # spirals differ in the number of their rings
        row, ahead = [vertex, *around[vertex]], _next_ring(around, around[vertex], [vertex])
        while ahead and len(row) + len(ahead) < length:
            row = [*row, *ahead]
            ahead = _next_ring(around, ahead, row)
        row = [*row, *ahead] if ahead else _nearest(verts, vertex, length)
        rows.append(row[:length])
    return np.asarray(rows, dtype=np.int64)


def _next_ring(around: list[list[int]], last: list[int], row: list[int]) -> list[int]:
    """The ring outside of `last`: of each vertex first what follows a vertex of `last`."""
    inner, taken = set(last), {*last, *row}
    ring: list[int] = []
    for vertex in last:
        near = around[vertex]
        start = next((k for k, n in enumerate(near) if n in inner), len(near))
        for neighbour in [*near[start:], *near[:start]]:
            if neighbour not in taken:
                ring.append(neighbour)
                taken.add(neighbour)
    return ring


def _nearest(verts: Float[np.ndarray, "verts 3"], vertex: int, length: int) -> list[int]:
    distance = np.square(verts - verts[vertex]).sum(-1)
    return np.argsort(distance, kind="stable")[:length].tolist()
