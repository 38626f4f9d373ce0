"""Known rooms that many tests look at: made once, and kept on disk until a source changes."""

import fcntl
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from mover.core.files import sources
from mover.core.observe import Observer, silent
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Bodies, Capture, People
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.known import KnownRoom, demo_room, make_room

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mover-tests"
FEW = 2  # rooms of one kind that are kept: of these sources, and of those before them
Rows = TypeVar("Rows", Bodies, People)
Make = Callable[["Recipe", RoomConfig, Observer], KnownRoom]


@dataclass(frozen=True)
class Recipe:
    """What a room is made of beside its settings."""

    seed: int
    sources: str
    """Digest of all that makes rooms."""


def drawn(inputs: Recipe, config: RoomConfig, observe: Observer = silent) -> KnownRoom:
    """A drawn room."""
    del observe
    return make_room(inputs.seed, config)


def demo(inputs: Recipe, config: RoomConfig, observe: Observer = silent) -> KnownRoom:
    """The room of `mover demo`."""
    del inputs, config, observe
    return demo_room()


def kept(make: Make, seed: int = 0, config: RoomConfig | None = None) -> KnownRoom:
    """The room from disk, or made and written there; one worker makes it, the others wait."""
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        recipe = Recipe(seed, sources("mover_bench"))
        room = Run(CACHE).stage(make, recipe, config or RoomConfig())
        _forget(CACHE / "stages" / make.__name__)
    return room


def _forget(folder: Path) -> None:
    """Remove all but the newest rooms."""
    files = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in files[FEW:]:
        path.unlink()
        path.with_suffix(".npz").unlink(missing_ok=True)


def some(rows: Rows, every: int = 8) -> Rows:
    """Bodies, or masks of people, of every so many frames."""
    return rows_of(rows, rows.frame % every == 0)


def thinned(capture: Capture, every: int = 8) -> Capture:
    """Every so many frames of the people."""
    return replace(capture, bodies=some(capture.bodies, every), people=some(capture.people, every))
