r"""Bend meshes whose shapes do not fit the image (not in the paper, whose shapes are given).

A tool that makes a mesh from one picture chooses another design, rounds it and is off by some per
cent of its size; placed truly, its silhouette is smaller than the mask, and the piece comes nearer
until it fills it. So place, turn, size and shape are found together:

    min  L_scene(layout, mesh bent by d) + w \sum |d|^2 / 2 \sigma^2

with d the moves of 27 control points as shares of the box (`geometry.cage`), without what a
placement could do and the same left and right. Only pieces whose shapes do not fit are bent: the
others stay as they are, to the bit.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.observe import Energy, Observer, silent
from mover.core.records import record, rows_of, with_rows
from mover.core.types import Cage, Layout, Objects, SceneObject
from mover.energy.config import SceneConfig
from mover.energy.minimize import minimize
from mover.energy.objective import scene_energy
from mover.geometry.cage import bent, even
from mover.geometry.mesh import bottom_center, box
from mover.geometry.rotations import rot_y
from mover.stages.config import BendConfig
from mover.stages.objects.place_inputs import PlaceInputs
from mover.stages.objects.place_objects import some_inputs, standing
from mover.stages.objects.prepare_objects import Prepared
from mover.stages.objects.seat_heights import offsets_of
from mover.stages.objects.starts import merged, piles_of


@record
class BendInputs:
    """Furniture where it was placed, and which of it may be bent."""

    inputs: PlaceInputs
    """What it was placed by."""
    scene: SceneConfig
    """How that is priced."""
    layout: Layout
    loose: Bool[Tensor, " objects"]
    """Whose shapes do not fit."""


@record
class Bending:
    """Shapes, and where they stand."""

    offset: Float[Tensor, "objects 3 3 3 3"]
    """Moves of the control points as shares of the box; 0 where a mesh is kept."""
    layout: Layout
    """Of the unbent boxes."""


@record
class _Free:
    t_world_object: Float[Tensor, "objects 3"]
    yaw: Float[Tensor, " objects"]
    log_scale: Float[Tensor, "objects 3"]
    offset: Float[Tensor, "objects 3 3 3 3"]


def bend_shapes(inputs: BendInputs, config: BendConfig, observe: Observer = silent) -> Bending:
    """Find shapes and places together, of what is loose and of what stands with it."""
    start, pile = inputs.layout, piles_of(inputs.inputs.objects.supports)
    rows = torch.isin(pile, pile[inputs.loose]).nonzero()[:, 0]
    known, few = some_inputs(inputs.inputs, rows), rows_of(start, rows, "objects")
    objects, loose = known.objects, inputs.loose[rows].to(start.yaw)

    def layout_of(free: _Free) -> Layout:
        return standing(known, Layout(free.t_world_object, free.yaw, free.log_scale))

    def shape_of(free: _Free) -> Tensor:
        return even(free.offset) * loose.view(-1, 1, 1, 1, 1)

    def energy(free: _Free) -> Energy:
        offset = shape_of(free)
        verts = bent(objects.verts, _cages(objects, offset))
        found = scene_energy(
            layout_of(free), replace(objects, verts=verts), known.camera, known.image,
            known.humans, inputs.scene,
        )  # fmt: skip
        bend = config.weight * (offset / config.sigma).square().flatten(1).sum(-1) / 2
        return Energy({"placed": found.per_item, "bend": bend})

    none = torch.zeros(len(pile), 3, 3, 3, 3).to(start.yaw)
    begin = _Free(few.t_world_object, few.yaw, few.log_scale, none[rows])
    found = minimize(energy, begin, config.method, observe, "bend_shapes").at
    offset = even(none.index_copy(0, rows, found.offset)) * inputs.loose.view(-1, 1, 1, 1, 1)
    ends = with_rows(start, rows, layout_of(found), "objects")
    return Bending(offset, merged(inputs.loose, ends, start))


def _cages(objects: Objects, offset: Float[Tensor, "objects 3 3 3 3"]) -> Cage:
    """Cages about the boxes, in the objects' frames [m]."""
    half = objects.size * torch.tensor([0.5, 0.0, 0.5]).to(objects.size)
    return Cage(-half, objects.size - half, offset * objects.size[:, None, None, None])


