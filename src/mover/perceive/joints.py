"""Joints of people in the frames: ViTPose on the boxes of their masks."""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.runs import decode
from ..minimize import Observer, Step, silent
from ..readers.masks import tight_box
from ..records import record
from ..types import Keypoints
from .models import ModelsConfig, Network, network
from .track import Tracks
from .video import Clip, read_picture

LAYOUT = "coco17"


@dataclass(frozen=True)
class JointsConfig:
    """How joints are found."""

    models: ModelsConfig = field(default_factory=ModelsConfig)
    """Which network."""
    batch: int = 16
    """People that the network sees at once."""


@record
class JointsInputs:
    """People in the frames of a clip."""

    clip: Clip
    tracks: Tracks


def find_joints(
    inputs: JointsInputs, config: JointsConfig, observe: Observer = silent
) -> Keypoints:
    """Joints of everybody whose mask is known.

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
