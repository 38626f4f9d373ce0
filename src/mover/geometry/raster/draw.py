"""Launches the kernels of the rasteriser on a CPU or an NVIDIA GPU.

On a CPU a launch is a plain loop that lets go of Python's lock. A thread draws a few items at a
time, one after the other in the same working memory, and threads share nothing: the result does not
depend on their number. On a GPU there is a thread for each vertex, triangle, edge and pixel; the
same kernels run on a CPU, where tests hold them against the others.
"""

from collections.abc import Sequence
from threading import local
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mover.geometry.raster.records import Crops, Cuts, Maps, Topology, Trace
from mover.geometry.warp_start import (
    filled,
    kernels,
    launch,
    mapped,
    name_of,
    share,
    started,
    threads,
)

BORDER = 1  # [px], so that an outline just outside the window still moves the window's pixels
NOWHERE, FRONT, BEHIND = 0, 1, 2  # where backs are drawn, as in `kernels.grid`
GROUPS = 3  # of items for each thread of a CPU, so that none waits long for the last
KEPT = 1 << 22  # pixels up to which a thread of a CPU keeps its working memory (72 bytes each)
_own = local()


def look(
    verts: Tensor, shape: Topology, views: Crops, silhouette: bool, depth: bool
) -> tuple[Maps, Trace]:
    """Silhouettes and depths, where they are asked for, of items in camera axes."""
    size = (len(verts), views.height, views.width)
    image, nearest, farthest = (
        verts.new_zeros(size if wanted else 0) for wanted in (silhouette, depth, depth)
    )
    maps = Maps(image, nearest, farthest, torch.zeros_like(nearest, dtype=torch.bool))
    near, far = (torch.empty_like(nearest, dtype=torch.int32) for _ in range(2))
    scene = _scene(verts, shape, views, BORDER)
    cuts = _draw(scene, _maps(maps, near, far), BEHIND if depth else NOWHERE, verts.device)
    return maps, Trace(scene, near, far, cuts)


def first_hit(verts: Tensor, shape: Topology, views: Crops, depth: Tensor, face: Tensor) -> None:
    """Write the nearest surface and its face where there is one."""
    none = verts.new_zeros(0)
    packed = _maps(Maps(none, depth, none, none.bool()), face, face)
    _draw(_scene(verts, shape, views, 0), packed, FRONT, verts.device)


def pull(maps: Maps, trace: Trace, grads: dict[str, Tensor | None], verts: Tensor) -> None:
    """Add the gradients of `image`, `nearest` and `farthest` to those of the vertices."""
    where, packed = verts.device, _maps(maps, trace.near_face, trace.far_face)
    known = {name: g.contiguous().view(-1) for name, g in grads.items() if g is not None}
    known |= {f"has_{name}": name in known for name in grads}

    def pull_group(k: int) -> None:
        cuts, flat = trace.cuts[k], verts.view(-1, 3)
        given = _packed("Pull", cuts=cuts.table, targets=cuts.targets, verts=flat, **known)
        if _in_loops(where):
            ends = cuts.group.start, cuts.group.stop
            _launch(where, "items.pull_items", 1, trace.scene, packed, given, *ends)
            return
        if given.has_image:
            _launch(where, "grid.pull_cuts", len(cuts.targets), trace.scene, given)
        if given.has_nearest or given.has_farthest:
            _launch(where, "grid.pull_pixels", maps.nearest.numel(), trace.scene, packed, given)

    share(pull_group, len(trace.cuts))


