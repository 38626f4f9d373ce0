"""What `view` does, and `run --view`."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg

from .commands import reconstruct_into
from .presets import Config
from .readers import read
from .records import InputError
from .results import Origin, read_config
from .types import Capture
from .viewer import (
    Address,
    Opened,
    SolveJob,
    begin_watching,
    end_watching,
    open_viewer,
    read_shown,
    shown_before,
    source_of,
    start_session,
    started_from,
)

NO_CAPTURE = "Solving again needs the capture: `mover view OUT --capture CAPTURE`."


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
    args = tyro.cli(ViewArgs, prog="mover view", args=list(arguments))
    bare = read_shown(args.out)
    found = source_of(bare.log) if args.capture is None else (args.format, args.capture)
    capture = None if found is None else read(*found)
    shown = bare if capture is None else read_shown(args.out, capture)
    session = start_session(shown, args.edits or args.out / "edits.json", capture)
    job = None if capture is None or found is None else _job(args.out, found, bare.log)
    opened = open_viewer(session, args.address, job, NO_CAPTURE)
    _say(f"{opened.url} shows {args.out}; Ctrl-C ends it")
    wait(opened)


def run_in_view(capture: Capture, config: Config, out: Path, origin: Origin) -> None:
    """`mover run --view`: the viewer opens before the run and stays after it."""
    start = shown_before(started_from(capture, origin.edits))
    session = start_session(start, None, capture)
    job = SolveJob(out, config, origin)
    opened = open_viewer(session, Address(), job)
    _say(f"{opened.url} shows {out}; Ctrl-C ends it")
    watch = begin_watching(opened.window, session.shown.result, opened.gauges)
    reconstruct_into(out, capture, config, origin, watch)
    session.file, session.edits = out / "edits.json", (*origin.edits, *session.edits)
    said = f"done; the result is in `{out}`"
    end_watching(opened.window, opened.gauges, said, read_shown(out, capture), len(origin.edits))
    _say(f"report: {out / 'report.html'}")
    wait(opened)


def wait(opened: Opened) -> None:
    """Until Ctrl-C."""
    try:
        while True:
            time.sleep(3600)
    finally:
        opened.close()


def _job(out: Path, found: tuple[str, Path], log: Mapping[str, Any]) -> SolveJob | None:
    """How the capture `found` is solved again as `log` says; None: its settings are unknown."""
    kind, source = found
    try:
        config = read_config(out / "run.json")
    except InputError:
        return None
    refine = bool(log.get("people_refined", False))
    return SolveJob(out, config, Origin(str(source.resolve()), kind, refine=refine))


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {"view": view}
