"""A folder of finished stages: equal inputs and settings are not computed twice."""

import functools
import hashlib
import logging
import os
import resource
import sys
import time
import typing
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch

from mover import __version__
from mover.core import records
from mover.core.devices import CPU, named
from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent

log = logging.getLogger(__name__)
In = TypeVar("In")
Conf = TypeVar("Conf")
Out = TypeVar("Out")
ON_DEVICE = ("refine_camera", "gather_cues", "place_objects")  # where the time goes


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
    device: torch.device = CPU
    """Where the stages in `ON_DEVICE` compute; all others do on the processor."""
    started: dict[Path, "Future[tuple[Any, float]]"] = field(default_factory=lambda: {})
    """Stages that are computed beside others, and how many seconds they took."""

    def stage(self, fn: Callable[[In, Conf, Observer], Out], inputs: In, config: Conf) -> Out:
        """Return the stored output of `fn`, or compute and store it.

        The output is found by the content of its inputs and settings, the version of the package
        and its sources: a stale result cannot be read, and a killed run goes on where it stopped.
        Inputs and output lie on the processor; what another device computed has another name.
        """
        name, device, path = self._named(fn, inputs, config)
        start, beside = time.perf_counter(), self.started.pop(path, None)
        kind = typing.get_type_hints(fn)["return"]
        output: Out | None = _stored(kind, path) if beside is None else None
        kept = output is not None
        if beside is not None:
            self.observe(Step(name, 0, 1))
            output, took = beside.result()
            start = time.perf_counter() - took
        if output is None and device == CPU:
            output = fn(inputs, config, self.observe)
        elif output is None:  # it lies on the processor, wherever it is computed
            found = fn(records.to_device(inputs, device), config, self.observe)
            output = records.to_device(found, CPU)
        if not kept:
            records.save(output, path)
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        megabytes = peak / (1e6 if sys.platform == "darwin" else 1e3)
        self.stages.append(StageLog(name, seconds, megabytes, kept, path.name))
        log.info("%s: %s %s in %.1f s", name, "kept" if kept else "made", path.name, seconds)
        return output

    def begin(self, fn: Callable[[In, Conf, Observer], Out], inputs: In, config: Conf) -> None:
        """Begin to compute what `stage` is asked for later, beside the stages in between.

        The output is the same. Nothing is done where it is on disk, or where a GPU computes it.
        """
        _, device, path = self._named(fn, inputs, config)
        if device != CPU or path in self.started or path.with_suffix(".json").exists():
            return

        def work() -> tuple[Out, float]:
            start = time.perf_counter()
            return fn(inputs, config, silent), time.perf_counter() - start

        self.started[path] = _beside().submit(copy_context().run, work)

    def _named(
        self, fn: Callable[[In, Conf, Observer], Out], inputs: In, config: Conf
    ) -> tuple[str, torch.device, Path]:
        """A stage's name, where it computes, and its files, by all that it is made from.

        A GPU is not worth it for descents that ask after each step (`docs/engine.md`).
        """
        name = getattr(fn, "__name__", "stage")
        gains = name in ON_DEVICE and getattr(getattr(config, "method", None), "on_device", True)
        device = self.device if gains else CPU
        where = () if device == CPU else (named(device),)
        package = (getattr(fn, "__module__", None) or "").partition(".")[0]
        key = records.fingerprint(inputs, config, sources(package), *where)
        return name, device, self.folder / "stages" / name / key


@functools.cache
def _beside() -> ThreadPoolExecutor:
    """One thread: what is started is computed one after the other."""
    return ThreadPoolExecutor(1, thread_name_prefix="mover-beside")


def _stored(kind: type[Out], path: Path) -> Out | None:
    """A finished output; None where there is none, or none that can be trusted, which is said."""
    if not path.with_suffix(".json").exists():
        return None
    try:
        return records.load(kind, path)
    except InputError as error:
        log.warning("warning: %s; it is computed again", error)
        return None


@functools.cache
def sources(package: str = "mover") -> str:
    """Digest of the version and sources of `mover`, and of another package that builds on it."""
    digest = hashlib.sha256(__version__.encode())
    for name in dict.fromkeys(("mover", package)):
        for folder in getattr(sys.modules.get(name), "__path__", ()):
            for path in sorted(Path(folder).rglob("*.py")):
                digest.update(path.read_bytes())
    return digest.hexdigest()


# What is made of the same input in every run, kept in the user's cache folder.


T = TypeVar("T")
MOST = 2000  # records; the oldest half goes when there are more


def kept(kind: type[T], key: str, make: Callable[[], T]) -> T:
    """What was made under this key before, in any run; else it is made now and kept.

    Nothing hangs on the folder (`$XDG_CACHE_HOME/mover`, by default `~/.cache/mover`): what is
    damaged is made again, and where nothing can be written, nothing is kept.

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
        ages: list[tuple[float, Path]] = []
        for file in folder.glob("*.json"):
            with suppress(OSError):  # another process removes it
                ages.append((file.stat().st_mtime, file))
        for _, file in sorted(ages)[: MOST // 2 if len(ages) > MOST else 0]:
            for suffix in (".json", ".npz"):
                file.with_suffix(suffix).unlink(missing_ok=True)
    except OSError as error:
        log.info("%s: %s; nothing is kept there", folder, error.strerror)
    return made
