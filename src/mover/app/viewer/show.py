"""`mover view`: a finished result in the browser, where it can be corrected.

Only pages of the viewer itself may talk to it. A web page that is open in the same browser may send
requests to this machine, under any name that its owner's DNS gives it (`Host`), and open WebSockets
(`Origin`). Both are checked before viser gets a request.
"""

import contextlib
import io
import math
import time
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import torch

from mover.app.cli import say
from mover.app.viewer.drawing import DrawnPeople, RoomWindow
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
