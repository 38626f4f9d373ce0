"""Furniture and people in single pictures: instance masks of COCO's classes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..minimize import Observer, Step, silent
from ..readers.masks import encode
from ..records import record
from ..types import Masks
from .models import ModelsConfig, Network, instance_reader, network
from .video import Clip, read_picture

PERSON = "person"
TASK = "instance"  # what OneFormer is asked for


@dataclass(frozen=True)
class DetectConfig:
    """How instances are found."""

    models: ModelsConfig = field(default_factory=ModelsConfig)
    """Which network."""
    score: float = 0.5
    """Least score."""
    batch: int = 4
    """Pictures that the network sees at once."""
    least: float = 0.0004
    """Smallest instance, as a share of the picture."""


@record
class DetectInputs:
    """Pictures of a clip."""

    clip: Clip
    frames: tuple[int, ...]


@record
class Finds:
    """Instances in pictures, row by row."""

    masks: Masks
    frame: Int[Tensor, " rows"]
    category: tuple[str, ...]
    score: Float[Tensor, " rows"]


def find_instances(inputs: DetectInputs, config: DetectConfig, observe: Observer = silent) -> Finds:
    """Instance masks in some frames.

    Raises:
        InputError: If the network is not there.
    """
    net = network("masks", config.models.masks, config.models)
    parts: list[Finds] = []
    for begin in range(0, len(inputs.frames), config.batch):
        frames = inputs.frames[begin : begin + config.batch]
        pictures = [read_picture(inputs.clip.path(k)) for k in frames]
        parts.append(instances(net, pictures, frames, config))
        observe(Step("find_instances", begin + len(frames), len(inputs.frames)))
    size = inputs.clip.height, inputs.clip.width
    return joined_finds(parts) if parts else Finds(
        Masks(*size, ()), torch.zeros(0, dtype=torch.long), (), torch.zeros(0)
    )  # fmt: skip


def instances(
    net: Network, pictures: Sequence[Any], frames: Sequence[int], config: DetectConfig
) -> Finds:
    """What the network sees in a batch of pictures."""
    words = net.model.config.model_type == "oneformer"
    told: dict[str, Any] = {"task_inputs": [TASK] * len(pictures)} if words else {}
    inputs = net.processor(images=list(pictures), return_tensors="pt", **told).to(net.device)
    with torch.inference_mode():
        outputs = net.model(**inputs)
    sizes = [picture.shape[:2] for picture in pictures]
    found = instance_reader(net).post_process_instance_segmentation(
        outputs, threshold=config.score, target_sizes=sizes, return_binary_maps=True
    )
    return finds_of(found, frames, sizes[0], net.model.config.id2label, config.least)


def finds_of(
    found: Sequence[dict[str, Any]],
    frames: Sequence[int],
    size: tuple[int, int],
    names: dict[int, str],
    least: float,
) -> Finds:
    """Rows from what transformers' post-processing returns for each picture."""
    codes: list[bytes] = []
    rows: list[tuple[int, str, float]] = []
    for frame, one in zip(frames, found, strict=True):
        maps = one["segmentation"]
        for index, info in enumerate(one["segments_info"]):
            mask = _binary(maps, index, int(info["id"]))
            if int(mask.sum()) < max(1, least * mask.numel()):
                continue
            codes.append(encode(mask))
            rows.append((frame, str(names[int(info["label_id"])]).lower(), float(info["score"])))
    return Finds(
        Masks(int(size[0]), int(size[1]), tuple(codes)),
        torch.tensor([r[0] for r in rows], dtype=torch.long),
        tuple(r[1] for r in rows),
        torch.tensor([r[2] for r in rows], dtype=torch.float32),
    )


def _binary(maps: Any, index: int, name: int) -> Bool[Tensor, "h w"]:  # noqa: ANN401
    """One mask of a stack of masks, or of a map of ids where the network gives no stack."""
    if maps.dim() == 3:
        return maps[index].cpu() > 0
    return maps.cpu() == name


def joined_finds(parts: Sequence[Finds]) -> Finds:
    """Rows of several batches."""
    first = parts[0].masks
    return Finds(
        Masks(first.height, first.width, tuple(c for p in parts for c in p.masks.counts)),
        torch.cat([p.frame for p in parts]),
        tuple(c for p in parts for c in p.category),
        torch.cat([p.score for p in parts]),
    )


def picked(finds: Finds, rows: Sequence[int]) -> Finds:
    """Some of the rows."""
    index = torch.tensor(list(rows), dtype=torch.long)
    counts = tuple(finds.masks.counts[k] for k in rows)
    return Finds(
        Masks(finds.masks.height, finds.masks.width, counts),
        finds.frame[index],
        tuple(finds.category[k] for k in rows),
        finds.score[index],
    )


def people_in(finds: Finds) -> Finds:
    """The rows that are people."""
    return picked(finds, [k for k, name in enumerate(finds.category) if name == PERSON])


def overlap(a: Bool[Tensor, "n h w"], b: Bool[Tensor, "m h w"]) -> Float[Tensor, "n m"]:
    """Shared area over joint area of masks."""
    flat = [x.flatten(1).float() for x in (a, b)]
    shared = flat[0] @ flat[1].mT
    return shared / (flat[0].sum(1)[:, None] + flat[1].sum(1)[None] - shared).clamp_min(1)
