"""Make any meshes fit for optimisation: closed, light, evenly sampled, with known parts."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..furniture.library import SEATS, canonical
from ..geometry.mesh import box, decimate, edges_of, sample_surface, signed_volume, used
from ..geometry.placement import FREE, GROUND
from ..geometry.rotations import rot_y
from ..geometry.watertight import close_mesh
from ..minimize import Observer, Step, silent
from ..records import record
from ..types import Layout, Mesh, Objects, Piece
from .regions import Regions, find_regions


@dataclass(frozen=True)
class PrepareConfig:
    """How meshes are prepared."""

    cells: int = 96
    """Cells along the longest side when a mesh must be closed."""
    faces: int = 2000
    """Faces of the proxies that are optimised."""
    samples: int = 1500
    """Even surface samples of each object."""
    region: int = 400
    """Points of each region that can be touched."""
    rule: Literal["level", "release"] = "level"
    """How seats and backs are found (see stages/regions.py)."""


@record
class PrepareInputs:
    """The furniture of the initial scene."""

    pieces: tuple[Piece, ...]


@record
class Prepared:
    """Proxies, where they start, and how to come back to the user's meshes."""

    objects: Objects
    start: Layout
    center: Float[Tensor, "objects 3"]
    """Centre of the box's bottom in the mesh's own coordinates."""
    scale: Float[Tensor, "objects 3"]
    """Initial scale."""
    warnings: tuple[str, ...]


@record
class _Proxy:
    mesh: Mesh
    edges: Int[Tensor, "edges 4"]
    samples: Float[Tensor, "samples 3"]
    regions: Regions
    center: Float[Tensor, "3"]


def prepare_objects(
    inputs: PrepareInputs, config: PrepareConfig, observe: Observer = silent
) -> Prepared:
    """Close, decimate, sample and pack the furniture; read off where it starts."""
    proxies: list[_Proxy] = []
    for index, piece in enumerate(inputs.pieces):
        proxies.append(_proxy(piece, config))
        observe(Step("prepare_objects", index, len(inputs.pieces)))
    pieces = inputs.pieces
    center = torch.stack([p.center for p in proxies])
    scale = torch.stack([p.scale for p in pieces])
    yaw = torch.stack([p.yaw for p in pieces])
    origin = torch.stack([p.t_world_object for p in pieces])
    moved = (rot_y(yaw) @ (scale * center).unsqueeze(-1)).squeeze(-1)
    start = Layout(origin + moved, yaw, torch.zeros_like(scale))
    return Prepared(_pack(pieces, proxies), start, center, scale, _warnings(pieces, proxies))


def restore(pieces: tuple[Piece, ...], prepared: Prepared, layout: Layout) -> tuple[Piece, ...]:
    """Turn a layout of proxies back into placements of the user's own meshes."""
    scale = prepared.scale * layout.log_scale.exp()
    back = (rot_y(layout.yaw) @ (scale * prepared.center).unsqueeze(-1)).squeeze(-1)
    origin = layout.t_world_object - back
    return tuple(
        dataclasses.replace(p, t_world_object=origin[i], yaw=layout.yaw[i], scale=scale[i])
        for i, p in enumerate(pieces)
    )


def proxy_meshes(prepared: Prepared) -> tuple[Mesh, ...]:
    """The closed proxies in the coordinates of the pieces' own meshes, for the same placements."""
    objects, meshes = prepared.objects, []
    for i in range(len(objects.ids)):
        verts = objects.verts[i][objects.real_verts[i]] / prepared.scale[i] + prepared.center[i]
        faces = objects.faces[i]
        meshes.append(Mesh(verts, faces[(faces != 0).any(-1)]))
    return tuple(meshes)


def _proxy(piece: Piece, config: PrepareConfig) -> _Proxy:
    mesh = used(piece.mesh)
    low, high = box(mesh.verts)
    center = torch.stack([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    mesh = Mesh((mesh.verts - center) * piece.scale, mesh.faces)
    mesh = decimate(close_mesh(mesh, config.cells), config.faces)
    points, normals = sample_surface(mesh, 4 * config.samples)
    regions = find_regions(points, normals, canonical(piece.category), config.rule)
    samples, _ = sample_surface(mesh, config.samples)
    return _Proxy(mesh, edges_of(mesh.faces), samples, _thin(regions, config.region), center)


def _thin(regions: Regions, count: int) -> Regions:
    def some(points: Tensor) -> Tensor:
        if len(points) == 0:
            return points.new_zeros(count, 3)
        return points[torch.linspace(0, len(points) - 1, count).round().long()]

    return Regions(some(regions.top), some(regions.back), regions.has_top, regions.has_back)


def _pack(pieces: tuple[Piece, ...], proxies: list[_Proxy]) -> Objects:
    categories = tuple(canonical(p.category) for p in pieces)
    size = torch.stack([high - low for low, high in (box(p.mesh.verts) for p in proxies)])
    return Objects(
        ids=tuple(p.id for p in pieces),
        categories=categories,
        verts=_pad([p.mesh.verts for p in proxies], repeat=True),
        real_verts=_real([len(p.mesh.verts) for p in proxies]),
        faces=_pad([p.mesh.faces for p in proxies]),
        edges=_pad([p.edges for p in proxies]),
        samples=torch.stack([p.samples for p in proxies]),
        size=size,
        top=torch.stack([p.regions.top for p in proxies]),
        back=torch.stack([p.regions.back for p in proxies]),
        has_top=torch.tensor([p.regions.has_top for p in proxies]),
        has_back=torch.tensor([p.regions.has_back for p in proxies]),
        is_seat=torch.tensor([c in SEATS for c in categories]),
        supports=_supports(pieces),
    )


def _pad(rows: list[Tensor], repeat: bool = False) -> Tensor:
    most = max(len(r) for r in rows)
    fill = [r[:1] if repeat else torch.zeros_like(r[:1]) for r in rows]
    return torch.stack(
        [torch.cat([r, f.expand(most - len(r), -1)]) for r, f in zip(rows, fill, strict=True)]
    )


def _real(counts: list[int]) -> Bool[Tensor, "objects verts"]:
    return torch.arange(max(counts)) < torch.tensor(counts).unsqueeze(-1)


def _supports(pieces: tuple[Piece, ...]) -> Int[Tensor, " objects"]:
    index = {p.id: i for i, p in enumerate(pieces)} | {"ground": GROUND, "free": FREE}
    return torch.tensor([index[p.support] for p in pieces])


def _warnings(pieces: tuple[Piece, ...], proxies: list[_Proxy]) -> tuple[str, ...]:
    return tuple(
        f"{piece.id}: its mesh encloses almost nothing, its silhouette may be wrong"
        for piece, proxy in zip(pieces, proxies, strict=True)
        if signed_volume(proxy.mesh) <= 0
    )
