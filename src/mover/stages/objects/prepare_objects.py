"""Make any meshes fit for optimisation: closed, light, evenly sampled, with known parts."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Layout, Mesh, Objects, SceneObject, SeatStretch
from mover.furniture.library import BACKS, SEATS, canonical
from mover.geometry import mesh as shapes
from mover.geometry.mesh import bottom_center, box, decimate, signed_volume, used
from mover.geometry.occupancy import load_occupancy, occupied_mesh
from mover.geometry.placement import FREE, GROUND
from mover.geometry.rotations import rot_y
from mover.geometry.topology import edges_of
from mover.geometry.warp_start import threads
from mover.geometry.watertight import close_mesh
from mover.stages.config import PrepareConfig

UPRIGHT = 0.866  # cosine of 30 degrees: normals of a seat or a back
MISSING = 0.15  # of the height: a corner that hangs higher has no foot
LEVEL = 0.005  # of the height: feet that differ by less stand level
LAYER = 0.05  # [m], thickness of the layer that is one seat


def find_regions(
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    category: str,
    rule: Literal["level", "normals"] = "level",
) -> tuple[Float[Tensor, "tops 3"], Float[Tensor, "backs 3"]]:
    """Surface points of the seat or top, and of the back, in the object's frame [m].

    Supplement, "Contact Regions of Objects": normals are up on seats and tops, forward on backs.
    The seat is the largest level layer above a quarter of the height, so that neither arms nor the
    back's rim count; a top is the highest layer with a quarter of the largest one's area. By
    `normals` all that looks upward is the seat or top, and all that looks forward the back.
    """
    if rule == "normals":
        up, forward = normals[:, 1] > UPRIGHT, normals[:, 2] > UPRIGHT
        return points[up], points[forward if category in BACKS else torch.zeros_like(up)]
    y = points[:, 1]
    height = float(y.max())
    facing = (normals[:, 1] > UPRIGHT) & (y > 0.25 * height)
    layers = torch.arange(0.0, height + LAYER, LAYER / 2)
    inside = facing & ((y - layers.unsqueeze(-1)).abs() <= LAYER)
    area = inside.sum(-1)
    if category in SEATS or category == "bed":
        level = inside[area.argmax()]
    else:
        wide = (area >= 0.25 * area.max()) & (area > 0)
        level = inside[wide.nonzero()[-1, 0]] if wide.any() else facing
    seat, back = points[level], torch.zeros_like(level)
    if category in BACKS and len(seat):
        above, behind = y > seat[:, 1].mean() + LAYER, points[:, 2] < seat[:, 2].mean()
        back = (normals[:, 2] > UPRIGHT) & above & behind
    return seat, points[back]


@record
class PrepareInputs:
    """The furniture of the initial scene."""

    objects: tuple[SceneObject, ...]


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
    stretch: SeatStretch | None = None
    """How seats are raised, in the objects' frames [m] (`seat_heights`); None: none is."""
    straight: Objects | None = None
    """The proxies before that; None: none is raised."""


@record
class _Proxy:
    mesh: Mesh
    edges: Int[Tensor, "edges 4"]
    samples: Float[Tensor, "samples 3"]
    top: Float[Tensor, "tops 3"]
    back: Float[Tensor, "backs 3"]
    center: Float[Tensor, "3"]


