"""Thousands of captures: each in a process of its own, none of them done twice.

An engine takes jobs and yields how each of them ended; what is finished is found by files
(job.py), so that a batch that was killed goes on where it stopped, with any engine.
"""

import csv
import hashlib
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from mover.app.batch.engines import ENGINES, EngineOptions
from mover.app.batch.job import Job, Outcome, earlier
from mover.app.batch.runner import read_tree
from mover.app.cli.waiting import WAITING
from mover.core.errors import InputError
from mover.core.files import replacing

CAPTURE, OUT = "{capture}", "{out}"
FAILURES = "failures"


@dataclass(frozen=True)
class BatchPlan:
    """What is to be run, and where its results go."""

    captures: tuple[Path, ...]
    out: Path
    """Folder of all results: one folder a capture, `failures/`, `summary.csv`."""
    command: tuple[str, ...]
    """Of one capture; `{capture}` and `{out}` in it are replaced."""
    fingerprint: str
    """Of the configuration."""
    limit: float = 0.0
    """Most seconds for one capture; 0: no limit."""
    threads: int = 1
    """Threads of the numerical libraries in each process."""


def captures_in(listing: Path, out: Path | None = None) -> tuple[Path, ...]:
    """The captures of a text file (one path a line, `#` begins a remark) or of a folder.

    Args:
        listing: Relative paths in it count from its folder.
        out: A folder that is no capture even if it lies among them.

    Raises:
        InputError: If there are none, or one is listed twice.
    """
    if listing.is_dir():
        if (listing / "camera.json").is_file():
            raise InputError(f"{listing}: is a capture, expected a folder or list of captures")
        found = [p for p in sorted(listing.iterdir()) if p.is_dir() and p.name[0] not in "._"]
        found = [p.resolve() for p in found if out is None or p.resolve() != out.resolve()]
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
    shared = Counter(path.name.casefold() for path in captures)
    reserved = {FAILURES, "summary.csv", "config.json"}
    return [
        path.name
        if shared[path.name.casefold()] == 1 and path.name.casefold() not in reserved
        else f"{path.name}-{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
        for path in captures
    ]


def jobs_of(plan: BatchPlan) -> list[Job]:
    """The job of each capture."""
    out = plan.out.resolve()
    jobs: list[Job] = []
    for name, capture in zip(names_of(plan.captures), plan.captures, strict=True):
        words = {CAPTURE: str(capture), OUT: str(out / name)}
        jobs.append(
            Job(
                name=name,
                capture=str(capture),
                out=str(out / name),
                record=str(out / FAILURES / f"{name}.json"),
                command=tuple(words.get(word, word) for word in plan.command),
                fingerprint=_fingerprint(plan.fingerprint, capture),
                limit=plan.limit,
                threads=plan.threads,
            )
        )
    return jobs


def _fingerprint(config: str, capture: Path) -> str:
    """Of a configuration and of what a capture's files are: names, sizes, times of change."""
    digest = hashlib.sha256(config.encode())
    for path in sorted(capture.rglob("*")) if capture.is_dir() else [capture]:
        if path.is_file():
            seen = path.stat()
            name = path.relative_to(capture).as_posix()
            digest.update(f"\n{name} {seen.st_size} {seen.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


def run_batch(
    plan: BatchPlan, options: EngineOptions, *, retry: bool = False, quiet: bool = False
) -> list[Outcome]:
    """Run what is not finished, and write `summary.csv`.

    Args:
        plan: What to run.
        options: Where and how many at a time.
        retry: Whether captures that failed before are run again.
        quiet: Whether progress is kept to oneself.

    Returns:
        How each capture ended, in the order of the plan.

    Raises:
        ValueError: If there is no such engine.
        InputError: If the engine's package is not installed.
    """
    if options.engine not in ENGINES:
        raise ValueError(f"engine {options.engine!r}, expected one of {', '.join(ENGINES)}")
    jobs = jobs_of(plan)
    plan.out.mkdir(parents=True, exist_ok=True)
    ended = {job.name: found for job in jobs if (found := earlier(job, retry)) is not None}
    todo = [job for job in jobs if job.name not in ended]
    try:
        with Tally(len(jobs), ended.values(), quiet=quiet) as tally:
            for outcome in ENGINES[options.engine](todo, options, plan.out.resolve()):
                ended[outcome.name] = outcome
                tally.add(outcome)
    finally:
        rows = [_row(job, ended.get(job.name)) for job in jobs]
        write_summary(rows, plan.out)
    return [ended[job.name] for job in jobs]


def _row(job: Job, outcome: Outcome | None) -> dict[str, Any]:
    """A line of the summary."""
    if outcome is None or outcome.state == "stopped":
        return {**_EMPTY, "name": job.name, "state": "open", "capture": job.capture}
    state = "done" if outcome.state == "kept" else outcome.state
    log = read_tree(Path(job.out) / "run.json") if state == "done" else {}
    stages = log.get("stages", [])
    return {
        "name": job.name,
        "state": state,
        "seconds": round(outcome.seconds, 2),
        "peak_memory_mb": max((s.get("peak_memory", 0.0) for s in stages), default=""),
        "warnings": len(log["warnings"]) if "warnings" in log else "",
        "reason": outcome.reason,
        "capture": job.capture,
        "out": job.out if state == "done" else "",
    }


_EMPTY: dict[str, Any] = dict.fromkeys(
    ("name", "state", "seconds", "peak_memory_mb", "warnings", "reason", "capture", "out"), ""
)


def write_summary(rows: Sequence[Mapping[str, Any]], out: Path) -> list[Path]:
    """Write summary.csv, and summary.parquet where pyarrow is installed."""
    path = out / "summary.csv"
    with replacing(path) as part, part.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(_EMPTY))
        writer.writeheader()
        writer.writerows(rows)
    return [path, *_parquet(rows, out / "summary.parquet")]


