"""The page and its stream over HTTP, with the standard library: one thread a client.

``GET /`` is the page, ``GET /events`` what happens as server-sent events, ``POST /command`` a
command as JSON. Another site's page cannot send commands: a POST must be JSON (which a browser
asks leave for first, and gets none) and name this server as its origin; on this machine's own
address the request must name this machine as its host.
"""

from __future__ import annotations

import ipaddress
import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from derail_ros.look.board import Board, Refused
from derail_ros.review import web

PORT = 8631
"""Where the page is unless it is asked for elsewhere or something else is there."""
LOCAL = "127.0.0.1"
MOST = 10_000
"""Size of a command, bytes."""
QUIET = 10.0
"""A stream in which nothing happens says so every so often, s."""


def page() -> str:
    """The page of a live run as HTML."""
    template, script, own = (
        web.text("derail_ros.look", f"page.{k}") for k in ("html", "js", "css")
    )
    style = web.text("derail_ros.review", "replay_page.css") + own
    return web.assemble(template, style, web.scene_script(script), connect="'self'")


class Server(ThreadingHTTPServer):
    """A server of a board's page."""

    daemon_threads = True

    def __init__(self, board: Board, host: str, port: int) -> None:
        self.board = board
        self.host = host
        self.page = page().encode("utf-8")
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), Handler)

    @property
    def addresses(self) -> list[str]:
        """Addresses of the page: on this machine, and for others if they may come."""
        port = self.server_address[1]
        if self.local:
            return [f"http://{'[::1]' if ':' in self.host else self.host}:{port}/"]
        others = own_address() if self.host in ("0.0.0.0", "::") else self.host
        return [f"http://{LOCAL}:{port}/", *([f"http://{others}:{port}/"] if others else [])]

    @property
    def local(self) -> bool:
        """Only this machine can reach it."""
        return is_local(self.host)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that has gone is no error."""


def is_local(host: str) -> bool:
    """Whether a host's name or address means this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def own_address() -> str:
    """This machine's address in its network, "" without one. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return str(probe.getsockname()[0])
        except OSError:
            return ""


class Handler(BaseHTTPRequestHandler):
    """One request."""

    server: Server
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """The page, or the stream."""
        if not self._own():
            return
        if self.path == "/":
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
        elif self.path == "/events":
            self._stream()
        else:
            self._answer(HTTPStatus.NOT_FOUND, error="there is no such page")

    def do_POST(self) -> None:
        """A command."""
        if not self._own():
            return
        try:
            length = int(self.headers.get("Content-Length") or "0")
        except ValueError:
            length = -1
        kind = (self.headers.get("Content-Type") or "").partition(";")[0].strip()
        if self.path != "/command" or kind != "application/json" or not 0 < length <= MOST:
            self.close_connection = True
            self._answer(HTTPStatus.BAD_REQUEST, error="a command is JSON, sent to /command")
            return
        try:
            command = json.loads(self.rfile.read(length))
            name = command.pop("command")
            if name not in self.server.board.can:
                raise Refused(f"command must be one of {', '.join(self.server.board.can)}")
            said = self.server.board.act(name, command)
        except Refused as error:
            self._answer(HTTPStatus.CONFLICT, error=str(error))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            self._answer(HTTPStatus.BAD_REQUEST, error=f"not a command: {error}")
        else:
            self._answer(HTTPStatus.OK, said=said)

    def _own(self) -> bool:
        """Whether a request comes from this server's own page; answers those that do not."""
        host = self.headers.get("Host") or ""
        origin = self.headers.get("Origin")
        name = host.rpartition(":")[0] if not host.endswith("]") else host
        if (self.server.local and not is_local(name or host)) or (
            origin is not None and origin != f"http://{host}"
        ):
            self.close_connection = True
            self._answer(HTTPStatus.FORBIDDEN, error="this page answers its own requests only")
            return False
        return True

    def _stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Connection", "close")
        self.end_headers()
        self.close_connection = True
        reader = self.server.board.reader()
        while (new := reader.next(QUIET)) is not None:
            lines = [f"event: {kind}\ndata: {_json(what)}\n\n" for kind, what in new]
            self.wfile.write(("".join(lines) or ": still here\n\n").encode("utf-8"))
        self.wfile.write(b"event: closed\ndata: {}\n\n")

    def _answer(self, status: HTTPStatus, **what: str) -> None:
        self._send(status, "application/json", _json(what).encode("utf-8"))

    def _send(self, status: HTTPStatus, kind: str, data: bytes) -> None:
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(data))),
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""


def _json(what: dict[str, Any]) -> str:
    return json.dumps(what, allow_nan=False, ensure_ascii=False, separators=(",", ":"))


@contextmanager
def serving(board: Board, host: str = LOCAL, port: int | None = None) -> Iterator[Server]:
    """Serve a board's page; without ``port`` at `PORT`, or at a free one if that is taken.

    Raises
    ------
    OSError
        There is no such host, or the port is taken.
    """
    try:
        server = Server(board, host, PORT if port is None else port)
    except OSError:
        if port is not None:
            raise
        server = Server(board, host, 0)
    thread = threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        board.close()
        server.shutdown()
        server.server_close()
