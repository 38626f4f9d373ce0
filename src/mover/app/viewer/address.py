"""Where the viewer listens. Imports no torch: `--help` is quick."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Address:
    """Where the viewer listens."""

    host: str = "127.0.0.1"
    """This machine only; 0.0.0.0 lets the whole network in."""
    port: int = 8080
    """The next free one is taken where it is in use."""
