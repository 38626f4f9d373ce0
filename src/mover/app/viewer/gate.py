"""Who may talk to the viewer: pages of its own address; from the network, who has its token.

A web page that is open in the same browser may send requests to this machine, under any name that
its owner's DNS gives it (`Host`), and open WebSockets (`Origin`). Both are looked at before viser
sees a request. Where the viewer is opened to the network, its URL has a token, which the first
request turns into a cookie.
"""

import contextlib
import hmac
import secrets
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

LOOPBACK = ("127.0.0.1", "localhost", "::1")
COOKIE = "mover_view"


@dataclass(frozen=True)
class Gate:
    """What a request must have."""

    hosts: tuple[str, ...]
    """Names by which it may call the viewer; empty: any, as the token decides."""
    token: str = ""
    """Empty: none is asked for."""

    def refusal(self, path: str, headers: Mapping[str, str]) -> str:
        """Why a request is refused; empty: it is let in."""
        host = headers.get("Host") or ""
        name = urlsplit(f"//{host}").hostname or ""
        if self.hosts and name not in self.hosts:
            return f"the viewer is not at {name!r}, but at {self.hosts[0]}"
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return f"a page of {origin} may not use the viewer"
        if self.token and not (self.shown_in(path) or self._kept_in(headers)):
            return "the viewer's URL has a token; open it as it was printed"
        return ""

    def shown_in(self, path: str) -> bool:
        """Whether the path of a request has the token."""
        shown = parse_qs(urlsplit(path).query).get("token", [""])[0]
        return bool(self.token) and _same(shown, self.token)

    def cookie(self) -> str:
        """The header that makes a browser keep the token."""
        return f"{COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _kept_in(self, headers: Mapping[str, str]) -> bool:
        try:
            kept = SimpleCookie(headers.get("Cookie") or "").get(COOKIE)
        except CookieError:
            return False
        return kept is not None and _same(kept.value, self.token)


def gate_at(host: str) -> Gate:
    """The gate of a viewer that listens at an address."""
    if host in LOOPBACK:
        return Gate((host, *LOOPBACK))
    return Gate((), secrets.token_urlsafe(16))


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(), b.encode())


@contextlib.contextmanager
def guarded(gate: Gate) -> Generator[None, None, None]:
    """Servers of `websockets` that are started in the block have the gate before them.

    viser starts one from its constructor and passes nothing through to it, so that the function
    that starts it is another one meanwhile.
    """
    from websockets.asyncio import server  # pyright: ignore[reportMissingImports]

    serve: Any = server.serve

    def behind_gate(*args: Any, process_request: Any = None, **options: Any) -> Any:  # noqa: ANN401
        return serve(*args, process_request=_before(gate, process_request), **options)

    setattr(server, "serve", behind_gate)  # noqa: B010
    try:
        yield
    finally:
        setattr(server, "serve", serve)  # noqa: B010


def _before(gate: Gate, then: Callable[[Any, Any], Any] | None) -> Callable[[Any, Any], Any]:
    """A handler of requests that asks the gate first."""

    def handle(connection: Any, request: Any) -> Any:  # noqa: ANN401
        if reason := gate.refusal(request.path, request.headers):
            return connection.respond(403, f"{reason}\n")
        answer = None if then is None else then(connection, request)
        if answer is not None and gate.shown_in(request.path):
            answer.headers["Set-Cookie"] = gate.cookie()
        return answer

    return handle
