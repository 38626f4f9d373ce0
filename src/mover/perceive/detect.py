"""Furniture and people in pictures: masks of COCO's classes, by pretrained networks.

Networks come by name, from a folder or from the cache of Hugging Face; nothing else.
"""

import importlib
import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Masks
from mover.geometry.rle import encode, joined
from mover.perceive.config import DetectConfig, ModelsConfig
from mover.perceive.networks import absent
from mover.perceive.video import Clip, read_picture

log = logging.getLogger(__name__)
KINDS = {
    "masks": ("AutoModelForUniversalSegmentation", "AutoImageProcessor"),
    "tracker": ("Sam2VideoModel", ""),
    "keypoints": ("VitPoseForPoseEstimation", "AutoImageProcessor"),
}
"""Classes of transformers for each task: of the network, and of what prepares its input."""
OWN_PROCESSOR = {"oneformer": "OneFormerProcessor"}
"""Networks that are given their task in words, too."""
PERSON = "person"
TASK = "instance"  # what OneFormer is asked for


@dataclass(frozen=True)
class Network:
    """A network that is ready, and what prepares its input."""

    model: Any
    processor: Any
    device: str


def network(kind: str, name: str, config: ModelsConfig) -> Network:
    """A network of a kind; it is loaded once.

    Raises:
        InputError: If transformers or the weights are missing; the message says what to do.
    """
    return _loaded(kind, name, device_of(config.device), config.download)


def instance_reader(net: Network) -> Any:  # noqa: ANN401
    """What turns the queries' logits of a network for masks into instances.

    OneFormer reads instances off as Mask2Former does. Its own processor in transformers (up to 5.x)
    forgets the sigmoid of the masks, so that the best mask of all also gets every pixel where
    nothing is, and needs torchvision; Mask2Former's is used for both.
    """
    if net.model.config.model_type not in OWN_PROCESSOR:
        return net.processor
    library: Any = importlib.import_module("transformers")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return library.Mask2FormerImageProcessor()


def device_of(name: str) -> str:
    """The device that a name stands for.

    Raises:
        InputError: If there is no such device.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name.split(":")[0] not in ("cpu", "cuda"):
        raise InputError(f"--models.device: {name!r} is none of auto, cpu, cuda")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("--models.device: there is no GPU that torch can use, expected cpu")
    return name


@lru_cache(maxsize=4)
def _loaded(kind: str, name: str, device: str, download: bool) -> Network:
    try:
        library: Any = importlib.import_module("transformers")
    except ImportError as error:
        raise InputError(
            "perceive needs transformers: pip install '.[perceive]' in mover's folder"
        ) from error
    model_class, processor_class = KINDS[kind]
    own: dict[str, Any] = {"local_files_only": not download}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = getattr(library, model_class).from_pretrained(name, **own)
            processor = None
            processor_class = OWN_PROCESSOR.get(model.config.model_type, processor_class)
            if processor_class:
                processor = getattr(library, processor_class).from_pretrained(name, **own)
    except (OSError, ValueError, KeyError, ImportError) as error:
        log.debug("loading %s: %s", name, error)
        raise InputError(absent(kind, replace(ModelsConfig(), **{kind: name}))) from error
    return Network(model.to(device).eval(), processor, device)


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
    task: dict[str, Any] = {"task_inputs": [TASK] * len(pictures)} if words else {}
    inputs = net.processor(images=list(pictures), return_tensors="pt", **task).to(net.device)
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
        maps = one["segmentation"].cpu()
        for index, info in enumerate(one["segments_info"]):
            mask = maps[index] > 0 if maps.dim() == 3 else maps == int(info["id"])  # a map of ids
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


def joined_finds(parts: Sequence[Finds]) -> Finds:
    """Rows of several batches."""
    return Finds(
        joined([p.masks for p in parts]),
        torch.cat([p.frame for p in parts]),
        tuple(c for p in parts for c in p.category),
        torch.cat([p.score for p in parts]),
    )


def people_in(finds: Finds) -> Finds:
    """The rows that are people."""
    rows = [k for k, name in enumerate(finds.category) if name == PERSON]
    masks = replace(finds.masks, counts=tuple(finds.masks.counts[k] for k in rows))
    return Finds(masks, finds.frame[rows], (PERSON,) * len(rows), finds.score[rows])


def overlap(a: Bool[Tensor, "n h w"], b: Bool[Tensor, "m h w"]) -> Float[Tensor, "n m"]:
    """Shared area over joint area of masks."""
    flat = [x.flatten(1).float() for x in (a, b)]
    shared = flat[0] @ flat[1].mT
    return shared / (flat[0].sum(1)[:, None] + flat[1].sum(1)[None] - shared).clamp_min(1)
