"""Where the jobs of a batch run: on this machine, on a Ray cluster, or under SLURM."""

import importlib
import logging
import math
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Annotated, Any

import msgspec

from mover.app.batch.job import Attempt, Job, Outcome, earlier, lost, run_job
from mover.app.batch.runner import run_jobs
from mover.core.errors import InputError
from mover.core.settings import float_in, int_in

ARRAY = 1000  # jobs in one SLURM array; many clusters allow no more
WAIT = 2.0  # [s] between two looks at SLURM's queue
LATE = 30.0  # [s] after which the files of a job that has ended must be seen here


@dataclass(frozen=True)
class RayOptions:
    """Share of a machine that each capture gets from Ray."""

    address: str = "local"
    """Of a running cluster (`auto`, `ray://...`); local: start one on this machine."""
    cpus: Annotated[float, float_in(0.01, 1024)] = 1.0
    """Cores for each capture; fractions share a core."""
    gpus: Annotated[float, float_in(0, 64)] = 0.0
    """GPUs for each capture; 0.25: four captures share one."""
    retries: Annotated[int, int_in(0, 1000)] = 2
    """How often a capture is run again whose machine or worker was lost."""


@dataclass(frozen=True)
class SlurmOptions:
    """What each capture asks of SLURM."""

    partition: str = ""
    """Empty: the cluster's default."""
    cpus: Annotated[int, int_in(1, 1024)] = 1
    """Cores for each capture."""
    gpus: Annotated[int, int_in(0, 64)] = 0
    """GPUs for each capture."""
    memory: Annotated[float, float_in(0, 1e5)] = 0.0
    """[GB]; 0: the cluster's default."""
    minutes: Annotated[int, int_in(0, 100_000)] = 0
    """Time that is asked for each capture; 0: its limit and five minutes more, else two hours."""


@dataclass(frozen=True)
class EngineOptions:
    """Where a batch runs."""

    engine: str = "local"
    """local, ray or slurm."""
    workers: Annotated[int, int_in(1, 10_000)] = 1
    """Captures at a time."""
    ray: RayOptions = field(default_factory=RayOptions)
    slurm: SlurmOptions = field(default_factory=SlurmOptions)


Engine = Callable[[Sequence[Job], EngineOptions, Path], Iterator[Outcome]]


def on_this_machine(jobs: Sequence[Job], options: EngineOptions, out: Path) -> Iterator[Outcome]:
    """So many processes at a time."""
    del out
    for _, outcome in run_jobs(jobs, options.workers, Attempt):
        yield outcome


def on_ray(jobs: Sequence[Job], options: EngineOptions, out: Path) -> Iterator[Outcome]:
    """One Ray task a capture; each still runs it in a process of its own."""
    del out
    if not jobs:
        return
    if find_spec("ray") is None:
        raise InputError(
            "--engine ray: ray is not installed; pip install '.[ray]' in mover's folder"
        )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray: Any = importlib.import_module("ray")
    asked = options.ray
    cores = max(1, round(options.workers * max(asked.cpus, 1e-3)))
    local: dict[str, Any] = {"num_cpus": cores} if asked.address == "local" else {}
    ray.init(
        address=asked.address, include_dashboard=False if local else None, log_to_driver=False,
        logging_level=logging.ERROR, ignore_reinit_error=True, **local,
    )  # fmt: skip
    share = {"num_cpus": asked.cpus, "num_gpus": asked.gpus, "max_retries": asked.retries}
    task = ray.remote(**share)(run_job)
    waiting: dict[Any, Job] = {}
    todo = iter(jobs)
    try:
        while True:
            for job in todo:
                waiting[task.remote(job)] = job
                if len(waiting) >= options.workers:
                    break
            if not waiting:
                return
            ready, _ = ray.wait(list(waiting), num_returns=1)
            yield _answer(waiting.pop(ready[0]), ray, ready[0])
    finally:
        ray.shutdown()


