"""Masks of people and of a smaller image: whose they are, and what they imply of depth."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import interpolate

from mover.core.types import Bodies, Camera, Masks, People
from mover.energy.image_terms import WIDTH
from mover.geometry.camera import project
from mover.geometry.crops import depth_in
from mover.geometry.raster import Crops, fronts
from mover.geometry.rle import decode, thinned
from mover.geometry.warp_start import mapped


@dataclass(frozen=True)
class MaskTable:
    """Rows of `people` for each body: its own mask, and those of the others in its frame."""

    masks: Masks
    own: tuple[int | None, ...]
    """None: the track has no mask in that frame, so the body says nothing about depth."""
    others: tuple[tuple[int, ...], ...]

    def decode(self, body: int) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
        """The visible mask of a body, and the union of the other people's."""
        own, size = self.own[body], (self.masks.height, self.masks.width)
        counts = tuple(self.masks.counts[row] for row in self.others[body])
        visible = torch.zeros(size, dtype=torch.bool) if own is None else decode(self.masks, own)
        return visible, pixels_of(Masks(*size, counts))


def pixels_of(masks: Masks) -> Bool[Tensor, "h w"]:
    """The pixels that are in any of some masks."""
    found = torch.zeros(masks.height, masks.width, dtype=torch.bool)
    for row in range(len(masks.counts)):
        found = found | decode(masks, row)
    return found


def mask_table(people: People, bodies: Bodies) -> MaskTable:
    """Match masks with bodies by frame and track."""
    row_of: dict[tuple[int, int], int] = {}
    in_frame: dict[int, list[int]] = {}
    masked = zip(people.frame.tolist(), people.person.tolist(), strict=True)
    for row, (frame, person) in enumerate(masked):
        row_of[frame, person] = row
        in_frame.setdefault(frame, []).append(row)
    frames, persons = bodies.frame.tolist(), bodies.person.tolist()
    own = tuple(row_of.get(key) for key in zip(frames, persons, strict=True))
    others = tuple(
        tuple(row for row in in_frame.get(frame, ()) if row != mine)
        for frame, mine in zip(frames, own, strict=True)
    )
    return MaskTable(people.masks, own, others)


WHOLE = 0.01  # of the body's picture may be covered by objects or others, and no more
UPRIGHT = 1.8  # times as high as wide
HEAD = 0.125  # of the height
HIGH = 100.0  # [px]; of smaller people a pixel is more than a percent
GAUSS = 1.4826  # standard deviation over the median of absolute deviations


@dataclass(frozen=True)
class Extents:
    """What the heights of one person say."""

    factor: float
    """True depth over the given one."""
    spread: float
    """Standard deviation of `factor`."""
    frames: int
    """How many showed the person wholly."""


def compare_extents(
    bodies: Bodies,
    rows: Int[Tensor, " rows"],
    camera: Camera,
    table: MaskTable,
    blocked: Callable[[int], Bool[Tensor, "h w"]],
) -> Extents | None:
    """Compare the heights of a person's wholly seen bodies with those of their masks.

    factor = median over frames of (h_body - w_body) / (h_mask - w_mask), w of the head: a mask that
    is too wide all round cancels. Blocked pixels are of what may hide people in a frame (ours).

    Returns:
        None if no person is seen wholly, upright and high enough.
    """

    def ratio(row: int) -> float:
        """Height of the body over that of its mask; NaN where they constrain nothing."""
        verts = bodies.verts[row]
        pixels = project(verts, camera.K.to(verts))
        last = pixels.new_tensor([camera.width - 2, camera.height - 2])
        if not bool((verts[:, 2] > 0).all() & ((pixels > 2) & (pixels < last)).all()):
            return math.nan
        (x, y), (right, bottom) = pixels.amin(0).long().tolist(), pixels.amax(0).long().tolist()
        at = slice(y - 1, bottom + 2), slice(x - 1, right + 2)  # nothing else is looked at
        K = camera.K.float().clone()
        K[:2, 2] -= K.new_tensor([at[1].start, at[0].start])
        views = Crops(K[None], *(span.stop - span.start for span in at))
        drawn = fronts(verts[None].float(), bodies.faces, views).isfinite()[0]
        high, wide = _extent(drawn)
        if high <= UPRIGHT * wide:
            return math.nan
        own, others = table.decode(row)
        covered = drawn & (blocked(int(bodies.frame[row]))[at] | others[at]) & ~own[at]
        if covered.sum() > WHOLE * drawn.sum() or min(high, _extent(own)[0]) < HIGH:
            return math.nan
        body, mask = high - _thick(drawn), _extent(own)[0] - _thick(own)
        return body / mask if mask > 0 else math.nan

    ratios = mapped(ratio, rows.tolist())
    found = torch.tensor([r for r in ratios if math.isfinite(r)], dtype=torch.float64)
    if not len(found):
        return None
    middle = found.median()
    off = GAUSS * float((found - middle).abs().median())
    return Extents(float(middle), 1.25 * off / len(found) ** 0.5, len(found))


def _extent(mask: Bool[Tensor, "h w"]) -> tuple[float, float]:
    """Height and width of what is set [px]."""
    ends = [torch.nonzero(mask.any(axis))[:, 0] for axis in (1, 0)]
    high, wide = (float(e[-1] - e[0] + 1) if len(e) else 0.0 for e in ends)
    return high, wide


