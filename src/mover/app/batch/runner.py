"""The one runner of jobs: so many beside each other, each a process of its own.

`mover batch` runs commands with it, `mover experiment` functions. What is finished or has failed is
told by files only, so that a run that was killed goes on where it stopped.
"""

import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from mover.core.files import replacing

POLL = 0.05  # [s] between two looks at the running jobs
LINES = 20  # last lines of the log that a failure record keeps
LOG = "log.txt"
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
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
        pick: Which of those that wait may begin beside those that run; None: none of them yet.
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


def read_tree(path: Path) -> dict[str, Any]:
    """A JSON object, empty where there is none or it was cut short."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write_tree(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a JSON object in one step."""
    with replacing(path) as part:
        part.write_text(json.dumps(tree, indent=1, allow_nan=False))


def last_lines(log: Path) -> list[str]:
    """What a job said last; empty where it said nothing."""
    if not log.is_file():
        return []
    with log.open("rb") as stream:
        stream.seek(max(0, log.stat().st_size - 16_384))
        text = stream.read().decode(errors="replace")
    return [line.rstrip() for line in text.splitlines() if line.strip()][-LINES:]


def record_failure(
    path: Path, about: Mapping[str, Any], code: int | None, lines: Sequence[str]
) -> None:
    """Write down how a job failed.

    Args:
        path: The record.
        about: Name, kind and reason of the failure, and what was to be done.
        code: Exit code, minus the signal that ended it; None: it was not that.
        lines: What it said last.
    """
    ended = {
        "exit_code": code if code is not None and code >= 0 else None,
        "signal": signal_name(-code) if code is not None and code < 0 else None,
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": socket.gethostname(),
        "last_lines": list(lines),
    }
    write_tree(path, {**about, **ended})


def signal_name(number: int) -> str:
    """`SIGKILL`."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


class Forked:
    """A job that is a copy of the server."""

    def __init__(self, process: BaseProcess) -> None:
        self._process = process

    def poll(self) -> int | None:
        """See `Running`."""
        return self._process.exitcode

    def terminate(self) -> None:
        """See `Running`."""
        self._process.terminate()

    def wait(self) -> int:
        """Wait for its end; the exit code."""
        self._process.join()
        code = self._process.exitcode
        assert code is not None, "it has ended"
        return code


def start_main(
    module: str, words: Sequence[str], log: Path, preloaded: tuple[str, ...] = ()
) -> Running[int]:
    """Start `main(words)` of a module in a process with one thread; what it says goes to a log.

    Importing torch and the package takes five seconds of a processor, as long as many jobs take. A
    server (`multiprocessing`'s forkserver) does it once and is copied for each job. It has imported
    and done nothing else: it has no threads, so copies of it are safe.

    Args:
        module: Where `main` is.
        words: Its arguments.
        log: File of what it says.
        preloaded: Modules that the server imports before the first job.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    if not can_fork():  # everything is imported again
        command = [sys.executable, "-m", module, *words]
        with log.open("w") as file, _single_threads():
            return subprocess.Popen(command, stdout=file, stderr=file, stdin=subprocess.DEVNULL)
    process = _server(preloaded).Process(target=_work, args=(module, tuple(words), str(log)))
    with _single_threads():  # the first start starts the server, which keeps these
        process.start()
    return Forked(process)


def can_fork() -> bool:
    """Whether this system has servers that can be copied."""
    return "forkserver" in multiprocessing.get_all_start_methods()


@cache
def _server(preloaded: tuple[str, ...]) -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preloaded))
    return context


@contextmanager
def _single_threads() -> Generator[None]:
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(module: str, words: tuple[str, ...], log: str) -> None:
    """In the copy: do the job, with all that it says in its log."""
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(file, stream.fileno())
    _die_with_parent()
    try:
        import_module(module).main(words)
    except KeyboardInterrupt:  # as a process that does not catch it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)


def _die_with_parent() -> None:
    """The server ends when who waits for the jobs ends; its copies end with it."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
