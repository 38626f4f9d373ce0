"""Start jobs from a process that has imported everything: each is still a process of its own.

Importing torch and the package takes five seconds of a processor, as long as many jobs take. A
server (`multiprocessing`'s forkserver) does it once and is copied for each job. It has imported and
done nothing else: it has no threads, so copies of it are safe.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Protocol, runtime_checkable

PRELOADED = (
    "mover.experiments.job", "mover.experiments.made", "warp", "scipy.interpolate",
    "scipy.ndimage", "scipy.sparse.csgraph",
)  # fmt: skip
"""What jobs do, and what they import themselves when they first need it."""
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@runtime_checkable
class Running(Protocol):
    """A job that was started."""

    def poll(self) -> int | None:
        """The exit code, minus the signal that killed it; None: it still runs."""
        ...

    def terminate(self) -> None:
        """Stop it."""
        ...


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


def start_process(module: str, words: Sequence[str], log: Path) -> Running:
    """Start `main(words)` of a module in a process with one thread; what it says goes to a log."""
    log.parent.mkdir(parents=True, exist_ok=True)
    if not can_fork():
        return _start_anew(module, words, log)
    process = _server().Process(target=_work, args=(module, tuple(words), str(log)))
    with _single_threads():  # the first start starts the server, which keeps these
        process.start()
    return Forked(process)


def can_fork() -> bool:
    """Whether this system has servers that can be copied."""
    return "forkserver" in multiprocessing.get_all_start_methods()


def _start_anew(module: str, words: Sequence[str], log: Path) -> Running:
    """The same where nothing can be copied: everything is imported again."""
    with log.open("w") as file:
        return subprocess.Popen(
            [sys.executable, "-m", module, *words],
            stdout=file,
            stderr=file,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **dict.fromkeys(THREADS, "1")},
        )


@cache
def _server() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(PRELOADED))
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
    try:
        import_module(module).main(words)
    except KeyboardInterrupt:  # as a process that does not catch it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
