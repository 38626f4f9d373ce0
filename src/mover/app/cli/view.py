"""What `view` does."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mover.app.cli.config import parsed
from mover.app.viewer.address import Address


@dataclass(frozen=True)
class ViewArgs:
    """Look at a result in the browser, correct it, and solve it again."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    capture: Path | None = None
    """The capture it was made from; by default the one that run.json names."""
    format: str = "folder"
    """How that capture is written."""
    edits: Path | None = None
    """The list of edits; by default OUT/edits.json."""
    address: Annotated[Address, arg(name="")] = field(default_factory=Address)


def view(arguments: Sequence[str]) -> None:
    """`mover view`."""
    args = parsed(ViewArgs, "mover view", arguments)
    from mover.app.viewer.show import view_result

    source = None if args.capture is None else (args.format, args.capture)
    view_result(args.out, source, args.edits, args.address)
