"""The settings of all stages, and the presets.

`paper`:   the printed terms and numbers; what they leave open as "Readings of the paper" has it.
`printed`: the literal form of each of these readings, one row of `READINGS` each.
`robust`:  ours; docs/method.md gives the reason for each departure.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

from mover.core.settings import float_in, int_in
from mover.energy.config import Adam, BatchedBFGS, SceneWeights
from mover.stages.config import (
    AlignConfig,
    AssignConfig,
    ContactConfig,
    DepthConfig,
    FootContactConfig,
    GatherConfig,
    ImageConfig,
    LensConfig,
    PlaceConfig,
    PrepareConfig,
    RefineConfig,
    SelectConfig,
    SpreadConfig,
)


@dataclass(frozen=True)
class Config:
    """Settings of all stages, in their order."""

    lens: LensConfig = field(default_factory=LensConfig)
    """The focal length from the lines of the picture."""
    select: SelectConfig = field(default_factory=SelectConfig)
    """Which frames count."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """One depth factor a person."""
    correct_depth: bool = False
    """Whether it is looked for and applied."""
    foot_contacts: FootContactConfig = field(default_factory=FootContactConfig)
    """Feet at rest."""
    path: Literal["find", "keep"] = "find"
    """The scale of a moving camera's path is found, or the path is in metres as it is."""
    align: AlignConfig = field(default_factory=AlignConfig)
    """Camera pitch, roll and ground from the feet."""
    contacts: ContactConfig = field(default_factory=ContactConfig)
    """Where contacts come from."""
    prepare: PrepareConfig = field(default_factory=PrepareConfig)
    """How meshes are made fit."""
    image: ImageConfig = field(default_factory=ImageConfig)
    """How the image is sampled."""
    layout: PlaceConfig = field(default_factory=PlaceConfig)
    """Stage 1: objects from the image alone."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """Camera and ground refined with the objects."""
    sizes: SpreadConfig = field(default_factory=SpreadConfig)
    """How much weight the given sizes have in this room."""
    gather: GatherConfig = field(default_factory=GatherConfig)
    """Evidence from all people."""
    assign: AssignConfig = field(default_factory=AssignConfig)
    """Which object each touching body part touches."""
    place: PlaceConfig = field(default_factory=PlaceConfig)
    """Stage 2: objects from the image and the people."""
    propose_seats: bool = True
    """Propose seats and beds that no detector saw, where people rest on nothing that is known."""
    outer_iterations: Annotated[int, int_in(0, 100)] = 0
    """Further passes of stage 2 with assignment and occlusion order renewed."""
    height_spread: Annotated[float, float_in(0, 0.3)] = 0.0
    """Standard deviation of the logarithm of people's height, where all have the mean shape of
    their model and no height is given: the furniture then constrains the scale (and where bodies
    say how far their sizes may be off, as those of `mover fit` do); 0: the scale is kept."""
    seat_heights: bool = False
    """How high people sit constrains the scale of such a room, and the seats of meshes that do not
    fit the image."""
    turn_to_people: bool = False
    """Furniture along walls that was given with its back to the people begins turned to them."""
    silhouette_confidence: bool = False
    """Give the silhouette of an object less weight whose shape does not fit."""


IMAGE_ONLY = SceneWeights(depth=0.0, collision=0.0, contact=0.0)
"""L_scene: Eq. 1 without people."""

_PLANE = AlignConfig(sigmas=(0.1,), offset_prior=0.0, votes="points")
_NAMED_FEET = FootContactConfig(given=True)

PAPER = Config(
    select=SelectConfig("each"), foot_contacts=_NAMED_FEET, align=_PLANE,
    layout=PlaceConfig(weights=IMAGE_ONLY, method=Adam(1000)), gather=GatherConfig(erode=2),
    assign=AssignConfig("mask_hits"), place=PlaceConfig(),
)  # fmt: skip

Settings = Mapping[str, Any]
"""Values by the dotted names of their settings."""
READINGS: Mapping[str, Settings] = MappingProxyType({
    "near bound": {"gather.near": "far side"},
    "both bounds": {"gather.vote": False},
    "borders": {"gather.erode": 0},
    "contradictions": {"place.readings.contradiction": "count"},
    "vertices": {"place.readings.surface": "vertices"},
    "voxels": {"place.readings.lookup": "voxel"},
    "contact sum": {"place.readings.contact": "sum"},
    "contact components": {"place.readings.contact": "components"},
    "assignment": {"assign.by": "vertex"},
    "regions": {"prepare.regions": "normals"},
    "feet": {"align.votes": "sum"},
    "tilt": {"align.tilt_prior": math.inf},
})  # fmt: skip
"""The settings that switch each reading of `paper` to the literal form (docs/method.md)."""


def changed(owner: Any, way: Sequence[str], value: Any) -> Any:  # noqa: ANN401
    """Settings with one of them, or of those inside, replaced."""
    key, *rest = way
    return replace(owner, **{key: changed(getattr(owner, key), rest, value) if rest else value})


def literally(config: Config, *readings: str) -> Config:
    """The same with some readings in their literal form."""
    for name in readings:
        for setting, value in READINGS[name].items():
            config = changed(config, setting.split("."), value)
    return config


PRINTED = literally(PAPER, *READINGS)

_GROUPS = AssignConfig("group", cell=0.02, most=300)
_SHORT = Adam(60, 0.03, 0.01, beta2=0.98, keep_best=True)
_ROBUST_IMAGE = SceneWeights(
    1.0, 1.0, 0.3, 0.0, 0.0, 0.0, distance=0.02, wall=0.01, given=0.02, measured=0.05
)
_ROBUST_FULL = SceneWeights(
    1.0, 1.0, 0.3, 0.2, 0.1, 0.2, distance=0.02, heading=0.1, wall=0.01, given=0.02, measured=0.05
)

ROBUST = Config(
    lens=LensConfig(use=True),
    correct_depth=True,
    foot_contacts=FootContactConfig(speed=0.6), align=AlignConfig(level=True),
    prepare=PrepareConfig(level_feet=True),
    image=ImageConfig(
        128, "robust", hidden=0.2, bounded=True, borders=(-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5)
    ),
    layout=PlaceConfig(
        _ROBUST_IMAGE, "robust", BatchedBFGS(), yaws=16, short=_SHORT,
        num_hypotheses=6, coarse=2, walls=True,
        yaw_prior_weight=1.0,
    ),
    refine=RefineConfig(rounds=8),
    sizes=SpreadConfig(0.05),
    gather=GatherConfig(erode=1, reach=0.1, cells=128),
    assign=_GROUPS,
    place=PlaceConfig(
        _ROBUST_FULL, "robust", BatchedBFGS(), walls=True,
        yaw_prior_weight=1.0, apart=0.3,
    ),
    outer_iterations=1,
    height_spread=0.055,
    seat_heights=True,
    turn_to_people=True,
    silhouette_confidence=True,
)  # fmt: skip

PRESETS = {"paper": PAPER, "robust": ROBUST, "printed": PRINTED}
_Weighted = TypeVar("_Weighted", PlaceConfig, RefineConfig)


def with_sizes(config: Config, shape: float, whole: float) -> Config:
    """Multiply the weights of shape and of overall size in all stages."""

    def of(stage: _Weighted) -> _Weighted:
        weights = replace(stage.weights, scale=shape * stage.weights.scale)
        growth = stage.uniform_scale_weight * whole / shape
        return replace(stage, weights=weights, uniform_scale_weight=growth)

    return replace(
        config, layout=of(config.layout), refine=of(config.refine), place=of(config.place)
    )
