"""The tab `Solve`: run the main job again from the edited room, and watch it."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mover.app.results import Origin
from mover.app.viewer.drawing import draw_room
from mover.app.viewer.session import Shown, read_shown
from mover.app.viewer.solve import Stopped, Watch, solve_again, started_from
from mover.app.viewer.window import Window, redraw_result
from mover.core.observe import Step
from mover.core.types import Scene
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
        listed.content = _listed(window)

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

    @stop.on_click
    def _(_event: Any) -> None:  # noqa: ANN401
        if window.watch is not None:
            window.watch.stop = True

    session.on_room.append(refresh)
    refresh()
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
        watch = begin_watching(window, started_from(capture, edits).scene, gauges)
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


def _listed(window: Window) -> str:
    """The edits, the newest last."""
    session = window.session
    if not session.edits:
        return "*There are no edits.*"
    lines = [
        f"{i + 1}. {type(edit).__name__.lower()} `{edit.id}`" + (" ✓" if i < session.done else "")
        for i, edit in enumerate(session.edits)
    ]
    return "\n".join(lines)
