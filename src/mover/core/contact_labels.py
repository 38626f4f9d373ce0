"""Who touches what in each frame, where, and how sure that is."""

from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record


@record
class ContactLabels:
    """One row for each frame, person, part of the body and object that touch."""

    frame: Int[Tensor, " rows"]
    person: Int[Tensor, " rows"]
    part: Int[Tensor, " rows"]
    """Index into `parts`."""
    object: Int[Tensor, " rows"]
    """Index into `objects`."""
    position: Float[Tensor, "rows 3"]
    """On the surface of the object, in the world [m]."""
    normal: Float[Tensor, "rows 3"]
    """Out of the object there, a unit vector."""
    gap: Float[Tensor, " rows"]
    """From the surface to the nearest vertex of the part [m]; negative: the part is inside."""
    confidence: Float[Tensor, " rows"]
    """From 0 to 1: how near it is, and whether the posture bears on it."""
    parts: tuple[str, ...]
    objects: tuple[str, ...]
    """Ids of the scene's objects; the last is `ground`, the floor."""
