"""Settings of all stages, in the order of the method. Imports no torch: `--help` is quick."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from mover.core.settings import Count, Metres, Share, Weight, float_in, int_in
from mover.energy.config import (
    GROWTH,
    REFINE,
    Adam,
    BatchedBFGS,
    BodyWeights,
    Readings,
    SceneWeights,
    Variant,
)

IMAGE_ONLY = SceneWeights(1.0, 1.0, 0.3, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LensConfig:
    """When the focal length follows from the lines of the picture."""

    use: bool = False
    """Whether they are asked."""
    tilt: Annotated[float, float_in(1e-3, 1)] = 0.07
    """Standard deviation of the pitch and roll that are given [rad] ..."""
    feet: Annotated[float, float_in(1e-3, 1)] = 0.0175
    """... and of those by the feet, beside their own covariance: poses are biased."""


@dataclass(frozen=True)
class SelectConfig:
    """Which frames are used."""

    rule: Literal["chain", "each"] = "chain"
    """`chain`: the longest consistent sequence; `each`: the paper's test of every frame."""


@dataclass(frozen=True)
class DepthConfig:
    """How the depth of people is searched for."""

    span: Annotated[float, float_in(0, 0.9)] = 0.09
    """Factors from 1 - span to 1 + span are tried."""
    factors: Annotated[int, int_in(3, 1000)] = 13
    """How many."""
    most: Count = 40
    """At most so many of a person's frames in which it is seen well, spread over the video."""
    whole: Count = 150
    """At most so many frames are searched for people who are seen well, or wholly."""
    least: Count = 3
    """Fewer frames than that are no evidence."""
    width: Annotated[int, int_in(16, 4096)] = 240
    """Width of the pictures that are compared [px]."""
    seen: Share = 0.6
    """Share of a body's picture that its mask has to fill, and that no object may cover."""
    inside: Share = 0.6
    """Share of the body that has to be inside the image."""
    spread: Share = 0.04
    """A factor less certain than that is not used."""


@dataclass(frozen=True)
class FootContactConfig:
    """When a foot carries a person."""

    speed: Annotated[float, float_in(0, 100)] = 0.2
    """A foot is still if it is slower [m/s]."""
    given: bool = False
    """Where the capture has contacts of its own (POSA), these say which soles stand (paper)."""


@dataclass(frozen=True)
class AlignConfig:
    """How feet make a floor; the paper has sigmas (0.1,), no priors, one vote a point."""

    sigmas: tuple[Annotated[float, float_in(1e-4, 100)], ...] = (0.1, 0.06, 0.035, 0.02)
    """Scales of the Geman-McClure cost, one descent after the other [m]."""
    tilt_prior: Annotated[float, float_in(1e-4, math.inf)] = math.radians(4.0)
    """How far off the first pitch and roll usually are [rad]; inf: no prior."""
    offset_prior: Metres = 0.03
    """How far a person usually floats because of a wrong depth [m]; 0: not at all."""
    votes: Literal["places", "points", "sum"] = "places"
    """What counts once: a place where a person stood, a point, or (preset `printed`) all points
    together, by their mean."""
    steps: Annotated[int, int_in(0, 10_000)] = 60
    """Most Gauss-Newton steps for each scale; 0: the camera stays as it is given."""
    level: bool = False
    """Whether fitted bodies, which may lean, are combined with how level cameras stand."""


@dataclass(frozen=True)
class ContactConfig:
    """Where contacts come from."""

    given: bool = True
    """Use the capture's own contacts (POSA, DECO) where it has them; else the geometric prior."""


@dataclass(frozen=True)
class PrepareConfig:
    """How meshes are prepared."""

    cells: Annotated[int, int_in(8, 512)] = 96
    """Cells along the longest side when a mesh must be closed."""
    faces: Annotated[int, int_in(20, 200_000)] = 2000
    """Faces of the proxies that are optimised."""
    samples: Annotated[int, int_in(20, 100_000)] = 1500
    """Even surface samples of each object."""
    region: Annotated[int, int_in(1, 100_000)] = 400
    """Points of each region that can be touched."""
    regions: Literal["level", "normals"] = "level"
    """What can be touched: the level layer of the seat and the back above it, or all of the
    surface whose normal is upward or forward (preset `printed`)."""
    level_feet: bool = False
    """All feet of a proxy are put on the floor (`prepare_objects.levelled`)."""
    watertight: Literal["wrap", "occnet"] = "wrap"
    """How meshes become closed: those that are not are wrapped, or all by Occupancy Networks."""
    occnet: str = ""
    """The checkpoint of the Occupancy Network for point clouds, for `occnet`."""


