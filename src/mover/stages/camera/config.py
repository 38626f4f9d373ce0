"""Settings of the lens. Imports no torch: `--help` is quick."""

from dataclasses import dataclass
from typing import Annotated

from mover.core.settings import float_in


@dataclass(frozen=True)
class LensConfig:
    """How far the focal length that is given is believed where the lines of the picture tell it."""

    use: bool = False
    """Whether they are asked."""
    tilt: Annotated[float, float_in(1e-3, 1)] = 0.07
    """Standard deviation of the pitch and roll that are given [rad] ..."""
    feet: Annotated[float, float_in(1e-3, 1)] = 0.0175
    """... and of those that feet tell, beside what they say themselves: poses are biased."""
