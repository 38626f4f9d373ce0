"""Everything that one open viewer holds."""

import threading
from dataclasses import dataclass, field
from typing import Any

from .drawing import Drawing, draw_fixed, draw_layers, draw_room
from .grips import Grips, bind_clicks, hold_selected
from .live import Watch
from .people import People, cast_of, replace_cast, show_people
from .session import Session


@dataclass
class Window:
    """Server, state and drawings of one viewer."""

    server: Any
    session: Session
    drawing: Drawing
    people: People
    grips: Grips
    moment: int = 0
    """Where the time line stands."""
    world: str = "after"
    """`after` or `before`: whose people, floor and camera are shown."""
    watch: Watch | None = None
    """The run that moves the furniture; edits wait for it."""
    running: threading.Lock = field(default_factory=threading.Lock)
    """Held by the run."""

    @property
    def watching(self) -> bool:
        """Whether a run moves the furniture."""
        return self.watch is not None


def redraw(window: Window) -> None:
    """Draw the room as the session has it."""
    drawing, session = window.drawing, window.session
    draw_room(drawing, session.scene, "after")
    bind_clicks(window.grips)
    if not window.watching:
        hold_selected(window.grips)


def redraw_result(window: Window) -> None:
    """Draw all that changes with a new result."""
    drawing, shown = window.drawing, window.session.shown
    draw_room(drawing, shown.initial, "before")
    for handle in drawing.before.values():
        handle.visible = window.world == "before"
    draw_layers(drawing, shown.layers)
    set_world(window, window.world)


def set_world(window: Window, world: str) -> None:
    """Show people, floor and camera before or after the run."""
    window.world = world
    shown = window.session.shown
    scene = shown.result if world == "after" else shown.initial
    draw_fixed(window.drawing, scene, shown.image)
    bodies = shown.bodies if world == "after" else shown.initial_bodies
    replace_cast(window.people, cast_of(bodies))
    show_people(window.people, window.moment)