def _parquet(rows: Sequence[Mapping[str, Any]], path: Path) -> list[Path]:
    from importlib.util import find_spec

    if find_spec("pyarrow") is None:
        return []
    from importlib import import_module

    table, parquet = import_module("pyarrow").table, import_module("pyarrow.parquet")
    columns = {key: [None if r[key] == "" else r[key] for r in rows] for key in _EMPTY}
    with replacing(path) as part:
        parquet.write_table(table(columns), part)
    return [path]


def counted(outcomes: Iterable[Outcome]) -> str:
    """`37 done (12 of them before), 3 failed` in one line."""
    states = Counter(outcome.state for outcome in outcomes)
    done = states["done"] + states["kept"]
    before = f" ({states['kept']} of them before)" if states["kept"] else ""
    return f"{done} done{before}, {states['failed']} failed"


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


EVERY = 10.0  # [s] between two lines where there is no terminal


class Tally:
    """Counts outcomes and shows them on stderr."""

    def __init__(self, total: int, ended: Iterable[Outcome], *, quiet: bool = False) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        self._quiet, self._total = quiet, total
        before = list(ended)
        self._failed = sum(outcome.state == "failed" for outcome in before)
        self._before = self._done = len(before)
        self._begin = self._said = time.monotonic()
        self._console = Console(file=sys.stderr)
        self._live = self._console.is_terminal and not quiet
        self._progress = Progress(
            TextColumn("captures"), BarColumn(), MofNCompleteColumn(),
            TextColumn("{task.fields[failed]} failed"), TimeElapsedColumn(),
            TextColumn("left"), TimeRemainingColumn(elapsed_when_finished=False),
            console=self._console, transient=False,
        )  # fmt: skip
        self._task = self._progress.add_task("", total=total, failed=self._failed)

    def __enter__(self) -> "Tally":
        WAITING.hide()
        if self._live:
            self._progress.update(self._task, completed=self._done)
            self._progress.start()
        elif not self._quiet and self._before:
            self._line(f"{self._before} of {self._total} captures were run before")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live:
            self._progress.stop()

    def add(self, outcome: Outcome) -> None:
        """Count one more."""
        self._done += outcome.state != "stopped"
        self._failed += outcome.state == "failed"
        if self._quiet:
            return
        self._progress.update(self._task, completed=self._done, failed=self._failed)
        if outcome.state == "failed":
            self._line(f"{outcome.name} failed: {outcome.reason}")
        elif not self._console.is_terminal and time.monotonic() - self._said > EVERY:
            self._line(self.sentence())

    def sentence(self) -> str:
        """`12 of 40 captures, 1 failed, 3.5 min left`."""
        new = self._done - self._before
        pace = (time.monotonic() - self._begin) / new if new else 0.0
        left = pace * (self._total - self._done)
        spare = f", {left / 60:.1f} min left" if new else ""
        return f"{self._done} of {self._total} captures, {self._failed} failed{spare}"

    def _line(self, text: str) -> None:
        self._said = time.monotonic()
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)
