"""What `paper-table` does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from .console import say

Table = Literal["prox", "prox-quantitative", "pigraphs"]


@dataclass(frozen=True)
class PaperTableArgs:
    """Print the paper's table for your copy of a data set, beside the published rows."""

    table: Annotated[Positional[Table], arg(metavar="TABLE")]
    """prox, prox-quantitative or pigraphs."""
    captures: Annotated[Positional[Path], arg(metavar="CAPTURES")]
    """Folder of captures made by `mover import`, one for each recording, under its name."""
    results: Annotated[Positional[Path], arg(metavar="RESULTS")]
    """Folder of results of `mover run` or `mover batch`, under the same names."""


def show_paper_table(arguments: Sequence[str]) -> None:
    """`mover paper-table`."""
    args = tyro.cli(PaperTableArgs, prog="mover paper-table", args=list(arguments))
    from .paper_table import paper_table

    say(paper_table(args.table, args.captures, args.results))


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {"paper-table": show_paper_table}
