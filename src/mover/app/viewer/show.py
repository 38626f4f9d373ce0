"""`mover view`: a finished result in the browser, where it can be corrected."""

import contextlib
import io
import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from mover.app.cli import say
from mover.app.viewer.drawing import Drawing, DrawnPeople, draw_room, move_object
from mover.app.viewer.gate import HOSTS, guarded
from mover.app.viewer.panels import (
    Viewer,
    add_object_panel,
    add_room_panel,
    set_world,
    show_furniture,
)
from mover.app.viewer.session import Session, read_shown, start_session
from mover.core.errors import InputError
from mover.core.types import Scene, SceneObject
from mover.geometry.boxes import box_of


@dataclass
class Grips:
    """What the mouse holds."""

    session: Session
    drawing: Drawing
    gizmo: Any = None
    bound: dict[str, Any] = field(default_factory=dict[str, Any])
    """Handles that answer clicks, by object."""


def bind_clicks(grips: Grips) -> None:
    """Let every drawn object be selected by a click."""
    for name, handle in grips.drawing.after.items():
        if grips.bound.get(name) is not handle:
            grips.bound[name] = handle
            handle.on_click(lambda _event, name=name: grips.session.select(name))


def hold_selected(grips: Grips) -> None:
    """Give the selected object a gizmo; the last one loses its own."""
    if grips.gizmo is not None:
        grips.gizmo.remove()
        grips.gizmo = None
    item = grips.session.object_named(grips.session.selected)
    handle = grips.drawing.after.get(grips.session.selected or "")
    if item is None or handle is None:
        return
    half = float(item.yaw) / 2
    grips.gizmo = gizmo = grips.drawing.server.scene.add_transform_controls(
        "/gizmo", scale=0.9, active_axes=(True, item.support == "free", True), depth_test=False,
        position=tuple(item.t_world_object.tolist()),
        wxyz=(math.cos(half), 0.0, math.sin(half), 0.0),
    )  # fmt: skip

    @gizmo.on_update
    async def _(event: Any) -> None:  # noqa: ANN401
        now = grips.session.object_named(item.id)
        if now is not None:
            moved = _at_gizmo(now, gizmo)
            move_object(handle, moved)
            if event.phase == "end":  # the mouse lets it go
                grips.session.put(moved)


def _at_gizmo(item: SceneObject, gizmo: Any) -> SceneObject:  # noqa: ANN401
    w, x, y, z = (float(v) for v in gizmo.wxyz)
    yaw = math.atan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y))
    place = torch.tensor([float(v) for v in gizmo.position])
    return replace(item, t_world_object=place, yaw=torch.tensor(yaw))


def open_viewer(session: Session, port: int) -> tuple[Viewer, str]:
    """Start the server and draw the room; the window and its URL.

    Raises:
        InputError: If viser is not installed.
    """
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "mover view needs viser: pip install '.[viewer]' in mover's folder"
        ) from error
    with contextlib.redirect_stdout(io.StringIO()), guarded():
        server = viser.ViserServer(
            host=HOSTS[0], port=port, label=session.shown.title, verbose=False
        )
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="large", control_layout="fixed"
    )
    server.scene.set_up_direction("+y")
    drawing = Drawing(server)
    window, grips = Viewer(server, session, drawing, DrawnPeople(server)), Grips(session, drawing)

    def redraw() -> None:
        draw_room(drawing, session.scene, "after")
        show_furniture(window)
        bind_clicks(grips)
        hold_selected(grips)

    _aim(server, session.shown.result)
    session.listen(redraw)
    set_world(window, "after")
    tabs = server.gui.add_tab_group()
    with tabs.add_tab("Room"):
        add_room_panel(window)
    with tabs.add_tab("Object"):
        add_object_panel(window)
    return window, f"http://{HOSTS[0]}:{server.get_port()}"


def _aim(server: Any, scene: Scene) -> None:  # noqa: ANN401
    """Start behind and above the video's camera, looking at the furniture."""
    centers = [box_of(item).center for item in scene.objects] or [torch.tensor([0.0, -1.0, -3.0])]
    middle = torch.stack(centers).mean(0).tolist()
    start = server.initial_camera
    start.up = (0.0, 1.0, 0.0)
    start.position = (middle[0] + 1.0, 2.2, 1.8)
    start.look_at = (middle[0], middle[1], middle[2])
    start.fov = math.radians(55)


def view_result(out: Path, edits: Path | None, port: int) -> None:
    """Show a finished result until Ctrl-C."""
    session = start_session(read_shown(out), edits or out / "edits.json")
    window, url = open_viewer(session, port)
    say(f"{url} shows {out}; Ctrl-C ends it")
    try:
        while True:
            time.sleep(3600)
    finally:
        window.server.stop()
