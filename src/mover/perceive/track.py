"""People through the video: SAM 2 carries masks on, detections bring new people in.

The video is cut into segments. At the first frame of each, people are detected; a detection that
overlaps a track continues it, all others start new tracks. SAM 2 then propagates all masks through
the segment. Each segment is kept on disk, so a killed run continues with the next. Without a
tracker, detections in all frames are linked by their overlap. ViTPose then finds the joints of each
person in the box of their mask.
"""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Keypoints, Masks
from mover.geometry.rle import decode, encode, tight_box
from mover.perceive.config import JointsConfig, TrackConfig
from mover.perceive.detect import Finds, Network, network, overlap
from mover.perceive.video import Clip, load_frame, read_picture

MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as SAM 2 was trained
LAYOUT = "coco17"  # of ViTPose's joints


@record
class Tracks:
    """People's masks, one row for each (frame, person)."""

    masks: Masks
    frame: Int[Tensor, " rows"]
    person: Int[Tensor, " rows"]
    people: int
    """Numbers that are used up."""


@record
class SegmentInputs:
    """A segment of the video."""

    clip: Clip
    first: int
    """Its first frame,"""
    last: int
    """and its last."""
    found: Finds
    """People detected in the first frame."""
    carried: Tracks
    """People who were followed into the first frame."""


def no_people(clip: Clip, used: int = 0) -> Tracks:
    """No person is followed; so many numbers are used up."""
    none = torch.zeros(0, dtype=torch.long)
    return Tracks(Masks(clip.height, clip.width, ()), none, none, used)


def stack_of(masks: Masks) -> Bool[Tensor, "rows h w"]:
    """Masks as pixels."""
    if not masks.counts:
        return torch.zeros(0, masks.height, masks.width, dtype=torch.bool)
    return torch.stack([decode(masks, k) for k in range(len(masks.counts))])


def track_people(inputs: SegmentInputs, config: TrackConfig, observe: Observer = silent) -> Tracks:
    """Track all people through a segment.

    Raises:
        InputError: If the network is not there.
    """
    seeds, names, used = seeded(inputs, config.same)
    if not names:
        return no_people(inputs.clip, used)
    net = network("tracker", config.models.tracker, config.models)
    codes: list[bytes] = []
    rows: list[tuple[int, int]] = []
    size = inputs.clip.height, inputs.clip.width
    frames = range(inputs.first, inputs.last + 1)
    session = opened(net, [inputs.clip.path(k) for k in frames], size)
    add_masks(session, net, seeds, names)
    with torch.inference_mode():
        for output in net.model.propagate_in_video_iterator(session, start_frame_idx=0):
            masks = full_masks(output.pred_masks, size)
            scores = output.object_score_logits.flatten().tolist()
            for name, mask, score in zip(output.object_ids, masks, scores, strict=True):
                if score >= config.present and int(mask.sum()) >= config.least * mask.numel():
                    codes.append(encode(mask))
                    rows.append((inputs.first + int(output.frame_idx), int(name)))
            observe(Step("track_people", int(output.frame_idx) + 1, len(frames)))
    frame, person = (torch.tensor([r[k] for r in rows], dtype=torch.long) for k in (0, 1))
    return Tracks(Masks(*size, tuple(codes)), frame, person, used)


def seeded(inputs: SegmentInputs, same: float) -> tuple[Bool[Tensor, "people h w"], list[int], int]:
    """Masks at the first frame, who they are, and how many numbers are used up.

    A track with a detection takes its mask; a track without one (hidden for a moment) continues;
    a detection without a track starts a new one.
    """
    old, new = stack_of(inputs.carried.masks), stack_of(inputs.found.masks)
    names = inputs.carried.person.tolist()
    masks, used = list(old), inputs.carried.people
    pairs = matched(overlap(old, new), same)
    for index, mask in enumerate(new):
        if index in pairs:
            masks[pairs[index]] = mask
        else:
            masks.append(mask)
            names.append(used)
            used += 1
    return (torch.stack(masks) if masks else old), names, used


def matched(overlaps: Float[Tensor, "old new"], least: float) -> dict[int, int]:
    """Old row of each new one: the pairing with the largest sum of overlaps above `least`."""
    from scipy.optimize import linear_sum_assignment

    if 0 in overlaps.shape:
        return {}
    values = np.where(overlaps.numpy() >= least, overlaps.numpy(), 0)
    rows, columns = linear_sum_assignment(-values)
    return {int(c): int(r) for r, c in zip(rows, columns, strict=True) if values[r, c] > 0}


