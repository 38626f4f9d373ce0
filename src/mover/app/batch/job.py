"""One capture of a batch, in a process of its own: run it, bound it, and record how it ended.

A job is finished when its products and `batch.json` with its fingerprint stand in its folder; it
has failed when the failure record holds its fingerprint.
"""

import fcntl
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Literal

import msgspec

from mover.app.batch.runner import (
    LOG,
    POLL,
    THREADS,
    last_lines,
    read_tree,
    record_failure,
    signal_name,
    write_tree,
)

log = logging.getLogger(__name__)
State = Literal["done", "kept", "failed", "stopped"]
PRODUCTS = ("scene.json", "run.json")
MARK, LOCK = "batch.json", ".lock"
GRACE = 5.0  # [s] between the request to stop and the end
NEVER = threading.Event()
GUARD = """
import ctypes, os, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, 9)
if os.getppid() != int(sys.argv[1]):
    os._exit(1)
os.execvp(sys.argv[2], sys.argv[2:])
"""  # the job dies with the process that waits for it, even if that is killed


@dataclass(frozen=True)
class Job:
    """A capture to run."""

    name: str
    capture: str
    out: str
    """Folder of its result."""
    record: str
    """File that tells why it failed."""
    command: tuple[str, ...]
    """What to run; it exits with 0 when it is well."""
    fingerprint: str
    """Of the configuration and the capture's files."""
    limit: float
    """Most seconds; 0: no limit."""
    threads: int
    """Threads of the numerical libraries."""


@dataclass(frozen=True)
class Outcome:
    """How a job ended."""

    name: str
    state: State
    seconds: float
    """Wall clock of the run that made the result."""
    reason: str
    """Why it failed, in one line; empty if it did not."""


def earlier(job: Job, retry: bool = False) -> Outcome | None:
    """How the job ended before, None if it is still to be done.

    Args:
        job: Its fingerprint tells whether the record is of the same work.
        retry: Whether what failed is still to be done.
    """
    mark = read_tree(Path(job.out) / MARK)
    whole = all((Path(job.out) / name).is_file() for name in PRODUCTS)
    if whole and mark.get("fingerprint") == job.fingerprint:
        return Outcome(job.name, "kept", float(mark.get("seconds", 0.0)), "")
    failure = read_tree(Path(job.record))
    if not retry and failure.get("fingerprint") == job.fingerprint:
        reason = str(failure.get("reason", ""))
        return Outcome(job.name, "failed", float(failure.get("seconds", 0.0)), reason)
    return None


class Attempt:
    """A job on its way to its end, see `Running`."""

    def __init__(self, job: Job) -> None:
        self._job, self._steps = job, _steps(job)

    def poll(self) -> Outcome | None:
        """How it ended; None: it waits or runs. What goes wrong around it is recorded, too."""
        try:
            next(self._steps)
        except StopIteration as end:
            return end.value
        except Exception as error:  # a full disk, a forbidden folder: it must not end the others
            log.warning("%s: %s", self._job.name, error)
            return lost(self._job, error)
        return None

    def terminate(self) -> None:
        """End it; nothing is recorded."""
        self._steps.close()


def run_job(job: Job, stop: threading.Event = NEVER) -> Outcome:
    """Run a job to its end and record it; a finished one is left alone.

    Args:
        job: What to run.
        stop: Set from another thread, it ends the job; nothing is recorded then.
    """
    attempt = Attempt(job)
    while (outcome := attempt.poll()) is None:
        if stop.wait(POLL):
            attempt.terminate()
            return Outcome(job.name, "stopped", 0.0, "")
    return outcome


def run_numbered(jobs: str) -> None:
    """Of a file of jobs, run the one whose place SLURM names."""
    rows = msgspec.json.decode(Path(jobs).read_bytes(), type=list[Job])
    run_job(rows[int(os.environ["SLURM_ARRAY_TASK_ID"])])


def _steps(job: Job) -> Generator[None, None, Outcome]:
    """Yields while another batch runs this capture, and while it runs itself."""
    Path(job.out).mkdir(parents=True, exist_ok=True)
    with (Path(job.out) / LOCK).open("w") as lock:
        while not _locked(lock):
            yield
        found = earlier(job, retry=True)
        return (yield from _run(job)) if found is None else found


def _locked(lock: IO[str]) -> bool:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _run(job: Job) -> Generator[None, None, Outcome]:
    (Path(job.out) / MARK).unlink(missing_ok=True)
    Path(job.record).unlink(missing_ok=True)
    begin = time.monotonic()
    try:
        process = _start(job)
    except OSError as error:
        return _failed(job, "no start", f"could not be started: {error}", time.monotonic() - begin)
    try:
        while (code := process.poll()) is None:
            if 0 < job.limit < time.monotonic() - begin:
                break
            yield
    finally:
        _end(process)
    seconds = time.monotonic() - begin
    if code is None:
        reason = f"ran longer than its limit of {job.limit:g} s"
        return _failed(job, "time limit", reason, seconds)
    missing = [name for name in PRODUCTS if not (Path(job.out) / name).is_file()]
    if code == 0 and not missing:
        done = {"fingerprint": job.fingerprint, "seconds": seconds}
        write_tree(Path(job.out) / MARK, done)
        return Outcome(job.name, "done", seconds, "")
    return _failed(job, *_why(job, code, missing), seconds, code)


def _start(job: Job) -> subprocess.Popen[bytes]:
    variables = {**dict.fromkeys(THREADS, str(job.threads)), **os.environ}
    guarded = (sys.executable, "-S", "-E", "-c", GUARD, str(os.getpid()), *job.command)
    with (Path(job.out) / LOG).open("wb") as log:
        return subprocess.Popen(
            guarded, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=variables,
            start_new_session=True,
        )  # fmt: skip


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask the process and its children to stop, then make them."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        try:
            os.killpg(process.pid, number)
            process.wait(GRACE)
        except (ProcessLookupError, subprocess.TimeoutExpired):
            continue
    process.wait()


def _why(job: Job, code: int, missing: Sequence[str]) -> tuple[str, str]:
    """Kind of the failure, and its reason in one line."""
    last = (last_lines(Path(job.out) / LOG) or ["it said nothing"])[-1]
    if code < 0:
        return "signal", f"ended by {signal_name(-code)}: {last}"
    if code == 0:
        return "no result", f"ended well without {' and '.join(missing)}: {last}"
    return ("input" if code == 2 else "exit"), f"exit code {code}: {last}"


def _failed(job: Job, kind: str, reason: str, seconds: float, code: int | None = None) -> Outcome:
    """Write the failure record."""
    about = {**asdict(job), "kind": kind, "reason": reason, "seconds": round(seconds, 3)}
    del about["record"]
    record_failure(Path(job.record), about, code, last_lines(Path(job.out) / LOG))
    return Outcome(job.name, "failed", seconds, reason)


def lost(job: Job, error: Exception) -> Outcome:
    """Record a job whose worker vanished, so that it could not do so itself."""
    found = earlier(job)
    if found is not None:
        return found
    text = " ".join(f"{type(error).__name__}: {error}".split())[:300]
    return _failed(job, "worker", f"its worker was lost: {text}", 0.0)
