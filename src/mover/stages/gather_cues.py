"""Gather what the people say, once, over all frames (Sec. 3.1).

The cost of placing the objects then does not grow with the video.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from ..energy import HumanCues
from ..geometry.crops import sample_nearest
from ..geometry.raster import Views
from ..geometry.volume import grid_around, union_bodies
from ..minimize import Observer, Step, silent
from ..records import record
from ..terms.bbox import WIDTH
from ..terms.collision import BodySpace
from ..terms.contact import Touches
from ..terms.depth import DepthMaps, DepthRange
from ..types import Bodies, Camera, People
from .gather_depth import Sight, gather_depth
from .person_masks import mask_table
from .small import small_camera, small_masks


@dataclass(frozen=True)
class GatherConfig:
    """How the evidence is gathered."""

    erode: int = 1
    """Pixels (of an image 640 wide) by which masks and silhouettes shrink."""
    reach: float = 0.0
    """How far the outlines of bodies may be wrong: what is thinner is not hidden (robust) [m]."""
    vote: bool = True
    """Per body and object, keep only the larger of the hidden and the hiding region."""
    cells: int = 256
    """Cells along the longest side of the volume of all bodies."""
    padding: float = 0.2
    """Space around the bodies in the volume [m]."""
    workers: int = 2
    """Threads that draw and measure; the result does not depend on it."""


@record
class GatherInputs:
    """People and masks."""

    bodies: Bodies
    """The selected bodies, in the world."""
    people: People | None
    masks: Bool[Tensor, "objects h w"]
    """Of the objects in the clean image; empty where only the box is known."""
    camera: Camera


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


def cues_in_windows(cues: Cues, touches: Touches | None, views: Views, camera: Camera) -> HumanCues:
    """The evidence as the terms want it: depth bounds sampled in the objects' windows."""
    depth = None
    if cues.maps is not None:
        K = small_camera(camera).K
        lowest = float("-inf")
        scale = WIDTH / camera.width * camera.K[0, 0] / views.K[:, 0, 0]
        depth = DepthRange(
            sample_nearest(cues.maps.near, views, K, lowest),
            sample_nearest(cues.maps.far, views, K, -lowest),
            sample_nearest(cues.maps.free, views, K, lowest),
            scale.square(),
        )
    return HumanCues(depth, cues.space, touches)


def _depth_maps(inputs: GatherInputs, config: GatherConfig, observe: Observer) -> DepthMaps | None:
    if inputs.people is None:
        return None
    masks = small_masks(inputs.masks, inputs.camera).cpu()
    table = mask_table(inputs.people, inputs.bodies)
    return gather_depth(
        Sight(inputs.bodies, table, masks, inputs.camera, config.erode, config.vote, config.reach),
        config.workers,
        lambda done, of: observe(Step("gather_cues: depth", done, of)),
    )


def _space(inputs: GatherInputs, config: GatherConfig, observe: Observer) -> BodySpace:
    flat = inputs.bodies.verts.flatten(1)  # long rows first: eight times as fast
    low, high = (end.view(-1, 3) for end in (flat.amin(0), flat.amax(0)))
    grid = grid_around(low.amin(0), high.amax(0), config.cells, config.padding)
    volume = union_bodies(
        inputs.bodies.verts,
        inputs.bodies.faces,
        grid,
        config.workers,
        lambda done, of: observe(Step("gather_cues: free space", done, of)),
    )
    return BodySpace(volume)
