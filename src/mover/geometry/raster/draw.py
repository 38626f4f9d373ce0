"""Launches the kernels of the rasteriser on a CPU or an NVIDIA GPU.

On a CPU a launch is a plain loop that lets go of Python's lock. A thread draws a few items at a
time, one after the other in the same working memory, and threads share nothing: the result does not
depend on their number. On a GPU there is a thread for each vertex, triangle, edge and pixel; the
same kernels run on a CPU, where tests hold them against the others. Their speed on a GPU has not
been measured.
"""

from collections.abc import Sequence
from threading import local
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mover.geometry.kernels.start import (
    filled,
    kernels,
    launch,
    name_of,
    share,
    started,
    threads,
)
from mover.geometry.raster.records import Asked, Cuts, Gradients, Items, Maps, Trace

NOWHERE, FRONT, BEHIND = 0, 1, 2  # where backs are drawn, as in `kernels.grid`
GROUPS = 3  # of items for each thread of a CPU, so that none waits long for the last
KEPT = 1 << 22  # pixels up to which a thread of a CPU keeps its working memory (72 bytes each)
_own = local()


def look(items: Items, asked: Asked) -> tuple[Maps, Trace]:
    """Silhouettes and depths of all items."""
    like, size = items.verts, (len(items.verts), items.height, items.width)
    image, nearest, farthest = (
        like.new_zeros(size if wanted else 0)
        for wanted in (asked.silhouette, asked.depth, asked.depth)
    )
    maps = Maps(image, nearest, farthest, torch.zeros_like(nearest, dtype=torch.bool))
    near, far = (torch.empty_like(nearest, dtype=torch.int32) for _ in range(2))
    cuts = _draw(items, _maps(maps, near, far), BEHIND if asked.depth else NOWHERE)
    return maps, Trace(near, far, cuts)


def first_hit(items: Items, depth: Tensor, face: Tensor) -> None:
    """Write the nearest surface and its face where there is one."""
    none = items.verts.new_zeros(0)
    _draw(items, _maps(Maps(none, depth, none, none.bool()), face, face), FRONT)


def pull(items: Items, maps: Maps, trace: Trace, grads: Gradients) -> Tensor:
    """Gradients of the vertices of all items."""
    verts, scene = torch.zeros_like(items.verts), _scene(items)
    packed = _maps(maps, trace.near_face, trace.far_face)
    known = {name: value.view(-1) for name, value in vars(grads).items() if value is not None}
    known |= {f"has_{name}": name in known for name in vars(grads)}

    def pull_group(k: int) -> None:
        cuts, flat = trace.cuts[k], verts.view(-1, 3)
        given = _packed("Pull", cuts=cuts.table, targets=cuts.targets, verts=flat, **known)
        if _in_loops(items):
            ends = cuts.group.start, cuts.group.stop
            _launch(items, "items.pull_items", 1, scene, packed, given, *ends)
            return
        if given.has_image:
            _launch(items, "grid.pull_cuts", len(cuts.targets), scene, given)
        if given.has_nearest or given.has_farthest:
            _launch(items, "grid.pull_pixels", maps.nearest.numel(), scene, packed, given)

    share(pull_group, len(trace.cuts))
    return verts


