"""The evidence of some objects, as often as they are asked for: starts become objects."""

from dataclasses import fields, replace

import torch
from jaxtyping import Int
from torch import Tensor

from ..energy import HumanCues, ImageCues
from ..geometry.raster import Views
from ..terms.border import Borders
from ..terms.contact import Touches
from ..terms.contact_trees import some_trees
from ..terms.wall import some_walls
from ..types import Objects
from .pinned import Pinned

Rows = Int[Tensor, " rows"]


def some_objects(objects: Objects, rows: Rows) -> Objects:
    """The objects of rows of (starts x objects), counted through; carriers come with their loads.

    Raises:
        ValueError: If an object is asked for without what carries it.
    """
    n = len(objects.ids)
    index = rows % n
    place = torch.full((int(rows.max()) // n * n + n if len(rows) else n,), -1).to(rows)
    place[rows] = torch.arange(len(rows)).to(rows)
    below = objects.supports[index]
    carrier = place[(rows - index + below).clamp_min(0)]
    if bool(((below >= 0) & (carrier < 0)).any()):
        raise ValueError("some_objects: an object without the one that carries it")
    tensors = {
        f.name: getattr(objects, f.name)[index]
        for f in fields(objects)
        if isinstance(getattr(objects, f.name), Tensor)
    }
    names = index.tolist()
    return replace(
        objects,
        **tensors
        | {"supports": torch.where(below >= 0, carrier, below)}
        | {k: tuple(getattr(objects, k)[i] for i in names) for k in ("ids", "categories")},
    )


def some_image(image: ImageCues, index: Rows) -> ImageCues:
    """What the image says about the objects of this index."""
    views = Views(image.views.K[index], image.views.height, image.views.width)
    rest = {k: getattr(image, k)[index] for k in ("boxes", "sides", "masks", "keep", "trust")}
    distance, outline = (x if x is None else x[index] for x in (image.distance, image.outline))
    borders = image.borders
    if borders is not None:
        borders = Borders(borders.shifts, borders.masks[:, index])
    walls = None if image.walls is None else some_walls(image.walls, index)
    return ImageCues(
        views=views, distance=distance, outline=outline, borders=borders, walls=walls, **rest
    )


def some_humans(humans: HumanCues, index: Rows, n: int) -> HumanCues:
    """What the people say about the objects of this index, out of `n`."""
    depth, touches = humans.depth, humans.touches
    if depth is not None:
        depth = replace(depth, **{f.name: getattr(depth, f.name)[index] for f in fields(depth)})
    if touches is not None:
        row = torch.full((n,), -1).to(index)
        row[touches.object_of] = torch.arange(len(touches.object_of)).to(index)
        touched = torch.nonzero(row[index] >= 0)[:, 0]
        few = row[index[touched]]
        rest = {k: getattr(touches, k)[few] for k in ("points", "weight", "bodies", "heading")}
        touches = Touches(touched, **rest)
    return HumanCues(depth, humans.space, touches, some_trees(humans.trees, index))


def some_pinned(pinned: Pinned | None, index: Rows) -> Pinned | None:
    """The pinned objects among those of this index."""
    if pinned is None:
        return None
    there = pinned.layout
    rows = {f.name: getattr(there, f.name)[index] for f in fields(there)}
    return Pinned(pinned.fixed[index], replace(there, **rows))
