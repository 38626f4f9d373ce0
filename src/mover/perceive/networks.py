"""Furniture, people and their joints in pictures, by pretrained networks of transformers.

A network finds masks of COCO's classes in each frame; people are linked from frame to frame by
their place; another network finds the joints of each person in the box of the mask.
Networks come by name from the cache of Hugging Face, or from a folder.
"""

import importlib
import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Keypoints, Masks, People
from mover.geometry.rle import encode, joined, mask_boxes
from mover.io.people.found import followed
from mover.perceive.config import ModelsConfig, PerceiveConfig, absent, install
from mover.perceive.video import Clip, read_picture

log = logging.getLogger(__name__)
CLASSES = {"masks": "AutoModelForUniversalSegmentation", "keypoints": "VitPoseForPoseEstimation"}
"""Classes of transformers for each task."""
PERSON = "person"
LEAST = 0.0004  # smallest instance, as a share of the picture
PICTURES, PEOPLE = 4, 16  # that a network sees at once


@dataclass(frozen=True)
class Network:
    """A network that is ready, and what prepares its input."""

    model: Any
    processor: Any
    device: str


@lru_cache(maxsize=4)
def network(kind: str, config: ModelsConfig) -> Network:
    """The network of a kind, `masks` or `keypoints`, on the GPU if there is one; loaded once.

    Raises:
        InputError: If transformers or the weights are missing; the message says what to do.
    """
    name = str(getattr(config, kind))
    try:
        library: Any = importlib.import_module("transformers")
    except ImportError as error:
        raise InputError(f"perceive needs transformers: {install('perceive')}") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            here: dict[str, Any] = {"local_files_only": True}
            model = getattr(library, CLASSES[kind]).from_pretrained(name, **here)
            processor = library.AutoImageProcessor.from_pretrained(name, **here)
    except (OSError, ValueError, KeyError, ImportError) as error:
        log.debug("loading %s: %s", name, error)
        raise InputError(absent(kind, config)) from error
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return Network(model.to(device).eval(), processor, device)


@record
class Finds:
    """Instances in pictures, row by row."""

    masks: Masks
    frame: Int[Tensor, " rows"]
    category: tuple[str, ...]
    score: Float[Tensor, " rows"]


def find_instances(clip: Clip, config: PerceiveConfig, observe: Observer = silent) -> Finds:
    """Instance masks in all frames of a clip.

    Raises:
        InputError: If the network is not there.
    """
    net = network("masks", config.models)
    nothing, count = Masks(clip.height, clip.width, ()), len(clip.time)
    parts = [Finds(nothing, torch.zeros(0, dtype=torch.long), (), torch.zeros(0))]
    for begin in range(0, count, PICTURES):
        frames = range(begin, min(begin + PICTURES, count))
        pictures = [read_picture(clip.path(k)) for k in frames]
        parts.append(instances(net, pictures, frames, config.score))
        observe(Step("find_instances", frames.stop - 1, count))
    return joined_finds(parts)


def instances(net: Network, pictures: Sequence[Any], frames: Sequence[int], score: float) -> Finds:
    """What Mask2Former or MaskFormer sees in pictures of one size."""
    inputs = net.processor(images=list(pictures), return_tensors="pt").to(net.device)
    with torch.inference_mode():
        outputs = net.model(**inputs)
    sizes = [picture.shape[:2] for picture in pictures]
    found = net.processor.post_process_instance_segmentation(
        outputs, threshold=score, target_sizes=sizes, return_binary_maps=True
    )
    codes: list[bytes] = []
    rows: list[tuple[int, str, float]] = []
    for frame, one in zip(frames, found, strict=True):
        maps = one["segmentation"].cpu()
        for index, info in enumerate(one["segments_info"]):
            mask = maps[index] > 0 if maps.dim() == 3 else maps == int(info["id"])  # a map of ids
            if int(mask.sum()) < max(1, LEAST * mask.numel()):
                continue
            codes.append(encode(mask))
            name = str(net.model.config.id2label[int(info["label_id"])]).lower()
            rows.append((frame, name, float(info["score"])))
    return Finds(
        Masks(int(sizes[0][0]), int(sizes[0][1]), tuple(codes)),
        torch.tensor([r[0] for r in rows], dtype=torch.long),
        tuple(r[1] for r in rows),
        torch.tensor([r[2] for r in rows], dtype=torch.float32),
    )


def joined_finds(parts: Sequence[Finds]) -> Finds:
    """Rows of several batches."""
    return Finds(
        joined([p.masks for p in parts]),
        torch.cat([p.frame for p in parts]),
        tuple(c for p in parts for c in p.category),
        torch.cat([p.score for p in parts]),
    )


def link_people(found: Finds) -> People:
    """People of all frames, linked by where each was last seen."""
    kept = [k for k, name in enumerate(found.category) if name == PERSON]
    people = replace(found.masks, counts=tuple(found.masks.counts[k] for k in kept))
    low, high = mask_boxes(people).double().reshape(-1, 2, 2).unbind(1)
    low, high = low.numpy(), high.numpy()
    frames, size = found.frame[kept], np.linalg.norm(high - low, axis=1)
    person = followed(frames.tolist(), (low + high) / 2, size)
    return People(people, frames, torch.from_numpy(person))


@record
class JointsInputs:
    """People in the frames of a clip."""

    clip: Clip
    tracks: People


def find_joints(
    inputs: JointsInputs, config: ModelsConfig, observe: Observer = silent
) -> Keypoints:
    """Joints of all people with a mask.

    Raises:
        InputError: If the network is not there.
    """
    net = network("keypoints", config)
    tracks, boxes = inputs.tracks, mask_boxes(inputs.tracks.masks)
    parts = [torch.zeros(0, 17, 3)]
    for begin in range(0, len(boxes), PEOPLE):
        frames = tracks.frame[begin : begin + PEOPLE].tolist()
        pictures = [read_picture(inputs.clip.path(k)) for k in frames]
        parts.append(joints_in(net, pictures, boxes[begin : begin + PEOPLE]))
        observe(Step("find_joints", begin + len(frames) - 1, len(boxes)))
    found = torch.cat(parts)
    return Keypoints(
        found[..., :2], found[..., 2].clamp(0, 1), "coco17", tracks.frame, tracks.person,
        inputs.clip.fps,
    )  # fmt: skip


def joints_in(
    net: Network, pictures: list[Any], boxes: Float[Tensor, "people 4"]
) -> Float[Tensor, "people joints 3"]:
    """x, y [px] and confidence of one person's joints in each picture."""
    corners = [[[x, y, right - x, bottom - y]] for x, y, right, bottom in boxes.tolist()]
    inputs = net.processor(images=pictures, boxes=corners, return_tensors="pt").to(net.device)
    with torch.inference_mode():
        outputs = net.model(**inputs)
    found = net.processor.post_process_pose_estimation(outputs, boxes=corners)
    each = [torch.cat([one[0]["keypoints"], one[0]["scores"].reshape(-1, 1)], -1) for one in found]
    return torch.stack(each).float().cpu()
