"""How far a batch is: a bar with the time left on a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Iterable
from types import TracebackType

from mover.app.batch.job import Outcome

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
