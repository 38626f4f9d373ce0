"""Which networks a video needs: what they are for, and which of them are not on this machine.

Nothing is loaded here, so that everything that is missing is said at once, before any work.
"""

import importlib
import importlib.util
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from mover.core.errors import InputError
from mover.perceive.config import ModelsConfig

WEIGHTS = (
    "model.safetensors",
    "model.safetensors.index.json",
    "pytorch_model.bin",
    "pytorch_model.bin.index.json",
)
"""Files in which transformers saves a network; one of them has to be there."""
PACKAGES = {
    "transformers": "runs the networks",
    "av": "reads videos",
    "cv2": "holds the camera still (OpenCV)",
}


@dataclass(frozen=True)
class NetworkFacts:
    """One of the networks that are used where no other is named."""

    task: str
    """What it finds."""
    licence: str
    size: str
    """Of its files."""


FACTS = {
    "facebook/mask2former-swin-large-coco-instance": NetworkFacts(
        "furniture and people in single pictures", "MIT (its repository; see its card)", "0.9 GB"
    ),
    "facebook/sam2.1-hiera-large": NetworkFacts("people through the video", "Apache-2.0", "0.9 GB"),
    "usyd-community/vitpose-base-simple": NetworkFacts("joints of people", "Apache-2.0", "0.34 GB"),
}
"""Of the networks of `ModelsConfig`, by their names on Hugging Face."""
CLASSES = "shi-labs/oneformer_demo"
"""Where OneFormer's processor looks for the names of its classes, if they are not in its folder."""
KINDS = ("masks", "tracker", "keypoints")


def in_folder(models: ModelsConfig, weights: Path) -> ModelsConfig:
    """The same networks, from a folder that holds one folder for each: `weights/NAME`.

    NAME is the whole name with `/` as in the folder tree, or its last part.

    Raises:
        InputError: If the folder is not there.
    """
    if not weights.is_dir():
        raise InputError(f"--weights: {weights} is no folder, expected one with {_folders(models)}")
    found: dict[str, str] = {}
    for kind in KINDS:
        name = str(getattr(models, kind))
        places = [weights / name, weights / name.rsplit("/", 1)[-1]]
        here = [place for place in places if name and place.is_dir()]
        if here:
            found[kind] = str(here[0])
    return replace(models, **found)


def _folders(models: ModelsConfig) -> str:
    names = [str(getattr(models, kind)) for kind in KINDS]
    return ", ".join(f"{name.rsplit('/', 1)[-1]}/" for name in names if name)


def missing(models: ModelsConfig) -> list[str]:
    """A sentence for each thing that a video needs and this machine lacks; empty: all is there."""
    lacking = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    found = [
        f"the package {name}, which {PACKAGES[name]}: pip install '.[perceive]' in mover's folder"
        for name in lacking
    ]
    if "transformers" in lacking:
        return found + [absent(kind, models) for kind in KINDS if getattr(models, kind)]
    kinds = [f.name for f in fields(models) if f.name in KINDS]
    return found + [absent(kind, models) for kind in kinds if not _is_here(kind, models)]


def _is_here(kind: str, models: ModelsConfig) -> bool:
    """Whether a network can be loaded; a network that may be fetched counts as there."""
    name = str(getattr(models, kind))
    if not name or models.download:
        return True
    if Path(name).is_dir():
        held = {path.name for path in Path(name).iterdir()}
        return "config.json" in held and any(file in held for file in WEIGHTS)
    hub: Any = importlib.import_module("huggingface_hub")  # transformers brings it

    def cached(file: str) -> bool:
        return isinstance(hub.try_to_load_from_cache(name, file), str)

    return cached("config.json") and any(cached(file) for file in WEIGHTS)


def absent(kind: str, models: ModelsConfig) -> str:
    """What a network is that is not there or cannot be loaded, and how it gets here."""
    name = str(getattr(models, kind))
    if Path(name).is_dir():
        return (
            f"--models.{kind}: the folder {name} holds no network for this task, expected "
            "config.json and model.safetensors as transformers save them"
        )
    facts = FACTS.get(name)
    known = "" if facts is None else f" ({facts.task}; {facts.licence}; {facts.size})"
    more = f" and `hf download {CLASSES}`" if "oneformer" in name.lower() else ""
    return (
        f"--models.{kind}: {name}{known}: run `hf download {name}`{more} once where there is a "
        f"network, or --models.download, or --weights DIR with the folder "
        f"{name.rsplit('/', 1)[-1]}/ in it"
    )


def check_networks(models: ModelsConfig) -> None:
    """Refuse to begin where something is missing.

    Raises:
        InputError: With everything that is missing, and what to do about each.
    """
    lacking = missing(models)
    if lacking:
        raise InputError("not on this machine: " + "; ".join(lacking))
