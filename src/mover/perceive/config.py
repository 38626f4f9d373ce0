"""Settings of what is seen in a video, and of the first scene, and what each setting needs.

Google's public wheel of mediapipe holds them (Apache-2.0); they are taken out of it, and the
package itself is not installed: it does not run beside today's numpy. Nothing heavy is imported.
Nothing heavy is imported.
"""

import hashlib
import importlib
import importlib.util
import math
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.settings import Seconds, Share, Weight, float_in, int_in
from mover.energy.config import Adam, SceneWeights
from mover.stages.config import ImageConfig, PlaceConfig, PrepareConfig

PICTURES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True)
class FramesConfig:
    """Which frames are taken."""

    fps: Annotated[float, float_in(0, 1e4)] = 5.0
    """Frames a second at least, more where people move fast; 0: all, at the rate of the video.
    Of a folder of pictures, whose rate is not known, all are taken."""
    start: Seconds = 0.0
    """Start of the part that is used [s]."""
    end: Seconds = 0.0
    """Its end [s]; 0: the end of the video."""


@dataclass(frozen=True)
class ModelsConfig:
    """Which networks do what: names on Hugging Face, or folders."""

    masks: str = "facebook/mask2former-swin-large-coco-instance"
    """Furniture and people in pictures (Mask2Former or MaskFormer on COCO)."""
    keypoints: str = "usyd-community/vitpose-base-simple"
    """Joints of people (ViTPose on COCO's 17); empty: none."""


@dataclass(frozen=True)
class PerceiveConfig:
    """How a video is read."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    """Which frames."""
    models: ModelsConfig = field(default_factory=ModelsConfig)
    """Which networks do what."""
    score: Share = 0.5
    """Least score of a detection."""


@dataclass(frozen=True)
class ScreenConfig:
    """How the first look by boxes is done."""

    heights: tuple[Annotated[float, float_in(0.1, 20)], ...] = (
        0.8, 0.95, 1.1, 1.25, 1.4, 1.6, 1.8, 2.05, 2.35,
    )  # fmt: skip
    """Heights of the camera that are tried [m]."""
    usual: Annotated[float, float_in(0.1, 20)] = 1.5
    """The usual one [m]."""
    tilt: Annotated[float, float_in(0, 1.5)] = math.radians(3)
    """How wrong pitch and roll may be [rad]; 0: not at all."""
    tilt_known: Annotated[float, float_in(0, 1.5)] = math.radians(1)
    """The same where the height is known, too [rad]."""
    prior: Weight = 0.03
    """Weight of usual heights and tilts."""
    method: Adam = field(default_factory=lambda: Adam(100, 0.05, 0.005, beta2=0.98))
    """The descent."""


@dataclass(frozen=True)
class LayoutConfig:
    """How the first scene is found."""

    shapes: Annotated[int, int_in(1, 1000)] = 16
    """Shapes of each thing that the boxes judge."""
    keep: Annotated[int, int_in(1, 1000)] = 5
    """Shapes of each thing that the silhouettes judge."""
    turns: Annotated[int, int_in(1, 360)] = 6
    """Starts of each of them."""
    screen: ScreenConfig = field(default_factory=ScreenConfig)
    """The quick look by boxes."""
    image: ImageConfig = field(default_factory=lambda: ImageConfig(size=96, form="robust"))
    """How the picture is sampled."""
    prepare: PrepareConfig = field(
        default_factory=lambda: PrepareConfig(faces=600, samples=200, region=20)
    )
    """How shapes are made fit."""
    place: PlaceConfig = field(
        default_factory=lambda: PlaceConfig(
            SceneWeights(1.0, 1.0, 0.3, 1.0, 0.0, 0.0, given=0.1), "robust",
            Adam(100, 0.02, 0.003, beta2=0.98, keep_best=True),
            short=Adam(40, 0.03, 0.01, beta2=0.98, keep_best=True), num_hypotheses=2,
        )
    )  # fmt: skip
    """The descent by silhouettes."""


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
