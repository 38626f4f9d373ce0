"""Gather what the people say, once, over all frames (Sec. 3.1).

Bodies are drawn in threads, and one set of depth bounds is kept: the cost of placing the objects
does not grow with the video.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextvars import copy_context
from dataclasses import dataclass, replace
from functools import cached_property
from threading import Lock

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.observe import Observer, Step, silent
from mover.core.records import record, to_device
from mover.core.types import STILL, Bodies, Camera, CameraPath, People
from mover.energy.human_terms import (
    BodySpace,
    BodyView,
    ContactPoints,
    DepthMaps,
    DepthRange,
    bounds_of,
    merge,
)
from mover.energy.image_terms import WIDTH
from mover.energy.objective import HumanCues
from mover.geometry.camera import to_camera
from mover.geometry.crops import sample_nearest
from mover.geometry.path import is_still, poses_at, resampled
from mover.geometry.raster import Crops, layers
from mover.geometry.thinning import coarser
from mover.geometry.volume import grid_around
from mover.geometry.volume_warp import union_bodies
from mover.stages.config import GatherConfig
from mover.stages.masks import (
    MaskTable,
    mask_table,
    small_camera,
    small_masks,
    small_views,
)

NEAREST = 0.3  # [m], bodies are taken to be at least that far when pixels become metres
ASIDE = 3  # [px] around known objects in which what hides people may be one of them
PADDING = 0.2  # [m], space around the bodies in the volume
WORKERS = 2  # threads that draw and measure; the result does not depend on it
BESIDE = 0.25  # [m] between a moving camera and that of the image, within which its frame shows who
# hides whom: from farther away another object may be in between
FACES = 4000  # of a body in the volume: an adult's skin is within 1 mm of them in the mean
BLOCK = 4  # bodies that a thread draws at once

Window = tuple[slice, slice]


@dataclass(frozen=True)
class PeopleView:
    """The people, the objects and where they are seen from."""

    bodies: Bodies
    table: MaskTable
    masks: Bool[Tensor, "objects h w"]
    """Of the objects, in the image 640 wide; on the CPU."""
    camera: Camera
    erode: int
    """Pixels by which masks and silhouettes shrink."""
    vote: bool
    """See `human_terms.bounds_of`."""
    reach: float = 0.0
    """How far the outline of a body may be wrong [m]."""
    path: CameraPath = STILL
    """Of the cameras that saw the people, in the axes of this one."""

    @cached_property
    def observed_rows(self) -> list[int]:
        """Bodies that have a mask and were seen from here."""
        away = poses_at(self.path, self.bodies.frame).t_reference_camera.norm(dim=-1)
        near = (away <= BESIDE).tolist()
        return [row for row, own in enumerate(self.table.own) if own is not None and near[row]]

    def seen(
        self, row: int, window: Window, front: Float[Tensor, "h w"]
    ) -> tuple[Bool[Tensor, "rows columns"], Bool[Tensor, "rows columns"]]:
        """The visible mask of a body and those of others, as if this camera had seen them."""
        masks = self.table.decode(row)
        if is_still(self.path):
            own, others = (small_masks(mask[None], self.camera, window)[0] for mask in masks)
            return own, others
        whole = [small_masks(mask[None], self.camera)[0] for mask in masks]
        pose = poses_at(self.path, self.bodies.frame[row : row + 1])
        depth = torch.where(front.isfinite(), front, front[front.isfinite()].median())
        K = small_camera(self.camera).K
        own, others = resampled(torch.stack(whole), depth[window], (K, window), pose)
        return own, others

    @cached_property
    def spans(self) -> tuple[tuple[int, int, int, int], ...]:
        """First row and the one after the last of each object, and the same of its columns."""
        return tuple((*_ends(mask.any(1)), *_ends(mask.any(0))) for mask in self.masks)

    def meeting(self, window: Window) -> list[int]:
        """The objects that may have a pixel in a window."""
        rows, columns = window
        return [
            k
            for k, (top, end, left, right) in enumerate(self.spans)
            if top < rows.stop and rows.start < end
            if left < columns.stop and columns.start < right
        ]


def gather_depth(
    sight: PeopleView, workers: int, observe: Callable[[int, int], None] | None = None
) -> DepthMaps:
    """The narrowest bounds of all frames; they do not depend on the number of workers.

    Memory is that of a few frames for each worker, however many frames there are. Bodies whose
    track has no mask give no bounds. Bodies are drawn where their vertices are; the maps are on the
    CPU.
    """
    views = small_views(sight.camera)
    blank, lock = torch.full((views.height, views.width), float("inf")), Lock()
    maps = DepthMaps(-blank, blank)
    rows = sight.observed_rows

    def add(block: list[int]) -> int:
        for window, found in _bounds(sight, block):
            with lock:  # the least and the greatest do not depend on the order
                before = DepthMaps(maps.near[window], maps.far[window])
                kept = merge(before, found)
                maps.near[window], maps.far[window] = kept.near, kept.far
        return len(block)

    done = 0
    with ThreadPoolExecutor(max(workers, 1)) as pool:
        blocks = [rows[first : first + BLOCK] for first in range(0, len(rows), BLOCK)]
        for job in as_completed([pool.submit(copy_context().run, add, block) for block in blocks]):
            done += job.result()
            if observe is not None:
                observe(done, len(rows))
    return maps


def _bounds(sight: PeopleView, block: list[int]) -> Iterator[tuple[Window, DepthMaps]]:
    """Where each of some bodies is seen, and its bounds there."""
    views = small_views(sight.camera)
    verts = to_camera(sight.bodies.verts[torch.tensor(block)], sight.camera.R_cam_world)
    many = replace(views, K=views.K.expand(len(block), 3, 3))
    drawn = to_device(layers(verts, sight.bodies.faces, many), "cpu")  # where the masks are
    for k, row in enumerate(block):
        window = _window(drawn.front[k] < float("inf"), sight.erode)
        visible, others = sight.seen(row, window, drawn.front[k])
        reach = sight.reach
        if reach > 0:
            reach *= float(views.K[0, 0, 0] / verts[k, :, 2].median().clamp_min(NEAREST))
        seen = BodyView(drawn.front[k][window], drawn.exit[k][window], visible, others, reach)
        objects = sight.masks[sight.meeting(window)][:, *window]
        yield window, bounds_of(seen, objects, sight.erode, vote=sight.vote)


def _window(body: Bool[Tensor, "h w"], border: int) -> Window:
    """Rows and columns of a silhouette and a border, so that its masks shrink as in the image."""
    first, last = _ends(body.any(1))
    left, right = _ends(body[first:last].any(0))
    rows = slice(max(first - border, 0), min(last + border, body.shape[0]))
    return rows, slice(max(left - border, 0), min(right + border, body.shape[1]))


def _ends(line: Bool[Tensor, " n"]) -> tuple[int, int]:
    """First place that is set, and the one after the last; zeros where none is."""
    index = torch.nonzero(line)[:, 0]
    return (int(index[0]), int(index[-1]) + 1) if len(index) else (0, 0)


@record
class GatherInputs:
    """People and masks."""

    bodies: Bodies
    """The selected bodies, in the world."""
    people: People | None
    masks: Bool[Tensor, "objects h w"]
    """Of the objects in the clean image; empty where only the box is known."""
    camera: Camera
    path: CameraPath = STILL
    """Of the cameras that saw the people, in the axes of this one [m]."""


@record
class Cues:
    """The evidence of all frames, still in the image."""

    maps: DepthMaps | None
    space: BodySpace
    near_pixels: tuple[int, ...]
    far_pixels: tuple[int, ...]
    """Bounded pixels (of an image 640 wide) inside each object's mask."""


