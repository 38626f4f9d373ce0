"""A moving line on a terminal, from the first moment on, until there is more to tell.

It needs nothing but Python: what takes long at first is to import what draws better bars.
"""

import logging
import sys
import time
from threading import Event, Thread

FIRST, EVERY = 0.05, 0.1  # [s]
WIDTH, BLOCK = 40, 8  # characters of the bar, and of what moves in it


class Waiting:
    """One line at a time, on standard error."""

    def __init__(self) -> None:
        self._label = ""
        self._over = Event()
        self._thread: Thread | None = None

    def show(self, label: str) -> None:
        """Say what is done now; nothing where there is no terminal."""
        self._label = label
        if self._thread is None and sys.stderr.isatty():
            self._over = Event()
            self._thread = Thread(target=self._draw, daemon=True)
            self._thread.start()

    def hide(self) -> None:
        """Clear the line: something else writes now."""
        if self._thread is not None:
            self._over.set()
            self._thread.join()
            self._thread = None

    def _draw(self) -> None:
        begin, place = time.monotonic(), 0
        if self._over.wait(FIRST):  # `--help` and errors need no line
            return
        while True:
            at = place % WIDTH
            bar = "".join("━" if (k - at) % WIDTH < BLOCK else "─" for k in range(WIDTH))
            seconds = int(time.monotonic() - begin)
            sys.stderr.write(f"\r\x1b[2K{self._label:<28} {bar} {seconds // 60}:{seconds % 60:02}")
            sys.stderr.flush()
            place += 1
            if self._over.wait(EVERY):
                break
        sys.stderr.write("\r\x1b[2K")
        sys.stderr.flush()


WAITING = Waiting()
"""The terminal's line."""


class Lines(logging.StreamHandler):  # type: ignore[type-arg]
    """Writes lines of the log where the moving line stood."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one."""
        WAITING.hide()
        super().emit(record)
