"""The tabs `Room` and `Object`: what is shown, and numbers and edits of the chosen object."""

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from mover.app.report.tables import QUANTITIES, find_changes, write_quantity
from mover.app.viewer.drawing import GHOST, LAYERS, camera_wxyz
from mover.app.viewer.session import Session, Shown
from mover.app.viewer.window import Window, hold_selected, set_world, show_moment
from mover.core.types import Camera, Scene, SceneObject
from mover.furniture.library import PIECES, STYLES
from mover.geometry.boxes import box_of

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

    def show(_event: Any) -> None:  # noqa: ANN401
        window.people.visible = people.value
        show_moment(window, int(slider.value))

    slider.on_update(show)
    people.on_update(show)

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

    window.session.listen(refresh)


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

    window.session.listen(refresh)


def _add_looks(window: Window) -> None:
    gui, drawing = window.server.gui, window.drawing
    frustum = gui.add_checkbox("Camera", initial_value=True)
    through = gui.add_button("Look through the camera")
    above = gui.add_button("Look from above")

    def show(visible: bool) -> None:
        frustum.value = drawing.camera_visible = drawing.fixed["camera"].visible = visible

    @through.on_click
    def _(event: Any) -> None:  # noqa: ANN401
        camera = window.session.shown.result.camera
        view = event.client.camera
        show(False)  # its picture would hide the room
        view.up_direction = (0.0, 1.0, 0.0)
        view.position = (0.0, 0.0, 0.0)
        view.wxyz = camera_wxyz(camera)
        view.fov = _field(camera, view.aspect)

    @above.on_click
    def _(event: Any) -> None:  # noqa: ANN401
        view, start = event.client.camera, window.server.initial_camera
        show(True)
        view.up_direction = (0.0, 1.0, 0.0)
        view.position = start.position
        view.look_at = start.look_at
        view.fov = start.fov

    frustum.on_update(lambda _event: show(frustum.value))


def _field(camera: Camera, aspect: float) -> float:
    """The upright field of view in which the whole image of the camera fits [rad]."""
    half = camera.height / (2 * float(camera.K[1, 1]))
    across = camera.width / (2 * float(camera.K[0, 0]))
    return 2 * math.atan(max(half, across / aspect))


WORDS = {
    "mask_pixels": "pixels of its mask",
    "near_pixels": "pixels where people passed before it",
    "far_pixels": "pixels where it hid people",
    "touching_bodies": "bodies that touch it",
    "nearest_body": "metres to the nearest body",
    "energy": "energy that is left",
}


def numbers_of(piece: SceneObject, scene: Scene, shown: Shown) -> str:
    """A table in Markdown: place, size, what the run did, its evidence, its metrics."""
    box = box_of(piece)
    x, y, z = box.center.tolist()
    width, height, depth = (100 * v for v in box.size.tolist())
    rows = [
        ("category", piece.category),
        ("centre x, y, z", f"{x:.2f}, {y:.2f}, {z:.2f} m"),
        ("front", f"{math.degrees(float(piece.yaw)):.0f}°"),
        ("width, height, depth", f"{width:.0f}, {height:.0f}, {depth:.0f} cm"),
        ("stands on", piece.support),
        *_change(piece, scene, shown),
        *_evidence(piece, shown.log),
        *_metrics(piece, shown.metrics),
    ]
    lines = [f"| {name} | {value} |" for name, value in rows]
    return "\n".join([f"| **{piece.id}** | |", "|---|---|", *lines])


def _change(piece: SceneObject, scene: Scene, shown: Shown) -> list[tuple[str, str]]:
    change = find_changes(shown.initial, scene).get(piece.id)
    if change is None:
        return [("before", "not there")]
    grown = ", ".join(f"{factor:.2f}" for factor in change.grown)
    return [
        ("moved since the start", f"{100 * change.moved:.0f} cm"),
        ("turned", f"{math.degrees(change.turned):+.0f}°"),
        ("grown", grown),
    ]


def _evidence(piece: SceneObject, log: Mapping[str, Any]) -> list[tuple[str, str]]:
    row = next((r for r in log.get("evidence", ()) if r.get("id") == piece.id), {})
    return [
        (text, f"{row[key]:,}" if isinstance(row[key], int) else f"{row[key]:.3f}")
        for key, text in WORDS.items()
        if isinstance(row.get(key), int | float)
    ]


