"""Silhouettes and depth in plain torch, in any precision: the reference of the kernels."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, prod

import torch
from jaxtyping import Float, Int
from raster_torch_contour import blend, cuts, outline
from raster_torch_depth import planes, surface
from raster_torch_spans import LOW, coverage, inverse_depth, on_screen, signed_areas, spans, zbuffer
from torch import Tensor

from mover.geometry.raster.records import Crops, Depths, Layers, Topology

BORDER = 1  # [px], as in the kernels
PIXELS, TRIANGLES = 1 << 19, 1 << 16  # of one chunk: bounds the memory, and stays in the cache


@dataclass(frozen=True)
class Chunk:
    """Some items, with their vertices and triangles counted through."""

    verts: Tensor
    """Vertices of the items [m], differentiable."""
    K: Tensor
    """Intrinsics of their windows, with the border [px]."""
    size: tuple[int, int]
    """Rows and columns, with the border."""
    faces: Tensor
    """Vertices of all triangles, 3 rows."""
    edges: Tensor
    """Vertices and triangles of all edges, 4 rows."""


def look(
    verts_cam: Float[Tensor, "*starts items verts 3"],
    shape: Topology,
    views: Crops,
    depth: bool = True,
) -> tuple[Float[Tensor, "*starts items h w"], Depths | None]:
    """See `raster.look`."""
    size = (*verts_cam.shape[:-2], views.height, views.width)
    results = [_seen(chunk, True, depth) for chunk in _chunks(verts_cam, shape, views)]
    images = [image for image, _ in results]
    maps = [maps for _, maps in results]
    image = torch.cat(images) if images else verts_cam.new_zeros(size)
    return image.view(size), _depths(maps, size, verts_cam) if depth else None


def depths(
    verts_cam: Float[Tensor, "*starts items verts 3"], shape: Topology, views: Crops
) -> Depths:
    """See `raster.depths`."""
    size = (*verts_cam.shape[:-2], views.height, views.width)
    maps = [_seen(chunk, False, True)[1] for chunk in _chunks(verts_cam, shape, views)]
    return _depths(maps, size, verts_cam)


def _chunks(verts_cam: Tensor, shape: Topology, views: Crops) -> Iterator[Chunk]:
    """Starts x items as one list, cut so that the buffers stay small."""
    items, n_faces, _ = shape.faces.shape
    n_verts = verts_cam.shape[-2]
    size = (views.height + 2 * BORDER, views.width + 2 * BORDER)
    border = verts_cam.new_tensor([[0.0, 0, BORDER], [0, 0, BORDER], [0, 0, 0]])
    step = max(1, min(PIXELS // prod(size), TRIANGLES // max(n_faces, 1)))
    total = prod(verts_cam.shape[:-2])
    if total * n_verts == 0:
        return
    step, first = ceil(total / ceil(total / step)), 0
    for verts in verts_cam.reshape(-1, n_verts, 3).split(step):
        place = torch.arange(len(verts), device=verts.device)
        item = (place + first) % items
        first += len(verts)
        faces = shape.faces[item].long() + (place * n_verts)[:, None, None]
        edges = shape.edges[item, : None if n_faces else 0].long()
        edges = edges + torch.stack([place * n_verts] * 2 + [place * n_faces] * 2, -1)[:, None]
        yield Chunk(verts, views.K[item].to(verts) + border, size, _rows(faces), _rows(edges))


def _rows(table: Tensor) -> Tensor:
    """Put the last axis first and join the others."""
    return table.flatten(0, 1).T.contiguous()


def _seen(chunk: Chunk, silhouette: bool, depth: bool) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Silhouette, and nearest, farthest and covered, of a chunk (empty where not asked for)."""
    grid = (len(chunk.verts), *chunk.size)
    inside = (slice(None), *[slice(BORDER, -BORDER)] * 2)
    image, maps = chunk.verts.new_zeros(0), ()
    screen = on_screen(chunk.verts, chunk.K, chunk.size)
    area = signed_areas(screen, chunk.faces)
    fronts = spans(screen, chunk.faces, area < 0)
    if silhouette:
        covered = coverage(screen, fronts)
        found = cuts(screen, outline(screen, chunk.faces, chunk.edges, area < 0), covered)
        image = blend(chunk.verts.reshape(-1, 3), chunk.K, found, covered).view(grid)[inside]
    if depth:
        backs = spans(screen, chunk.faces, area > 0, nearest=False)
        near, far = zbuffer(screen, fronts), zbuffer(screen, backs)
        covered = (near > 0) & (far > 0)
        pixel = torch.nonzero(covered)[:, 0]
        plane = planes(chunk.verts, chunk.K, chunk.faces)
        nearest = surface(plane, screen, fronts, near, pixel)
        farthest = surface(plane, screen, backs, far, pixel)
        maps = tuple(m.view(grid)[inside] for m in (nearest, farthest, covered))
    return image, maps


def _depths(maps: list[tuple[Tensor, ...]], size: tuple[int, ...], like: Tensor) -> Depths:
    """One record from the maps of all chunks."""
    if not maps:
        return Depths(like.new_zeros(size), like.new_zeros(size), like.new_zeros(size).bool())
    nearest, farthest, covered = (torch.cat(parts).view(size) for parts in zip(*maps, strict=True))
    return Depths(nearest, farthest, covered)


def layers(
    verts_cam: Float[Tensor, "items verts 3"], faces: Int[Tensor, "faces 3"], views: Crops
) -> Layers:
    """See `raster.layers`."""
    items, n_verts, _ = verts_cam.shape
    size = (views.height, views.width)
    front = torch.full((items, *size), torch.inf).to(verts_cam)
    leave = torch.full((items, *size), -torch.inf).to(verts_cam)
    step = max(1, min(PIXELS // max(prod(size), 1), TRIANGLES // max(len(faces), 1)))
    for first in range(0, items, step):
        few = slice(first, first + step)
        verts = verts_cam[few].detach()
        base = torch.arange(len(verts), device=verts.device) * n_verts
        table = _rows(faces.long() + base[:, None, None])
        screen = on_screen(verts, views.K[few], size)
        area = signed_areas(screen, table)
        for out, facing in ((front, area < 0), (leave, area > 0)):
            keys = zbuffer(screen, spans(screen, table, facing))
            z = torch.where(keys > 0, 1 / inverse_depth(keys), out[few].reshape(-1))
            out[few] = z.view(out[few].shape).to(out)
    return Layers(front, leave)


def first_hit(
    verts_cam: Float[Tensor, "verts 3"],
    faces: Int[Tensor, "faces 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """See `raster.first_hit`."""
    table = faces.long().T.contiguous()
    screen = on_screen(verts_cam[None], K[None], size)
    runs = spans(screen, table, signed_areas(screen, table) != 0)
    keys = zbuffer(screen, runs)
    pixel = torch.nonzero(keys)[:, 0]
    seen = keys.index_select(0, pixel)
    depth = torch.full_like(keys, torch.inf, dtype=verts_cam.dtype)
    depth[pixel] = (1 / inverse_depth(seen)).to(depth)
    face = torch.full_like(keys, -1)
    face[pixel] = runs.face.index_select(0, seen & LOW)
    return depth.view(size), face.view(size)
