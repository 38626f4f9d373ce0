"""The paper's first table on known rooms: initial, Stage 1 and full, preset by preset.

Every seed and preset is a process of its own; finished ones are files and are not done again.
"""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from ..minimize import Observer, Step, silent
from ..presets import PRESETS
from ..records import InputError, replacing
from .job import DONE, ROOM, SETS, Job, key_of
from .pictures import draw_worst
from .tables import Experiment, Failure, read_outcome, write_tables

log = logging.getLogger(__name__)
WAIT = 0.2  # [s] between two looks at the running jobs
FAILED = "failure.json"
LOG = "log.txt"


@dataclass(frozen=True)
class ExperimentArgs:
    """Rebuild known rooms with each preset and compare with the truth; goes on where it stopped."""

    seeds: str = "0-9"
    """Which rooms: 0-9, or 0,3,5-7."""
    presets: tuple[str, ...] = ("paper", "release", "robust")
    """Which settings."""
    out: Path = Path("experiments")
    """Folder for the results."""
    workers: int = 0
    """How many jobs run at once; 0: as many as there are cores."""
    set: str = "rooms"
    """Where the rooms come from."""
    keep: bool = False
    """Take finished jobs of other versions or settings of the program as they are."""


@runtime_checkable
class Running(Protocol):
    """A job that was started."""

    def poll(self) -> int | None:
        """The exit code; None: it still runs."""
        ...

    def terminate(self) -> None:
        """Stop it."""
        ...


Launch = Callable[[Job], Running]


def run_experiment(
    args: ExperimentArgs, observe: Observer = silent, launch: Launch | None = None
) -> Path:
    """Do all jobs that are not finished, then write tables and pictures.

    Args:
        args: What to do.
        observe: Told of every job that ends.
        launch: Starts a job; None: as a process of its own.

    Returns:
        The summary, OUT/SET/summary.md.

    Raises:
        InputError: If a seed, a preset or a set is none.
    """
    seeds = parse_seeds(args.seeds)
    _check(args)
    rooms = [Job(args.set, seed, ROOM, args.out) for seed in seeds]
    presets = tuple(dict.fromkeys(args.presets))
    rebuilt = [Job(args.set, s, name, args.out) for name in presets for s in seeds]
    jobs, workers = rooms + rebuilt, args.workers or os.cpu_count() or 1
    open_jobs = [job for job in jobs if not _finished(job, args.keep)]
    count, done = len(jobs), len(jobs) - len(open_jobs)
    for job in _run_all(open_jobs, workers, launch or start):
        done += 1
        observe(Step(f"{args.set} {job.seed}: {job.name}", done - 1, count))
    outcomes = [read_outcome(job.folder / DONE) for job in rebuilt if _ended_well(job)]
    failures = [_failure(job) for job in jobs if not _ended_well(job)]
    experiment = Experiment(
        command_of(args), args.set, presets, seeds, tuple(outcomes), tuple(failures)
    )
    folder = args.out / args.set
    pictures = draw_worst(experiment, args.set, args.out)
    return write_tables(experiment, pictures, folder)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Read `0-9` or `0,3,5-7`.

    Raises:
        InputError: If it is anything else.
    """
    seeds: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        ends = [first, last if dash else first]
        if not all(end.isascii() and end.isdigit() for end in ends) or int(ends[1]) < int(ends[0]):
            raise InputError(f"--seeds: {text!r}, expected numbers and ranges like 0,3,5-7")
        seeds.update(range(int(ends[0]), int(ends[1]) + 1))
    return tuple(sorted(seeds))


def command_of(args: ExperimentArgs) -> str:
    """The command that makes the same table."""
    presets = " ".join(args.presets)
    return f"mover experiment --set {args.set} --seeds {args.seeds} --presets {presets}"


def start(job: Job) -> Running:
    """Start a job as a process with one thread; what it says goes to its log."""
    job.folder.mkdir(parents=True, exist_ok=True)
    words = (job.rooms, str(job.seed), job.name, str(job.out))
    command = [sys.executable, "-m", "mover.experiments.job", *words]
    single = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with (job.folder / LOG).open("w") as file:
        return subprocess.Popen(
            command,
            stdout=file,
            stderr=file,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **single},
        )


def _run_all(jobs: Sequence[Job], workers: int, launch: Launch) -> Iterator[Job]:
    """Yield each job when it has ended; rooms come first, and a job waits for its room."""
    waiting, running = list(jobs), dict[Job, Running]()
    try:
        while waiting or running:
            making = {job.seed for job in (*waiting, *running) if job.name == ROOM}
            for job in [j for j in waiting if j.name == ROOM or j.seed not in making]:
                if len(running) >= workers:
                    break
                waiting.remove(job)
                running[job] = _begin(job, launch)
            ended = [(job, process.poll()) for job, process in running.items()]
            for job, code in ended:
                if code is not None:
                    del running[job]
                    _end(job, code)
                    yield job
            if running and all(code is None for _, code in ended):
                time.sleep(WAIT)
    finally:
        for process in running.values():
            process.terminate()


def _begin(job: Job, launch: Launch) -> Running:
    """Forget how an earlier pass ended and start the job."""
    for name in (FAILED, DONE):
        (job.folder / name).unlink(missing_ok=True)
    return launch(job)


def _end(job: Job, code: int) -> None:
    """Write down why a job failed."""
    if code == -signal.SIGINT:  # the user stops everything
        raise KeyboardInterrupt
    if code == 0 and (job.folder / DONE).exists():
        return
    path = job.folder / LOG
    said = path.read_text(errors="replace").strip() if path.exists() else ""
    reason = said.splitlines()[-1] if said else "it said nothing"
    if code < 0:
        reason = f"killed by signal {-code} (out of memory?)"
    log.warning("%s %s: %s failed: %s", job.rooms, job.seed, job.name, reason)
    with replacing(job.folder / FAILED) as part:
        part.write_text(json.dumps({"reason": reason, "exit": code, "log": said[-4000:]}, indent=1))


def _finished(job: Job, keep: bool) -> bool:
    try:
        found = json.loads((job.folder / DONE).read_text())
    except (OSError, ValueError):
        return False
    return keep or found.get("key") == key_of(job)


def _ended_well(job: Job) -> bool:
    return (job.folder / DONE).exists()


def _failure(job: Job) -> Failure:
    path = job.folder / FAILED
    reason = json.loads(path.read_text())["reason"] if path.exists() else "it left no results"
    return Failure(job.seed, job.name, str(reason))


def _check(args: ExperimentArgs) -> None:
    if args.set not in SETS:
        raise InputError(f"--set: {args.set!r} is none of {', '.join(SETS)}")
    for name in args.presets:
        if name not in PRESETS:
            raise InputError(f"--presets: {name!r} is none of {', '.join(PRESETS)}")
    if args.workers < 0:
        raise InputError(f"--workers: {args.workers}, expected 0 or more")
