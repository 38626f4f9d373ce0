"""Where the jobs of a batch run: on this machine, on a Ray cluster, or under SLURM."""

import importlib
import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from mover.app.batch.job import Attempt, Job, Outcome, lost, run_job
from mover.app.batch.runner import run_jobs
from mover.core.errors import InputError
from mover.core.settings import float_in, int_in

ARRAY = 1000  # jobs in one SLURM array; many clusters allow no more
WAIT = 1.0  # [s] between two looks at a cluster


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

    cluster: str = "slurm"
    """slurm; local and debug are submitit's stand-ins for a test."""
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
    _need("ray", "ray")
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
    """Arrays of SLURM jobs, one a capture."""
    if not jobs:
        return
    _need("submitit", "slurm")
    submitit: Any = importlib.import_module("submitit")
    executor = submitit.AutoExecutor(folder=out / "slurm", cluster=options.slurm.cluster)
    executor.update_parameters(**_parameters(options, jobs[0].limit))
    for start in range(0, len(jobs), ARRAY):
        part = jobs[start : start + ARRAY]
        waiting = dict(zip(executor.map_array(run_job, part), part, strict=True))
        try:
            while waiting:
                ready = [handle for handle in waiting if handle.done()]
                for handle in ready:
                    yield _result(waiting.pop(handle), handle)
                if not ready:
                    time.sleep(WAIT)
        finally:
            for handle in waiting:
                handle.cancel()


def _parameters(options: EngineOptions, limit: float) -> dict[str, Any]:
    """The options as submitit calls them."""
    asked = options.slurm
    needed = math.ceil(limit / 60) + 5 if limit > 0 else 120
    found: dict[str, Any] = {
        "timeout_min": asked.minutes or needed, "cpus_per_task": asked.cpus, "name": "mover",
        "slurm_array_parallelism": options.workers,
    }  # fmt: skip
    if asked.gpus:
        found["gpus_per_node"] = asked.gpus
    if asked.memory:
        found["mem_gb"] = asked.memory
    if asked.partition:
        found["slurm_partition"] = asked.partition
    return found


def _result(job: Job, handle: Any) -> Outcome:  # noqa: ANN401
    try:
        return handle.result()
    except Exception as error:  # submitit raises what the worker raised, or that it vanished
        return lost(job, error)


def _need(package: str, extra: str) -> None:
    if find_spec(package) is None:
        raise InputError(
            f"--engine {extra}: {package} is not installed; "
            f"pip install '.[{extra}]' in mover's folder"
        )


ENGINES: dict[str, Engine] = {"local": on_this_machine, "ray": on_ray, "slurm": on_slurm}
"""How to run jobs, by name."""
