"""Settings of what is seen in a video, and of the first scene; nothing heavy is imported."""

import math
from dataclasses import dataclass, field
from pathlib import Path

from mover.energy.config import Adam, SceneWeights
from mover.stages.config import ImageConfig, PlaceConfig, PrepareConfig


@dataclass(frozen=True)
class FramesConfig:
    """Which frames are taken."""

    fps: float = 5.0
    """Frames a second; 0: all."""
    start: float = 0.0
    """Where to begin [s]."""
    end: float = 0.0
    """Where to stop [s]; 0: at the end."""
    folder_fps: float = 0.0
    """Frames a second of a folder of pictures; 0: unknown, all are taken."""


@dataclass(frozen=True)
class SteadyConfig:
    """What counts as still."""

    still: float = 0.002
    """Largest drift of a camera that stands still, as a share of the image's larger side."""
    small: float = 0.15
    """Largest drift that is undone; beyond it the camera walks."""
    agree: float = 0.35
    """Least share of pixels that must agree with the homography of a frame."""


@dataclass(frozen=True)
class CleanConfig:
    """How the reference picture is made."""

    frames: int = 40
    """Most frames that are looked at, evenly over the video."""
    free: float = 0.0005
    """Share of the picture that may be hidden in a frame that is taken as it is."""
    least: int = 3
    """Fewest frames that must show a pixel; with fewer it is hidden."""
    strips: int = 16
    """Parts in which the picture is put together, to save memory."""


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


@dataclass(frozen=True)
class TrackConfig:
    """How people are followed."""

    models: ModelsConfig = field(default_factory=ModelsConfig)
    """Which network."""
    segment: int = 50
    """Frames between two detections."""
    same: float = 0.3
    """Overlap from which on a detection is somebody who is already followed."""
    present: float = 0.0
    """Least score (logit) of SAM 2 that a person is in the picture."""
    least: float = 0.0004
    """Smallest mask, as a share of the picture."""
    patience: int = 10
    """Frames for which somebody who is not detected is remembered (without a tracker)."""


@dataclass(frozen=True)
class JointsConfig:
    """How joints are found."""

    models: ModelsConfig = field(default_factory=ModelsConfig)
    """Which network."""
    batch: int = 16
    """People that the network sees at once."""


@dataclass(frozen=True)
class PerceiveConfig:
    """How a video is read."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    """Which frames."""
    steady: SteadyConfig = field(default_factory=SteadyConfig)
    """What counts as a camera that stands still."""
    clean: CleanConfig = field(default_factory=CleanConfig)
    """The reference picture without people."""
    models: ModelsConfig = field(default_factory=ModelsConfig)
    """Which networks do what."""
    detect: DetectConfig = field(default_factory=DetectConfig)
    """Furniture and people in pictures (its models are those above)."""
    track: TrackConfig = field(default_factory=TrackConfig)
    """People through the video (its models are those above)."""


@dataclass(frozen=True)
class Lens:
    """What is known of the camera."""

    file: Path | None = None
    fov: float | None = None
    photo: Path | None = None


@dataclass(frozen=True)
class ScreenConfig:
    """How the quick look is done."""

    heights: tuple[float, ...] = (0.8, 0.95, 1.1, 1.25, 1.4, 1.6, 1.8, 2.05, 2.35)
    """Heights of the camera that are tried [m]."""
    usual: float = 1.5
    """The usual one [m],"""
    spread: float = 0.4
    """and how much it varies (of its logarithm)."""
    yaws: int = 8
    """Turns that are tried."""
    scale: float = 0.3
    """Weight of usual sizes against boxes."""
    depth: float = 0.5
    """Weight of measured depth, where there is any."""
    tilt: float = math.radians(3)
    """How wrong pitch and roll may be [rad]; 0: not at all."""
    prior: float = 0.03
    """Weight of usual heights and tilts."""
    cap: float = 0.3
    """Most that one object may say about the height."""
    soft: float = 0.05
    """Shapes that fit worse than the best by so much hardly count."""
    method: Adam = field(default_factory=lambda: Adam(100, 0.05, 0.005, beta2=0.98))
    """The descent."""


SHORT = Adam(40, 0.03, 0.01, beta2=0.98, keep_best=True)


LONG = Adam(100, 0.02, 0.003, beta2=0.98, keep_best=True)


@dataclass(frozen=True)
class LayoutConfig:
    """How the first scene is found."""

    shapes: int = 8
    """Shapes of each thing that the boxes judge."""
    keep: int = 3
    """Shapes of each thing that the silhouettes judge."""
    turns: int = 6
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
            SceneWeights(1.0, 1.0, 0.3, 1.0, 0.0, 0.0),
            "robust",
            LONG,
            short=SHORT,
            num_hypotheses=2,
        )
    )
    """The descent by silhouettes."""
