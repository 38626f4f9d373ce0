"""Put seats where their contacts are, before people have their say in the descent.

`by_release` is the authors' re-initialisation. Chairs and sofas that people touch are turned so
that they face as their sitters do, moved to the mean of their contact points, and resized with
their distance; untouched chairs with more than 500 pixels that are bounded from both sides move to
the middle. (The release inverts its sigmoid wrongly, which shrinks every such piece by 10-13 %; not
here.) `contact_start` gives the robust preset one more candidate for used seats.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..energy import HumanCues
from ..geometry.camera import to_camera
from ..geometry.rotations import rot_y, wrap
from ..minimize import Observer, silent
from ..records import record
from ..terms.contact import Touches
from ..terms.factors import CHAIRS
from ..types import Camera, Layout, Objects

BOUNDED = 500.0  # pixels (of an image 640 wide) bounded from both sides


@dataclass(frozen=True)
class ReinitConfig:
    """Whether the authors' re-initialisation is done."""

    use: bool = False
    """True in `release`."""
    span: float = 0.8
    """Scales stay within 1 +- span/2."""
    chair_span: float = 0.6
    """The same for chairs."""


@record
class ReinitInputs:
    """The room after the image-only stage, and what people say."""

    objects: Objects
    camera: Camera
    humans: HumanCues
    masks: Float[Tensor, "objects h w"]
    layout: Layout


def by_release(inputs: ReinitInputs, config: ReinitConfig, observe: Observer = silent) -> Layout:
    """The layout with used seats re-initialised; unchanged if `use` is off."""
    del observe
    layout, touches = inputs.layout, inputs.humans.touches
    if not config.use:
        return layout
    t, yaw, log_scale = layout.t_world_object.clone(), layout.yaw.clone(), layout.log_scale.clone()
    used = [] if touches is None else touches.object_of.tolist()
    for i, category in enumerate(inputs.objects.categories):
        if category not in (*CHAIRS, "sofa"):
            continue
        if touches is not None and i in used:
            place, turn = _at_contacts(touches, used.index(i), layout, i)
            yaw[i] = wrap(yaw[i] + turn)
        else:
            place = _between_bounds(inputs, i)
        if category == "sofa" and i not in used:
            continue
        ratio = place[[0, 2]].norm() / t[i, [0, 2]].norm().clamp_min(1e-6)
        half = (config.chair_span if category != "sofa" else config.span) / 2
        scale = (log_scale[i].exp() * ratio).clamp(1 - 0.98 * half, 1 + 0.98 * half)
        log_scale[i], t[i] = scale.log(), torch.stack([place[0], t[i, 1], place[2]])
    return Layout(t, yaw, log_scale)


def _at_contacts(touches: Touches, k: int, layout: Layout, i: int) -> tuple[Tensor, Tensor]:
    """Mean of the contact points, and the turn towards the sitters' heading."""
    weight = touches.weight[k].flatten()
    mean = (touches.points[k].flatten(0, 1) * weight.unsqueeze(-1)).sum(0) / weight.sum().clamp_min(
        1e-9
    )
    x, z = touches.heading[k].unbind()
    turn = torch.where(
        x.abs() + z.abs() > 0, torch.atan2(x, z) - layout.yaw[i], torch.zeros_like(x)
    )
    return mean, turn


def _between_bounds(inputs: ReinitInputs, i: int) -> Tensor:
    """Place of an unused chair whose depth is bounded from both sides; else where it is."""
    here = inputs.layout.t_world_object[i]
    depth = inputs.humans.depth
    if depth is None or inputs.objects.categories[i] not in CHAIRS:
        return here
    both = depth.near[i].isfinite() & depth.far[i].isfinite() & (inputs.masks[i] > 0.5)
    if float(both.sum() * depth.area[i]) <= BOUNDED:
        return here
    middle = ((depth.near[i] + depth.far[i]) / 2)[both].mean()
    now = to_camera(here, inputs.camera.R_cam_world)[2].clamp_min(0.1)
    return here * (middle / now)


def contact_start(layout: Layout, objects: Objects, touches: Touches | None) -> Layout:
    """Candidates of all objects: used seats under their sitters and facing as they do."""
    if touches is None:
        return layout
    t, yaw = layout.t_world_object.clone(), layout.yaw.clone()
    for k, i in enumerate(touches.object_of.tolist()):
        x, z = touches.heading[k].unbind()
        weight = touches.weight[k, 0]
        if (
            not bool(objects.is_seat[i])
            or float(weight.sum()) == 0
            or float(x.abs() + z.abs()) == 0
        ):
            continue
        yaw[i] = torch.atan2(x, z)
        contact = (touches.points[k, 0] * weight.unsqueeze(-1)).sum(0) / weight.sum()
        seat = rot_y(yaw[i]) @ (objects.top[i].mean(0) * layout.log_scale[i].exp())
        t[i] = torch.stack([contact[0] - seat[0], t[i, 1], contact[2] - seat[2]])
    return Layout(t, yaw, layout.log_scale)
