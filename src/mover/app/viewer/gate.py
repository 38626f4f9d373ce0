"""Only pages of the viewer itself may talk to it.

A web page that is open in the same browser may send requests to this machine, under any name that
its owner's DNS gives it (`Host`), and open WebSockets (`Origin`). Both are checked before viser
gets a request.
"""

import contextlib
from collections.abc import Generator, Mapping
from typing import Any
from urllib.parse import urlsplit

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
