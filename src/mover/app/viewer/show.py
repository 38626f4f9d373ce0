"""Start a viewer for a finished result or for a run that works; its tab `Solve` runs it again."""

import contextlib
import io
import logging
import math
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mover.app.cli import say
from mover.app.cli.results import Address
from mover.app.cli.run import reconstruct_into
from mover.app.results import Origin, read_config
from mover.app.viewer.drawing import Drawing, People, draw_room
from mover.app.viewer.gate import gate_at, guarded
from mover.app.viewer.panels import add_object_panel, add_room_panel
from mover.app.viewer.proposals import add_proposals
from mover.app.viewer.session import (
    Session,
    Shown,
    read_shown,
    shown_before,
    source_of,
    start_session,
)
from mover.app.viewer.solve import Stopped, Watch, solve_again
from mover.app.viewer.window import Grips, Window, redraw, redraw_result
from mover.core.errors import InputError
from mover.core.observe import Step
from mover.core.types import Capture, Scene
from mover.geometry.boxes import box_of
from mover.io.capture.edits import apply_edits
from mover.io.formats import read
from mover.pipeline.presets import Config

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SolveJob:
    """What solving again needs."""

    out: Path
    config: Config
    origin: Origin
    """Whose edits are those of the session when it starts."""


@dataclass
class Gauges:
    """What shows how far a run is."""

    status: Any
    bar: Any
    curve: Any


def add_solve_panel(window: Window, job: SolveJob | None, why_not: str) -> Gauges:
    """Fill the tab; without a job it says why there is none."""
    gui, session = window.server.gui, window.session
    start = gui.add_button("Solve again", disabled=job is None)
    stop = gui.add_button("Stop", visible=False)
    listed = gui.add_markdown("")
    gauges = add_gauges(window, "" if job is not None else why_not)

    def refresh() -> None:
        listed.content = _listed(session)

    @start.on_click
    def _(_event: Any) -> None:  # noqa: ANN401
        if job is None or window.watching or not window.running.acquire(blocking=False):
            return
        start.disabled, stop.visible = True, True
        try:
            _solve(window, job, gauges)
        finally:
            start.disabled, stop.visible = False, False
            window.running.release()

    stop.on_click(lambda _event: stop_watching(window))
    session.listen(refresh)
    return gauges


def add_gauges(window: Window, text: str) -> Gauges:
    """A line of text, a bar, and the curve of the energy."""
    import viser.uplot as uplot  # pyright: ignore[reportMissingImports]

    gui = window.server.gui
    status = gui.add_markdown(text)
    bar = gui.add_progress_bar(0.0, visible=False)
    curve = gui.add_uplot(
        (np.zeros(1), np.zeros(1)),
        (uplot.Series(label="seen"), uplot.Series(label="energy", stroke="#2563eb", width=2)),
        scales={"x": uplot.Scale(time=False)}, aspect=1.6, visible=False,
    )  # fmt: skip
    return Gauges(status, bar, curve)


def _draw_curve(gauges: Gauges, watch: Watch) -> None:
    """The energy of the rooms that were shown."""
    values = list(watch.energies)
    if len(values) > 1:
        gauges.curve.visible = True
        gauges.curve.data = (np.arange(len(values), dtype=float), np.array(values))


def _solve(window: Window, job: SolveJob, gauges: Gauges) -> None:
    """Run the main job in this thread and show its result."""
    session = window.session
    edits, capture = session.edits, session.capture
    assert capture is not None
    origin = replace(job.origin, edits=edits)
    shown = None
    try:
        watch = begin_watching(window, apply_edits(capture, edits)[0].scene, gauges)
        folder = solve_again(capture, origin, job.config, job.out, watch)
        shown = read_shown(folder, capture)
        said = f"done; the result is in `{folder}`"
    except Stopped:
        said = "stopped; the room is as it was"
    except Exception as error:  # whatever a run may raise, the viewer goes on
        log.warning("solve again failed", exc_info=error)
        said = f"**{type(error).__name__}: {error}**"
    end_watching(window, gauges, said, shown, len(edits))


def begin_watching(window: Window, scene: Scene, gauges: Gauges) -> Watch:
    """An observer of a run that moves the furniture of the window, from `scene` on."""

    def show(seen: Scene) -> None:
        draw_room(window.drawing, seen, "after")

    def tell(step: Step) -> None:
        gauges.bar.visible = True
        gauges.bar.value = 100.0 * (step.index + 1) / max(1, step.steps)
        gauges.status.content = f"{step.stage}: {step.index + 1} of {step.steps}"
        _draw_curve(gauges, watch)

    watch = Watch(scene.objects, show, tell)
    window.watch = watch
    if window.grips.gizmo is not None:
        window.grips.gizmo.remove()
        window.grips.gizmo = None
    draw_room(window.drawing, scene, "after")
    return watch


