"""A folder of finished stages: equal inputs and settings are not computed twice."""

import logging
import resource
import sys
import time
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import torch

from mover.core import records
from mover.core.devices import CPU, named
from mover.core.errors import InputError
from mover.core.files import sources
from mover.core.observe import Observer, silent

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
    peak_memory: float  #: peak resident memory of the process until then [MB]
    kept: bool  #: True: read from disk, not computed
    fingerprint: str = ""  #: name of its files in stages/<name>


@dataclass(frozen=True)
class Run:
    """A folder of finished stages, and the log of this pass over them."""

    folder: Path
    observe: Observer = silent
    stages: list[StageLog] = field(default_factory=lambda: [])
    device: torch.device = CPU
    """Where the stages in `ON_DEVICE` compute; all others do on the processor."""

    def stage(self, fn: Callable[[In, Conf, Observer], Out], inputs: In, config: Conf) -> Out:
        """Return the stored output of `fn`, or compute and store it.

        The output is found by the content of its inputs and settings, the version of the package
        and its sources: a stale result cannot be read, and a killed run goes on where it stopped.
        Inputs and output lie on the processor; what another device computed has another name.
        """
        name, device, path = self._named(fn, inputs, config)
        start = time.perf_counter()
        kind = typing.get_type_hints(fn)["return"]
        output: Out | None = None
        if path.with_suffix(".json").exists():
            try:
                output = records.load(kind, path)
            except InputError as error:
                log.warning("warning: %s; it is computed again", error)
        kept = output is not None
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