def _draw(scene: Any, maps: Any, backs: int, where: torch.device) -> tuple[Cuts, ...]:  # noqa: ANN401
    """Fill the maps; the cuts of the outlines, by groups of items."""
    count = len(scene.verts) // scene.n_verts
    if not _in_loops(where):
        return (_draw_at_once(scene, maps, backs, where),)
    size = max(4, count // (GROUPS * threads()))
    groups = [range(k, min(k + size, count)) for k in range(0, count, size)]

    def draw_group(group: range) -> Cuts:
        scratch = _own_scratch(scene, len(group) if maps.silhouette else 0)
        ends = group.start, group.stop
        _launch(where, "items.look_items", 1, scene, scratch, maps, backs, *ends)
        number = int(started().to_torch(scratch.count)[1])
        table, targets = (x[:number].clone() for x in _listed(scratch))
        return Cuts(group, table, targets)

    return tuple(mapped(draw_group, groups))


def _draw_at_once(scene: Any, maps: Any, backs: int, where: torch.device) -> Cuts:  # noqa: ANN401
    """The same with a thread for each vertex, triangle, edge and pixel."""
    from mover.geometry.kernels.grid import LANES

    n = len(scene.verts) // scene.n_verts
    scratch = scratch_of(_room(scene, n, n if maps.silhouette else 0), where)
    table, targets = _listed(scratch)
    edges = (n, scene.n_edges)
    _launch(where, "grid.place_verts", (n, scene.n_verts), scene, scratch)
    _launch(where, "grid.draw_faces", (n, scene.n_faces), scene, scratch, backs)
    _launch(where, "grid.draw_rows", LANES, scene, scratch, backs)
    if maps.silhouette:
        _launch(where, "grid.enter_edges", edges, scene, scratch)
    _launch(where, "grid.show_pixels", (n, scene.height, scene.width), scene, scratch, maps)
    if maps.silhouette:
        _launch(where, "grid.keep_edges", edges, scene, scratch, maps)
        _launch(where, "grid.mark_cuts", len(targets), scratch, maps)
        _launch(where, "grid.bound_cuts", len(targets), scratch, maps)
    return Cuts(range(n), table, targets)


def _in_loops(where: torch.device) -> bool:
    """Whether a thread draws whole items."""
    return where.type == "cpu"


def _own_scratch(scene: Any, listed: int) -> Any:  # noqa: ANN401
    """The working memory of this thread of a CPU, which kernels leave clean, for one item."""
    room = _room(scene, 1, listed)
    if any(have < need for have, need in zip(getattr(_own, "room", [0]), room, strict=False)):
        _own.room, _own.scratch = room, scratch_of(room, torch.device("cpu"))
    scratch = _own.scratch
    if scene.height * scene.width > KEPT:
        vars(_own).clear()
    started().to_torch(scratch.count).zero_()
    return scratch


def _room(scene: Any, count: int, listed: int) -> list[int]:  # noqa: ANN401
    """What `scratch_of` asks for some items at a time, and the cuts of some one after the other."""
    grid = scene.height * scene.width
    one = scene.n_verts, scene.n_faces, scene.n_edges, grid
    return [*(count * n for n in one), 2 * listed * grid]


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


def _scene(verts: Tensor, shape: Topology, views: Crops, border: int) -> Any:  # noqa: ANN401
    """The items as the kernels read them; `border` [px] lies around the windows."""
    edges = shape.edges[:, : None if shape.faces.shape[1] else 0]
    faces, edges = (t.to(verts.device, torch.int64).contiguous() for t in (shape.faces, edges))
    return _packed(
        "Scene",
        verts=verts.detach().contiguous().view(-1, 3),
        window=windows(views.K.to(verts), border),
        faces=faces.view(-1, 3),
        edges=edges.view(-1, 4),
        views=len(views.K),
        shapes=len(faces),
        n_verts=verts.shape[1],
        n_faces=faces.shape[1],
        n_edges=edges.shape[1],
        height=views.height + 2 * border,
        width=views.width + 2 * border,
        border=border,
    )


def windows(K: Tensor, border: int) -> Tensor:
    """Focal lengths and principal points in windows with a border [px]."""
    return torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2] + border, K[:, 1, 2] + border], -1)


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


def _launch(where: torch.device, name: str, dim: int | tuple[int, ...], *inputs: Any) -> None:  # noqa: ANN401
    """Launch a kernel, by its module and name."""
    module, kernel = name.split(".")
    launch(getattr(kernels(module, name_of(where)), kernel), dim, list(inputs), where)