def prepare_objects(
    inputs: PrepareInputs, config: PrepareConfig, observe: Observer = silent
) -> Prepared:
    """Close, decimate, sample and pack the furniture; read off where it starts.

    Raises:
        InputError: If a network is asked for whose checkpoint is missing or is none.
    """
    close, notes = _closing(config)
    proxies: list[_Proxy] = []
    with ThreadPoolExecutor(threads()) as pool:
        made = pool.map(lambda piece: _proxy(piece, config, close), inputs.objects)
        for index, proxy in enumerate(made):
            proxies.append(proxy)
            observe(Step("prepare_objects", index, len(inputs.objects)))
    pieces = inputs.objects
    center = torch.stack([p.center for p in proxies])
    scale, yaw, origin = (
        torch.stack([getattr(p, name) for p in pieces])
        for name in ("scale", "yaw", "t_world_object")
    )
    moved = (rot_y(yaw) @ (scale * center).unsqueeze(-1)).squeeze(-1)
    start = Layout(origin + moved, yaw, torch.zeros_like(scale))
    hollow = tuple(
        f"{piece.id}: its mesh encloses almost nothing, its silhouette may be wrong"
        for piece, proxy in zip(pieces, proxies, strict=True)
        if signed_volume(proxy.mesh) <= 0
    )
    objects = _pack(pieces, proxies, config.region)
    return Prepared(objects, start, center, scale, (*hollow, *sorted(notes)))


def to_objects(
    pieces: tuple[SceneObject, ...], prepared: Prepared, layout: Layout
) -> tuple[SceneObject, ...]:
    """Turn a layout of proxies back into placements of the user's own meshes."""
    scale = prepared.scale * layout.log_scale.exp()
    back = (rot_y(layout.yaw) @ (scale * prepared.center).unsqueeze(-1)).squeeze(-1)
    origin, objects = layout.t_world_object - back, prepared.objects
    words = {GROUND: "ground", FREE: "free"}
    below = [words.get(k) or objects.ids[k] for k in objects.supports.tolist()]
    return tuple(
        dataclasses.replace(
            p, support=below[i], t_world_object=origin[i], yaw=layout.yaw[i], scale=scale[i]
        )
        for i, p in enumerate(_with_raised_seats(pieces, prepared))
    )


def _with_raised_seats(
    pieces: tuple[SceneObject, ...], prepared: Prepared
) -> tuple[SceneObject, ...]:
    """The objects with their own meshes raised; those whose seats stay are as they were."""
    known = prepared.stretch
    if known is None:
        return pieces
    unit, low = prepared.scale[:, 1], prepared.center[:, 1]
    seat, top, rise = low + known.seat / unit, low + known.top / unit, known.rise / unit
    out = list(pieces)
    for i in known.rise.nonzero()[:, 0].tolist():
        stretch, mesh = SeatStretch(low[i], seat[i], top[i], rise[i]), pieces[i].mesh
        mesh = dataclasses.replace(mesh, verts=stretch.of(mesh.verts))
        out[i] = dataclasses.replace(pieces[i], mesh=mesh, stretch=stretch)
    return tuple(out)


def proxy_meshes(prepared: Prepared) -> tuple[Mesh, ...]:
    """The closed proxies in the coordinates of the pieces' own meshes, for the same placements."""
    objects, meshes = prepared.objects, []
    for i in range(len(objects.ids)):
        verts = objects.verts[i][objects.real_verts[i]] / prepared.scale[i] + prepared.center[i]
        faces = objects.faces[i]
        meshes.append(Mesh(verts, faces[(faces != 0).any(-1)]))
    return tuple(meshes)


def _closing(config: PrepareConfig) -> tuple[Callable[[Mesh], Mesh], list[str]]:
    """How meshes become closed and light, and the warnings about it afterwards."""
    notes: list[str] = []

    def wrapped(mesh: Mesh) -> Mesh:
        return decimate(close_mesh(mesh, config.cells), config.faces)

    if config.watertight == "wrap":
        return wrapped, notes
    if not config.occnet:
        raise InputError("--prepare.occnet: names no file, expected the network's checkpoint")
    network = load_occupancy(Path(config.occnet))

    def seen(mesh: Mesh) -> Mesh:
        try:
            found = close_mesh(occupied_mesh(network, mesh), config.cells)
            return decimate(found, config.faces)
        except ValueError as error:  # it finds nothing inside
            notes.append(f"a mesh was wrapped, as the Occupancy Network gave none ({error})")
            return wrapped(mesh)

    return seen, notes


