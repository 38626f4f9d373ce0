"""What the clean image says about each object: its box, its mask, and what is unknown."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.types import Camera, Capture, Masks
from mover.energy.image_terms import LEAST, LIKELY, SEEN, UNKNOWN, borders_of
from mover.energy.objective import ImageCues
from mover.geometry.crops import Region, area_mean, crop_views, regions, share_inside
from mover.geometry.rle import decode
from mover.geometry.warp_start import mapped
from mover.stages.config import ImageConfig
from mover.stages.masks import pixels_of
from mover.stages.objects.prepare_objects import Prepared


@record
class ObjectDetections:
    """The detections of the objects, in the order of the scene."""

    boxes: Float[Tensor, "objects 4"]
    """x_min, y_min, x_max, y_max [px]; the whole image where there is no detection."""
    detected: Bool[Tensor, " objects"]
    masks: Bool[Tensor, "objects h w"]
    """Empty where only the box is known."""
    people: Bool[Tensor, "h w"]
    """People in the reference image."""


def image_evidence(capture: Capture) -> ObjectDetections:
    """Line the detections up with the objects of the scene."""
    camera, pieces = capture.scene.camera, capture.scene.objects
    by_id = {d.id: d for d in capture.detections}
    found = [by_id.get(-1 if p.annotation is None else p.annotation) for p in pieces]
    whole = torch.tensor([0.0, 0.0, camera.width, camera.height])
    blank = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    masks = [blank if d is None or d.mask is None else decode(d.mask, 0) for d in found]
    return ObjectDetections(
        torch.stack([whole if d is None else d.box for d in found]) if found else torch.zeros(0, 4),
        torch.tensor([d is not None for d in found], dtype=torch.bool),
        torch.stack(masks) if masks else blank.expand(0, -1, -1),
        people_in_reference(capture),
    )


def people_in_reference(capture: Capture) -> Bool[Tensor, "h w"]:
    """Where people are in the reference image."""
    camera, people = capture.scene.camera, capture.reference_people
    return pixels_of(Masks(camera.height, camera.width, ()) if people is None else people)


def ground_without_people(capture: Capture, prepared: Prepared) -> float:
    """Height of the floor where no foot is seen: given, or under the median object [m]."""
    if capture.camera_height is not None:
        return -capture.camera_height
    if capture.scene.ground is not None:
        return capture.scene.ground
    return float(prepared.start.t_world_object[:, 1].median())


BORDER = 1.5  # [px], a side this close to the image's border is cut by it
STRIP = 0.06  # of the box's size: how far beyond a side one looks for what may hide it
GAP = 0.02  # of the image's width: two cells of a coarse mask, by which masks of neighbours part
BASE = 0.02  # of the image's height, within which bases are equally high
SHARED = 0.01  # of the image's width that two objects share at least, to be compared
MOST = 0.8  # of these columns in which one of them is lower
MARGIN = 0.3  # of the box's larger side: how much a window is larger than the box (PHOSA)


@record
class ImageInputs:
    """The detections of the objects, in their order."""

    camera: Camera
    boxes: Float[Tensor, "objects 4"]
    """x_min, y_min, x_max, y_max [px]; the whole image where there is no detection."""
    seen: Bool[Tensor, " objects"]
    """False where an object has no annotation."""
    masks: Bool[Tensor, "objects h w"]
    """Empty where only the box is known."""
    people: Bool[Tensor, "h w"]
    """People in the reference image."""
    behind: Bool[Tensor, "objects objects"]
    """[i, j]: object j is known to stand behind object i, so it cannot hide it."""
    distance: Float[Tensor, " objects"] | None = None
    """From the camera to the middle of each base in the initial scene [m]."""


def find_image_cues(
    inputs: ImageInputs, config: ImageConfig, observe: Observer = silent
) -> ImageCues:
    """Cut a square window around each box; mark what other objects, people or the border hide."""
    del observe
    K, size = inputs.camera.K, (inputs.camera.height, inputs.camera.width)
    views = crop_views(K, inputs.boxes, MARGIN, config.size)
    center = (inputs.boxes[:, :2] + inputs.boxes[:, 2:]) / 2
    side = (inputs.boxes[:, 2:] - inputs.boxes[:, :2]).amax(-1).clamp_min(2)
    strip = _strip_depth(inputs.boxes).clamp_min(GAP * inputs.camera.width)
    reach = 1 + (side * (1 + MARGIN) / 2).maximum(side / 2 + strip)
    at = regions(center, reach, size)  # nothing else of the picture is looked at
    others = _others(inputs, at)
    masks = [mask[region] for mask, region in zip(inputs.masks, at, strict=True)]
    own, hidden = mapped(lambda images: area_mean(images, at, views, K), [masks, others])
    inside = share_inside(views, K, size) > 0.999
    known = inputs.masks.any(-1).any(-1)[:, None, None]
    keep = (hidden < 1e-6) & inside & known
    sides = torch.where(inputs.seen, SEEN, UNKNOWN).unsqueeze(-1).expand(-1, 4)
    beside = borders = None
    if config.form == "robust":
        touched = _beside(inputs, others, at, 0.0)
        sides = torch.where(sides == SEEN, _sides(inputs, touched, config), sides)
        if config.bounded:
            near = _beside(inputs, others, at, GAP * inputs.camera.width)
            beside = torch.stack([touched, near], -1)
    if config.borders:
        zoom = views.K[:, 0, 0] / inputs.camera.K[0, 0]
        borders = borders_of(own, zoom, config.borders)
    return ImageCues(
        inputs.boxes, sides, views, own, keep, torch.ones(len(own)), inputs.distance, borders,
        beside=beside,
    )  # fmt: skip


def _others(inputs: ImageInputs, at: Sequence[Region]) -> list[Bool[Tensor, "_ _"]]:
    """Pixels of each object's region where something else is seen that may hide it."""
    found: list[Tensor] = []
    for i, region in enumerate(at):
        seen = inputs.people[region].clone()
        for j in (~inputs.behind[i]).nonzero()[:, 0].tolist():
            if j != i:
                seen |= inputs.masks[j][region]
        found.append(seen & ~inputs.masks[i][region])
    return found


