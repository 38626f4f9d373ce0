"""What a command says to its user. Imports nothing, so that `mover --help` stays quick."""

import sys
from typing import Any


def say(text: str, stream: Any = None) -> None:  # noqa: ANN401
    """Write a line to standard output, or to `stream`."""
    where = stream or sys.stdout
    where.write(text + "\n")
    where.flush()
