"""Everything that one open viewer holds, and how the mouse moves objects in it."""

import math
import threading
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from mover.app.viewer.drawing import (
    Drawing,
    People,
    cast_of,
    draw_fixed,
    draw_layers,
    draw_room,
    move_object,
    replace_cast,
    show_people,
)
from mover.app.viewer.session import Session
from mover.app.viewer.solve import Watch
from mover.core.types import Scene, SceneObject
from mover.geometry.placement import placed_at

FARTHEST = 30.0  # [m] from the camera of the view that a drag may carry


@dataclass
class Grips:
    """What the mouse holds."""

    session: Session
    drawing: Drawing
    gizmo: Any = None
    switch: Any = None
    """Checkbox that lets the chosen object itself be dragged, not only its gizmo."""
    bound: dict[str, Any] = field(default_factory=lambda: {})
    """Handles that answer clicks, by object."""
    dragged: Any = None
    """Handle of the chosen object, which can be dragged."""
    start: SceneObject | None = None
    """The object as it was when the mouse took it."""
    grabbed: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def by_hand(self) -> bool:
        """Whether the chosen object itself can be dragged."""
        return self.switch is not None and self.switch.value


def bind_clicks(grips: Grips) -> None:
    """Let every drawn object be chosen by a click."""
    for name, handle in grips.drawing.after.items():
        if grips.bound.get(name) is handle:
            continue
        grips.bound[name] = handle

        @handle.on_click
        def _(_event: Any, name: str = name) -> None:  # noqa: ANN401
            grips.session.select(name)


def hold_selected(grips: Grips) -> None:
    """Give the chosen object a gizmo and, if asked, let it be dragged; the last one loses both."""
    if grips.gizmo is not None:
        grips.gizmo.remove()
        grips.gizmo = None
    name = grips.session.selected
    handle = grips.drawing.after.get(name or "")
    if grips.dragged is not None and (grips.dragged is not handle or not grips.by_hand):
        if any(grips.dragged is there for there in grips.drawing.after.values()):
            grips.dragged.remove_drag_callback()
        grips.dragged = None
    piece = grips.session.piece(name)
    if piece is None or handle is None:
        return
    _add_gizmo(grips, piece)
    if grips.by_hand and grips.dragged is None:
        grips.dragged = handle
        _bind_drag(grips, handle)


def _add_gizmo(grips: Grips, piece: SceneObject) -> None:
    free = piece.support == "free"
    half = float(piece.yaw) / 2
    gizmo = grips.drawing.server.scene.add_transform_controls(
        "/gizmo", scale=0.9, active_axes=(True, free, True), depth_test=False,
        position=tuple(piece.t_world_object.tolist()),
        wxyz=(math.cos(half), 0.0, math.sin(half), 0.0),
    )  # fmt: skip
    grips.gizmo = gizmo

    @gizmo.on_update
    async def _(event: Any) -> None:  # noqa: ANN401
        now = grips.session.piece(piece.id)
        if now is None:
            return
        w, x, y, z = (float(v) for v in gizmo.wxyz)
        yaw = math.atan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y))
        place = torch.tensor([float(v) for v in gizmo.position])
        _moved(grips, replace(now, t_world_object=place, yaw=torch.tensor(yaw)), event.phase)


def _bind_drag(grips: Grips, handle: Any) -> None:  # noqa: ANN401
    @handle.on_drag("left")
    async def _(event: Any) -> None:  # noqa: ANN401
        if event.phase == "start" or grips.start is None:
            grips.start = grips.session.piece(grips.session.selected)
            grips.grabbed = event.start_position
        if grips.start is None:
            return
        eye = np.asarray(event.client.camera.position, dtype=float)
        shift = _over_floor(eye, np.asarray(event.end_position, dtype=float), grips.grabbed)
        place = grips.start.t_world_object + torch.tensor(shift, dtype=torch.float32)
        _moved(grips, replace(grips.start, t_world_object=place), event.phase)
        if event.phase == "end":
            grips.start = None


def _over_floor(
    eye: np.ndarray, pointer: np.ndarray, grabbed: tuple[float, float, float]
) -> tuple[float, float, float]:
    """How far the pointer has carried the grabbed point at its own height [m]."""
    ray = pointer - eye
    drop = grabbed[1] - eye[1]
    if abs(ray[1]) < 1e-6 or drop / ray[1] <= 0:
        return 0.0, 0.0, 0.0
    hit = eye + ray * (drop / ray[1])
    if np.linalg.norm(hit - eye) > FARTHEST:
        return 0.0, 0.0, 0.0
    return float(hit[0] - grabbed[0]), 0.0, float(hit[2] - grabbed[2])


def _moved(grips: Grips, piece: SceneObject, phase: str) -> None:
    """Show an object in its new place; record it when the mouse lets it go."""
    handle = grips.drawing.after.get(piece.id)
    if handle is not None:
        move_object(handle, piece)
    if phase == "end":
        grips.session.put(piece)


# The whole window.


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
    def frame(self) -> int:
        """The frame of the video where the time line stands."""
        cast = self.people.cast
        return 0 if cast is None else cast.frames[min(self.moment, len(cast.frames) - 1)]

    @property
    def watching(self) -> bool:
        """Whether a run moves the furniture."""
        return self.watch is not None


def redraw(window: Window) -> None:
    """Draw the room as the session has it."""
    drawing, session = window.drawing, window.session
    draw_room(drawing, _at_moment(window), "after")
    proposed = tuple(one.object for one in session.proposals)
    draw_room(drawing, replace(session.scene, objects=proposed), "proposed")
    bind_clicks(window.grips)
    if not window.watching:
        hold_selected(window.grips)


def _at_moment(window: Window) -> Scene:
    """The room with each object where it stands in the frame that is shown."""
    scene = window.session.scene
    pieces = tuple(placed_at(piece, window.frame) for piece in scene.objects)
    return replace(scene, objects=pieces)


def show_moment(window: Window, moment: int) -> None:
    """Show people, and objects that are moved, at a moment of the time line."""
    window.moment = moment
    show_people(window.people, moment)
    if not window.watching and any(piece.segments for piece in window.session.scene.objects):
        draw_room(window.drawing, _at_moment(window), "after")


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
