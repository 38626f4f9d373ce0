"""What `mover experiment` can be asked for. Imports no torch: `--help` is quick."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mover.core.settings import int_in


@dataclass(frozen=True)
class ExperimentArgs:
    """Reconstruct known rooms with each variant and compare with the truth; resumes."""

    seeds: str = "0-9"
    """Which rooms: 0-9, or 0,3,5-7."""
    variants: tuple[str, ...] = ("robust", "paper")
    """Presets, other variants, or lists of them: ablation, parts, terms, length, sensitivity.
    The first one is what the others are compared with."""
    out: Path = Path("experiments")
    """Folder for the results."""
    workers: Annotated[int, int_in(0, 10_000)] = 0
    """How many rooms are worked on at once; 0: as many as there are cores."""
    set: str = "rooms"
    """Set of rooms, see docs/rooms.md; or i3db, with --source."""
    source: Path | None = None
    """For the set i3db: the folder i3DB of amonszpart/iMapper. Its scenes are reconstructed with
    the first variant, from library furniture and from the true shapes."""
    keep: bool = False
    """Take finished results of other versions or settings of the program as they are."""
