"""Pretrained networks by name, from a folder or from the cache of Hugging Face; nothing else."""

import importlib
import logging
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..records import InputError

log = logging.getLogger(__name__)
KINDS = {
    "masks": ("AutoModelForUniversalSegmentation", "AutoImageProcessor"),
    "tracker": ("Sam2VideoModel", ""),
    "keypoints": ("VitPoseForPoseEstimation", "AutoImageProcessor"),
}
"""Classes of transformers for each task: of the network, and of what prepares its input."""
OWN_PROCESSOR = {"oneformer": "OneFormerProcessor"}
"""Networks that are told their task in words, too."""
CLASSES = "shi-labs/oneformer_demo"
"""Where OneFormer's processor looks for the names of its classes, if they are not in its folder."""


@dataclass(frozen=True)
class ModelsConfig:
    """Which networks do what: names on Hugging Face, or folders."""

    masks: str = "facebook/mask2former-swin-large-coco-instance"
    """Furniture and people in one picture (Mask2Former, MaskFormer or OneFormer on COCO)."""
    tracker: str = "facebook/sam2.1-hiera-large"
    """People through the video (SAM 2); empty: detections are linked frame by frame."""
    keypoints: str = "usyd-community/vitpose-base-simple"
    """Joints of people (ViTPose on COCO's 17); empty: none."""
    device: str = "auto"
    """auto, cpu or cuda."""
    download: bool = False
    """Fetch what is not in the cache."""


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
        raise InputError(missing_text(kind, name)) from error
    return Network(model.to(device).eval(), processor, device)


def missing_text(kind: str, name: str) -> str:
    """The one sentence that says what to do about a network that cannot be loaded."""
    if Path(name).is_dir():
        return (
            f"--models.{kind}: the folder {name} holds no network for this task, expected "
            "config.json and model.safetensors as transformers save them"
        )
    more = f" and `hf download {CLASSES}`" if "oneformer" in name.lower() else ""
    return (
        f"--models.{kind}: {name!r} is not on this machine; where there is a network, run "
        f"`hf download {name}`{more} once (or add --models.download), or name a folder that holds "
        "it"
    )
