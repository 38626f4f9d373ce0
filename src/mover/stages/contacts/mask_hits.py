"""Which object a group of contact vertices touches, by the rules of the authors' released code.

The whole body (seat, thighs, back) and both arms (hands, forearms) are each given to one object:

1. An object is a candidate if its mask shares a pixel with the person's mask and its box overlaps
   the person's box; arms take tables only.
2. Each contact vertex is looked up in the object's mask inside its window (a square of 1.3 times
   the box); vertices beyond the window count at its border. No hit: no candidate.
3. Several candidates: those with at most 5 % of the hits of the best fall away, and all classes
   but beds, chairs, sofas and tables. The one that owns most of the nearest object vertices is
   touched, unless the mean squared distance to it is above 1 m^2.
4. A single candidate is touched if more than 20 vertices hit, however far it is.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.geometry.boxes import iou2d

CHAIRS = ("chair", "armchair", "office chair", "stool")  # one class in the authors' detector
TABLES = ("table", "coffee table", "dining table", "round table", "desk")
KEPT = (*CHAIRS, *TABLES, "bed", "sofa")
SHARE = 0.05  # of the hits of the best candidate
HITS = 20  # of a single candidate
FARTHEST = 1.0  # [m^2]
WINDOW = 1.3  # of the larger side of the box


@record
class Candidates:
    """The objects in the image and in the room."""

    categories: tuple[str, ...]
    masks: Bool[Tensor, "objects h w"]
    boxes: Float[Tensor, "objects 4"]
    """x_min, y_min, x_max, y_max [px]."""
    verts: Float[Tensor, "objects verts 3"]
    """Placed in the world [m]; padding is far away."""


def decide_by_mask_hits(
    points: Float[Tensor, "verts 3"],
    pixels: Int[Tensor, "verts 2"],
    person: Bool[Tensor, "h w"] | None,
    objects: Candidates,
    *,
    arms: bool,
) -> int:
    """Index of the object that one group of one body touches, -1 for none.

    Args:
        points: Contact vertices in the world [m].
        pixels: Where they are seen, x and y [px].
        person: The person's visible mask; None: unknown, so rule 1 asks for the class alone.
        objects: Who may be touched.
        arms: The group is hands and forearms.
    """
    hits = torch.stack(
        [_hits(pixels, m, b) for m, b in zip(objects.masks, objects.boxes, strict=True)]
    )
    may = _near(person, objects) & (hits > 0) & _is_one_of(objects, TABLES if arms else None)
    if int(may.sum()) > 1:
        may = may & (hits > SHARE * hits[may].max()) & _is_one_of(objects, KEPT)
        return _nearest(points, objects, may)
    if not bool(may.any()):
        return -1
    only = int(may.nonzero()[0, 0])
    return only if int(hits[only]) > HITS else -1


def _near(person: Bool[Tensor, "h w"] | None, objects: Candidates) -> Bool[Tensor, " objects"]:
    """Objects whose mask and box overlap those of the person."""
    if person is None:
        return torch.ones(len(objects.categories), dtype=torch.bool)
    if not bool(person.any()):
        return torch.zeros(len(objects.categories), dtype=torch.bool)
    y, x = person.nonzero().unbind(-1)
    box = torch.stack([x.min(), y.min(), x.max() + 1, y.max() + 1]).to(objects.boxes)
    shared = (objects.masks & person).any(-1).any(-1)
    return shared & (iou2d(objects.boxes, box.expand_as(objects.boxes)) > 0)


def _is_one_of(objects: Candidates, names: tuple[str, ...] | None) -> Bool[Tensor, " objects"]:
    return torch.tensor([names is None or c in names for c in objects.categories]).bool()


def _hits(
    pixels: Int[Tensor, "verts 2"], mask: Bool[Tensor, "h w"], box: Float[Tensor, "4"]
) -> Int[Tensor, ""]:
    """Number of vertices on the mask, clamped to the object's window."""
    middle, half = (box[:2] + box[2:]) / 2, WINDOW / 2 * (box[2:] - box[:2]).max()
    inside = torch.minimum(torch.maximum(pixels, middle - half), middle + half - 1).long()
    size = torch.tensor([mask.shape[1], mask.shape[0]])
    shown = ((inside >= 0) & (inside < size)).all(-1)
    x, y = torch.minimum(inside.clamp_min(0), size - 1).unbind(-1)
    return (mask[y, x] & shown).sum()


def _nearest(
    points: Float[Tensor, "verts 3"], objects: Candidates, may: Bool[Tensor, " objects"]
) -> int:
    """The candidate that owns most nearest vertices, if it is near enough."""
    if not bool(may.any()):
        return -1
    away = torch.full((len(may), len(points)), torch.inf).to(points)
    away[may] = torch.stack([torch.cdist(points, v).amin(-1) for v in objects.verts[may]])
    best = int(away.argmin(0).mode().values)
    return best if float(away[best].square().mean()) <= FARTHEST else -1