@dataclass(frozen=True)
class ImageConfig:
    """How the image is sampled."""

    size: Annotated[int, int_in(8, 2048)] = 256
    """Pixels along a side of each object's window."""
    form: Variant = "paper"
    """`robust`: hidden sides are lower bounds."""
    hidden: Share = 0.5
    """Share of the strip beyond a side from which on more may be hidden there (`robust`)."""
    bounded: bool = False
    """Reaching beyond such a side costs, up to a bound; else it is free (`robust`)."""
    borders: tuple[Annotated[float, float_in(-100, 100)], ...] = ()
    """By how much outlines of masks may be off, with 0 among them [px of the image] (`robust`)."""


@dataclass(frozen=True)
class PlaceConfig:
    """How the objects are placed."""

    weights: SceneWeights = field(default_factory=SceneWeights)
    form: Variant = "paper"
    """How the terms are weighted."""
    method: Adam | BatchedBFGS = field(default_factory=Adam)
    """The descent from each start that is left."""
    yaws: Annotated[int, int_in(1, 360)] = 1
    """Starts that are turned evenly round each object."""
    short: Adam | BatchedBFGS = field(default_factory=lambda: Adam(steps=0))
    """A short descent from each of them."""
    num_hypotheses: Annotated[int, int_in(1, 1000)] = 1
    """Starts of each object that are left after the short descents."""
    coarse: Annotated[int, int_in(1, 64)] = 1
    """Pixels of a window that are one, along each side, in the short descents."""
    walls: bool = False
    """Objects along a wall are placed again with its line (robust)."""
    yaw_prior_weight: Weight = 0.0
    """How much a turn away from the reference yaw worsens a candidate: 1 doubles half a turn."""
    apart: Weight = 0.0
    """Weight of the space that objects share, in a last descent of all together."""
    uniform_scale_weight: Weight = GROWTH
    """Cost of another size as a whole, against that of another shape (robust)."""
    readings: Readings = field(default_factory=Readings)
    """How the form `paper` reads what the formulas leave open."""


@dataclass(frozen=True)
class RefineConfig:
    """How the camera is refined."""

    rounds: Annotated[int, int_in(0, 100)] = 0
    """How often at most, until it stays; 0: never (the paper)."""
    weights: SceneWeights = IMAGE_ONLY
    """Of what the image says."""
    uniform_scale_weight: Weight = GROWTH
    """Cost of another size as a whole, against that of another shape."""
    method: Adam = field(default_factory=lambda: Adam(150, rate=0.3, last_rate=0.02, beta2=0.98))


@dataclass(frozen=True)
class SpreadConfig:
    """How the cost of sizes follows the room."""

    usual: Share = 0.0
    """Usual standard deviation of the logarithm of a size; 0: nothing is learnt."""
    common: Share = 0.03
    """That of the common factor of an object's three sizes."""
    known: Annotated[float, float_in(0, 1e6)] = 2.0
    """Number of objects of a usual room that count as observed."""


@dataclass(frozen=True)
class GatherConfig:
    """How the evidence is gathered."""

    erode: Annotated[int, int_in(0, 100)] = 1
    """Pixels (of an image 640 wide) by which masks and silhouettes shrink."""
    near: Literal["exit", "far side"] = "exit"
    """The near bound: where the ray first leaves the body, or the far side of the body."""
    vote: bool = True
    """An object is hidden by a body or hides it in a frame, whichever region is larger, or both."""
    reach: Metres = 0.0
    """How far the outlines of bodies may be wrong: what is thinner is not hidden (robust) [m]."""
    cells: Annotated[int, int_in(8, 512)] = 256
    """Cells along the longest side of the volume of all bodies."""


@dataclass(frozen=True)
class AssignConfig:
    """How contact vertices find their objects."""

    by: Literal["mask_hits", "group", "vertex"] = "mask_hits"
    """By the rules of the authors' released code, by groups of parts (`assign_contacts`), or
    each vertex by itself (preset `printed`)."""
    cell: Annotated[float, float_in(1e-4, 10)] = 0.01
    """Contact points nearer than this become one with their count as weight [m]."""
    most: Count = 2000
    """Points kept for each part of each object."""


@dataclass(frozen=True)
class RefineBodiesConfig:
    """How bodies are refined with the room."""

    weights: BodyWeights = REFINE
    place: Adam = field(default_factory=lambda: Adam(60, 0.02, 0.004, beta2=0.98))
    """The descent of one round that moves bodies as a whole."""
    places: Annotated[int, int_in(0, 1000)] = 2
    """How many of these rounds come first."""
    method: Adam = field(default_factory=lambda: Adam(25, 0.01, 0.003, beta2=0.98))
    """The descent of one round that changes poses too."""
    rounds: Annotated[int, int_in(1, 1000)] = 3
    """How often contacts and depth order are looked for again."""
    rows: Annotated[int, int_in(1, 100_000)] = 512
    """Bodies that are moved at once."""
    overlap: Annotated[int, int_in(0, 10_000)] = 12
    """Rows on both sides that are moved along."""