def link_people(found: Finds, config: TrackConfig) -> Tracks:
    """Detections of all frames linked by the overlap with where each person was last seen."""
    last: dict[int, tuple[int, Tensor]] = {}
    persons, used = [0] * len(found.category), 0
    for frame in sorted(set(found.frame.tolist())):
        rows = (found.frame == frame).nonzero()[:, 0].tolist()
        masks = torch.stack([decode(found.masks, k) for k in rows])
        names = [n for n, (when, _) in last.items() if frame - when <= config.patience]
        old = torch.stack([last[n][1] for n in names]) if names else masks[:0]
        pairs = matched(overlap(old, masks), config.same)
        for index, row in enumerate(rows):
            name = names[pairs[index]] if index in pairs else used
            used += index not in pairs
            persons[row], last[name] = name, (frame, masks[index])
    return Tracks(found.masks, found.frame, torch.tensor(persons, dtype=torch.long), used)


def opened(net: Network, paths: Sequence[Any], size: tuple[int, int]) -> Any:  # noqa: ANN401
    """A session of SAM 2 with these frames.

    Its own processor needs torchvision; resizing and normalising is all that it does.
    """
    sam2: Any = import_module("transformers.models.sam2_video.modeling_sam2_video")
    side = net.model.config.image_size
    frames = torch.stack([prepared(load_frame(path), side) for path in paths])
    return sam2.Sam2VideoInferenceSession(
        video=frames, video_height=size[0], video_width=size[1], inference_device=net.device,
        inference_state_device=net.device, video_storage_device="cpu", dtype=net.model.dtype,
    )  # fmt: skip


def prepared(picture: Float[Tensor, "h w 3"], side: int) -> Float[Tensor, "3 side side"]:
    """A picture as SAM 2 wants it: a square, normalised."""
    square = torch.nn.functional.interpolate(
        picture.permute(2, 0, 1)[None], (side, side), mode="bilinear", antialias=True
    )[0]
    mean, spread = (torch.tensor(v)[:, None, None] for v in (MEAN, SPREAD))
    return (square - mean) / spread


def add_masks(
    session: Any,  # noqa: ANN401
    net: Network,
    masks: Bool[Tensor, "people h w"],
    names: Sequence[int],
) -> None:
    """Prompt SAM 2 with the masks of all people in the first frame."""
    side = net.model.config.image_size
    square = torch.nn.functional.interpolate(
        masks[:, None].float(), (side, side), mode="bilinear", antialias=True
    )
    for mask, name in zip((square >= 0.5).float(), names, strict=True):
        index = session.obj_id_to_idx(name)
        session.add_mask_inputs(index, 0, mask[None].to(net.device))
    session.obj_with_new_inputs = list(names)


def full_masks(logits: Tensor, size: tuple[int, int]) -> Bool[Tensor, "people h w"]:
    """Masks in the pixels of the video from SAM 2's own resolution."""
    wide = torch.nn.functional.interpolate(
        logits.reshape(-1, 1, *logits.shape[-2:]).float(), size, mode="bilinear"
    )
    return (wide[:, 0] > 0).cpu()


@record
class JointsInputs:
    """People in the frames of a clip."""

    clip: Clip
    tracks: Tracks


def find_joints(
    inputs: JointsInputs, config: JointsConfig, observe: Observer = silent
) -> Keypoints:
    """Joints of all people with a mask.

    Raises:
        InputError: If the network is not there.
    """
    net = network("keypoints", config.models.keypoints, config.models)
    tracks = inputs.tracks
    points: list[Tensor] = []
    scores: list[Tensor] = []
    for begin in range(0, len(tracks.frame), config.batch):
        rows = range(begin, min(begin + config.batch, len(tracks.frame)))
        boxes = [tight_box(decode(tracks.masks, row)) for row in rows]
        pictures = [read_picture(inputs.clip.path(int(tracks.frame[row]))) for row in rows]
        for one in joints_in(net, pictures, boxes):
            points.append(one[:, :2])
            scores.append(one[:, 2].clamp(0, 1))
        observe(Step("find_joints", rows[-1] + 1, len(tracks.frame)))
    none = torch.zeros(0, 17)
    return Keypoints(
        points=torch.stack(points) if points else none[..., None].expand(0, 17, 2),
        confidence=torch.stack(scores) if scores else none,
        layout=LAYOUT,
        frame=tracks.frame,
        person=tracks.person,
        fps=inputs.clip.fps,
    )


def joints_in(
    net: Network, pictures: list[Any], boxes: list[Float[Tensor, "4"]]
) -> list[Float[Tensor, "joints 3"]]:
    """x, y [px] and confidence of one person's joints in each picture."""
    corners = [
        [[x, y, right - x, bottom - y]] for x, y, right, bottom in (b.tolist() for b in boxes)
    ]
    inputs = net.processor(images=pictures, boxes=corners, return_tensors="pt").to(net.device)
    with torch.inference_mode():
        outputs = net.model(**inputs)
    found = net.processor.post_process_pose_estimation(outputs, boxes=corners)
    return [
        torch.cat([one[0]["keypoints"], one[0]["scores"].reshape(-1, 1)], -1).float().cpu()
        for one in found
    ]