def gather_cues(inputs: GatherInputs, config: GatherConfig, observe: Observer = silent) -> Cues:
    """Two depth maps and one distance volume from all frames."""
    masks = small_masks(inputs.masks, inputs.camera).cpu()
    maps = _depth_maps(inputs, config, observe)
    near = far = torch.zeros(len(masks))
    if maps is not None:
        near = (masks & maps.near.isfinite()).sum((-2, -1))
        far = (masks & maps.far.isfinite()).sum((-2, -1))
    whole = [tuple(int(v) for v in row.tolist()) for row in (near, far)]
    return Cues(maps, _space(inputs, config, observe), whole[0], whole[1])


def cues_in_windows(
    cues: Cues, touches: ContactPoints | None, views: Crops, camera: Camera
) -> HumanCues:
    """The evidence as the terms want it: depth bounds sampled in the objects' windows."""
    depth = None
    if cues.maps is not None:
        K = small_camera(camera).K
        lowest = float("-inf")
        scale = WIDTH / camera.width * camera.K[0, 0] / views.K[:, 0, 0]
        depth = DepthRange(
            sample_nearest(cues.maps.near, views, K, lowest),
            sample_nearest(cues.maps.far, views, K, -lowest),
            scale.square(),
        )
    return HumanCues(depth, cues.space, touches)


def _depth_maps(inputs: GatherInputs, config: GatherConfig, observe: Observer) -> DepthMaps | None:
    if inputs.people is None:
        return None
    masks = small_masks(inputs.masks, inputs.camera).cpu()
    return gather_depth(
        _sight(inputs, masks, config),
        WORKERS,
        lambda done, of: observe(Step("gather_cues: depth", done, of)),
    )


def _sight(
    inputs: GatherInputs, masks: Bool[Tensor, "objects h w"], config: GatherConfig
) -> PeopleView:
    """What is drawn of the people, against some masks of the image 640 wide."""
    assert inputs.people is not None, "people have masks"
    table = mask_table(inputs.people, inputs.bodies)
    return PeopleView(
        inputs.bodies, table, masks, inputs.camera, config.erode, config.vote, config.reach,
        inputs.path,
    )  # fmt: skip


def _space(inputs: GatherInputs, config: GatherConfig, observe: Observer) -> BodySpace:
    flat = inputs.bodies.verts.flatten(1)  # long rows first: eight times as fast
    low, high = (end.view(-1, 3) for end in (flat.amin(0), flat.amax(0)))
    grid = grid_around(low.amin(0), high.amax(0), config.cells, PADDING)
    volume = union_bodies(
        *coarser(inputs.bodies.verts, inputs.bodies.faces, FACES),
        grid,
        WORKERS,
        lambda done, of: observe(Step("gather_cues: free space", done, of)),
    )
    return BodySpace(volume)
