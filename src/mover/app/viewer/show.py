"""`mover view`: a finished result in the browser, where it can be corrected."""

import contextlib
import io
import math
import time
from pathlib import Path

import torch

from mover.app.cli import say
from mover.app.viewer.drawing import DrawnPeople, RoomWindow
from mover.app.viewer.gate import HOSTS, guarded
from mover.app.viewer.panels import add_object_panel, add_room_panel
from mover.app.viewer.session import Session, read_shown, start_session
from mover.core.errors import InputError
from mover.geometry.boxes import box_of


def open_viewer(session: Session, port: int) -> tuple[RoomWindow, str]:
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
