"""Depth of the reference picture, brought to the scale of the room.

A network's depth is off as a whole: metric networks by a factor, relative ones (inverse depth) by a
factor and a shift. Both are fitted to what is known of the room: the drawn surfaces of the objects
where they stand now, and the floor in front of them. Robust, so that an object that stands wrong
does not pull the others, but bears the difference.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.devices import lstsq
from mover.core.records import record
from mover.core.types import Camera, DepthImage, Layout, Objects
from mover.energy.image_terms import Measured
from mover.energy.objective import ImageCues
from mover.geometry.camera import to_world
from mover.geometry.crops import sample_nearest
from mover.geometry.placement import place_in
from mover.geometry.raster import Topology, look

SPREAD = 0.06  # published errors of metric networks indoors (AbsRel on NYUv2: .05 to .06)
SCALE = 0.1  # standard deviation of the logarithm of a metric network's factor from room to room
STRIP = 0.06  # of the picture's height: how far in front of an object the floor is looked at
FEWEST = 20  # pixels of an object, or of the floor, that count
MOST = 200  # pixels of each that are looked at
ROUNDS = 10  # of the robust fit
VARIED = 0.02  # of its mean: an inverse depth that varies less is no evidence
LEAST = 3  # objects and strips of floor that a scale with a shift needs


@record
class DepthImageInputs:
    """A measured picture, and the room as it is known."""

    depth: DepthImage
    image: ImageCues
    objects: Objects
    camera: Camera
    ground: float
    layout: Layout
    """Where the objects stand now."""
    hidden: Bool[Tensor, "h w"]
    """Objects and people in the picture: no floor is seen there."""


@record
class References:
    """Pixels whose depth is known of the room; those of one object or strip weigh one."""

    known: Float[Tensor, " pixels"]
    """[m]"""
    measured: Float[Tensor, " pixels"]
    """As the file has it."""
    weight: Float[Tensor, " pixels"]


def gather_depth(inputs: DepthImageInputs) -> Measured | None:
    """The measured depth in the windows of the objects [m]; None: its scale is unknown."""
    values = inputs.depth.values.nan_to_num(0.0)
    windows = sample_nearest(values, inputs.image.views, inputs.camera.K, 0.0)
    found = _references(inputs, values, windows)
    if not len(found.known):
        return None
    spread = torch.full((len(windows),), SPREAD)
    if inputs.depth.metric:
        return Measured(windows * math.exp(_factor(found)), spread)
    fitted = _line(found)
    if fitted is None:
        return None
    inverse = fitted[0] * windows + fitted[1]
    there = (windows > 0) & (inverse > 0)
    return Measured(torch.where(there, 1 / inverse.clamp_min(1e-3), 0.0), spread)


def _references(inputs: DepthImageInputs, values: Tensor, windows: Tensor) -> References:
    """Drawn surfaces within the masks, and the floor in front of the objects."""
    objects, image, camera = inputs.objects, inputs.image, inputs.camera
    verts = place_in(objects.verts, inputs.layout, camera.R_cam_world)
    seen = look(verts, Topology(objects.faces, objects.edges), image.views, depth=True)[1]
    assert seen is not None
    inside = seen.covered & (image.masks > 0.5) & (windows > 0)
    parts = [(seen.nearest[k][inside[k]], windows[k][inside[k]]) for k in range(len(windows))]
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in values.shape), indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(camera.K).mT
    down = to_world(rays, camera.R_cam_world)[..., 1]
    floor = torch.where(down < -0.02, inputs.ground / down.clamp_max(-0.02), 0.0)  # its depth [m]
    free = (floor > 0) & (values > 0) & ~inputs.hidden
    for box in image.boxes:
        x0, x1 = (round(float(v)) for v in box[[0, 2]].clamp(0, camera.width))
        y0 = round(float(box[3])) + 2
        strip = slice(y0, y0 + round(STRIP * camera.height)), slice(x0, x1)
        parts.append((floor[strip][free[strip]], values[strip][free[strip]]))
    few = [(k[:: 1 + len(k) // MOST], v[:: 1 + len(v) // MOST]) for k, v in parts]
    few = [part for part in few if len(part[0]) >= FEWEST] or [(values.new_zeros(0),) * 2]
    weights = [torch.full_like(known, 1 / max(1, len(known))) for known, _ in few]
    known, measured = (torch.cat([part[k] for part in few]) for k in (0, 1))
    return References(known.detach(), measured, torch.cat(weights))


def _factor(found: References) -> float:
    """Logarithm of the factor between the room and what was measured."""
    off = found.known.log() - found.measured.log()
    order, count = off.argsort(), float(found.weight.sum())
    share = found.weight[order].cumsum(0) / found.weight.sum()
    middle = float(off[order][int((share < 0.5).sum())])
    return middle * count / (count + (SPREAD / SCALE) ** 2)


def _line(found: References) -> tuple[float, float] | None:
    """Factor and shift of an inverse depth, by reweighted squares; None: too little evidence."""
    flat = float(found.measured.std()) < VARIED * float(found.measured.abs().mean())
    if flat or float(found.weight.sum()) < LEAST - 0.5:
        return None
    target, weight = 1 / found.known, found.weight * found.known.square()
    row = torch.stack([found.measured, torch.ones_like(found.measured)], -1).double()
    line = row.new_zeros(2)
    for _ in range(ROUNDS):
        left = (row * weight.double()[:, None]).mT
        line = lstsq(left @ row, left @ target.double())
        off = (row @ line - target) * found.known / SPREAD
        weight = found.weight * found.known.square() / (1 + off.square()).float()
    factor, shift = line.tolist()
    return (factor, shift) if factor > 0 else None
