"""What a picture shows. Imports no torch: `--help` is quick."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class RenderConfig:
    """What is drawn."""

    view: Literal["camera", "above", "orbit"] = "camera"
    """From the video's camera, from above, or from a place around the room."""
    scene: Literal["result", "initial", "both"] = "result"
    """The result, the scene as it was given, or both side by side."""
    width: int = 960
    """Of one picture [px]."""
    azimuth: float = 35.0
    """orbit: 0 is the video's side, 90 the right of its image [degrees]."""
    elevation: float = 25.0
    """orbit: above the floor [degrees]."""
    turns: float = 0.0
    """orbit: how often the eye goes around during a film."""
    frame: int | None = None
    """A still: which frame of the video; by default the one in the middle."""
    people: bool = True
    """Draw people."""
