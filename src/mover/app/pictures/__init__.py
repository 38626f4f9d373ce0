"""Pictures and films of a room, without a screen. This file imports no torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from mover.core.errors import InputError
from mover.core.settings import Index, int_in


@dataclass(frozen=True)
class RenderConfig:
    """What is drawn."""

    scene: Literal["result", "initial"] = "result"
    """The result, or the initial scene."""
    width: Annotated[int, int_in(16, 8192)] = 960
    """Of one picture [px]."""
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
