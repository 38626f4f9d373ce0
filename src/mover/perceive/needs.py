"""What a video needs that is not on this machine; nothing heavy is imported to find that out."""

import importlib
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mover.core.errors import InputError
from mover.perceive import weights
from mover.perceive.config import ModelsConfig

FILES = tuple(
    name + end for name in ("model.safetensors", "pytorch_model.bin") for end in ("", ".index.json")
)
"""Files in which transformers saves a network; one of them has to be there."""
PACKAGES = {
    "transformers": ("runs the networks", "perceive"),
    "ai_edge_litert": ("runs MediaPipe's networks", "mediapipe"),
    "av": ("reads videos", ""),
}
"""What a package does, and the extra that brings it; empty: all of them."""
FACTS = {
    "facebook/mask2former-swin-large-coco-instance": (
        "furniture and people in pictures", "MIT (its repository; see its card)", "0.9 GB",
    ),
    "usyd-community/vitpose-base-simple": ("joints of people", "Apache-2.0", "0.34 GB"),
}  # fmt: skip
"""What the networks of `ModelsConfig` find, their licence, and the size of their files."""
NETWORKS = ("masks", "keypoints")
"""The fields of `ModelsConfig` that name a network."""


def install(extra: str) -> str:
    """The command that brings an extra, in a checkout or where mover was installed as a wheel."""
    if (Path(__file__).parents[3] / "pyproject.toml").is_file():
        return f"pip install -c constraints.txt -e '.[{extra}]' in mover's folder"
    return f"pip install 'mover[{extra}]'"


def missing(
    models: ModelsConfig, kinds: Sequence[str] = NETWORKS, *, mediapipe: bool = False
) -> list[str]:
    """A sentence for each thing that a video needs and this machine lacks; empty: all is there."""
    kinds = [kind for kind in kinds if getattr(models, kind)]
    extra = "perceive" if kinds else "mediapipe"
    packages = ["av", *(["transformers"] if kinds else [])]
    packages += ["ai_edge_litert"] if mediapipe else []
    lacking = [name for name in packages if importlib.util.find_spec(name) is None]
    found = [
        f"the package {name}, which {PACKAGES[name][0]}: {install(PACKAGES[name][1] or extra)}"
        for name in lacking
    ]
    if mediapipe and weights.networks() is None:
        found.append(f"MediaPipe's networks (Apache-2.0; 9 MB): {weights.COMMAND}")
    unknown = "transformers" in lacking  # which finds the cache
    return found + [absent(kind, models) for kind in kinds if unknown or not _is_here(kind, models)]


def _is_here(kind: str, models: ModelsConfig) -> bool:
    """Whether a network can be loaded."""
    name = str(getattr(models, kind))
    if Path(name).is_dir():
        held = {path.name for path in Path(name).iterdir()}
        return "config.json" in held and any(file in held for file in FILES)
    hub: Any = importlib.import_module("huggingface_hub")  # transformers brings it
    here = [isinstance(hub.try_to_load_from_cache(name, f), str) for f in ("config.json", *FILES)]
    return here[0] and any(here[1:])


def absent(kind: str, models: ModelsConfig) -> str:
    """What a network is that is not there or cannot be loaded, and how it gets here."""
    name = str(getattr(models, kind))
    if Path(name).is_dir():
        return (
            f"--models.{kind}: the folder {name} holds no network for this task, expected "
            "config.json and model.safetensors as transformers save them"
        )
    known = f" ({'; '.join(FACTS[name])})" if name in FACTS else ""
    return (
        f"--models.{kind}: {name}{known}: run `hf download {name}` once where there is a network, "
        f"or --models.{kind} with a folder that holds it"
    )


def check_needs(
    models: ModelsConfig, kinds: Sequence[str] = NETWORKS, *, mediapipe: bool = False
) -> None:
    """Refuse to begin where something is missing, see `missing`.

    Raises:
        InputError: With everything that is missing, a line each, and what to do about it.
    """
    lacking = missing(models, kinds, mediapipe=mediapipe)
    if lacking:
        raise InputError("\n  ".join(["not on this machine:", *lacking]))
