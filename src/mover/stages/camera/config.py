"""Settings of the lens and of a moving camera's path. Imports no torch: `--help` is quick."""

from dataclasses import dataclass
from typing import Annotated

from mover.core.settings import Metres, float_in


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
class LensConfig:
    """How far the focal length that is given is believed where the lines of the picture tell it."""

    use: bool = False
    """Whether they are asked."""
    tilt: Annotated[float, float_in(1e-3, 1)] = 0.07
    """Standard deviation of the pitch and roll that are given [rad] ..."""
    feet: Annotated[float, float_in(1e-3, 1)] = 0.0175
    """... and of those that feet tell, beside what they say themselves: poses are biased."""
