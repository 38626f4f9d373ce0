"""Launches the Warp kernels on a CPU: a thread draws one item at a time, in memory of its own.

A launch is a plain loop that lets go of Python's lock, so that threads run side by side. They
share nothing: the result does not depend on their number.
"""

from collections.abc import Callable
from itertools import accumulate
from threading import local
from typing import Any

import torch
from torch import Tensor

from mover.geometry.kernels.start import kernels, share, started
from mover.geometry.raster.records import Asked, Gradients, Items, Maps, Trace
from mover.geometry.raster.warp_pack import (
    Workspace,
    blank,
    box_of,
    desk_of,
    pack_maps,
    pack_pull,
    pack_scene,
    room_of,
)

KEPT = 1 << 22  # pixels up to which a thread keeps its working memory (32 bytes each)
_own = local()


def look(items: Items, asked: Asked) -> tuple[Maps, Trace]:
    """Silhouettes and depths of all items."""
    maps, seen = blank(items, asked)
    cuts = [maps.image.new_zeros(0, 5, dtype=torch.int32)] * len(items.verts)

    def keep(item: int, desk: Workspace) -> None:
        found = slice(int(desk.count[1]) if asked.silhouette else 0)
        cuts[item] = torch.cat([desk.cuts[found], desk.targets[found, None]], 1)

    _draw("look_item", items, pack_maps(maps, *seen), keep)
    starts = torch.tensor([0, *accumulate(len(c) for c in cuts)], dtype=torch.int32)
    table = torch.cat(cuts)
    trace = Trace(*seen, table[:, :4].contiguous(), table[:, 4].contiguous(), starts)
    return maps, trace


def pull(items: Items, maps: Maps, trace: Trace, grads: Gradients) -> Tensor:
    """Gradients of the vertices of all items."""
    kernel = kernels("items", "cpu").pull_item
    verts = torch.zeros_like(items.verts)
    inputs = [pack_scene(items), pack_maps(maps, trace.near_face, trace.far_face, trace.box)]
    inputs.append(pack_pull(trace, grads, verts))
    launch = started().launch
    share(lambda item: launch(kernel, 1, [*inputs, item], device="cpu"), len(verts))
    return verts


def first_hit(items: Items, depth: Tensor, face: Tensor) -> None:
    """Write the nearest surface and its face where there is one."""
    none = items.verts.new_zeros(0)
    _draw(
        "hit_item",
        items,
        pack_maps(Maps(none, depth, none, none.bool()), face, face, box_of(items)),
    )


def _draw(
    name: str,
    items: Items,
    maps: Any,  # noqa: ANN401
    keep: Callable[[int, Workspace], None] = lambda *_: None,
) -> None:
    """Launch a kernel for each item, and let `keep` take what it left on the desk."""
    kernel = getattr(kernels("items", "cpu"), name)
    launch, scene, room = started().launch, pack_scene(items), room_of(items)

    def one(item: int) -> None:
        desk = _desk(room)
        launch(kernel, 1, [scene, desk.scratch, maps, item], device="cpu")
        keep(item, desk)

    share(one, len(items.verts))


def _desk(room: tuple[int, int, int, int]) -> Workspace:
    """Working memory of this thread."""
    desk: Workspace | None = getattr(_own, "desk", None)
    if desk is None or not desk.fits(room):
        desk = desk_of(room, 2 * room[3], torch.device("cpu"))
        _own.desk = desk if room[3] <= KEPT else None
    return desk