def _answer(job: Job, ray: Any, handle: Any) -> Outcome:  # noqa: ANN401
    try:
        return ray.get(handle)
    except ray.exceptions.RayError as error:
        return lost(job, error)


def on_slurm(jobs: Sequence[Job], options: EngineOptions, out: Path) -> Iterator[Outcome]:
    """Arrays of SLURM jobs, one a capture.

    Asked is `squeue` only, which knows no more than what waits and runs, so that no cluster needs
    accounting: how a job ended stands in its folder. SLURM itself runs those again whose node died.
    """
    if not jobs:
        return
    missing = [name for name in ("sbatch", "squeue", "scancel") if shutil.which(name) is None]
    if missing:
        raise InputError(
            f"--engine slurm: there is no {missing[0]}, expected a machine with SLURM's commands"
        )
    folder = out / "slurm"
    folder.mkdir(parents=True, exist_ok=True)
    for start in range(0, len(jobs), ARRAY):
        yield from _array(jobs[start : start + ARRAY], options, folder)


def _array(jobs: Sequence[Job], options: EngineOptions, folder: Path) -> Iterator[Outcome]:
    with NamedTemporaryFile(dir=folder, prefix="jobs-", suffix=".json", delete=False) as file:
        file.write(msgspec.json.encode(jobs))
    number = _asked(_sbatch(options, len(jobs), jobs[0].limit, Path(file.name))).split(";")[0]
    waiting, gone = dict(enumerate(jobs)), dict[int, float]()
    try:
        while waiting:
            time.sleep(WAIT)
            queued = _queued(number)
            for place in [p for p in waiting if queued is not None and p not in queued]:
                since = gone.setdefault(place, time.monotonic())
                found = earlier(waiting[place])
                if found is None and time.monotonic() - since > LATE:
                    log = folder / f"{number}_{place}.log"
                    found = lost(waiting[place], RuntimeError(f"SLURM has ended it, see {log}"))
                if found is not None:
                    del waiting[place]
                    yield replace(found, state="done") if found.state == "kept" else found
    finally:
        if waiting:
            subprocess.run(["scancel", number], check=False, capture_output=True)


def _queued(number: str) -> set[int] | None:
    """Places in an array that wait or run; None: SLURM does not answer now."""
    asked = subprocess.run(
        ["squeue", "--noheader", "--array", "--format=%K", f"--jobs={number}"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if asked.returncode:  # it forgets an array some minutes after its end
        return set() if "Invalid job id" in asked.stderr else None
    return {int(word) for word in asked.stdout.split()}


def _sbatch(options: EngineOptions, count: int, limit: float, jobs: Path) -> list[str]:
    """The command that queues an array."""
    asked = options.slurm
    minutes = asked.minutes or (math.ceil(limit / 60) + 5 if limit > 0 else 120)
    work = f"from mover.app.batch.job import run_numbered; run_numbered({str(jobs)!r})"
    return [
        "sbatch", "--parsable", "--requeue", "--open-mode=append", "--job-name=mover",
        f"--array=0-{count - 1}%{options.workers}", f"--output={jobs.parent}/%A_%a.log",
        f"--time={minutes}", f"--cpus-per-task={asked.cpus}",
        *([f"--gpus-per-node={asked.gpus}"] if asked.gpus else []),
        *([f"--mem={math.ceil(1024 * asked.memory)}M"] if asked.memory else []),
        *([f"--partition={asked.partition}"] if asked.partition else []),
        f"--wrap={shlex.join(['exec', sys.executable, '-c', work])}",
    ]  # fmt: skip


def _asked(command: Sequence[str]) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except subprocess.CalledProcessError as error:
        said = " ".join(str(error.stderr).split())
        raise InputError(f"--engine slurm: {command[0]} refuses the jobs: {said}") from None


ENGINES: dict[str, Engine] = {"local": on_this_machine, "ray": on_ray, "slurm": on_slurm}
"""How to run jobs, by name."""
