"""The tab `Object`: numbers and edits of the chosen object."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from mover.app.report.tables import QUANTITIES, find_changes, write_quantity
from mover.app.viewer.session import Session, Shown
from mover.app.viewer.window import Window, hold_selected
from mover.core.types import Scene, SceneObject
from mover.furniture.library import PIECES, STYLES
from mover.geometry.boxes import box_of

WORDS = {
    "mask_pixels": "pixels of its mask",
    "near_pixels": "pixels where people passed before it",
    "far_pixels": "pixels where it hid people",
    "touching_bodies": "bodies that touch it",
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

    @undo.on_click
    def _(_event: Any) -> None:  # noqa: ANN401
        window.session.undo()


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

    session.on_room.append(refresh)
    session.on_select.append(refresh)


def _add_numbers(window: Window) -> None:
    session = window.session
    table = window.server.gui.add_markdown("Click on an object.")

    def refresh() -> None:
        scene, piece = session.scene, session.piece(session.selected)
        none = "Click on an object."
        table.content = none if piece is None else numbers_of(piece, scene, session.shown)

    session.on_room.append(refresh)
    session.on_select.append(refresh)


@dataclass
class Fields:
    """Where the user writes about the chosen object."""

    folder: Any
    place: Any
    yaw: Any
    size: Any
    label: Any
    rename: Any
    pin: Any


def _add_edits(window: Window) -> None:
    gui, session = window.server.gui, window.session
    folder = gui.add_folder("Edit", visible=False)
    with folder:
        gui.add_markdown("Pull at its arrows, its square or its arc, or write:")
        fields = Fields(
            folder,
            gui.add_vector3("Place [m]", (0.0, 0.0, 0.0), step=0.01),
            gui.add_number("Front [°]", 0.0, step=1.0),
            gui.add_vector3("Size [cm]", (1.0, 1.0, 1.0), min=(1.0, 1.0, 1.0), step=1.0),
            gui.add_text("Category", ""),
            gui.add_button("Set the category"),
            gui.add_checkbox("Pinned", False, hint="Solve again does not move it"),
        )
        delete = gui.add_button("Delete", color="red")

        by_hand = gui.add_checkbox("Drag the object itself", False)

    @by_hand.on_update
    def _(_event: Any) -> None:  # noqa: ANN401
        window.grips.by_hand = by_hand.value
        hold_selected(window.grips)

    @delete.on_click
    def _(_event: Any) -> None:  # noqa: ANN401
        if session.selected is not None:
            session.delete(session.selected)

    def refresh() -> None:
        _fill(fields, session)

    _listen(fields, session)
    session.on_room.append(refresh)
    session.on_select.append(refresh)


def _fill(fields: Fields, session: Session) -> None:
    """Write the chosen object's values into the fields."""
    piece = session.piece(session.selected)
    fields.folder.visible = piece is not None
    if piece is not None:
        fields.place.value = tuple(round(v, 3) for v in piece.t_world_object.tolist())
        fields.yaw.value = round(math.degrees(float(piece.yaw)), 1)
        fields.size.value = tuple(round(100 * v, 1) for v in box_of(piece).size.tolist())
        fields.label.value = piece.category
        fields.pin.value = piece.id in session.pinned


def _listen(fields: Fields, session: Session) -> None:
    """Record what the user (a client, not this program) writes into the fields."""

    def moved(piece: SceneObject) -> None:
        session.put(_as_written(piece, fields.place.value, fields.yaw.value, fields.size.value))

    def heard(act: Callable[[SceneObject], None]) -> Callable[[Any], None]:
        def listen(event: Any) -> None:  # noqa: ANN401
            piece = session.piece(session.selected)
            if event.client is not None and piece is not None:
                act(piece)

        return listen

    for field in (fields.place, fields.yaw, fields.size):
        field.on_update(heard(moved))
    fields.rename.on_click(heard(lambda piece: session.relabel(piece.id, fields.label.value)))
    fields.pin.on_update(heard(lambda piece: session.pin(piece.id, fields.pin.value)))


def _as_written(
    piece: SceneObject, place: tuple[float, ...], yaw: float, size: tuple[float, ...]
) -> SceneObject:
    """The piece with what the user wrote; fields that still say what they said change nothing."""
    now = box_of(piece).size
    asked = torch.tensor(size) / 100
    same = (asked - now).abs() < 6e-4
    scale = torch.where(same, piece.scale, piece.scale * asked / now.clamp_min(1e-6))
    t = torch.tensor(place)
    t = torch.where((t - piece.t_world_object).abs() < 6e-4, piece.t_world_object, t)
    turn = torch.tensor(math.radians(yaw))
    turn = torch.where((turn - piece.yaw).abs() < 1e-3, piece.yaw, turn)
    return replace(piece, t_world_object=t, yaw=turn, scale=scale)


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

    session.on_room.append(refresh)
    refresh()