def with_shapes(prepared: Prepared, bending: Bending) -> tuple[Prepared, Layout]:
    """The furniture bent, and its layout.

    Each frame is again at the middle of its box's bottom, and each box as large as before: what
    bending added to a size is in the layout, where what is known of sizes has its say.
    """
    objects, layout = prepared.objects, bending.layout
    cages = _cages(objects, bending.offset)
    verts = bent(objects.verts, cages)
    low, high = (torch.stack(ends) for ends in zip(*(box(v) for v in verts), strict=True))
    base = bottom_center(low, high)
    some = bending.offset.flatten(1).any(-1)
    base = torch.where(some[:, None], base, 0)
    grown = torch.where(some[:, None], (high - low) / objects.size.clamp_min(1e-9), 1)
    grid = grown[:, None, None, None]
    points = _control_points(cages)
    offset = (points + cages.offset - base[:, None, None, None]) / grid - points
    cages = replace(cages, offset=offset * some[:, None, None, None, None])

    def shaped(points: Tensor) -> Tensor:
        return torch.where(some[:, None, None], bent(points, cages), points)

    new = replace(
        objects, verts=shaped(objects.verts), samples=shaped(objects.samples),
        top=shaped(objects.top), back=shaped(objects.back),
    )  # fmt: skip
    away = (layout.log_scale.exp() * base).unsqueeze(-1)
    moved = layout.t_world_object + (rot_y(layout.yaw) @ away).squeeze(-1)
    there = replace(layout, t_world_object=moved, log_scale=layout.log_scale + grown.log())
    own = _to_mesh(cages, prepared)
    bent_ones = replace(prepared, objects=new, cages=own, straight=objects)
    return bent_ones, merged(some, there, layout)


def with_lifted_seats(prepared: Prepared, lift: Float[Tensor, " objects"]) -> Prepared:
    """The furniture with its seats higher by so much [m], as bent as it was before (`cages`)."""
    straight = prepared.straight or prepared.objects
    rise = offsets_of(lift, straight)
    some = rise.flatten(1).any(-1)
    if not bool(some.any()):
        return prepared
    cages = prepared.cages or _to_mesh(_cages(straight, torch.zeros_like(rise)), prepared)
    cages = replace(cages, offset=cages.offset + rise / prepared.scale[:, None, None, None])
    own = _from_mesh(cages, prepared)

    def lifted(name: str) -> Tensor:
        new = bent(getattr(straight, name), own)
        return torch.where(some[:, None, None], new, getattr(prepared.objects, name))

    names = ("verts", "samples", "top", "back")
    objects = replace(prepared.objects, **{name: lifted(name) for name in names})
    return replace(prepared, objects=objects, cages=cages, straight=straight)


def _to_mesh(cages: Cage, prepared: Prepared) -> Cage:
    """Cages in the objects' frames [m], in the units and about the origins of the given meshes."""
    unit, center = prepared.scale, prepared.center
    grid = unit[:, None, None, None]
    return Cage(cages.low / unit + center, cages.high / unit + center, cages.offset / grid)


def _from_mesh(cages: Cage, prepared: Prepared) -> Cage:
    """The same back."""
    unit, center = prepared.scale, prepared.center
    grid = unit[:, None, None, None]
    return Cage((cages.low - center) * unit, (cages.high - center) * unit, cages.offset * grid)


def _control_points(cages: Cage) -> Float[Tensor, "objects 3 3 3 3"]:
    """Where they are before they are moved: a map of them that is affine is that of all points."""
    share = torch.linspace(0, 1, 3).to(cages.low)
    grid = torch.stack(torch.meshgrid(share, share, share, indexing="ij"), -1)
    low, size = (x[:, None, None, None] for x in (cages.low, cages.high - cages.low))
    return low + grid * size


def told_of_shapes(pieces: tuple[SceneObject, ...]) -> tuple[str, ...]:
    """A sentence for each piece that was bent."""
    return tuple(
        f"{piece.id}: its mesh does not fit the image and is bent, by up to"
        f" {100 * _farthest(piece, piece.cage):.0f} cm (`--shape keep` leaves it)"
        for piece in pieces
        if piece.cage is not None
    )


def _farthest(piece: SceneObject, cage: Cage) -> float:
    """How far a control point is moved at most, without what a placement could do [m]."""
    moved = even(cage.offset[None])[0].reshape(-1, 3)
    return float((moved * piece.scale).norm(dim=-1).max())
