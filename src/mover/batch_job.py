"""One capture of a batch, in a process of its own: run it, bound it, and record how it ended.

Nothing here imports torch, so that a worker on another machine starts at once. What is finished is
told by files only: a job is finished when its products and `batch.json` with its fingerprint stand
in its folder, and it has failed when the failure record holds its fingerprint.
"""

import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Literal

State = Literal["done", "kept", "failed", "stopped"]
PRODUCTS = ("scene.json", "run.json")
MARK, LOG, LOCK = "batch.json", "log.txt", ".lock"
LINES = 20  # last lines of the log that a failure record keeps
POLL = 0.05  # [s]
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
    mark = _read(Path(job.out) / MARK)
    whole = all((Path(job.out) / name).is_file() for name in PRODUCTS)
    if whole and mark.get("fingerprint") == job.fingerprint:
        return Outcome(job.name, "kept", float(mark.get("seconds", 0.0)), "")
    failure = _read(Path(job.record))
    if not retry and failure.get("fingerprint") == job.fingerprint:
        reason = str(failure.get("reason", ""))
        return Outcome(job.name, "failed", float(failure.get("seconds", 0.0)), reason)
    return None


def run_job(job: Job, stop: threading.Event = NEVER) -> Outcome:
    """Run a job to its end and record it; a finished one is left alone.

    Args:
        job: What to run.
        stop: Set from another thread, it ends the job; nothing is recorded then.
    """
    Path(job.out).mkdir(parents=True, exist_ok=True)
    with (Path(job.out) / LOCK).open("w") as lock:
        if not _locked(lock, stop):
            return Outcome(job.name, "stopped", 0.0, "")
        found = earlier(job, retry=True)
        return _run(job, stop) if found is None else found


def _locked(lock: IO[str], stop: threading.Event) -> bool:
    """Wait until no other batch runs this capture; False if it was stopped meanwhile."""
    while not stop.is_set():
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stop.wait(POLL)
        else:
            return True
    return False


def _run(job: Job, stop: threading.Event) -> Outcome:
    (Path(job.out) / MARK).unlink(missing_ok=True)
    begin = time.monotonic()
    try:
        code = _watched(job, stop, begin)
    except OSError as error:
        return _failed(job, "no start", f"could not be started: {error}", time.monotonic() - begin)
    seconds = time.monotonic() - begin
    if code is None:
        if stop.is_set():
            return Outcome(job.name, "stopped", seconds, "")
        reason = f"ran longer than its limit of {job.limit:g} s"
        return _failed(job, "time limit", reason, seconds)
    missing = [name for name in PRODUCTS if not (Path(job.out) / name).is_file()]
    if code == 0 and not missing:
        _write(Path(job.out) / MARK, {"fingerprint": job.fingerprint, "seconds": seconds})
        Path(job.record).unlink(missing_ok=True)
        return Outcome(job.name, "done", seconds, "")
    return _failed(job, *_why(job, code, missing), seconds, code)


def _watched(job: Job, stop: threading.Event, begin: float) -> int | None:
    """Exit code of the command, None if it was ended from here."""
    threads = str(job.threads)
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    variables = {**dict.fromkeys(names, threads), **os.environ}
    guarded = (sys.executable, "-S", "-E", "-c", GUARD, str(os.getpid()), *job.command)
    with (Path(job.out) / LOG).open("wb") as log:
        process = subprocess.Popen(
            guarded, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=variables,
            start_new_session=True,
        )  # fmt: skip
        while True:
            late = job.limit > 0 and time.monotonic() - begin > job.limit
            if late or stop.is_set():
                _end(process)
                return None
            try:
                return process.wait(POLL)
            except subprocess.TimeoutExpired:
                continue


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask the process and its children to stop, then make them."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
            process.wait(GRACE)
        except (ProcessLookupError, subprocess.TimeoutExpired):
            continue
    process.wait()


def _why(job: Job, code: int, missing: Sequence[str]) -> tuple[str, str]:
    """Kind of the failure, and its reason in one line."""
    lines = _last_lines(job)
    last = lines[-1] if lines else "it said nothing"
    if code < 0:
        return "signal", f"ended by {_signal_name(-code)}: {last}"
    if code == 0:
        return "no result", f"ended well without {' and '.join(missing)}: {last}"
    return ("input" if code == 2 else "exit"), f"exit code {code}: {last}"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _last_lines(job: Job) -> list[str]:
    path = Path(job.out) / LOG
    if not path.is_file():
        return []
    with path.open("rb") as log:
        log.seek(max(0, path.stat().st_size - 16_384))
        text = log.read().decode(errors="replace")
    return [line.rstrip() for line in text.splitlines() if line.strip()][-LINES:]


def _failed(job: Job, kind: str, reason: str, seconds: float, code: int | None = None) -> Outcome:
    """Write the failure record."""
    record = {
        "name": job.name,
        "kind": kind,
        "reason": reason,
        "exit_code": code if code is not None and code >= 0 else None,
        "signal": _signal_name(-code) if code is not None and code < 0 else None,
        "seconds": round(seconds, 3),
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": socket.gethostname(),
        "last_lines": _last_lines(job),
        **{key: value for key, value in asdict(job).items() if key not in ("name", "record")},
    }
    _write(Path(job.record), record)
    return Outcome(job.name, "failed", seconds, reason)


def lost(job: Job, error: Exception) -> Outcome:
    """Record a job whose worker vanished, so that it could not do so itself."""
    found = earlier(job)
    if found is not None:
        return found
    text = " ".join(f"{type(error).__name__}: {error}".split())[:300]
    return _failed(job, "worker", f"its worker was lost: {text}", 0.0)


def _read(path: Path) -> dict[str, Any]:
    """A JSON object, empty where there is none or it was cut short."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _write(path: Path, tree: dict[str, Any]) -> None:
    """Write JSON in one step."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=".json")
    with os.fdopen(handle, "w") as part:
        part.write(json.dumps(tree, indent=1))
    os.chmod(name, 0o644)
    os.replace(name, path)
