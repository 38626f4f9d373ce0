"""Many captures, each in a process of its own, none of them run twice.

How a capture ended stands in `batch.json` in the folder of its result, with the fingerprint of what
it was run on. A batch that was killed goes on there.
"""

import csv
import fcntl
import hashlib
import json
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.settings import float_in

PRODUCTS, RECORD, LOG = ("scene.json", "run.json"), "batch.json", "log.txt"  # of each capture
SUMMARY, CONFIG = "summary.csv", "config.json"  # of the batch
COLUMNS: tuple[str, ...] = (
    "name", "state", "seconds", "peak_memory_mb", "warnings", "reason", "capture", "out",
)  # fmt: skip
INTERRUPTED = (-signal.SIGINT, 130)  # exit codes after Ctrl-C: the job is still to be done
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class RayOptions:
    """Share of a machine that each capture gets from Ray."""

    address: str = "local"
    """Of a running cluster (`auto`, `ray://...`); local: start one on this machine."""
    cpus: Annotated[float, float_in(0.01, 1024)] = 1.0
    """Cores for each capture; fractions share a core."""
    gpus: Annotated[float, float_in(0, 64)] = 0.0
    """GPUs for each capture; 0.25: four captures share one."""


@dataclass(frozen=True)
class BatchJob:
    """A capture to run."""

    name: str
    capture: str
    out: str  #: folder of its result
    command: tuple[str, ...]  #: what to run; it exits with 0 when it is well
    fingerprint: str  #: of the configuration and the capture's files
    limit: float = 0.0  #: most seconds; 0: no limit
    threads: int = 1  #: threads of the numerical libraries


@dataclass(frozen=True)
class Outcome:
    """How a job ended."""

    name: str
    state: Literal["done", "kept", "failed", "stopped"]
    """stopped: interrupted, so that nothing is recorded."""
    seconds: float = 0.0  #: wall clock of the run that made the result
    reason: str = ""  #: why it failed, in one line; empty if it did not


def captures_in(listing: Path, out: Path | None = None) -> tuple[Path, ...]:
    """The captures of a text file (one path a line, relative to it; `#` starts a remark) or folder.

    Raises:
        InputError: If there are none, or one is listed twice.
    """
    if listing.is_dir():
        if (listing / "camera.json").is_file():
            raise InputError(f"{listing}: is a capture, expected a folder or list of captures")
        found = [p.resolve() for p in sorted(listing.iterdir()) if p.is_dir()]
        found = [p for p in found if p.name[0] not in "._" and (out is None or p != out.resolve())]
    elif listing.is_file():
        lines = [line.split("#")[0].strip() for line in listing.read_text().splitlines()]
        found = [(listing.parent / line).resolve() for line in lines if line]
    else:
        raise InputError(f"{listing}: there is no such file, expected a list or folder of captures")
    if not found:
        raise InputError(f"{listing}: names no captures, expected one path a line, or folders")
    twice = [path for path, count in Counter(found).items() if count > 1]
    if twice:
        raise InputError(f"{listing}: names {twice[0]} twice, expected each capture once")
    return tuple(found)


def names_of(captures: Sequence[Path]) -> list[str]:
    """A folder name for each capture: its own, with a mark of its path where two share one."""
    taken = Counter([SUMMARY, CONFIG, *(path.name.casefold() for path in captures)])
    marks = [hashlib.sha256(str(path).encode()).hexdigest()[:8] for path in captures]
    return [
        path.name if taken[path.name.casefold()] == 1 else f"{path.name}-{mark}"
        for path, mark in zip(captures, marks, strict=True)
    ]


def earlier(job: BatchJob, retry: bool = False) -> Outcome | None:
    """How the job ended before; None: it is to be done, as are failed ones with `retry`."""
    found, out = read_tree(Path(job.out) / RECORD), Path(job.out)
    if found.get("fingerprint") != job.fingerprint:
        return None
    seconds, reason = float(found.get("seconds", 0.0)), str(found.get("reason", ""))
    if reason:
        return None if retry else Outcome(job.name, "failed", seconds, reason)
    whole = all((out / name).is_file() for name in PRODUCTS)
    return Outcome(job.name, "kept", seconds) if whole else None


def run_job(job: BatchJob) -> Outcome:
    """Run a job to its end and record it; a finished one is left alone.

    The lock is passed on to its process: one that outlives a killed batch is waited for.
    """
    out = Path(job.out)
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another batch may run this capture
        return earlier(job, retry=True) or _run(job, out, lock.fileno())


