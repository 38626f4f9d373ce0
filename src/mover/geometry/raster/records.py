"""What is drawn and what comes of it: windows, padded triangles, maps, traces."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record


@record
class Crops:
    """Pinhole windows of one size, one for each item."""

    K: Float[Tensor, "items 3 3"]  #: intrinsics of each window [px of the window]; no skew
    height: int  #: rows of each window [px]
    width: int  #: columns of each window [px]


@record
class Topology:
    """Padded triangles of closed meshes, counter-clockwise seen from outside."""

    faces: Int[Tensor, "items faces 3"]  #: vertices of each triangle; padding is (0, 0, 0)
    edges: Int[Tensor, "items edges 4"]
    """Two vertices and the two faces beside them; padding is zeros."""


@record
class Depths:
    """First and last surface on the ray of each pixel centre."""

    nearest: Float[Tensor, "*starts items h w"]
    """Camera z of the front-most surface [m]; 0 where not covered."""
    farthest: Float[Tensor, "*starts items h w"]
    """Camera z of the last surface [m]; 0 where not covered."""
    covered: Bool[Tensor, "*starts items h w"]
    """Whether the ray of the pixel centre meets both a front and a back."""


@record
class Layers:
    """Where rays enter and first leave closed bodies; not differentiable."""

    front: Float[Tensor, "items h w"]
    """Camera z of the nearest front-facing surface [m]; inf where there is none."""
    exit: Float[Tensor, "items h w"]
    """Camera z of the nearest back-facing surface [m]; -inf where there is none."""


@dataclass(frozen=True)
class Maps:
    """What was drawn (items, h, w); empty where it was not asked for."""

    image: Tensor
    nearest: Tensor
    farthest: Tensor
    covered: Tensor


@dataclass(frozen=True)
class Cuts:
    """Where the outlines of some items are cut between pixel centres."""

    group: range  #: the items
    table: Tensor  #: 4 numbers for each cut: see `kernels.scene`
    targets: Tensor  #: pixel that each cut moves; negative where it has no gradient


@dataclass(frozen=True)
class Trace:
    """What the gradients need to know of a drawing."""

    scene: Any  #: the items as the kernels read them: `kernels.scene.Items`
    near_face: Tensor  #: face that is seen first (items, h, w); unset where not covered
    far_face: Tensor  #: face that is seen last (items, h, w); unset where not covered
    cuts: tuple[Cuts, ...]
