"""What placing the objects needs, and what comes of it."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import Camera, Layout, Objects
from mover.energy.objective import HumanCues, ImageCues
from mover.energy.prior_terms import Walls


@record
class Pinned:
    """Objects that the user has placed: they are part of the energy but do not move."""

    fixed: Bool[torch.Tensor, " objects"]
    layout: Layout
    """Without an axis of starts; rows that are not fixed have no meaning."""


@record
class PlaceInputs:
    """What placing the objects needs."""

    objects: Objects
    camera: Camera
    ground: float
    image: ImageCues
    humans: HumanCues
    starts: Layout
    """Candidates on a leading axis."""
    reference: Float[Tensor, " objects"]
    """Yaw that breaks ties: of the sitters where there are any, else the initial one [rad]."""
    pinned: Pinned | None = None
    """Objects that stay where they are; None: all may move."""


@record
class Placed:
    """Where the objects ended."""

    layout: Layout
    """The chosen candidate of each object."""
    candidates: Layout
    """All that were left, best first."""
    energy: Float[Tensor, "starts objects"]
    """Of the candidates."""
    trace: Float[Tensor, " steps"]
    """Total energy before each step of the last descent, summed over the candidates."""
    walls: Walls | None = None
    """The lines along which furniture was placed; None: none."""


def hold(layout: Layout, pinned: Pinned | None) -> Layout:
    """The layout with the pinned objects at their positions, in every start; no gradient there."""
    return layout if pinned is None else Layout.where(pinned.fixed, pinned.layout, layout)


def with_walls(inputs: PlaceInputs, walls: Walls | None) -> PlaceInputs:
    """The inputs with the lines along which furniture stands."""
    return replace(inputs, image=replace(inputs.image, walls=walls))
