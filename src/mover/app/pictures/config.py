"""What a picture shows, and into which files. Imports no torch: `--help` is quick."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from mover.core.errors import InputError
from mover.core.settings import Index, float_in, int_in


@dataclass(frozen=True)
class RenderConfig:
    """What is drawn."""

    view: Literal["camera", "above", "orbit"] = "camera"
    """From the video's camera, from above, or from around the room."""
    scene: Literal["result", "initial"] = "result"
    """The result, or the initial scene."""
    width: Annotated[int, int_in(16, 8192)] = 960
    """Of one picture [px]."""
    azimuth: Annotated[float, float_in(-3600, 3600)] = 35.0
    """orbit: 0 is the video's side, 90 the right of its image [degrees]."""
    elevation: Annotated[float, float_in(-89, 89)] = 25.0
    """orbit: above the floor [degrees]."""
    turns: Annotated[float, float_in(-1000, 1000)] = 0.0
    """orbit: how often the eye goes around during a film."""
    frame: Index | None = None
    """A still: which frame of the video; by default the one in the middle."""
    people: bool = True
    """Draw people."""


STILL, FILM = (".png", ".jpg", ".jpeg"), (".mp4",)


def check_ending(argument: str, path: Path, endings: tuple[str, ...]) -> None:
    """Refuse a file that cannot be written, before anything is drawn for it.

    Raises:
        InputError: If the ending is none of these.
    """
    ending = path.suffix.lower()
    if ending not in endings:
        found = f"ends in {ending!r}" if ending else "has no ending"
        raise InputError(f"{argument}: {path.name!r} {found}, expected {' or '.join(endings)}")
