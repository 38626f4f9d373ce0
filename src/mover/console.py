"""What a command says to its user. Imports nothing, so that `mover --help` stays quick."""

import sys


def say(text: str) -> None:
    """Write a line to standard output."""
    sys.stdout.write(text + "\n")
