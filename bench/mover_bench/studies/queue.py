"""The order of an experiment's jobs: room by room; finished ones are files."""

import logging
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence

from mover.app.batch import LOG, last_lines, read_tree, record_failure
from mover.core.errors import InputError
from mover.core.observe import Observer, Step
from mover_bench.processes import Running, run_jobs, start_main
from mover_bench.studies.job import DONE, ROOM, Job, key_of

log = logging.getLogger(__name__)
FAILED = "failure.json"
Launch = Callable[[Job], Running[int]]
"""Starts a job; where none is given, as a process of its own."""


def start(job: Job, module: str = "mover_bench.studies.job", *more: str) -> Running[int]:
    """Start a job in the process of a module, with `more` words; what it says goes to its log."""
    words = (job.rooms, str(job.seed), job.name, str(job.out), *more)
    return start_main(module, words, job.folder / LOG)


def open_jobs(jobs: Sequence[Job], keep: bool) -> list[Job]:
    """Those that are not finished; a room only if a job of it is open and the room is not there.

    With `keep` what other versions or settings of the program have finished counts.
    """
    waiting = [job for job in jobs if job.name != ROOM and not is_finished(job, keep)]
    needed = {(job.rooms, job.seed) for job in waiting}
    rebuilt = {(job.rooms, job.seed) for job in jobs if job.name != ROOM}
    rooms = [
        job
        for job in jobs
        if job.name == ROOM
        and ((job.rooms, job.seed) in needed or (job.rooms, job.seed) not in rebuilt)
        and not (is_finished(job, keep) and job.room.with_suffix(".json").exists())
    ]
    return [*rooms, *waiting]


def finish(
    jobs: Sequence[Job],
    waiting: Sequence[Job],
    workers: int,
    work: tuple[Observer, Launch],
    *,
    store: bool = True,
) -> None:
    """Do those of the jobs that wait, and tell an observer of each that ends.

    Raises:
        InputError: If the number of workers is negative; 0: as many as there are cores.
    """
    if workers < 0:
        raise InputError(f"--workers: {workers}, expected 0 or more")
    observe, launch = work
    ended = run_all(waiting, workers or os.cpu_count() or 1, launch, store=store)
    for done, job in enumerate(ended, len(jobs) - len(waiting)):
        observe(Step(f"{job.rooms} {job.seed}: {job.name}", done, len(jobs)))


def run_all(
    jobs: Sequence[Job], workers: int, launch: Launch, *, store: bool = True
) -> Iterator[Job]:
    """Yield each job when it has ended.

    A job waits for its room. A worker prefers a room that nobody works on, because the first job
    of a room leaves stages that the others take; what is left of them goes with the last job. So
    does the room itself, unless it is stored.
    """
    left = list(jobs)

    def begin(job: Job) -> Running[int]:
        for name in (FAILED, DONE):  # forget how an earlier pass ended
            (job.folder / name).unlink(missing_ok=True)
        return launch(job)

    for job, code in run_jobs(jobs, workers, begin, _next):
        _end(job, code)
        left.remove(job)
        _clear(job, left, store)
        yield job


def _next(waiting: Sequence[Job], running: Mapping[Job, object]) -> Job | None:
    """The next job that may begin: of a room that nobody works on, if there is one."""
    making = {(job.rooms, job.seed) for job in (*waiting, *running) if job.name == ROOM}
    seeds = {job.seed for job in running if job.name == ROOM}
    free = [
        job
        for job in waiting
        if (job.name == ROOM and job.seed not in seeds)
        or (job.name != ROOM and (job.rooms, job.seed) not in making)
    ]
    busy = {(job.rooms, job.seed) for job in running}
    alone = [job for job in free if (job.rooms, job.seed) not in busy]
    ready = [job for job in alone if job.name != ROOM]  # finish a room before the next is made
    return next(iter((*ready, *alone, *free)), None)


def _end(job: Job, code: int) -> None:
    """Write down why a job failed."""
    if code == -signal.SIGINT:  # the user stops everything
        raise KeyboardInterrupt
    if code == 0 and (job.folder / DONE).exists():
        return
    lines = last_lines(job.folder / LOG)
    reason = lines[-1] if lines else "it said nothing"
    if code < 0:
        reason = f"killed by signal {-code} (out of memory?)"
    log.warning("%s %s: %s failed: %s", job.rooms, job.seed, job.name, reason)
    about = {"name": f"{job.rooms} {job.seed} {job.name}", "reason": reason}
    record_failure(job.folder / FAILED, about, code, lines)


def _clear(job: Job, left: Sequence[Job], store: bool) -> None:
    """Remove the stages of a room whose last job has ended, and what no other room needs."""
    if not any((other.rooms, other.seed) == (job.rooms, job.seed) for other in left):
        shutil.rmtree(job.home / "stages", ignore_errors=True)
        if not store:
            for ending in (".json", ".npz"):
                job.room.with_suffix(ending).unlink(missing_ok=True)
    if not any(other.seed == job.seed for other in left):
        shutil.rmtree(job.truths, ignore_errors=True)


def is_finished(job: Job, keep: bool) -> bool:
    """Whether its results are there, of this version unless others are taken as well."""
    found = read_tree(job.folder / DONE)
    return bool(found) and (keep or found.get("key") == key_of(job))


def has_results(job: Job) -> bool:
    """Whether a job left results in this or an earlier pass."""
    return (job.folder / DONE).exists()


def failure_of(job: Job) -> str:
    """Why a job left no results."""
    return str(read_tree(job.folder / FAILED).get("reason", "it left no results"))
