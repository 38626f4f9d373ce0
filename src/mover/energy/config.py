"""Weights of Eq. 1 and the ways down it. Imports no torch: `--help` is quick."""

from dataclasses import dataclass, field, fields
from typing import Annotated, ClassVar, Literal

from mover.core.settings import Share, Steps, Weight, float_in, int_in

Variant = Literal["paper", "robust"]
"""How a term is weighted: as printed, or normalised and robust."""


GROWTH = 1.5  # cost of another size as a whole, against that of another shape


@dataclass(frozen=True)
class SceneWeights:
    """Weights of Eq. 1 in its order; zero removes a term and the need for its evidence."""

    bbox: Weight = 1000.0
    """lambda 1: objects fill their detected boxes."""
    silhouette: Weight = 0.3
    """lambda 2: objects cover their masks."""
    scale: Weight = 1000.0
    """lambda 3: objects keep their initial size."""
    depth: Weight = 8.0
    """lambda 4: who hides whom bounds the depth."""
    collision: Weight = 1000.0
    """lambda 5: people move through free space."""
    contact: Weight = 1e5
    """lambda 6: touching surfaces share a position."""
    distance: Weight = 0.0
    """Objects stay at the distance they were given, where nothing else constrains it (robust
    only)."""
    heading: Weight = 0.0
    """Seats face where their sitters face (robust only)."""
    wall: Weight = 0.0
    """Furniture along a wall stands in one line (robust only)."""
    given: Weight = 0.0
    """Objects stay about as they were given, of usual sizes and along the room (robust only)."""
    measured: Weight = 0.0
    """Surfaces lie where a depth network sees them (robust only)."""


def only(**weights: float) -> SceneWeights:
    """These weights, and none of the others."""
    return SceneWeights(**{f.name: weights.get(f.name, 0.0) for f in fields(SceneWeights)})


@dataclass(frozen=True)
class Readings:
    """How the form `paper` reads what its formulas leave open; preset `printed`: the last values.

    See "Readings of the paper" in docs/method.md.
    """

    contradiction: Literal["skip", "count"] = "skip"
    """Pixels whose near bound is beyond the far one have no range, or two costs."""
    surface: Literal["samples", "vertices"] = "samples"
    """u of L_collision: even samples that count as 1000, or the proxy's vertices."""
    lookup: Literal["trilinear", "voxel"] = "trilinear"
    """V at u, or of the voxel of u (whose gradient would be none: it is the trilinear one)."""
    contact: Literal["mean", "sum", "components"] = "mean"
    """L_contact: a mean over the skin that touches, the sum, or the sum of the y component of the
    distance to the top and the others of that to the back."""


@dataclass(frozen=True)
class SceneConfig:
    """How the terms of the room are weighted."""

    weights: SceneWeights = field(default_factory=SceneWeights)
    form: Variant = "paper"
    """As printed, or normalised and robust."""
    growth: Weight = GROWTH
    """Cost of another size as a whole, against that of another shape (robust only)."""
    readings: Readings = field(default_factory=Readings)


@dataclass(frozen=True)
class Adam:
    """Adam with a step that falls geometrically from `rate` to `last_rate`."""

    steps: Steps = 3000
    """Number of steps."""
    rate: Annotated[float, float_in(1e-9, 100)] = 0.002
    """First step size (Sec. "Optimization" of the supplement)."""
    last_rate: Annotated[float, float_in(1e-9, 100)] = 0.002
    """Last step size; equal to `rate`: constant."""
    beta2: Annotated[float, float_in(0.81, 0.999999)] = 0.999
    """Memory of the squared gradient; below the square of that of the gradient (.9) a step has no
    bound."""
    keep_best: bool = False
    """Return the best state of each item instead of the last one."""


@dataclass(frozen=True)
class BatchedBFGS:
    """Second-order steps of each problem within its own radius, until each has converged."""

    on_device: ClassVar[bool] = (
        False  # it asks after each step, which costs a GPU more than it gains
    )
    steps: Steps = 100
    """Most steps: a problem that still moves stops then."""
    reach: Annotated[float, float_in(1e-6, 100)] = 0.05
    """First radius, in units of the unknowns [m, rad, log scale]."""
    widest: Annotated[float, float_in(1e-6, 100)] = 0.5
    """Largest radius."""
    least: Annotated[float, float_in(1e-9, 1)] = 1e-4
    """Radius below which a problem has converged."""
    gain: Share = 1e-5
    """Relative decrease below which a step counts as none."""
    patience: Annotated[int, int_in(1, 1000)] = 3
    """Such steps in a row after which a problem has converged."""


@dataclass(frozen=True)
class BodyWeights:
    """How much each term of the energy of bodies counts; 0: it is left out."""

    keypoints: Weight = 0.0  # E_Body: projected keypoints off the detected ones
    smooth_joints: Weight = 0.0  # L_smooth: of 3D joints, over people's acceleration
    smooth_pixels: Weight = 0.0  # L_smooth: of projections, by the middle's confidence
    still: Weight = 0.0  # the pelvis, which does not move where its picture does not
    held: Weight = 0.0  # trunk, head and arms about the pelvis, where they look still
    support: Weight = 0.0  # points under the floor of a fit
    stands: Weight = 0.0  # lower soles of all bodies off one floor that is found with them
    balance: Weight = 0.0  # centres of mass of standing bodies that are not over their feet
    level: Weight = 0.0  # slopes of the floor that is found
    lies: Weight = 0.0  # distance before and after lying, for people lying along the view
    pose: Weight = 0.0  # the pose off the usual one, or the code of a learned prior
    limits: Weight = 0.0  # ranges of motion
    bending: Weight = 0.0  # elbows and knees bent the wrong way
    shape: Weight = 0.0  # proportions, and the stature of people of unknown height
    height: Weight = 0.0  # a given height
    offset: Weight = 0.0  # lasting offsets of a detector's keypoints
    hands: Weight = 0.0  # usual hands
    jaw: Weight = 0.0  # the jaw's opening; its other turns cost a hundred times as much
    expression: Weight = 0.0  # usual faces
    angles: Weight = 0.0  # refinement, in nats: distance of all angles from those that were given
    image: Weight = 0.0  # distance of the joints from where they were seen
    range: Weight = 0.0  # change of the depth
    smooth: Weight = 0.0  # E_smooth: joints between their neighbours in time
    steady: Weight = 0.0  # corrections that come and go
    under: Weight = 0.0  # CamGP: skin below the floor
    stand: Weight = 0.0  # CamGP: soles at rest off the floor
    lock: Weight = 0.0  # CamGP: soles at rest that slide
    sink: Weight = 0.0  # SDF: skin inside furniture
    touch: Weight = 0.0  # contact: skin that touches, off the furniture
    order: Weight = 0.0  # depth order: skin before its occluder, or behind what it occludes
    outline: Weight = 0.0  # masks: the outline of the body on the outline of its mask


REFINE = BodyWeights(
    angles=1.0, image=1.0, range=1.0, smooth=1.0, steady=0.5, under=1.0, stand=1.0, lock=1.0,
    sink=1.0, touch=1.0, order=0.3, outline=1.0,
)  # fmt: skip
"""The refinement in a room; all terms are in nats, so 1 is the natural weight."""
