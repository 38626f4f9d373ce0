"""The tab `Room`: time line, before and after, evidence."""

import math
import threading
import time
from typing import Any

import numpy as np

from mover.app.viewer.drawing import GHOST, LAYERS, camera_wxyz, show_people
from mover.app.viewer.window import Window, set_world
from mover.core.types import Camera

DEFAULT_PACE = 10.0  # frames a second where the bodies do not tell
FASTEST = 20.0  # pictures a second
TITLES = {
    "near": "People passed before",
    "far": "Objects hid people",
    "free space": "People's space",
    "contacts": "Contact points",
    "doubt": "Camera doubt (95 %)",
    "place": "Where it may stand (90 %)",
}


def add_room_panel(window: Window) -> None:
    """Fill the tab."""
    _add_time_line(window)
    _add_before_after(window)
    _add_layers(window)
    _add_looks(window)


def _add_time_line(window: Window) -> None:
    gui, cast = window.server.gui, window.people.cast
    if cast is None:
        gui.add_markdown("*There are no people in this capture.*")
        return
    slider = gui.add_slider("Moment", 0, max(1, len(cast.frames) - 1), 1, 0)
    play = gui.add_button("Play")
    people = gui.add_checkbox("People", initial_value=True)
    running = threading.Event()

    @slider.on_update
    def _(_event: Any) -> None:  # noqa: ANN401
        window.moment = int(slider.value)
        show_people(window.people, window.moment)

    @people.on_update
    def _(_event: Any) -> None:  # noqa: ANN401
        window.people.visible = people.value
        show_people(window.people, window.moment)

    @play.on_click
    def _(_event: Any) -> None:  # noqa: ANN401
        if running.is_set():
            running.clear()
            return
        running.set()
        play.label = "Pause"
        _play(window, slider, running)
        play.label = "Play"


def _play(window: Window, slider: Any, running: threading.Event) -> None:  # noqa: ANN401
    """Move the slider until somebody pauses; it starts anew at the end."""
    while running.is_set():
        cast = window.people.cast
        if cast is None:
            return
        pace, every = _pace(cast.bodies.fps or DEFAULT_PACE, cast.frames)
        slider.value = (int(slider.value) + every) % len(cast.frames)
        time.sleep(1 / pace)


def _pace(fps: float, frames: list[int]) -> tuple[float, int]:
    """Pictures a second, and how many moments each goes on."""
    gap = float(np.median(np.diff(frames))) if len(frames) > 1 else 1.0
    moments = fps / max(gap, 1.0)
    every = max(1, round(moments / FASTEST))
    return moments / every, every


def _add_before_after(window: Window) -> None:
    gui = window.server.gui
    everything = gui.add_button_group("Furniture", ["after", "before"])
    folder = gui.add_folder("As it was given", expand_by_default=False)
    boxes: dict[str, Any] = {}

    @everything.on_click
    def _(_event: Any) -> None:  # noqa: ANN401
        set_world(window, everything.value)
        for box in boxes.values():
            box.value = everything.value == "before"
        _show_furniture(window, boxes)

    def refresh() -> None:
        _match_boxes(window, folder, boxes)
        _show_furniture(window, boxes)

    window.session.on_room.append(refresh)
    refresh()


def _match_boxes(window: Window, folder: Any, boxes: dict[str, Any]) -> None:  # noqa: ANN401
    """One box for each object that there is both before and after."""
    there = [name for name in window.drawing.before if name in window.drawing.after]
    for name in [name for name in boxes if name not in there]:
        boxes.pop(name).remove()
    for name in [name for name in there if name not in boxes]:
        with folder:
            box = window.server.gui.add_checkbox(name, initial_value=window.world == "before")
        box.on_update(lambda _event: _show_furniture(window, boxes))
        boxes[name] = box


def _show_furniture(window: Window, boxes: dict[str, Any]) -> None:
    """Each object as its box says; those that are only before or only after, as their world."""
    early = window.world == "before"
    for name, handle in window.drawing.before.items():
        handle.visible = boxes[name].value if name in boxes else early
    for name, handle in window.drawing.after.items():
        handle.visible = not boxes[name].value if name in boxes else not early


def _add_layers(window: Window) -> None:
    gui = window.server.gui
    boxes: dict[str, Any] = {}
    with gui.add_folder("Evidence"):
        for name in LAYERS:
            boxes[name] = gui.add_checkbox(TITLES[name], initial_value=False)
        glass = gui.add_checkbox("Glass furniture", initial_value=False)
        missing = gui.add_markdown("*The run left no evidence here.*")

    def refresh() -> None:
        layers = window.drawing.layers
        for name, box in boxes.items():
            box.visible = bool(layers.get(name))
            for handle in layers.get(name, ()):
                handle.visible = box.value
        missing.visible = not any(layers.values())

    for box in boxes.values():
        box.on_update(lambda _event: refresh())

    @glass.on_update
    def _(_event: Any) -> None:  # noqa: ANN401
        for handle in (*window.drawing.after.values(), *window.drawing.before.values()):
            handle.opacity = GHOST if glass.value else None

    window.session.on_room.append(refresh)
    refresh()


def _add_looks(window: Window) -> None:
    gui, drawing = window.server.gui, window.drawing
    frustum = gui.add_checkbox("Camera", initial_value=True)
    through = gui.add_button("Look through the camera")
    above = gui.add_button("Look from above")

    @frustum.on_update
    def _(_event: Any) -> None:  # noqa: ANN401
        drawing.camera_visible = drawing.fixed["camera"].visible = frustum.value

    @through.on_click
    def _(event: Any) -> None:  # noqa: ANN401
        camera = window.session.shown.result.camera
        view = event.client.camera
        frustum.value = False  # its picture would hide the room
        view.up_direction = (0.0, 1.0, 0.0)
        view.position = (0.0, 0.0, 0.0)
        view.wxyz = camera_wxyz(camera)
        view.fov = _field(camera, view.aspect)

    @above.on_click
    def _(event: Any) -> None:  # noqa: ANN401
        view, start = event.client.camera, window.server.initial_camera
        frustum.value = True
        view.up_direction = (0.0, 1.0, 0.0)
        view.position = start.position
        view.look_at = start.look_at
        view.fov = start.fov


def _field(camera: Camera, aspect: float) -> float:
    """The upright field of view in which the whole image of the camera fits [rad]."""
    half = camera.height / (2 * float(camera.K[1, 1]))
    across = camera.width / (2 * float(camera.K[0, 0]))
    return 2 * math.atan(max(half, across / aspect))
