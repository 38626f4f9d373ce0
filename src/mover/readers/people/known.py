"""What the user knows beyond the files of a tool."""

from dataclasses import dataclass
from pathlib import Path

from ...types import Camera


@dataclass(frozen=True)
class Known:
    """What the user knows beyond the files of a tool."""

    camera: Camera | None = None
    """The true lens: bodies are moved so that they keep their pixels under it."""
    focal: float | None = None
    """The focal length that the tool assumed, where its files do not tell [px]."""
    faces: Path | None = None
    """A mesh file with the triangles of the bodies, where their model is not at hand."""
    fps: float | None = None
    """Frames a second."""
    gender: str | None = None
    """neutral, female or male; None: what the files say, else neutral."""
    first: int = 0
    """The number in the name of the first frame's file."""
