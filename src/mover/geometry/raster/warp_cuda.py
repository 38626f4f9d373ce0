"""Launches the Warp kernels with a thread for each vertex, triangle, edge or pixel: for GPUs.

The same kernels run on a CPU, one thread after the other, where the tests hold them against the
others. Their speed on a GPU has not been measured.
"""

from typing import Any

import torch
from torch import Tensor

from mover.geometry.kernels.start import kernels, launch, name_of
from mover.geometry.raster.records import Asked, Gradients, Items, Maps, Trace
from mover.geometry.raster.warp_pack import (
    Workspace,
    blank,
    box_of,
    desk_of,
    pack_cuts,
    pack_maps,
    pack_pull,
    pack_scene,
)

LANES = 1 << 16  # threads that share the triangles of many rows
NOWHERE, NEAR, FAR = 0, 1, 2  # what is done with backs, as in `kernels.items`


def look(items: Items, asked: Asked) -> tuple[Maps, Trace]:
    """Silhouettes and depths of all items."""
    maps, seen = blank(items, asked)
    scene, packed, desk = pack_scene(items), pack_maps(maps, *seen), _desk(items)
    n, edges = len(items.verts), items.edges.shape[1]
    _draw(items, scene, desk, FAR if asked.depth else NOWHERE)
    if asked.silhouette:
        _launch(items, "enter_cuts", (n, edges), scene, desk.scratch)
    _launch(items, "show", (n, items.height, items.width), scene, desk.scratch, packed)
    cuts = 2 * n * items.grid if asked.silhouette else 0  # as many as pairs: nobody waits for less
    table, targets = pack_cuts(desk, cuts)
    if cuts:
        _launch(items, "keep_cuts", (n, edges), scene, desk.scratch, packed)
        _launch(items, "mark_cuts", cuts, desk.scratch, packed)
        _launch(items, "bound_cuts", cuts, desk.scratch, packed)
    return maps, Trace(*seen, table, targets, desk.count)


def pull(items: Items, maps: Maps, trace: Trace, grads: Gradients) -> Tensor:
    """Gradients of the vertices of all items."""
    verts = torch.zeros_like(items.verts)
    scene, given = pack_scene(items), pack_pull(trace, grads, verts)
    packed = pack_maps(maps, trace.near_face, trace.far_face, trace.box)
    if grads.image is not None:
        _launch(items, "pull_cuts", len(trace.cuts), scene, given)
    if grads.nearest is not None or grads.farthest is not None:
        _launch(items, "pull_pixels", maps.nearest.numel(), scene, packed, given)
    return verts


def first_hit(items: Items, depth: Tensor, face: Tensor) -> None:
    """Write the nearest surface and its face where there is one."""
    none = items.verts.new_zeros(0)
    packed = pack_maps(Maps(none, depth, none, none.bool()), face, face, box_of(items))
    scene, desk = pack_scene(items), _desk(items)
    _draw(items, scene, desk, NEAR)
    _launch(items, "show_hits", depth.numel(), desk.scratch, packed)


def _desk(items: Items) -> Workspace:
    """Working memory of all items together; that of the cuts is added when these are listed."""
    n, verts, _ = items.verts.shape
    room = (n * verts, n * items.faces.shape[1], n * items.edges.shape[1], n * items.grid)
    return desk_of(room, 0, items.verts.device)


def _draw(items: Items, scene: Any, desk: Workspace, backs: int) -> None:  # noqa: ANN401
    """Fill the z-buffers."""
    n, verts, _ = items.verts.shape
    _launch(items, "project", n * verts, scene, desk.scratch)
    _launch(items, "draw", (n, items.faces.shape[1]), scene, desk.scratch, backs)
    _launch(items, "draw_tall", LANES, scene, desk.scratch, backs, LANES)


def _launch(items: Items, name: str, dim: int | tuple[int, ...], *inputs: Any) -> None:  # noqa: ANN401
    """Launch a kernel on the device of the items, in the stream that torch uses there."""
    where = items.verts.device
    launch(getattr(kernels("grid", name_of(where)), name), dim, list(inputs), where)