def _thick(mask: Bool[Tensor, "h w"]) -> float:
    """Width of the head [px]: of the largest disc in the top of what is set."""
    rows = torch.nonzero(mask.any(1))[:, 0]
    if not len(rows):
        return 0.0
    high = int(rows[-1] - rows[0]) + 1
    top = mask[rows[0] : rows[0] + max(3, round(HEAD * high))]
    padded = torch.nn.functional.pad(top, [1, 1, 1, 0])
    return 2 * float(depth_in(padded.numpy()).max()) - 1


COVERED = 0.05  # of a pixel of the smaller picture, from which it counts as covered
MARGINS = 9  # borders from one pixel too narrow to one pixel too wide are tried


def small(mask: Bool[Tensor, "h w"], width: int) -> Float[Tensor, "small_h small_w"]:
    """Share of each pixel of a smaller picture that is set."""
    height = max(1, round(mask.shape[0] * width / mask.shape[1]))
    return interpolate(mask[None, None].float(), (height, width), mode="area")[0, 0]


def uncovered(mask: Bool[Tensor, "h w"], width: int) -> Bool[Tensor, "small_h small_w"]:
    """The pixels of a smaller picture in which next to nothing is set."""
    return small(mask, width) < COVERED


def overlaps(
    drawn: Bool[Tensor, "items h w"], mask: Float[Tensor, "h w"], known: Bool[Tensor, "h w"]
) -> Float[Tensor, " items"]:
    """Intersection over union with the mask, in the known pixels, at the best width of its border.

    A mask that is two pixels too wide all around looks like a person who is 3 % nearer, were it
    not that arms and legs grow by as much as the whole body.
    """
    where = known.flatten().nonzero()[:, 0]
    inside = mask.flatten()[where]
    images = drawn, _grown(drawn), ~_grown(~drawn)
    exact, wide, narrow = (x.flatten(1).index_select(1, where).float() for x in images)
    best = torch.zeros(len(drawn)).to(mask)
    for margin in torch.linspace(-1, 1, MARGINS).tolist():  # a few; all at once is much memory
        part = exact + abs(margin) * ((wide if margin > 0 else narrow) - exact)
        both, either = torch.minimum(part, inside).sum(1), torch.maximum(part, inside).sum(1)
        best = torch.maximum(best, both / either.clamp_min(1))
    return best


def _grown(image: Bool[Tensor, "items h w"]) -> Bool[Tensor, "items h w"]:
    """Each pixel or any of its four neighbours."""
    grown = image.clone()
    grown[:, 1:] |= image[:, :-1]
    grown[:, :-1] |= image[:, 1:]
    grown[:, :, 1:] |= image[:, :, :-1]
    grown[:, :, :-1] |= image[:, :, 1:]
    return grown


def thin(masks: Masks, row: int, step: int) -> Bool[Tensor, "h w"]:
    """Every `step`-th pixel of one of the masks."""
    return torch.from_numpy(thinned(masks, row, step).copy())


def enlarged(mask: Bool[Tensor, "h w"], times: int) -> Bool[Tensor, "big_h big_w"]:
    """Each pixel as a square of so many."""
    return mask.repeat_interleave(times, 0).repeat_interleave(times, 1)


def widened(masks: Bool[Tensor, "masks h w"], wide: int) -> Bool[Tensor, "masks h w"]:
    """Masks that reach so many pixels farther along both axes."""
    if not wide or not len(masks):
        return masks
    import cv2

    square, pixels = np.ones((2 * wide + 1, 2 * wide + 1), np.uint8), masks.cpu().numpy()
    grown = [cv2.dilate(one.astype(np.uint8), square) > 0 for one in pixels]
    return torch.from_numpy(np.stack(grown)).to(masks.device)


ALL = slice(None)


def small_views(camera: Camera) -> Crops:
    """The whole image as one window, at most 640 pixels wide."""
    zoom = min(1.0, WIDTH / camera.width)
    width, height = max(1, round(camera.width * zoom)), max(1, round(camera.height * zoom))
    zooms = torch.tensor([width / camera.width, height / camera.height, 1.0]).to(camera.K)
    return Crops((camera.K * zooms.unsqueeze(-1)).unsqueeze(0), height, width)


def small_camera(camera: Camera) -> Camera:
    """The camera of that image."""
    views = small_views(camera)
    return replace(camera, K=views.K[0], width=views.width, height=views.height)


def small_masks(
    masks: Bool[Tensor, "rows h w"], camera: Camera, window: tuple[slice, slice] = (ALL, ALL)
) -> Bool[Tensor, "rows sh sw"]:
    """A window of masks of that image, by their nearest pixel; as given, if they have its size."""
    views, (height, width) = small_views(camera), masks.shape[-2:]
    if (views.height, views.width) == (height, width):
        return masks[:, *window]
    rows = ((torch.arange(views.height) + 0.5) * height / views.height).long()
    columns = ((torch.arange(views.width) + 0.5) * width / views.width).long()
    return masks[:, rows[window[0]]][:, :, columns[window[1]]]


def small_boxes(boxes: Float[Tensor, "rows 4"], camera: Camera) -> Float[Tensor, "rows 4"]:
    """Boxes in that image [px]."""
    views = small_views(camera)
    zoom = [views.width / camera.width, views.height / camera.height]
    return boxes * boxes.new_tensor(zoom * 2)