def _sides(
    inputs: ImageInputs, touched: Float[Tensor, "objects 4"], config: ImageConfig
) -> Int[Tensor, "objects 4"]:
    """What is known of the sides of boxes, which the image's border or something else may cut off.

    A table's legs may be hidden where nothing is in front of most of its top's lower edge: a small
    share is enough.
    """
    size = inputs.boxes.new_tensor([inputs.camera.width, inputs.camera.height])
    low, high = inputs.boxes[:, :2] > BORDER, inputs.boxes[:, 2:] < size - BORDER
    inside, free = torch.cat([low, high], -1), touched < config.hidden
    return torch.where(inside, torch.where(free, SEEN, LIKELY if config.bounded else LEAST), LEAST)


def _strip_depth(boxes: Float[Tensor, "*items 4"]) -> Float[Tensor, "*items"]:
    """How far beyond a side one looks for what may hide it [px]."""
    return STRIP * (boxes[..., 2:] - boxes[..., :2]).clamp_min(1).prod(-1).sqrt().clamp_min(2)


def _beside(
    inputs: ImageInputs, others: Sequence[Bool[Tensor, "_ _"]], at: Sequence[Region], gap: float
) -> Float[Tensor, "objects 4"]:
    """Share of the strip beyond each side of the boxes in which something else is seen.

    With a gap, the least width of the strip [px]: share of the side that something is near to.
    """
    rows: list[Tensor] = []
    height, width = inputs.camera.height, inputs.camera.width
    for own, (down, across), box in zip(others, at, inputs.boxes, strict=True):
        depth = _strip_depth(box).clamp_min(gap)
        for side in range(4):  # left, top, right, bottom
            axis, strip = side % 2, box.clone()
            strip[axis], strip[axis + 2] = (
                (box[axis] - depth, box[axis]) if side < 2 else (box[side], box[side] + depth)
            )
            x0, y0, x1, y1 = (round(v) for v in strip.tolist())
            low, high = max(0, y0) - down.start, min(height, max(y1, y0 + 1)) - down.start
            first, last = max(0, x0) - across.start, min(width, max(x1, x0 + 1)) - across.start
            part = own[max(0, low) : max(0, high), max(0, first) : max(0, last)]
            if gap:
                part = part.any(1 - axis) if part.numel() else part
            rows.append(part.float().mean() if part.numel() else torch.zeros(()))
    return torch.stack(rows).reshape(len(inputs.boxes), 4)


def order_in_image(
    masks: Bool[Tensor, "objects h w"], people: Bool[Tensor, "h w"]
) -> Bool[Tensor, "objects objects"]:
    """[i, j]: object j stands behind object i, since its base is higher in the image.

    Of two objects on the floor the nearer one has the lower base. Where something else hides the
    base of j, or the border cuts it off, nothing is known. The top of a table reaches over a chair
    whose base is lower there, so both count: the columns that the two share, and the whole bases.

    Args:
        masks: Of the objects; empty where only the box is known.
        people: Pixels of people.
    """
    count, height, width = masks.shape
    rows = torch.arange(1, height + 1, dtype=torch.int32, device=masks.device)[:, None]
    lowest = torch.stack([(mask * rows).amax(0) for mask in masks])  # 0: none in this column
    base = lowest.amax(1)
    gap, slack = max(2, round(GAP * height)), BASE * height
    found = torch.zeros(count, count, dtype=torch.bool, device=masks.device)
    for j in range(count):
        at = lowest[j] > (base[j] - slack).clamp_min(0)
        if not bool(at.any()) or int(base[j]) > height - gap:
            continue
        under = slice(max(0, int(base[j] - slack)), int(base[j]) + gap)
        near = masks[:, under][:, :, at].flatten(1).any(1)  # what may hide its base
        near[j] = False
        if bool(people[under][:, at].any()) or int(near.sum()) > 1:
            continue
        for i in range(count):
            both = (lowest[i] > 0) & (lowest[j] > 0)
            if i == j or int(both.sum()) < SHARED * width or (bool(near.any()) and not near[i]):
                continue
            lower = lowest[i][both] > lowest[j][both] + slack
            found[i, j] = float(lower.float().mean()) > MOST and base[i] > base[j] + slack
    return found


def order_of(
    nearest: Float[Tensor, " objects"], farthest: Float[Tensor, " objects"], slack: float = 0.1
) -> Bool[Tensor, "objects objects"]:
    """[i, j]: all of object j is farther than all of object i by more than `slack` [m]."""
    return nearest.unsqueeze(0) > farthest.unsqueeze(1) + slack