def end_watching(window: Window, gauges: Gauges, said: str, shown: Shown | None, done: int) -> None:
    """Give the furniture back to the user, with a new result if there is one."""
    session = window.session
    window.watch = None
    gauges.status.content, gauges.bar.visible = said, False
    if shown is not None:
        session.rebase(shown, done)
        redraw_result(window)
    session.rebase(session.shown, session.done)


def stop_watching(window: Window) -> None:
    """End the run, if there is one, at its next step."""
    if window.watch is not None:
        window.watch.stop = True


def _listed(session: Session) -> str:
    """The edits, the newest last."""
    lines = [
        f"{i + 1}. {type(edit).__name__.lower()} `{edit.id}`" + (" ✓" if i < session.done else "")
        for i, edit in enumerate(session.edits)
    ]
    return "\n".join(lines) or "*There are no edits.*"


SCRIPT = """
addEventListener("pointerdown", (press) => {
  if (press.target instanceof HTMLCanvasElement)
    Object.defineProperty(press, "preventDefault", {value: () => {}});
}, true);
"""


def quiet_presses(server: Any) -> None:  # noqa: ANN401
    """Presses on draggable objects say nothing in the browser's console.

    viser asks the browser to prevent what a press on a draggable object would do otherwise, from a
    listener that was registered as passive. There the request does nothing, and Chromium writes an
    error about it. The script, which every browser that connects runs, takes the request off such
    presses: what they do stays the same. A viser without such messages stays as it is.
    """
    from viser import _messages  # pyright: ignore[reportMissingImports]

    message = getattr(_messages, "RunJavascriptMessage", None)
    interface = getattr(server.gui, "_websock_interface", None)
    if message is not None and interface is not None:
        interface.queue_message(message(source=SCRIPT))


# The server.


@dataclass(frozen=True)
class Opened:
    """A running viewer."""

    window: Window
    gauges: Gauges
    url: str

    def close(self) -> None:
        """Stop the run, if there is one, and the server."""
        stop_watching(self.window)
        self.window.server.stop()


def open_viewer(
    session: Session, address: Address, job: SolveJob | None = None, why_not: str = ""
) -> Opened:
    """Start the server and draw the room.

    Raises:
        InputError: If viser is not installed.
    """
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "mover view needs viser: pip install '.[viewer]' in mover's folder"
        ) from error
    gate = gate_at(address.host)
    with contextlib.redirect_stdout(io.StringIO()), guarded(gate):
        server = viser.ViserServer(
            host=address.host, port=address.port, label=session.shown.title, verbose=False
        )
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="large", control_layout="fixed"
    )
    server.scene.set_up_direction("+y")
    quiet_presses(server)
    window = _window_of(server, session)
    _aim(window, session.shown.result)
    redraw(window)
    redraw_result(window)
    tabs = server.gui.add_tab_group()
    with tabs.add_tab("Room"):
        add_room_panel(window)
    with tabs.add_tab("Object"):
        add_object_panel(window)
        add_proposals(window)
    with tabs.add_tab("Solve"):
        gauges = add_solve_panel(window, job, why_not)
    host = socket.gethostname() if server.get_host() == "0.0.0.0" else server.get_host()
    token = f"/?token={gate.token}" if gate.token else ""
    return Opened(window, gauges, f"http://{host}:{server.get_port()}{token}")


def _window_of(server: object, session: Session) -> Window:
    drawing = Drawing(server)
    window = Window(server, session, drawing, People(server), Grips(session, drawing))

    def changed() -> None:
        if not window.watching:
            redraw(window)

    session.listeners.append(changed)
    return window


def _aim(window: Window, scene: Scene) -> None:
    """Begin behind and above the video's camera, looking at the furniture."""
    centers = [box_of(piece).center for piece in scene.objects] or [torch.tensor([0.0, -1.0, -3.0])]
    middle = torch.stack(centers).mean(0).tolist()
    start = window.server.initial_camera
    start.up = (0.0, 1.0, 0.0)
    start.position = (middle[0] + 1.0, 2.2, 1.8)
    start.look_at = (middle[0], middle[1], middle[2])
    start.fov = math.radians(55)


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
    start = shown_before(apply_edits(capture, origin.edits)[0])
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
