"""Settings of what is seen in a video, and of the first scene; nothing heavy is imported."""

import math
from dataclasses import dataclass, field
from typing import Annotated

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
