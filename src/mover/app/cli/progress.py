"""One progress bar on a terminal, one line a stage elsewhere."""

import logging
import sys
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

        self._stage, self._task, self._level = "", None, log.level
        self._console = console = Console(file=sys.stderr)
        self._lines = RichHandler(
            console=console, show_time=False, show_level=False, show_path=False
        )
        name = TextColumn("{task.description:<28}")
        columns = (name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, console=console, transient=True)

    def __enter__(self) -> "Bar":
        log.addHandler(self._lines)
        self._level, log.propagate = log.level, False
        log.setLevel(logging.INFO)
        if self._console.is_terminal:
            self._task = self._progress.add_task("...", total=None)
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        log.removeHandler(self._lines)
        log.setLevel(self._level)
        log.propagate = True

    def __call__(self, step: Step) -> None:
        """Show how far the stage is."""
        task: Any = self._task
        if step.stage != self._stage:
            self._stage = step.stage
            if task is None:
                self._console.print(f"{step.stage} ...", highlight=False)
            else:
                self._progress.remove_task(task)
                self._task = task = self._progress.add_task(step.stage, total=step.steps)
        if task is not None:
            self._progress.update(task, completed=step.index + 1, total=step.steps)
