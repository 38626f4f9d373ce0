"""Settings of the lens and of a moving camera's path. Imports no torch: `--help` is quick."""

import math
from dataclasses import dataclass
from typing import Annotated

from mover.core.settings import Metres, float_in, int_in


@dataclass(frozen=True)
class ScaleConfig:
    """How people at rest tell the scale of a moving camera's path."""

    waits: tuple[Annotated[float, float_in(1e-3, 100)], ...] = (0.2, 0.4, 0.8, 1.6, 3.2)
    """Times between two sights that are compared [s]."""
    pelvis: Annotated[float, float_in(1e-4, 10)] = 0.03
    """By how much the place of a pelvis at rest usually differs between two frames [m]."""
    foot: Annotated[float, float_in(1e-4, 10)] = 0.08
    """The same of a foot, which errors of the pose move, too [m]."""
    loose: Metres = 0.1
    """An error of the farthest camera's place that deserves a warning [m]."""


@dataclass(frozen=True)
class DriftConfig:
    """How standing feet tell the drift of a moving camera's path."""

    share: Annotated[float, float_in(1e-5, 1)] = 0.01
    """Usual error of the place at the end, as a share of the way."""
    every: Annotated[float, float_in(0.1, 600)] = 4.0
    """Time between two knots [s]."""
    sigmas: tuple[Annotated[float, float_in(1e-4, 100)], ...] = (0.1, 0.06, 0.035)
    """Scales of the Geman-McClure price, one descent after the other [m]."""
    tilt_prior: Annotated[float, float_in(1e-4, math.inf)] = math.radians(4.0)
    """How far off the first pitch and roll usually are [rad]."""
    loose: Metres = 0.02
    """A correction that is told [m]."""


@dataclass(frozen=True)
class ViewConfig:
    """How furniture in further frames tells the drift of a moving camera's path."""

    share: Annotated[float, float_in(1e-5, 1)] = 0.01
    """Usual error of the place at the end, as a share of the way."""
    turn: Annotated[float, float_in(1e-3, 180)] = 0.5
    """Usual error of the direction at the end [degrees]."""
    depth: Annotated[float, float_in(1e-4, 10)] = 0.2
    """Standard deviation of the logarithm of an object's first depth..."""
    relief: Annotated[float, float_in(1e-4, 10)] = 0.07
    """... and of that of its sides about it."""
    pixel: Annotated[float, float_in(1e-3, 1000)] = 1.0
    """Usual error of one side of a box [px]..."""
    border: Annotated[float, float_in(1e-3, 1000)] = 1.5
    """... and of a mask's whole outline, outward or inward [px]."""
    sigmas: tuple[Annotated[float, float_in(1e-3, 1e4)], ...] = (20.0, 8.0, 4.0)
    """Scales of the Geman-McClure price, one descent after the other [px]."""
    most: Annotated[int, int_in(1, 10_000)] = 24
    """So many frames, evenly chosen, are looked at."""
    loose: Metres = 0.02
    """A shift that is told [m]..."""
    loose_turn: Annotated[float, float_in(0, 180)] = 0.3
    """... and a turn [degrees]."""


@dataclass(frozen=True)
class LensConfig:
    """How far the focal length that is given is believed where the lines of the picture tell it."""

    use: bool = False
    """Whether they are asked."""
    tilt: Annotated[float, float_in(1e-3, 1)] = 0.07
    """Standard deviation of the pitch and roll that are given [rad] ..."""
    feet: Annotated[float, float_in(1e-3, 1)] = 0.0175
    """... and of those that feet tell, beside what they say themselves: poses are biased."""
