r"""Who hides whom bounds the depth of people (Eq. L_depth with the roles exchanged).

Evidence:  the furniture of the estimated room is drawn once. Skin that faces the camera and is seen
           (inside the person's visible mask) before a piece of furniture is not farther than its
           front; skin that a piece hides (inside the mask of that piece, outside of all people) is
           not nearer than its front.
Price:     how far the skin is out of these bounds, less a margin, at most half a metre.
Paper:     L_depth moves objects between people; the refinement of the bodies does not name it.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import record

MARGIN = 0.03  # [m], outlines and fronts are not known better
MOST = 0.5  # [m], beyond, something else is wrong
USUAL = 0.05  # [m]
POINTS = 20.0  # independent places of a body's skin


@record
class Bounds:
    """How near and far skin points may be."""

    near: Float[Tensor, "bodies points"]
    """Depth that hidden skin has at least [m]; -inf: no bound."""
    far: Float[Tensor, "bodies points"]
    """Depth that visible skin has at most [m]; inf: no bound."""


@record
class Sighting:
    """What is seen where skin points are projected."""

    front: Float[Tensor, "bodies points"]
    """Depth of the nearest furniture there [m]; inf: none."""
    shown: Bool[Tensor, "bodies points"]
    """Well inside the person's visible mask."""
    hidden: Bool[Tensor, "bodies points"]
    """Well outside everybody's masks, inside the mask of the furniture that is drawn there."""
    facing: Bool[Tensor, "bodies points"]
    """The skin faces the camera."""
    loose: Float[Tensor, "bodies points"]
    """How far off that furniture may be along the ray, as its shape is doubted [m]."""


def bounds_of_skin(seen: Sighting) -> Bounds:
    """Bounds for the depth of the skin; of one body, only what the larger region says."""
    real = seen.front.isfinite() & seen.facing
    shown, hidden = seen.shown & real, seen.hidden & real
    more = (shown.sum(-1) - hidden.sum(-1))[:, None]
    none = torch.full_like(seen.front, torch.inf)
    far = torch.where(shown & (more > 0), seen.front + seen.loose, none)
    return Bounds(torch.where(hidden & (more < 0), seen.front - seen.loose, -none), far)


def order_term(depth: Float[Tensor, "bodies points"], bounds: Bounds) -> Float[Tensor, " bodies"]:
    """Price of skin before what hides it or behind what it hides [nats]."""
    known = bounds.near.isfinite() | bounds.far.isfinite()
    near = torch.where(
        bounds.near.isfinite(), bounds.near - MARGIN - depth, torch.zeros_like(depth)
    )
    far = torch.where(bounds.far.isfinite(), depth - bounds.far - MARGIN, torch.zeros_like(depth))
    out = (near.clamp(0, MOST) + far.clamp(0, MOST)) / USUAL
    price = torch.where(out < 1, 0.5 * out.square(), out - 0.5)
    return POINTS * price.sum(-1) / known.sum(-1).clamp_min(POINTS)
