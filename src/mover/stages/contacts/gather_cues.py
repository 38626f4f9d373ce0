"""Gather what the people constrain, once, over all frames (Sec. 3.1).

Bodies are drawn in threads, and one set of depth bounds is kept: the cost of placing the objects
does not grow with the video.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextvars import copy_context
from dataclasses import replace
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
from mover.geometry.mesh import coarser
from mover.geometry.path import is_still, poses_at, resampled
from mover.geometry.raster import Crops, Topology, depths, layers
from mover.geometry.volume import grid_around, union_bodies
from mover.stages.config import GatherConfig
from mover.stages.masks import MaskTable, mask_table, small_camera, small_masks, small_views

NEAREST = 0.3  # [m], bodies are taken to be at least that far when pixels become metres
PADDING = 0.2  # [m], space around the bodies in the volume
WORKERS = 2  # threads that draw and measure; the result does not depend on it
BESIDE = 0.25  # [m] between a moving camera and that of the image, within which its frame shows who
# hides whom: from farther away another object may be in between
FACES = 3000  # of a body here: an adult's skin is within 1.5 mm of them in the mean
BLOCK = 4  # bodies that a thread draws at once

Window = tuple[slice, slice]


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

    def reported(part: str) -> Callable[[int, int], None]:
        return lambda done, of: observe(Step(f"gather_cues: {part}", done, of))

    verts, faces = coarser(inputs.bodies.verts, inputs.bodies.faces, FACES)
    bodies = replace(inputs.bodies, verts=verts, faces=faces, pose=None)
    maps, counts = None, [(0,) * len(inputs.masks)] * 2
    if inputs.people is not None:
        maps = depth_bounds(replace(inputs, bodies=bodies), config, WORKERS, reported("depth"))
        masks = small_masks(inputs.masks, inputs.camera).cpu()
        counts = [
            tuple(int(n) for n in (masks & bound.isfinite()).sum((-2, -1)))
            for bound in (maps.near, maps.far)
        ]
    flat = verts.flatten(1)  # long rows first: eight times as fast
    low, high = (end.view(-1, 3) for end in (flat.amin(0), flat.amax(0)))
    grid = grid_around(low.amin(0), high.amax(0), config.cells, PADDING)
    volume = union_bodies(verts, faces, grid, WORKERS, reported("free space"))
    return Cues(maps, BodySpace(volume), counts[0], counts[1])


def cues_in_windows(
    cues: Cues, touches: ContactPoints | None, views: Crops, camera: Camera
) -> HumanCues:
    """The evidence as the terms want it: depth bounds sampled in the objects' windows."""
    depth = None
    if cues.maps is not None:
        K, lowest = small_camera(camera).K, float("-inf")
        scale = WIDTH / camera.width * camera.K[0, 0] / views.K[:, 0, 0]
        depth = DepthRange(
            sample_nearest(cues.maps.near, views, K, lowest),
            sample_nearest(cues.maps.far, views, K, -lowest),
            scale.square(),
        )
    return HumanCues(depth, cues.space, touches)


def depth_bounds(
    inputs: GatherInputs,
    config: GatherConfig,
    workers: int,
    observe: Callable[[int, int], None] | None = None,
) -> DepthMaps:
    """The narrowest bounds of all frames; they do not depend on the number of workers.

    Memory is that of a few frames for each worker, however many frames there are. Bodies whose
    track has no mask, and those that were seen from far away, give no bounds. Bodies are drawn
    where their vertices are; the maps are on the CPU.
    """
    assert inputs.people is not None, "people have masks"
    table, views = mask_table(inputs.people, inputs.bodies), small_views(inputs.camera)
    blank = torch.full((views.height, views.width), float("inf"))
    maps, lock = DepthMaps(-blank, blank), Lock()
    objects = small_masks(inputs.masks, inputs.camera).cpu()
    near = poses_at(inputs.path, inputs.bodies.frame).t_reference_camera.norm(dim=-1) <= BESIDE
    pairs = enumerate(zip(table.own, near.tolist(), strict=True))
    rows = [row for row, (own, beside) in pairs if own is not None and beside]

    def add(block: list[int]) -> int:
        for window, found in _bounds(inputs, config, table, objects, block):
            with lock:  # the least and the greatest do not depend on the order
                kept = merge(DepthMaps(maps.near[window], maps.far[window]), found)
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


def _bounds(
    inputs: GatherInputs, config: GatherConfig, table: MaskTable, objects: Tensor, block: list[int]
) -> Iterator[tuple[Window, DepthMaps]]:
    """Where each of some bodies is seen before or behind objects, and its bounds there."""
    camera, views = inputs.camera, small_views(inputs.camera)
    verts = to_camera(inputs.bodies.verts[torch.tensor(block)], camera.R_cam_world)
    many = replace(views, K=views.K.expand(len(block), 3, 3))
    drawn = to_device(layers(verts, inputs.bodies.faces, many), "cpu")  # where the masks are
    leave = drawn.exit
    if config.near == "far side":
        faces = inputs.bodies.faces.expand(len(block), -1, -1)
        shape = Topology(faces, faces.new_zeros(len(block), 0, 4))
        seen = depths(verts, shape, many)
        leave = torch.where(seen.covered, seen.farthest, leave.to(seen.farthest)).cpu()
    for k, row in enumerate(block):
        front, body = drawn.front[k], drawn.front[k] < float("inf")
        first, last = _ends(body.any(1))
        left, right = _ends(body[first:last].any(0))
        edge = config.erode  # a border, so that masks shrink as in the whole image
        window = (
            slice(max(first - edge, 0), min(last + edge, views.height)),
            slice(max(left - edge, 0), min(right + edge, views.width)),
        )
        crossed = objects[:, *window]
        crossed = crossed[crossed.flatten(1).any(1)]
        if not len(crossed):
            continue
        visible, others = _masks_in(inputs, table, row, window, front)
        reach = config.reach
        if reach > 0:
            reach *= float(views.K[0, 0, 0] / verts[k, :, 2].median().clamp_min(NEAREST))
        view = BodyView(front[window], leave[k][window], visible, others, reach)
        yield window, bounds_of(view, crossed, config.erode, config.vote)


def _masks_in(
    inputs: GatherInputs, table: MaskTable, row: int, window: Window, front: Float[Tensor, "h w"]
) -> tuple[Bool[Tensor, "rows columns"], Bool[Tensor, "rows columns"]]:
    """The visible mask of a body and those of others, as if the image's camera had seen them."""
    masks, camera = torch.stack(table.decode(row)), inputs.camera
    if is_still(inputs.path):
        own, others = small_masks(masks, camera, window)
    else:
        pose = poses_at(inputs.path, inputs.bodies.frame[row : row + 1])
        depth = torch.where(front.isfinite(), front, front[front.isfinite()].median())[window]
        K = small_camera(camera).K
        own, others = resampled(small_masks(masks, camera), depth, (K, window), pose)
    return own, others


def _ends(line: Bool[Tensor, " n"]) -> tuple[int, int]:
    """First index that is set, and the one after the last; zeros where none is."""
    index = torch.nonzero(line)[:, 0]
    return (int(index[0]), int(index[-1]) + 1) if len(index) else (0, 0)
