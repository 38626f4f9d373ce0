"""One progress bar on a terminal, one line a stage elsewhere."""

import logging
import sys
from types import TracebackType
from typing import Any

from mover.core.observe import Step

log = logging.getLogger("mover.geometry.kernels")  # says what is compiled


class Bar:
    """An observer that draws how far the stages are."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.logging import RichHandler
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
        )

        self._stage, self._task = "", None
        self._level = log.level
        self._console = Console(file=sys.stderr)
        self._lines = RichHandler(
            console=self._console, show_time=False, show_level=False, show_path=False
        )
        columns = (
            TextColumn("{task.description:<28}"),
            BarColumn(),
            MofNCompleteColumn(),
        )
        self._progress = Progress(
            *columns, TimeElapsedColumn(), console=self._console, transient=True
        )

    def __enter__(self) -> "Bar":
        log.addHandler(self._lines)
        self._level = log.level
        log.setLevel(logging.INFO)
        log.propagate = False
        if self._console.is_terminal:
            self._task = self._progress.add_task("...", total=None)
            self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._progress.stop()
        log.removeHandler(self._lines)
        log.setLevel(self._level)
        log.propagate = True

    def __call__(self, step: Step) -> None:
        """Show how far the stage is."""
        if step.stage != self._stage:
            self._begin(step)
        task: Any = self._task
        if task is not None:
            self._progress.update(task, completed=step.index + 1, total=step.steps)

    def _begin(self, step: Step) -> None:
        self._stage = step.stage
        if not self._console.is_terminal:
            self._console.print(f"{step.stage} ...", highlight=False)
            return
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._task = self._progress.add_task(step.stage, total=step.steps)