def _proxy(piece: SceneObject, config: PrepareConfig, close: Callable[[Mesh], Mesh]) -> _Proxy:
    mesh = used(piece.mesh)
    center = bottom_center(*box(mesh.verts))
    mesh = close(Mesh((mesh.verts - center) * piece.scale, mesh.faces))
    if config.level_feet:
        mesh = levelled(mesh)
    points = shapes.scatter(mesh, 4 * config.samples)
    samples, _ = shapes.sample_surface(mesh, config.samples)
    regions = find_regions(*points, canonical(piece.category), config.regions)
    return _Proxy(mesh, edges_of(mesh.faces), samples, *regions, center)


def levelled(mesh: Mesh) -> Mesh:
    """The mesh with all its feet on the floor, in the same box; unchanged where they are.

    A mesh of unclean origin touches the bottom of its box with one foot. What the image shows
    below the others then pulls the object nearer: by ten centimetres for three.
    """
    verts = mesh.verts
    low, high = box(verts)
    height, half = high[1] - low[1], (high - low) / 2
    middle = (low + high) / 2
    right, front = verts[:, 0] > middle[0], verts[:, 2] > middle[2]
    lifts = torch.zeros(2, 2).to(verts)
    for i, column in enumerate((~right, right)):
        for k, corner in enumerate((column & ~front, column & front)):
            if bool(corner.any()):
                lift = verts[corner, 1].min() - low[1]
                lifts[i, k] = lift if float(lift) < MISSING * float(height) else 0.0
    if float(lifts.max()) < LEVEL * float(height):
        return mesh
    across, along = (
        ((verts[:, a] - middle[a]) / half[a].clamp_min(1e-6) + 0.5).clamp(0, 1) for a in (0, 2)
    )
    rows = lifts[0] * (1 - across[:, None]) + lifts[1] * across[:, None]
    lift = rows[:, 0] * (1 - along) + rows[:, 1] * along
    above = (verts[:, 1] - low[1]) / height
    y = torch.maximum(verts[:, 1] - lift * (1 - above), low[1])
    return Mesh(torch.stack([verts[:, 0], y, verts[:, 2]], -1), mesh.faces)


def _pack(pieces: tuple[SceneObject, ...], proxies: list[_Proxy], region: int) -> Objects:
    def thin(points: Tensor) -> Tensor:
        if not len(points):
            return points.new_zeros(region, 3)
        return points[torch.linspace(0, len(points) - 1, region).round().long()]

    categories = tuple(canonical(p.category) for p in pieces)
    counts = torch.tensor([len(p.mesh.verts) for p in proxies])
    index = {p.id: i for i, p in enumerate(pieces)} | {"ground": GROUND, "free": FREE}
    return Objects(
        ids=tuple(p.id for p in pieces),
        categories=categories,
        verts=_pad([p.mesh.verts for p in proxies], repeat=True),
        real_verts=torch.arange(int(counts.max())) < counts.unsqueeze(-1),
        faces=_pad([p.mesh.faces for p in proxies]),
        edges=_pad([p.edges for p in proxies]),
        samples=torch.stack([p.samples for p in proxies]),
        size=torch.stack([high - low for low, high in (box(p.mesh.verts) for p in proxies)]),
        top=torch.stack([thin(p.top) for p in proxies]),
        back=torch.stack([thin(p.back) for p in proxies]),
        has_top=torch.tensor([bool(len(p.top)) for p in proxies]),
        has_back=torch.tensor([bool(len(p.back)) for p in proxies]),
        is_seat=torch.tensor([c in SEATS for c in categories]),
        supports=torch.tensor([index[p.support] for p in pieces]),
    )


def _pad(rows: list[Tensor], repeat: bool = False) -> Tensor:
    most = max(len(r) for r in rows)
    fill = [r[:1] if repeat else torch.zeros_like(r[:1]) for r in rows]
    return torch.stack(
        [torch.cat([r, f.expand(most - len(r), -1)]) for r, f in zip(rows, fill, strict=True)]
    )
