"""What the rasterisers read and write: windows, padded triangles, depth maps of surfaces."""

from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..records import record


@record
class Views:
    """Pinhole windows of one size, one for each item."""

    K: Float[Tensor, "items 3 3"]
    """Intrinsics of each window [px of the window]; no skew."""
    height: int
    """Rows of each window [px]."""
    width: int
    """Columns of each window [px]."""


@record
class Topology:
    """Padded triangles of closed meshes, counter-clockwise seen from outside."""

    faces: Int[Tensor, "items faces 3"]
    """Vertices of each triangle; padding is (0, 0, 0)."""
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
