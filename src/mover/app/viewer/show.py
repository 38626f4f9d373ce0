"""Show a finished result, or a run while it works."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mover.app.cli.console import say
from mover.app.cli.run import reconstruct_into
from mover.app.results import Origin, read_config
from mover.app.viewer.address import Address
from mover.app.viewer.panel_solve import SolveJob, begin_watching, end_watching
from mover.app.viewer.serve import Opened, open_viewer
from mover.app.viewer.session import read_shown, shown_before, source_of, start_session
from mover.app.viewer.solve import started_from
from mover.core.errors import InputError
from mover.core.types import Capture
from mover.io.formats import read
from mover.pipeline.presets import Config

NO_CAPTURE = "Solving again needs the capture: `mover view OUT --capture CAPTURE`."


def view_result(
    out: Path, source: tuple[str, Path] | None, edits: Path | None, address: Address
) -> None:
    """Show a finished result, with its capture (how it is written, and where) for solving again."""
    bare = read_shown(out)
    found = source_of(bare.log) if source is None else source
    capture = None if found is None else read(*found)
    shown = bare if capture is None else read_shown(out, capture)
    session = start_session(shown, edits or out / "edits.json", capture)
    job = None if capture is None or found is None else _job(out, found, bare.log)
    opened = open_viewer(session, address, job, NO_CAPTURE)
    say(f"{opened.url} shows {out}; Ctrl-C ends it")
    wait(opened)


def run_in_view(capture: Capture, config: Config, out: Path, origin: Origin) -> None:
    """`mover run --view`: the viewer opens before the run and stays after it."""
    start = shown_before(started_from(capture, origin.edits))
    session = start_session(start, None, capture)
    job = SolveJob(out, config, origin)
    opened = open_viewer(session, Address(), job)
    say(f"{opened.url} shows {out}; Ctrl-C ends it")
    watch = begin_watching(opened.window, session.shown.result, opened.gauges)
    reconstruct_into(out, capture, config, origin, watch)
    session.file, session.edits = out / "edits.json", (*origin.edits, *session.edits)
    said = f"done; the result is in `{out}`"
    end_watching(opened.window, opened.gauges, said, read_shown(out, capture), len(origin.edits))
    say(f"report: {out / 'report.html'}")
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
