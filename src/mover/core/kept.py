"""What is made of the same input in every run, kept in the user's cache folder."""

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from mover.core import records
from mover.core.errors import InputError

log = logging.getLogger(__name__)
T = TypeVar("T")
MOST = 2000  # records; the oldest half goes when there are more


def kept(kind: type[T], key: str, make: Callable[[], T]) -> T:
    """What was made under this key before, in any run; else it is made now and kept.

    Nothing hangs on the folder (`$XDG_CACHE_HOME/mover`, by default `~/.cache/mover`): what is
    damaged is made anew, and where nothing can be written, nothing is kept.

    Args:
        kind: The record that `make` gives.
        key: Of all that it is made from, and of the sources that make it.
        make: Makes it.
    """
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mover"
    path = folder / f"{kind.__name__}-{key}"
    with suppress(InputError, OSError):
        found = records.load(kind, path)
        os.utime(path.with_suffix(".json"))  # what is used stays
        return found
    made = make()
    try:
        records.save(made, path)
        _bound(folder)
    except OSError as error:
        log.info("%s: %s; nothing is kept there", folder, error.strerror)
    return made


def _bound(folder: Path) -> None:
    """Remove the half that was not used for longest where there are too many."""
    found = list(folder.glob("*.json"))
    if len(found) <= MOST:
        return
    ages: list[tuple[float, Path]] = []
    for path in found:
        with suppress(OSError):  # another process removes it
            ages.append((path.stat().st_mtime, path))
    for _, path in sorted(ages)[: MOST // 2]:
        for suffix in (".json", ".npz"):
            path.with_suffix(suffix).unlink(missing_ok=True)
