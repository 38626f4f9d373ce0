"""Presses on draggable objects say nothing in the browser's console.

viser asks the browser to prevent what a press on a draggable object would do otherwise, from a
listener that was registered as passive. There the request does nothing, and Chromium writes an
error about it. The script below takes the request off such presses: what they do stays the same.
"""

from typing import Any

SCRIPT = """
addEventListener("pointerdown", (press) => {
  if (press.target instanceof HTMLCanvasElement)
    Object.defineProperty(press, "preventDefault", {value: () => {}});
}, true);
"""


def quiet_presses(server: Any) -> None:  # noqa: ANN401
    """Let every browser that connects run the script; a viser without such messages stays as it is.

    Args:
        server: The viser server.
    """
    from viser import _messages  # pyright: ignore[reportMissingImports]

    message = getattr(_messages, "RunJavascriptMessage", None)
    interface = getattr(server.gui, "_websock_interface", None)
    if message is not None and interface is not None:
        interface.queue_message(message(source=SCRIPT))
