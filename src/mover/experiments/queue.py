"""Do many jobs at once: each a process of its own, room by room; finished ones are files."""

import json
import logging
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence

from ..records import replacing
from .job import DONE, ROOM, Job, key_of
from .processes import Running, start_process
from .tables import Failure

log = logging.getLogger(__name__)
WAIT = 0.2  # [s] between two looks at the running jobs
FAILED = "failure.json"
LOG = "log.txt"


Launch = Callable[[Job], Running]


def start(job: Job) -> Running:
    """Start a job; what it says goes to its log."""
    words = (job.rooms, str(job.seed), job.name, str(job.out))
    return start_process("mover.experiments.job", words, job.folder / LOG)


def open_jobs(jobs: Sequence[Job], keep: bool) -> list[Job]:
    """Those that are not finished; a room only if a job of it is open and the room is not there.

    Args:
        jobs: The rooms among them.
        keep: Take what other versions or settings of the program have finished.
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


def run_all(
    jobs: Sequence[Job], workers: int, launch: Launch, *, store: bool = True
) -> Iterator[Job]:
    """Yield each job when it has ended.

    A job waits for its room. A worker prefers a room that nobody works on, because the first job
    of a room leaves stages that the others take; what is left of them goes with the last job.

    Args:
        jobs: In the order in which they should be done.
        workers: How many run at once.
        launch: Starts one.
        store: Keep the rooms themselves when their last job has ended.
    """
    waiting, running = list(jobs), dict[Job, Running]()
    try:
        while waiting or running:
            while len(running) < workers and (job := _next(waiting, running)) is not None:
                waiting.remove(job)
                running[job] = _begin(job, launch)
            ended = [(job, process.poll()) for job, process in running.items()]
            for job, code in ended:
                if code is not None:
                    del running[job]
                    _end(job, code)
                    _clear(job, (*waiting, *running), store)
                    yield job
            if running and all(code is None for _, code in ended):
                time.sleep(WAIT)
    finally:
        for process in running.values():
            process.terminate()


def _next(waiting: Sequence[Job], running: dict[Job, Running]) -> Job | None:
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
    try:
        found = json.loads((job.folder / DONE).read_text())
    except (OSError, ValueError):
        return False
    return keep or found.get("key") == key_of(job)


def has_results(job: Job) -> bool:
    """Whether a job left results in this or an earlier pass."""
    return (job.folder / DONE).exists()


def failure_of(job: Job) -> Failure:
    """Why a job left no results."""
    path = job.folder / FAILED
    reason = json.loads(path.read_text())["reason"] if path.exists() else "it left no results"
    return Failure(job.seed, job.name, str(reason))
