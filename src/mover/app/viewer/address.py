"""Where the viewer listens. Imports no torch: `--help` is quick."""

from dataclasses import dataclass
from typing import Annotated

from mover.core.settings import int_in


@dataclass(frozen=True)
class Address:
    """Where the viewer listens."""

    host: str = "127.0.0.1"
    """This machine only; 0.0.0.0 lets the network in, with the token of the URL."""
    port: Annotated[int, int_in(1, 65535)] = 8080
    """The next free one is taken where it is in use."""
