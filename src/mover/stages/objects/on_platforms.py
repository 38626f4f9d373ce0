"""What stands on a platform: on its top, not on the plane of the floor.

An image tells the ray to the base of an object; how far away it is follows from the height at which
it stands. One that would be inside the platform if it stood on the plane, stands on the top; one
that would be behind it does where the given scene has it nearer to the height of the top.
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from mover.core.types import Layout, Objects
from mover.furniture.floor import is_platform
from mover.geometry.boxes import Box, beyond
from mover.geometry.placement import GROUND, slide_to_floor


def platforms_of(objects: Objects) -> Bool[Tensor, " objects"]:
    """The objects that people step onto and that stand on the plane of the floor."""
    stepped = torch.tensor([is_platform(name) for name in objects.categories], dtype=torch.bool)
    return stepped & (objects.supports == GROUND)


def supports_with_platforms(
    objects: Objects, layout: Layout, given: Layout, ground: float
) -> Int[Tensor, " objects"]:
    """What carries each object, as in `Objects.supports`, by where it was placed on the plane.

    Args:
        objects: As they were given.
        layout: Where the image places them on the floor.
        given: Where the first scene has them in the same world; its heights count.
        ground: Height of the plane [m].
    """
    found, base = objects.supports.clone(), layout.t_world_object
    platforms = platforms_of(objects)
    size = objects.size * layout.log_scale.exp()
    for index in platforms.nonzero()[:, 0].tolist():  # few
        top = ground + size[index, 1]
        under = Box(base[index], size[index], layout.yaw[index])
        raised = base * (top / base[:, 1:2].clamp_max(-1e-3))
        over = (beyond(under, raised) < 0).all(-1)
        inside = (beyond(under, base) < 0).all(-1)
        high = given.t_world_object[:, 1] > (ground + top) / 2
        found[over & (inside | high) & (found == GROUND) & ~platforms] = index
    return found


def stood(
    layout: Layout, objects: Objects, ground: float, pinned: Bool[Tensor, " objects"]
) -> Layout:
    """Loose objects moved along their rays onto the floor, or onto the platform under them."""
    level = slide_to_floor(layout, ground, (objects.supports == GROUND) & ~pinned)
    carrier = objects.supports.clamp_min(0)
    raised = platforms_of(objects)[carrier] & (objects.supports >= 0) & ~pinned
    if not bool(raised.any()):
        return level
    height = objects.size[:, 1] * level.log_scale[..., 1].exp()
    return slide_to_floor(level, ground + height[..., carrier], raised)
