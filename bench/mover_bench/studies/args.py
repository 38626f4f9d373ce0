"""What `mover experiment` and its parts can be asked for. Imports no torch: `--help` is quick."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mover.core.settings import Steps, int_in


@dataclass(frozen=True)
class ExperimentArgs:
    """Rebuild known rooms with each preset and compare with the truth; goes on where it stopped."""

    seeds: str = "0-9"
    """Which rooms: 0-9, or 0,3,5-7."""
    presets: tuple[str, ...] = ("paper", "robust")
    """Which settings: presets, or `robust` without one of its parts (see docs/results.md)."""
    out: Path = Path("experiments")
    """Folder for the results."""
    workers: Annotated[int, int_in(0, 10_000)] = 0
    """How many jobs run at once; 0: as many as there are cores."""
    set: str = "rooms"
    """Where the rooms come from."""
    keep: bool = False
    """Take finished jobs of other versions or settings of the program as they are."""
    worst: Annotated[int, int_in(0, 1000)] = 3
    """How many of the worst objects are drawn."""


@dataclass(frozen=True)
class StudyArgs:
    """Make one of the paper's experiments on known rooms, or all; goes on where it stopped."""

    name: Annotated[Positional[str], arg(metavar="STUDY")]
    """ablation, camera, bodies, refit, video-length, interactions, time, sensitivity, paper, sets,
    stability, motion, upstream, all."""
    set: str = ""
    """Which rooms; empty: those that the study is meant for."""
    seeds: str = ""
    """Which of them: 1000-1009, or 1000,1003; empty: all that are held out."""
    presets: tuple[str, ...] = ("paper", "robust")
    """Which presets the studies `sets` and `paper` try."""
    errors: tuple[str, ...] = ()
    """Which errors the study `sensitivity` tries: scale, place, ..., or `paper` switches off:
    camera, bodies, contacts, masks; empty: all."""
    steps: Steps = 0
    """Steps of the last descent in the studies `paper` and `refit`; 0: the presets' own."""
    out: Path = Path("experiments")
    """Folder for the results."""
    workers: Annotated[int, int_in(0, 10_000)] = 0
    """How many jobs run at once; 0: as many as there are cores."""
    keep: bool = False
    """Take finished jobs of other versions or settings of the program as they are."""
    look: bool = False
    """Run nothing: write the pages from the jobs that are finished."""


@dataclass(frozen=True)
class MakeArgs:
    """Make the rooms of a set; goes on where it stopped."""

    set: Annotated[Positional[str], arg(metavar="SET")]
    """Name of a set, see docs/rooms.md."""
    out: Path = Path("experiments")
    """Folder for the rooms."""
    seeds: str = ""
    """Which rooms: 1000-1004, or 1000,1003; empty: the held-out ones."""
    captures: bool = False
    """Write each room as a capture folder with its truth, for `mover run` and other tools."""
    check: bool = False
    """Compare with the hashes that the package holds."""
    workers: Annotated[int, int_in(0, 10_000)] = 0
    """How many rooms are made at once; 0: as many as there are cores."""
    keep: bool = False
    """Take rooms that another version of the program has made as they are."""
