"""Jobs of an experiment, each a process of its own, so many beside each other."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from mover.app.batch import POLL, THREADS

Task = TypeVar("Task")
End = TypeVar("End")
End_co = TypeVar("End_co", covariant=True)


@runtime_checkable
class Running(Protocol[End_co]):
    """A job that was started."""

    def poll(self) -> End_co | None:
        """How it ended, such as its exit code (minus a signal); None: it still runs."""
        ...

    def terminate(self) -> None:
        """Stop it."""
        ...


def in_turn(waiting: Sequence[Task], running: Mapping[Task, object]) -> Task | None:
    """The job that waits first."""
    del running
    return next(iter(waiting), None)


def run_jobs(
    jobs: Sequence[Task],
    workers: int,
    start: Callable[[Task], Running[End]],
    pick: Callable[[Sequence[Task], Mapping[Task, object]], Task | None] = in_turn,
) -> Iterator[tuple[Task, End]]:
    """Yield each job with its end when it has ended; if that is not waited for, all are stopped.

    Args:
        jobs: In the order in which they should be done.
        workers: How many run at once.
        start: Starts one.
        pick: Which of those that wait may start beside those that run; None: none of them yet.
    """
    waiting, running = list(jobs), dict[Task, Running[End]]()
    try:
        while waiting or running:
            while len(running) < workers and (job := pick(waiting, running)) is not None:
                waiting.remove(job)
                running[job] = start(job)
            ended = [(job, process.poll()) for job, process in running.items()]
            for job, end in ended:
                if end is not None:
                    del running[job]
                    yield job, end
            if running and all(end is None for _, end in ended):
                time.sleep(POLL)
    finally:
        for process in running.values():
            process.terminate()


def start_main(module: str, words: Sequence[str], log: Path) -> Running[int]:
    """Start `python -m module words` with one thread; what it says goes to a log."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as file:
        return subprocess.Popen(
            [sys.executable, "-m", module, *words], stdout=file, stderr=file,
            stdin=subprocess.DEVNULL, env={**os.environ, **dict.fromkeys(THREADS, "1")},
        )  # fmt: skip
