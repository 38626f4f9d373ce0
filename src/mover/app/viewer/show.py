"""`mover view`: a finished result in the browser, where it can be corrected in two tabs.

Only pages of the viewer itself may talk to it. A web page that is open in the same browser may send
requests to this machine, under any name that its owner's DNS gives it (`Host`), and open WebSockets
(`Origin`). Both are checked before viser gets a request.
"""

import contextlib
import io
import math
import threading
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch

from mover.app.cli import say
from mover.app.report.tables import find_changes
from mover.app.viewer.drawing import (
    DrawnPeople,
    RoomWindow,
    Session,
    Shown,
    camera_wxyz,
    read_shown,
    start_session,
)
from mover.core.errors import InputError
from mover.core.types import Scene, SceneObject
from mover.geometry.boxes import box_of

DEFAULT_PACE, FASTEST = 10.0, 20.0  # frames a second of bodies without a rate; drawn at most
NONE = "(none)"
EVIDENCE = {
    "mask_pixels": "pixels of its mask",
    "near_pixels": "pixels where people passed before it",
    "far_pixels": "pixels where it hid people",
    "touching_bodies": "bodies that touch it",
}


def add_room_panel(window: RoomWindow) -> None:
    """Fill the tab."""
    _add_time_line(window)
    worlds = window.server.gui.add_button_group("Room", ["after", "before"])
    worlds.on_click(lambda _event: window.set_world(worlds.value))
    _add_looks(window)


def _add_time_line(window: RoomWindow) -> None:
    gui, frames = window.server.gui, window.people.frames
    if not frames:
        gui.add_markdown("*There are no people in this capture.*")
        return
    slider = gui.add_slider("Moment", 0, max(1, len(frames) - 1), 1, 0)
    play = gui.add_button("Play")
    people = gui.add_checkbox("People", initial_value=True)
    running = threading.Event()

    def show(_event: Any) -> None:  # noqa: ANN401
        window.people.visible, window.moment = people.value, int(slider.value)
        window.people.show(window.moment)

    slider.on_update(show)
    people.on_update(show)

    @play.on_click
    def _(_event: Any) -> None:  # noqa: ANN401
        if running.is_set():
            running.clear()
            return
        running.set()
        play.label = "Pause"
        while running.is_set() and window.people.bodies is not None:
            shown = window.people.frames
            gap = float(np.median(np.diff(shown))) if len(shown) > 1 else 1.0
            moments = (window.people.bodies.fps or DEFAULT_PACE) / max(gap, 1.0)  # a second
            every = max(1, round(moments / FASTEST))
            slider.value = (int(slider.value) + every) % len(shown)
            time.sleep(every / moments)
        play.label = "Play"


def _add_looks(window: RoomWindow) -> None:
    gui = window.server.gui
    frustum = gui.add_checkbox("Camera", initial_value=True)
    through = gui.add_button("Look through the camera")
    above = gui.add_button("Look from above")

    def show(visible: bool) -> None:
        frustum.value = window.camera_visible = window.camera.visible = visible

    @through.on_click
    def _(event: Any) -> None:  # noqa: ANN401
        camera, view = window.session.shown.result.camera, event.client.camera
        show(False)  # its picture would hide the room
        view.up_direction = (0.0, 1.0, 0.0)
        view.position = (0.0, 0.0, 0.0)
        view.wxyz = camera_wxyz(camera)
        half = camera.height / (2 * float(camera.K[1, 1]))
        across = camera.width / (2 * float(camera.K[0, 0]))
        view.fov = 2 * math.atan(max(half, across / view.aspect))  # the whole image fits [rad]

    @above.on_click
    def _(event: Any) -> None:  # noqa: ANN401
        view, start = event.client.camera, window.server.initial_camera
        show(True)
        view.up_direction, view.position = (0.0, 1.0, 0.0), start.position
        view.look_at, view.fov = start.look_at, start.fov

    frustum.on_update(lambda _event: show(frustum.value))


def numbers_of(item: SceneObject, scene: Scene, shown: Shown) -> str:
    """A table in Markdown: position, size, what the run did, its evidence."""
    box = box_of(item)
    x, y, z = box.center.tolist()
    width, height, depth = (100 * v for v in box.size.tolist())
    change = find_changes(shown.initial, scene).get(item.id)
    evidence = next((r for r in shown.log.get("evidence", ()) if r.get("id") == item.id), {})
    rows = [
        ("category", item.category),
        ("centre x, y, z", f"{x:.2f}, {y:.2f}, {z:.2f} m"),
        ("front", f"{math.degrees(float(item.yaw)):.0f}°"),
        ("width, height, depth", f"{width:.0f}, {height:.0f}, {depth:.0f} cm"),
        ("stands on", item.support),
    ]
    if change is None:
        rows.append(("before", "not there"))
    else:
        rows += [
            ("moved since the start", f"{100 * change.moved:.0f} cm"),
            ("turned", f"{math.degrees(change.turned):+.0f}°"),
            ("grown", ", ".join(f"{factor:.2f}" for factor in change.grown)),
        ]
    for key, text in EVIDENCE.items():
        if isinstance(evidence.get(key), int | float):
            rows.append((text, f"{evidence[key]:,}"))
    lines = [f"| {name} | {value} |" for name, value in rows]
    return "\n".join([f"| **{item.id}** | |", "|---|---|", *lines])


