"""No web page that is open beside the viewer may drive it."""

import asyncio
import http.client
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from threading import Event, Thread

import pytest

from mover.app.viewer.show import guarded

websockets = pytest.importorskip("websockets")
UPGRADE = {
    "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip


@contextmanager
def served() -> Iterator[int]:
    """A server as viser starts it: pages over HTTP, WebSockets for what moves."""
    from websockets.asyncio import server

    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    ready, loop = Event(), asyncio.new_event_loop()
    done = asyncio.Event()

    def page(connection, request):
        is_socket = request.headers.get("Upgrade") == "websocket"
        return None if is_socket else connection.respond(HTTPStatus.OK, "the page")

    async def echo(connection):
        await connection.send("hello")

    async def work():
        async with server.serve(echo, "127.0.0.1", port, process_request=page):
            ready.set()
            await done.wait()

    with guarded():
        thread = Thread(target=lambda: loop.run_until_complete(work()))
        thread.start()
        assert ready.wait(10)
    yield port
    loop.call_soon_threadsafe(done.set)
    thread.join()
    loop.close()


def ask(port: int, **headers: str) -> tuple[int, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", "/", skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders())
    connection.close()
    return found


def test_pages_of_this_machine_come_in_and_others_do_not():
    with served() as port:
        assert ask(port)[0] == 200
        assert ask(port, Host=f"localhost:{port}")[0] == 200
        for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", "", "[::2]"):
            assert ask(port, Host=host)[0] in (400, 403), host


def test_a_websocket_of_a_foreign_page_is_refused():
    with served() as port:
        own = f"http://127.0.0.1:{port}"
        assert ask(port, **UPGRADE)[0] == 101  # a program, not a browser
        assert ask(port, **UPGRADE, Origin=own)[0] == 101
        for origin in ("https://evil.example", "null", f"http://127.0.0.1:{port + 1}", "file://"):
            assert ask(port, **UPGRADE, Origin=origin)[0] == 403, origin


def test_servers_after_the_block_are_as_they_were():
    from websockets.asyncio import server

    before = server.serve
    with guarded():
        assert server.serve is not before
    assert server.serve is before
