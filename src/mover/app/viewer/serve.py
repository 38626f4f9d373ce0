"""Start a viewer on this machine's own address."""

import contextlib
import io
import math
import socket
from dataclasses import dataclass
from typing import Any

import torch

from mover.app.viewer.address import Address
from mover.app.viewer.drawing import Drawing, People
from mover.app.viewer.gate import gate_at, guarded
from mover.app.viewer.panel_object import add_object_panel
from mover.app.viewer.panel_room import add_room_panel
from mover.app.viewer.panel_solve import Gauges, SolveJob, add_solve_panel
from mover.app.viewer.session import Session
from mover.app.viewer.window import Grips, Window, redraw, redraw_result
from mover.core.errors import InputError
from mover.core.types import Scene
from mover.geometry.boxes import box_of

SCRIPT = """
addEventListener("pointerdown", (press) => {
  if (press.target instanceof HTMLCanvasElement)
    Object.defineProperty(press, "preventDefault", {value: () => {}});
}, true);
"""


def quiet_presses(server: Any) -> None:  # noqa: ANN401
    """Presses on draggable objects say nothing in the browser's console.

    viser asks the browser to prevent what a press on a draggable object would do otherwise, from a
    listener that was registered as passive. There the request does nothing, and Chromium writes an
    error about it. The script, which every browser that connects runs, takes the request off such
    presses: what they do stays the same. A viser without such messages stays as it is.

    Args:
        server: The viser server.
    """
    from viser import _messages  # pyright: ignore[reportMissingImports]

    message = getattr(_messages, "RunJavascriptMessage", None)
    interface = getattr(server.gui, "_websock_interface", None)
    if message is not None and interface is not None:
        interface.queue_message(message(source=SCRIPT))


# The server.


@dataclass(frozen=True)
class Opened:
    """A running viewer."""

    window: Window
    gauges: Gauges
    url: str

    def close(self) -> None:
        """Stop the run, if there is one, and the server."""
        if self.window.watch is not None:
            self.window.watch.stop = True
        self.window.server.stop()


def open_viewer(
    session: Session, address: Address, job: SolveJob | None = None, why_not: str = ""
) -> Opened:
    """Start the server and draw the room.

    Raises:
        InputError: If viser is not installed.
    """
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "mover view needs viser: pip install '.[viewer]' in mover's folder"
        ) from error
    gate = gate_at(address.host)
    with contextlib.redirect_stdout(io.StringIO()), guarded(gate):
        server = viser.ViserServer(
            host=address.host, port=address.port, label=session.shown.title, verbose=False
        )
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="large", control_layout="fixed"
    )
    server.scene.set_up_direction("+y")
    quiet_presses(server)
    window = _window_of(server, session)
    _aim(window, session.shown.result)
    redraw(window)
    redraw_result(window)
    tabs = server.gui.add_tab_group()
    with tabs.add_tab("Room"):
        add_room_panel(window)
    with tabs.add_tab("Object"):
        add_object_panel(window)
    with tabs.add_tab("Solve"):
        gauges = add_solve_panel(window, job, why_not)
    host = socket.gethostname() if server.get_host() == "0.0.0.0" else server.get_host()
    token = f"/?token={gate.token}" if gate.token else ""
    return Opened(window, gauges, f"http://{host}:{server.get_port()}{token}")


def _window_of(server: object, session: Session) -> Window:
    drawing = Drawing(server)
    window = Window(server, session, drawing, People(server), Grips(session, drawing))

    def changed() -> None:
        if not window.watching:
            redraw(window)

    session.on_room.append(changed)
    session.on_select.append(changed)
    return window


def _aim(window: Window, scene: Scene) -> None:
    """Begin behind and above the video's camera, looking at the furniture."""
    centers = [box_of(piece).center for piece in scene.objects] or [torch.tensor([0.0, -1.0, -3.0])]
    middle = torch.stack(centers).mean(0).tolist()
    start = window.server.initial_camera
    start.up = (0.0, 1.0, 0.0)
    start.position = (middle[0] + 1.0, 2.2, 1.8)
    start.look_at = (middle[0], middle[1], middle[2])
    start.fov = math.radians(55)