def add_object_panel(window: RoomWindow) -> None:
    """Fill the tab."""
    gui, session = window.server.gui, window.session
    choice = gui.add_dropdown("Object", [NONE, *window.furniture["after"]])
    table = gui.add_markdown("")
    _add_edits(window)
    undo = gui.add_button("Undo the last edit")
    saved = gui.add_markdown("")

    def refresh() -> None:
        choice.options = [NONE, *window.furniture["after"]]
        choice.value = session.selected or NONE
        item = session.object_named(session.selected)
        none = "Click on an object."
        table.content = none if item is None else numbers_of(item, session.scene, session.shown)
        new = len(session.edits) - session.done
        source = session.shown.log.get("source") or "CAPTURE"
        command = f"mover run {source} --edits {session.file} --out NEW"
        saved.content = f"{new} new edits in `{session.file}`; `{command}` solves them."
        saved.visible = new > 0

    @choice.on_update
    def _(event: Any) -> None:  # noqa: ANN401
        if event.client is not None:
            session.select(None if choice.value == NONE else choice.value)

    undo.on_click(lambda _event: session.undo())
    session.listen(refresh)


def _add_edits(window: RoomWindow) -> None:
    gui, session = window.server.gui, window.session
    folder = gui.add_folder("Edit", visible=False)
    with folder:
        gui.add_markdown("Pull at its arrows, its square or its arc, or write:")
        position = gui.add_vector3("Position [m]", (0.0, 0.0, 0.0), step=0.01)
        yaw = gui.add_number("Front [°]", 0.0, step=1.0)
        size = gui.add_vector3("Size [cm]", (1.0, 1.0, 1.0), min=(1.0, 1.0, 1.0), step=1.0)
        pin = gui.add_checkbox("Pinned", False, hint="The next run does not move it")
        delete = gui.add_button("Delete", color="red")

    def refresh() -> None:
        item = session.object_named(session.selected)
        folder.visible = item is not None
        if item is not None:
            position.value = tuple(round(v, 3) for v in item.t_world_object.tolist())
            yaw.value = round(math.degrees(float(item.yaw)), 1)
            size.value = tuple(round(100 * v, 1) for v in box_of(item).size.tolist())
            pin.value = item.id in session.pinned

    def by_user(act: Callable[[SceneObject], None]) -> Callable[[Any], None]:
        """Act on the selected object where a client, not this program, has changed a field."""

        def listen(event: Any) -> None:  # noqa: ANN401
            item = session.object_named(session.selected)
            if event.client is not None and item is not None:
                act(item)

        return listen

    # The fields are rounded: numbers that still say what they said change nothing.
    def put(item: SceneObject) -> None:
        now, turn = item.t_world_object, torch.tensor(math.radians(yaw.value))
        t, asked = torch.tensor(position.value), torch.tensor(size.value) / 100
        box = box_of(item).size
        scale = item.scale * asked / box.clamp_min(1e-6)
        session.put(
            replace(
                item,
                t_world_object=torch.where((t - now).abs() < 6e-4, now, t),
                yaw=torch.where((turn - item.yaw).abs() < 1e-3, item.yaw, turn),
                scale=torch.where((asked - box).abs() < 6e-4, item.scale, scale),
            )
        )

    for written in (position, yaw, size):
        written.on_update(by_user(put))
    pin.on_update(by_user(lambda item: session.pin(item.id, pin.value)))
    delete.on_click(by_user(lambda item: session.delete(item.id)))
    session.listen(refresh)


def open_viewer(session: Session, port: int) -> tuple[RoomWindow, str]:
    """Start the server and draw the room; the window and its URL.

    Raises:
        InputError: If viser is not installed.
    """
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "mover view needs viser: pip install -e '.[viewer]' in mover's folder"
        ) from error
    with contextlib.redirect_stdout(io.StringIO()), guarded():
        server = viser.ViserServer(
            host=HOSTS[0], port=port, label=session.shown.title, verbose=False
        )
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="large", control_layout="fixed"
    )
    server.scene.set_up_direction("+y")
    # It starts behind and above the video's camera, looking at the furniture.
    objects = session.shown.result.objects
    centers = [box_of(item).center for item in objects] or [torch.tensor([0.0, -1.0, -3.0])]
    x, y, z = torch.stack(centers).mean(0).tolist()
    start = server.initial_camera
    start.up, start.position = (0.0, 1.0, 0.0), (x + 1.0, 2.2, 1.8)
    start.look_at, start.fov = (x, y, z), math.radians(55)
    window = RoomWindow(server, session, DrawnPeople(server))
    window.set_world("after")
    session.listen(window.redraw)
    tabs = server.gui.add_tab_group()
    with tabs.add_tab("Room"):
        add_room_panel(window)
    with tabs.add_tab("Object"):
        add_object_panel(window)
    return window, f"http://{HOSTS[0]}:{server.get_port()}"


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


HOSTS = ("127.0.0.1", "localhost", "::1")


def refusal(headers: Mapping[str, str]) -> str:
    """Why a request is refused; empty: it is let in."""
    host = headers.get("Host") or ""
    name = urlsplit(f"//{host}").hostname or ""
    if name not in HOSTS:
        return f"the viewer is not at {name!r}, but at {HOSTS[0]}"
    origin = headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return f"a page of {origin} may not use the viewer"
    return ""


@contextlib.contextmanager
def guarded() -> Generator[None, None, None]:
    """Servers of `websockets` that are started in the block refuse foreign pages.

    viser starts one from its constructor and passes nothing through to it, so that the function
    that starts it is replaced meanwhile.
    """
    from websockets.asyncio import server  # pyright: ignore[reportMissingImports]

    serve: Any = server.serve

    def guarded_serve(*args: Any, process_request: Any = None, **options: Any) -> Any:  # noqa: ANN401
        def handle(connection: Any, request: Any) -> Any:  # noqa: ANN401
            if reason := refusal(request.headers):
                return connection.respond(403, f"{reason}\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*args, process_request=handle, **options)

    setattr(server, "serve", guarded_serve)  # noqa: B010
    try:
        yield
    finally:
        setattr(server, "serve", serve)  # noqa: B010