def _draw(items: Items, maps: Any, backs: int) -> tuple[Cuts, ...]:  # noqa: ANN401
    """Fill the maps; the cuts of the outlines, by groups of items."""
    scene, count = _scene(items), len(items.verts)
    if not _in_loops(items):
        return (_draw_at_once(items, scene, maps, backs),)
    size = max(1, count // (GROUPS * threads()))
    groups = [range(k, min(k + size, count)) for k in range(0, count, size)]
    found: dict[int, Cuts] = {}

    def draw_group(k: int) -> None:
        scratch = _own_scratch(items, len(groups[k]) if maps.silhouette else 0)
        ends = groups[k].start, groups[k].stop
        _launch(items, "items.look_items", 1, scene, scratch, maps, backs, *ends)
        number = int(started().to_torch(scratch.count)[1])
        table, targets = (x[:number].clone() for x in _listed(scratch))
        found[k] = Cuts(groups[k], table, targets)

    share(draw_group, len(groups))
    return tuple(found[k] for k in range(len(groups)))


def _draw_at_once(items: Items, scene: Any, maps: Any, backs: int) -> Cuts:  # noqa: ANN401
    """The same with a thread for each vertex, triangle, edge and pixel."""
    from mover.geometry.kernels.grid import LANES

    n, (_, verts, _) = len(items.verts), items.verts.shape
    scratch = scratch_of(_room(items, n, n if maps.silhouette else 0), items.verts.device)
    table, targets = _listed(scratch)
    edges = (n, items.edges.shape[1])
    _launch(items, "grid.place_verts", (n, verts), scene, scratch)
    _launch(items, "grid.draw_faces", (n, items.faces.shape[1]), scene, scratch, backs)
    _launch(items, "grid.draw_rows", LANES, scene, scratch, backs)
    if maps.silhouette:
        _launch(items, "grid.enter_edges", edges, scene, scratch)
    _launch(items, "grid.show_pixels", (n, scene.height, scene.width), scene, scratch, maps)
    if maps.silhouette:
        _launch(items, "grid.keep_edges", edges, scene, scratch, maps)
        _launch(items, "grid.mark_cuts", len(targets), scratch, maps)
        _launch(items, "grid.bound_cuts", len(targets), scratch, maps)
    return Cuts(range(n), table, targets)


def _in_loops(items: Items) -> bool:
    """Whether a thread draws whole items."""
    return items.verts.device.type == "cpu"


def _own_scratch(items: Items, listed: int) -> Any:  # noqa: ANN401
    """The working memory of this thread, which kernels leave clean, for one item at a time."""
    room = _room(items, 1, listed)
    if any(have < need for have, need in zip(getattr(_own, "room", [0]), room, strict=False)):
        _own.room, _own.scratch = room, scratch_of(room, items.verts.device)
    scratch = _own.scratch
    if items.grid > KEPT:
        vars(_own).clear()
    started().to_torch(scratch.count).zero_()
    return scratch


def _room(items: Items, count: int, listed: int) -> list[int]:
    """What `scratch_of` asks for some items at a time, and the cuts of some one after the other."""
    verts, faces, edges = (x.shape[1] for x in (items.verts, items.faces, items.edges))
    return [*(count * n for n in (verts, faces, edges, items.grid)), 2 * listed * items.grid]


def _listed(scratch: Any) -> tuple[Tensor, Tensor]:  # noqa: ANN401
    """The memory of the cuts, and of the pixels that they move."""
    return started().to_torch(scratch.cuts), started().to_torch(scratch.targets)


def scratch_of(room: Sequence[int], device: torch.device) -> Any:  # noqa: ANN401
    """Working memory for so many vertices, faces, edges, pixels and cuts, zero where need be."""
    verts, faces, edges, pixels, cuts = room
    count = torch.zeros(2, dtype=torch.int32, device=device)
    return _packed(
        "Scratch",
        screen=torch.empty(verts, 3, device=device),
        front=torch.empty(faces, dtype=torch.int8, device=device),
        near=_zeros(pixels, device),
        far=_zeros(pixels, device),
        pairs=_zeros(2 * pixels, device),
        queue=count.new_empty(max(edges, faces)),
        cuts=count.new_empty(cuts, 4),
        targets=count.new_full((cuts,), -1),
        count=count,
    )


def _zeros(size: int, device: torch.device) -> Tensor:
    """Zeros that on a CPU take memory only where they are written."""
    if device.type == "cpu":
        return torch.from_numpy(np.zeros(size, dtype=np.int64))
    return torch.zeros(size, dtype=torch.int64, device=device)


def _scene(items: Items) -> Any:  # noqa: ANN401
    """All items as the kernels read them."""
    return _packed(
        "Scene",
        verts=items.verts.view(-1, 3),
        window=items.window,
        faces=items.faces.view(-1, 3),
        edges=items.edges.view(-1, 4),
        views=len(items.window),
        shapes=len(items.faces),
        n_verts=items.verts.shape[1],
        n_faces=items.faces.shape[1],
        n_edges=items.edges.shape[1],
        height=items.height + 2 * items.border,
        width=items.width + 2 * items.border,
        border=items.border,
    )


def _maps(maps: Maps, near_face: Tensor, far_face: Tensor) -> Any:  # noqa: ANN401
    """The maps and the faces that are seen in them."""
    faces = {"near_face": near_face.view(-1), "far_face": far_face.view(-1)}
    flat = {name: value.view(-1) for name, value in vars(maps).items()} | faces
    drawn, both = maps.image.numel() > 0, maps.covered.numel() > 0
    hits = not drawn and not both
    return _packed("Maps", **flat, silhouette=drawn, depth=both, hits=hits)


def _packed(name: str, **fields: Any) -> Any:  # noqa: ANN401
    """The struct of that name in `kernels.scene`, see `filled`."""
    from mover.geometry.kernels import scene

    return filled(getattr(scene, name), **fields)


def _launch(items: Items, name: str, dim: int | tuple[int, ...], *inputs: Any) -> None:  # noqa: ANN401
    """Launch a kernel, by its module and name, where the items are."""
    where, (module, kernel) = items.verts.device, name.split(".")
    launch(getattr(kernels(module, name_of(where)), kernel), dim, list(inputs), where)
