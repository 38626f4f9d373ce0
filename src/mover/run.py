"""A folder of finished stages: equal inputs and settings are not computed twice."""

import functools
import hashlib
import logging
import resource
import sys
import time
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from . import __version__, records
from .minimize import Observer, silent

log = logging.getLogger(__name__)
In = TypeVar("In")
Conf = TypeVar("Conf")
Out = TypeVar("Out")


@dataclass(frozen=True)
class StageLog:
    """What a stage cost."""

    name: str
    seconds: float
    peak_memory: float
    """Peak resident memory of the process until then [MB]."""
    kept: bool
    """True: read from disk, not computed."""
    fingerprint: str = ""
    """Name of its files in stages/<name>."""


@dataclass(frozen=True)
class Run:
    """A folder of finished stages, and the log of this pass over them."""

    folder: Path
    observe: Observer = silent
    stages: list[StageLog] = field(default_factory=lambda: [])

    def stage(self, fn: Callable[[In, Conf, Observer], Out], inputs: In, config: Conf) -> Out:
        """Return the stored output of `fn`, or compute and store it.

        The output is found by the content of its inputs and settings, the version of the package
        and its sources: a stale result cannot be read, and a killed run goes on where it stopped.
        """
        name = getattr(fn, "__name__", "stage")
        path = self.folder / "stages" / name / records.fingerprint(inputs, config, sources())
        begin = time.perf_counter()
        kept = path.with_suffix(".json").exists()
        if kept:
            output = records.load(typing.get_type_hints(fn)["return"], path)
        else:
            output = fn(inputs, config, self.observe)
            records.save(output, path)
        seconds = time.perf_counter() - begin
        self.stages.append(StageLog(name, seconds, _peak_memory(), kept, path.name))
        log.info(
            "%s: %s %s in %.1f s",
            name,
            "kept" if kept else "made",
            path.name,
            self.stages[-1].seconds,
        )
        return output


def _peak_memory() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


@functools.cache
def sources() -> str:
    """Digest of the package's version and sources."""
    digest = hashlib.sha256(__version__.encode())
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