def _run(job: BatchJob, out: Path, lock: int) -> Outcome:
    (out / RECORD).unlink(missing_ok=True)
    environment = {**dict.fromkeys(THREADS, str(job.threads)), **os.environ}
    start = time.monotonic()
    try:
        with (out / LOG).open("wb") as log:
            code = subprocess.run(
                job.command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment,
                timeout=job.limit or None, pass_fds=(lock,), check=False,
            ).returncode  # fmt: skip
    except OSError as error:
        return ended(job, 0.0, f"could not be started: {error}")
    except subprocess.TimeoutExpired:
        return ended(job, job.limit, f"ran longer than its limit of {job.limit:g} s")
    if code in INTERRUPTED:
        return Outcome(job.name, "stopped")
    missing = " and ".join(name for name in PRODUCTS if not (out / name).is_file())
    why = ""
    if code < 0:
        why = f"ended by signal {-code} ({signal.strsignal(-code)})"
    elif code:
        why = f"exit code {code}"
    elif missing:
        why = f"ended well without {missing}"
    return ended(job, time.monotonic() - start, why and f"{why}: {last_line(out / LOG)}")


def last_line(log: Path) -> str:
    """What a process said last."""
    lines = log.read_text(errors="replace").splitlines() if log.is_file() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")


def ended(job: BatchJob, seconds: float, reason: str = "") -> Outcome:
    """Record that a job is done, or why it failed."""
    tree = {**asdict(job), "seconds": round(seconds, 3), "reason": reason}
    with suppress(OSError), replacing(Path(job.out) / RECORD) as part:
        part.write_text(json.dumps(tree, indent=1))
    return Outcome(job.name, "failed" if reason else "done", seconds, reason)


def read_tree(path: Path) -> dict[str, Any]:
    """A JSON object, empty where there is none or it was cut short."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def on_this_machine(jobs: Sequence[BatchJob], workers: int) -> Iterator[Outcome]:
    """So many processes at a time; Ctrl-C reaches them, and no further one is started."""
    pool = ThreadPoolExecutor(workers)
    try:
        yield from _outcomes({pool.submit(run_job, job): job for job in jobs})
    finally:
        pool.shutdown(cancel_futures=True)


def _outcomes(running: Mapping[Future[Outcome], BatchJob]) -> Iterator[Outcome]:
    """How jobs ended; a full disk, a forbidden folder, a lost machine end none but their own."""
    for future in as_completed(running):
        job = running[future]
        try:
            yield future.result()
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            yield earlier(job) or ended(job, 0.0, f"its worker was lost: {text}")


def on_ray(jobs: Sequence[BatchJob], workers: int, share: RayOptions) -> Iterator[Outcome]:
    """One Ray task a capture, which runs it in a process of its own; lost machines are replaced.

    Raises:
        InputError: If ray is not installed.
    """
    if find_spec("ray") is None:
        raise InputError(
            "--engine ray: ray is not installed; pip install -e '.[ray]' in mover's folder"
        )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray: Any = import_module("ray")
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if share.address == "local":
        options |= {"num_cpus": max(1, round(workers * share.cpus)), "include_dashboard": False}
    ray.init(address=share.address, ignore_reinit_error=True, **options)
    task = ray.remote(num_cpus=share.cpus, num_gpus=share.gpus, max_retries=2)(run_job)
    try:
        yield from _outcomes({task.remote(job).future(): job for job in jobs})
    finally:
        ray.shutdown()


def run_batch(
    jobs: Sequence[BatchJob],
    out: Path,
    workers: int,
    ray: RayOptions | None = None,
    retry: bool = False,
) -> list[Outcome]:
    """Run what is not finished, show how far it is on stderr, and write `summary.csv` into `out`.

    So many `workers` run at a time on this machine, or all on Ray; `retry` has those again that
    failed.
    """
    from rich.console import Console
    from rich.progress import track

    out.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    ended = {job.name: found for job in jobs if (found := earlier(job, retry)) is not None}
    todo = [job for job in jobs if job.name not in ended]
    if ended:
        console.print(f"{len(ended)} of {len(jobs)} captures were run before", highlight=False)
    running = on_this_machine(todo, workers) if ray is None else on_ray(todo, workers, ray)
    try:
        for outcome in track(running if todo else (), "captures", len(todo), console=console):
            ended[outcome.name] = outcome
            if outcome.state == "failed":
                console.print(f"{outcome.name} failed: {outcome.reason}", markup=False)
    finally:
        with replacing(out / SUMMARY) as part, part.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, COLUMNS)
            writer.writeheader()
            writer.writerows(_row(job, ended.get(job.name)) for job in jobs)
    return [ended[job.name] for job in jobs]


def _row(job: BatchJob, outcome: Outcome | None) -> dict[str, Any]:
    """A line of the summary."""
    row: dict[str, Any] = {"name": job.name, "state": "open", "capture": job.capture}
    if outcome is None or outcome.state == "stopped":
        return row
    row |= {"state": "failed", "seconds": round(outcome.seconds, 2), "reason": outcome.reason}
    if outcome.state == "failed":
        return row
    log = read_tree(Path(job.out) / "run.json")
    peak = max((stage.get("peak_memory", 0.0) for stage in log.get("stages", [])), default="")
    warned = len(log["warnings"]) if "warnings" in log else ""
    return {**row, "state": "done", "peak_memory_mb": peak, "warnings": warned, "out": job.out}
