"""The space that bodies have moved through: the union of bodies by Warp kernels, on CPU and CUDA.

A launch on the CPU is serial but leaves Python's lock, so bodies are measured in threads; on a GPU
one body keeps few of its threads busy, so bodies go into many streams. Each thread and each stream
has a volume of its own; the least of these is the result, whoever measured what.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import cycle
from queue import SimpleQueue
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.geometry.nearest import as_float64, as_int64
from mover.geometry.volume import Volume
from mover.geometry.warp_start import kernels, started

REACH = 2  # [cells], that the shell reaches out of the body
STREAMS = 32  # of a GPU
EIGHT = 8  # children of a node, and faces of a leaf: one instruction serves all of them


@dataclass(frozen=True)
class FaceTree:
    """A balanced tree over the triangles of a mesh; only its boxes follow the poses.

    Slot s is lane s % 8 of pack s // 8; the children of slot s are the pack s + `shift`.

    The first pack holds the nodes of the first level in its last lanes.
    """

    corners: np.ndarray
    """Of each leaf (leaves 4 8): lowest, second and highest vertex of its eight faces, and 1, or -1
    where that order turns a face over, or 0 where a face stands there a second time."""
    shift: int
    base: int
    """Slot of the first leaf."""
    levels: tuple[int, ...]
    """First pack of each level, and the number of packs."""

    def inner(self) -> list[tuple[int, int, int]]:
        """Levels above the leaves, from below: first pack of the children, first slot, nodes."""
        pairs = list(zip(self.levels[1:-1], self.levels[2:], strict=True))
        return [(first, first - self.shift, end - first) for first, end in reversed(pairs)]


def face_tree(verts: Tensor, faces: Int[Tensor, "faces 3"]) -> FaceTree:
    """Halve the triangles again and again across their longest side."""
    triangles = as_int64(faces)
    halvings = max(0, int(np.ceil(np.log2(len(triangles) / EIGHT))))
    top = 1 << ((halvings - 1) % 3 + 1) if halvings else 1
    order = _order(as_float64(verts)[triangles].mean(1), halvings)
    packs, nodes = [0, 1], top
    while nodes < 1 << halvings:
        packs.append(packs[-1] + nodes)
        nodes *= EIGHT
    base = EIGHT * packs[-2] if len(packs) > 2 else EIGHT - top
    return FaceTree(_corners(triangles[order], halvings), top - EIGHT + 1, base, tuple(packs))


def _corners(triangles: np.ndarray, halvings: int) -> np.ndarray:
    """See `FaceTree.corners`."""
    first = np.arange((1 << halvings) + 1) * len(triangles) // (1 << halvings)
    lane = np.arange(EIGHT)
    count = np.diff(first)[:, None]
    picked = triangles[first[:-1, None] + np.minimum(lane, count - 1)]
    rank = picked.argsort(-1, kind="stable")
    turned = (rank[..., 1] - rank[..., 0]) % 3 == 1
    side = np.where(turned, 1, -1) * (lane < count)
    ordered = np.take_along_axis(picked, rank, -1)
    return np.concatenate([ordered, side[..., None]], -1).swapaxes(1, 2).astype(np.int32)


def _order(center: np.ndarray, halvings: int) -> np.ndarray:
    """Indices such that each half, quarter, ... of them is a compact group."""
    count = len(center)
    order = np.arange(count)
    for level in range(halvings):
        groups = 1 << level
        first = np.arange(groups + 1) * count // groups
        group = np.repeat(np.arange(groups), np.diff(first))
        starts, held = np.minimum(first[:-1], count - 1), center[order]
        low, size = np.minimum.reduceat(held, starts), np.maximum.reduceat(held, starts)
        with np.errstate(invalid="ignore"):  # bodies that are not finite are refused elsewhere
            size = size - low
            axis = size.argmax(-1)
            off = held[np.arange(count), axis[group]] - low[group, axis[group]]
            share = off / np.maximum(size.max(-1), 1e-30)[group]  # in its group, 0 to 1
        order = order[np.argsort(group + 0.999 * share)]
    return order


@dataclass(frozen=True)
class Tools:
    """What the bodies of one union share."""

    tree: FaceTree
    faces: np.ndarray
    """Triangles, as they were given."""
    verts: Tensor
    """Bodies in the world [m], float32."""
    grid: Volume
    device: str


@dataclass
class Scratch:
    """What one worker writes to."""

    work: Any
    """`bodies.Work`."""
    field: Tensor
    """The volume of the bodies that this worker measured."""
    places: int = 0
    blocks: int = 0
    stacks: int = 0


def union_bodies(
    verts: Float[Tensor, "bodies verts 3"],
    faces: Int[Tensor, "faces 3"],
    grid: Volume,
    workers: int = 2,
    observe: Callable[[int, int], None] | None = None,
) -> Volume:
    """V = min over the bodies, and what `grid` holds, of the signed distance to each [m].

    Exact inside the bodies and up to two cells outside; further away as in `grid`. The result
    does not depend on the number of workers, and memory not on that of bodies.

    Args:
        verts: Closed bodies in the world [m].
        faces: Their triangles, one orientation, outward or inward.
        grid: Where to measure; `grid_around` makes an empty one.
        workers: Bodies measured at the same time.
        observe: Called with (bodies done, bodies) after each body.

    Raises:
        ValueError: If a vertex is not finite.
    """
    if len(verts) == 0 or len(faces) == 0:
        return grid
    tools = _tools(verts.detach().float().contiguous(), faces, grid)
    own = tools.device == "cpu"
    every = [_scratch(tools) for _ in range(max(1, min(workers if own else STREAMS, len(verts))))]
    for scratch, other in zip(every, every[1:] + every[:1], strict=True):
        scratch.work.other = other.work.field
    for done, _ in enumerate((_in_threads if own else _in_streams)(tools, every), 1):
        if observe is not None:
            observe(done, len(verts))
    values = every[0].field
    for scratch in every[1:]:
        torch.minimum(values, scratch.field, out=values)
    return replace(grid, values=values.to(grid.values))


def _in_threads(tools: Tools, every: list[Scratch]) -> Iterator[None]:
    """All bodies, as many at a time as there are workers."""
    idle: SimpleQueue[Scratch] = SimpleQueue()
    for scratch in every:
        idle.put(scratch)

    def add(body: int) -> None:
        scratch = idle.get()
        try:
            add_body(tools, scratch, body, _ends(tools, slice(body, body + 1))[0])
        finally:
            idle.put(scratch)

    with ThreadPoolExecutor(len(every)) as pool:
        yield from pool.map(add, _spread(len(tools.verts)))


def _in_streams(tools: Tools, every: list[Scratch]) -> Iterator[None]:
    """All bodies, handed to a GPU without waiting for any."""
    wp, ends = started(), _ends(tools, slice(None))
    streams = [wp.Stream(tools.device) for _ in every]
    most = np.nan_to_num((ends[:, 1] - ends[:, 0]).max(0)) + 2 * REACH + 2  # cells of a body's box
    widest = np.minimum(np.ceil(most), every[0].field.shape).astype(np.int64)
    for scratch in every:
        _make_room(tools, scratch, widest)  # nothing is freed while a stream may use it
    wp.synchronize_device(tools.device)
    turns = cycle(zip(every, streams, strict=True))
    try:
        for body, (scratch, stream) in zip(_spread(len(ends)), turns, strict=False):
            with wp.ScopedStream(stream, sync_enter=False):
                add_body(tools, scratch, body, ends[body])
            yield
    finally:
        wp.synchronize_device(tools.device)


def _spread(count: int) -> list[int]:
    """All bodies, at first from far apart: what these fill, the others need not measure again."""
    return [body for first in (0, 8, 4, 12, 2, 10, 6, 14) for body in range(first, count, 16)] + [
        *range(1, count, 2)
    ]


def _tools(verts: Tensor, faces: Tensor, grid: Volume) -> Tools:
    device = str(started().device_from_torch(verts.device))
    for name in ("bodies", "lower"):
        kernels(name, device)  # before there are threads
    return Tools(face_tree(verts[0], faces), as_int64(faces).astype(np.int32), verts, grid, device)


def _scratch(tools: Tools) -> Scratch:
    import warp as wp

    from mover.geometry.kernels.bodies import Pair, Work

    field, tree = tools.grid.values.detach().float().clone().contiguous(), tools.tree

    work = Work()
    work.origin = wp.vec3d(*tools.grid.origin.double().tolist())
    work.cell = tools.grid.cell
    work.tree = _tree(tree, tools.device)
    work.faces = wp.array(tools.faces, dtype=wp.vec3i, device=tools.device)
    work.lines = _blank(tools.verts.shape[1], Pair, tools.device)
    work.at = _blank(tools.verts.shape[1], wp.vec3, tools.device)
    work.place = _blank(tools.verts.shape[1], wp.vec3d, tools.device)
    work.turn = _blank(1, wp.float64, tools.device)
    work.beside = int(tools.device == "cpu")  # where columns are measured one after another
    work.field = wp.from_torch(field)
    work.other = work.field  # until there is another
    work.eight = 8  # places of a block; a number here keeps the loops over them short
    return Scratch(work, field)


def _tree(shape: FaceTree, device: str) -> Any:  # noqa: ANN401
    import warp as wp

    from mover.geometry.kernels.bodies import Tree

    tree, packs = Tree(), shape.levels[-1]
    tree.shift, tree.base, tree.longest = shape.shift, shape.base, EIGHT * (len(shape.levels) + 1)
    tree.corners = wp.array(shape.corners.ravel(), dtype=wp.int32, device=device)
    empty = np.repeat(np.array([1e30, -1e30], np.float32), 3 * EIGHT)
    tree.boxes = wp.array(np.tile(empty, packs), dtype=wp.float32, device=device)
    tree.shapes = _blank(17 * EIGHT * len(shape.corners), wp.float32, device)
    tree.slabs = _blank(EIGHT * len(shape.corners), wp.float32, device)
    return tree


def _ends(tools: Tools, some: slice) -> Float[np.ndarray, "bodies 2 3"]:
    """Lowest and highest corner of the box about each body [cells]."""
    verts = tools.verts[some]
    box = torch.stack([torch.stack(verts[..., k].aminmax(dim=-1), -1) for k in range(3)], -1)
    return ((box.double().cpu() - tools.grid.origin.double().cpu()) / tools.grid.cell).numpy()


def add_body(tools: Tools, scratch: Scratch, body: int, ends: Float[np.ndarray, "2 3"]) -> None:
    """Lower the worker's volume to the signed distance of one body [m].

    Args:
        tools: What the bodies share.
        scratch: The worker's.
        body: Which one.
        ends: Corners of the box about it [cells].

    Raises:
        ValueError: If a vertex is not finite.
    """
    import warp as wp

    from mover.geometry.kernels import bodies, lower

    if not np.isfinite(ends).all():
        raise ValueError(f"union_bodies: body {body} has vertices that are not finite")
    low = np.maximum(np.floor(ends[0]) - REACH, 0)
    high = np.minimum(np.ceil(ends[1]) + REACH, np.array(scratch.field.shape) - 1)
    if (high < low).any():
        return
    low, shape = low.astype(np.int64), (high - low + 1).astype(np.int64)
    work = _cleared(tools, scratch, shape)
    work.low, work.size = wp.vec3i(*low.tolist()), wp.vec3i(*shape.tolist())
    work.world = wp.from_torch(tools.verts[body], dtype=wp.vec3)

    def launch(kernel: Any, dim: int, *rest: int) -> None:  # noqa: ANN401
        wp.launch(kernel, dim, [work, *rest], device=tools.device)

    launch(bodies.place, tools.verts.shape[1])
    launch(bodies.leaves, len(tools.tree.corners))
    for pack, first, count in tools.tree.inner():
        launch(bodies.inner, count, pack, first)
    launch(bodies.cross, work.faces.shape[0])
    launch(lower.blocks, _columns(shape))


def _columns(shape: np.ndarray) -> int:
    """Columns of blocks of two by two places in a box."""
    return int((shape[0] + 1) // 2 * ((shape[2] + 1) // 2))


def _cleared(tools: Tools, scratch: Scratch, shape: np.ndarray) -> Any:  # noqa: ANN401
    """The scratch arrays, cleared, with room for a box."""
    work, (places, blocks) = scratch.work, _make_room(tools, scratch, shape)
    work.turn.zero_()
    work.steps[:places].zero_()
    work.near[:blocks].zero_()
    work.crossed[: _columns(shape)].zero_()
    return work


def _make_room(tools: Tools, scratch: Scratch, shape: np.ndarray) -> tuple[int, int]:
    """Enlarge the scratch arrays for a box, if need be; its places and blocks."""
    import warp as wp

    work = scratch.work
    places = int(shape[0] * shape[2] * (shape[1] + 1))
    blocks = int(((shape + 1) // 2).prod())
    if places > scratch.places:
        scratch.places = places * 5 // 4
        work.steps = _blank(scratch.places, wp.int32, tools.device)
    if blocks > scratch.blocks:
        scratch.blocks = blocks * 5 // 4
        work.near = _blank(scratch.blocks, wp.uint8, tools.device)
        work.owner = _blank(scratch.blocks, wp.int32, tools.device)
        work.crossed = _blank(scratch.blocks, wp.uint8, tools.device)
    stacks = 1 if work.beside else _columns(shape)
    if stacks > scratch.stacks:
        scratch.stacks = stacks
        work.tree.stack = _blank(stacks * work.tree.longest, wp.int32, tools.device)
    return places, blocks


def _blank(size: int, dtype: Any, device: str) -> Any:  # noqa: ANN401
    import warp as wp

    return wp.empty(size, dtype=dtype, device=device)
