"""What furniture may hide of people, in each frame.

Where the camera stands still, that is what the masks of the reference image cover. A moving camera
has masks in the reference image and in the frames of furniture.json. Each object mask is
warped from the two of them whose cameras were most similar to that of the frame, as a plane at the
depth of the initial scene, and is widened by the uncertainty of that depth.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.core.types import STILL, CameraPath, Capture, Masks, People
from mover.geometry.boxes import box_of
from mover.geometry.camera import at_pixels
from mover.geometry.path import is_still, poses_at
from mover.geometry.rle import joined
from mover.stages.masks import enlarged, pixels_of, thin, widened

STEP = 4  # [px] from one pixel of a carried mask to the next
LIKE = 2  # masks of each object that are carried: a person may stand before one of them
WRONG = 0.15
WIDEST = 6  # [STEP px] by which a carried mask grows at most
NEAREST = 0.3  # [m], no object is nearer to a camera


@record
class Cover:
    """Masks of possible occluders of people; one row for each object and image."""

    masks: Masks
    piece: Int[Tensor, " rows"] = torch.zeros(0, dtype=torch.long)
    """Only of a moving camera, as is all that follows."""
    depth: Float[Tensor, " rows"] = torch.zeros(0)
    """Depth of the object from the camera that saw it [m]."""
    seen: CameraPath = STILL
    """That camera."""
    path: CameraPath = STILL
    """Of the frames' cameras [m]."""
    K: Float[Tensor, "3 3"] = torch.eye(3)


def hiding(capture: Capture, path: CameraPath) -> Cover:
    """The furniture of a capture, as a path sees it [m]."""
    camera = capture.scene.camera
    still = Masks(camera.height, camera.width, ())
    shown = [(0, d.id, d.mask, STILL) for d in capture.detections if d.mask is not None]
    if is_still(path):
        return Cover(joined([still, *(mask for _, _, mask, _ in shown)]))
    centre = {p.annotation: camera.R_cam_world @ box_of(p).center for p in capture.scene.objects}
    rows = [row for row in (*shown, *_in_frames(capture.furniture, path)) if row[1] in centre]
    frames, pieces, masks, poses = zip(*rows, strict=True) if rows else ((), (), (), ())
    seen = CameraPath(
        torch.tensor(frames, dtype=torch.long),
        torch.cat([torch.zeros(0, 3, 3), *(p.R_reference_camera for p in poses)]),
        torch.cat([torch.zeros(0, 3), *(p.t_reference_camera for p in poses)]),
    )
    middle = torch.stack([torch.zeros(3), *(centre[piece] for piece in pieces)])[1:]
    ahead = ((middle - seen.t_reference_camera)[:, None] @ seen.R_reference_camera)[:, 0, 2]
    number = torch.tensor(pieces, dtype=torch.long)
    return Cover(joined([still, *masks]), number, ahead.clamp_min(NEAREST), seen, path, camera.K)


def _in_frames(
    furniture: People | None, path: CameraPath
) -> Iterator[tuple[int, int, Masks, CameraPath]]:
    """Frame, object and mask of each segmentation in further frames, and the frame's camera."""
    if furniture is None:
        return
    keys = zip(furniture.frame.tolist(), furniture.person.tolist(), strict=True)
    for code, (frame, piece) in zip(furniture.masks.counts, keys, strict=True):
        mask = dataclasses.replace(furniture.masks, counts=(code,))
        yield frame, piece, mask, poses_at(path, torch.tensor([frame]))


def covered(cover: Cover) -> Callable[[int], Bool[Tensor, "h w"]]:
    """The pixels that may be hidden in a frame; each is found once."""
    if is_still(cover.path):
        same = pixels_of(cover.masks)
        return lambda _: same
    return cache(lambda frame: _carried(cover, frame))


def _carried(cover: Cover, frame: int) -> Bool[Tensor, "h w"]:
    """The furniture as the camera of a frame sees it."""
    pose = poses_at(cover.path, torch.tensor([frame]))
    away = (cover.seen.t_reference_camera - pose.t_reference_camera).norm(dim=-1) / cover.depth
    turned = (cover.seen.R_reference_camera - pose.R_reference_camera).flatten(1).norm(dim=-1)
    height, width = cover.masks.height, cover.masks.width
    found = torch.zeros(-(-height // STEP), -(-width // STEP), dtype=torch.bool)
    for piece in cover.piece.unique():
        mine = (cover.piece == piece).nonzero()[:, 0]
        for row in mine[(away + turned)[mine].argsort()[:LIKE]].tolist():
            wide = math.ceil(float(away[row] * cover.K[0, 0]) * WRONG / STEP)
            there = _warped(cover, row, pose, found.shape)
            found = found | widened(there[None], min(wide, WIDEST))[0]
    return enlarged(found, STEP)[:height, :width]


def _warped(cover: Cover, row: int, pose: CameraPath, shape: torch.Size) -> Bool[Tensor, "h w"]:
    """A mask as another camera would see it if the object were flat."""
    source = thin(cover.masks, row, STEP)
    back = pose.R_reference_camera[0].mT
    turn = back @ cover.seen.R_reference_camera[row]
    shift = back @ (cover.seen.t_reference_camera[row] - pose.t_reference_camera[0])
    plane = turn.clone()
    plane[:, 2] += shift / cover.depth[row]
    there = cover.K @ torch.linalg.inv(plane) @ torch.linalg.inv(cover.K)
    y, x = (STEP * (torch.arange(n) + 0.5) for n in shape)
    pixel = torch.stack(torch.broadcast_tensors(x, y[:, None], torch.ones(())), -1) @ there.mT
    at = (pixel[..., :2] / pixel[..., 2:].clamp_min(1e-6) / STEP).floor().long()
    covered, inside = at_pixels(source, at)
    return covered & inside & (pixel[..., 2] > 0)