def _metrics(piece: SceneObject, metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    row = next((r for r in metrics.get("objects", ()) if r.get("id") == piece.id), {})
    before, after = row.get("initial") or {}, row.get("result") or {}
    return [
        (
            QUANTITIES[key].label,
            f"{write_quantity(key, before.get(key))} → {write_quantity(key, value)}",
        )
        for key, value in after.items()
        if key in QUANTITIES
    ]


# The tab.


NONE = "(none)"


def add_object_panel(window: Window) -> None:
    """Fill the tab."""
    _add_choice(window)
    _add_numbers(window)
    _add_edits(window)
    _add_library(window)
    undo = window.server.gui.add_button("Undo the last edit")
    undo.on_click(lambda _event: window.session.undo())


def _add_choice(window: Window) -> None:
    session = window.session
    choice = window.server.gui.add_dropdown("Object", [NONE, *window.drawing.after])

    def refresh() -> None:
        choice.options = [NONE, *window.drawing.after]
        choice.value = session.selected or NONE

    @choice.on_update
    def _(event: Any) -> None:  # noqa: ANN401
        if event.client is not None:
            session.select(None if choice.value == NONE else choice.value)

    session.listen(refresh)


def _add_numbers(window: Window) -> None:
    session = window.session
    table = window.server.gui.add_markdown("")

    def refresh() -> None:
        scene, piece = session.scene, session.piece(session.selected)
        none = "Click on an object."
        table.content = none if piece is None else numbers_of(piece, scene, session.shown)

    session.listen(refresh)


def _add_edits(window: Window) -> None:
    gui, session = window.server.gui, window.session
    folder = gui.add_folder("Edit", visible=False)
    with folder:
        gui.add_markdown("Pull at its arrows, its square or its arc, or write:")
        place = gui.add_vector3("Place [m]", (0.0, 0.0, 0.0), step=0.01)
        yaw = gui.add_number("Front [°]", 0.0, step=1.0)
        size = gui.add_vector3("Size [cm]", (1.0, 1.0, 1.0), min=(1.0, 1.0, 1.0), step=1.0)
        label = gui.add_text("Category", "")
        rename = gui.add_button("Set the category")
        pin = gui.add_checkbox("Pinned", False, hint="Solve again does not move it")
        delete = gui.add_button("Delete", color="red")
        by_hand = gui.add_checkbox("Drag the object itself", False)

    def refresh() -> None:
        piece = session.piece(session.selected)
        folder.visible = piece is not None
        if piece is not None:
            place.value = tuple(round(v, 3) for v in piece.t_world_object.tolist())
            yaw.value = round(math.degrees(float(piece.yaw)), 1)
            size.value = tuple(round(100 * v, 1) for v in box_of(piece).size.tolist())
            label.value = piece.category
            pin.value = piece.id in session.pinned

    place.on_update(_by_user(session, lambda p: session.put(_at(p, place.value))))
    yaw.on_update(_by_user(session, lambda p: session.put(_facing(p, yaw.value))))
    size.on_update(_by_user(session, lambda p: session.put(_sized(p, size.value))))
    rename.on_click(_by_user(session, lambda p: session.relabel(p.id, label.value)))
    pin.on_update(_by_user(session, lambda p: session.pin(p.id, pin.value)))
    delete.on_click(_by_user(session, lambda p: session.delete(p.id)))
    window.grips.switch = by_hand
    by_hand.on_update(lambda _event: hold_selected(window.grips))
    session.listen(refresh)


def _by_user(session: Session, act: Callable[[SceneObject], None]) -> Callable[[Any], None]:
    """Act on the chosen object where a client, not this program, has changed a field."""

    def listen(event: Any) -> None:  # noqa: ANN401
        piece = session.piece(session.selected)
        if event.client is not None and piece is not None:
            act(piece)

    return listen


# The fields are rounded: numbers that still say what they said change nothing.


def _at(piece: SceneObject, place: tuple[float, ...]) -> SceneObject:
    t, now = torch.tensor(place), piece.t_world_object
    return replace(piece, t_world_object=torch.where((t - now).abs() < 6e-4, now, t))


def _facing(piece: SceneObject, yaw: float) -> SceneObject:
    turn = torch.tensor(math.radians(yaw))
    return replace(piece, yaw=torch.where((turn - piece.yaw).abs() < 1e-3, piece.yaw, turn))


def _sized(piece: SceneObject, size: tuple[float, ...]) -> SceneObject:
    now, asked = box_of(piece).size, torch.tensor(size) / 100
    scale = piece.scale * asked / now.clamp_min(1e-6)
    return replace(piece, scale=torch.where((asked - now).abs() < 6e-4, piece.scale, scale))


def _add_library(window: Window) -> None:
    gui, session = window.server.gui, window.session
    with gui.add_folder("Add from the library", expand_by_default=False):
        kind = gui.add_dropdown("Piece", list(PIECES))
        style = gui.add_number("Design", 0, min=0, step=1)
        seen = gui.add_dropdown("Seen as", [NONE])
        add = gui.add_button("Add")

    def refresh() -> None:
        taken = {piece.annotation for piece in session.scene.objects}
        found = () if session.capture is None else session.capture.detections
        free = [f"{d.id}: {d.category}" for d in found if d.id not in taken]
        seen.options = [NONE, *free]

    @add.on_click
    def _(event: Any) -> None:  # noqa: ANN401
        look = [float(v) for v in event.client.camera.look_at]
        annotation = None if seen.value == NONE else int(seen.value.split(":")[0])
        design = int(style.value) % STYLES[kind.value]
        session.add(kind.value, design, annotation, (look[0], look[2]))

    session.listen(refresh)
