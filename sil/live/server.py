"""The live bench's server: one page and what it asks for, to this machine's browser only.

It listens on 127.0.0.1. The address holds a token that the browser returns as a cookie of this site;
a request without it, from another origin or for another host is refused with one line of log.
Requests, messages and connections are bounded.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import os
import secrets
import socket
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
from tornado import httpserver, iostream, web, websocket

from can_dbc.errors import InputError, RunError
from sil.live import bench, runs
from sil.live.bench import Asked

HOST = "127.0.0.1"
MAX_CONNECTIONS = 64

Log = Callable[[str], None]


@dataclass
class Bench:
    """What all handlers share."""

    scenarios: Mapping[str, str]
    """Scenarios that may be run: name on the page, and file or shipped name."""
    folder: Path  # folder of finished runs; nothing else is read
    log: Log
    firmware: str = ""  # of the user's, in place of that of the scenarios
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    port: int = 0
    started: str = field(default_factory=lambda: secrets.token_hex(4))
    """Tells a page that the server is not the one that it began with."""
    pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, "bench"))

    @property
    def origin(self) -> str:
        """The page's own origin."""
        return f"http://{HOST}:{self.port}"

    @property
    def address(self) -> str:
        """What the browser opens."""
        return f"{self.origin}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """Name of the cookie: several benches may run on one machine."""
        return f"opc4_live_{self.port}"

    def admit(self, request: Any, token: str | None) -> None:
        """Refuse a request that is not our own page's. Raises web.HTTPError, after a line of log."""
        why = ""
        if request.headers.get("Host") != f"{HOST}:{self.port}":
            why = "asked for another host"
        elif request.headers.get("Origin") not in (None, self.origin):
            why = f"came from another origin, {request.headers['Origin'][:60]!r}"
        elif not token or not hmac.compare_digest(token.encode(), self.token.encode()):
            why = "has no valid token"
        if why:
            self.log(f"refused: a request that {why}")
            raise web.HTTPError(403)


class _Handler(web.RequestHandler):
    """A request that is refused unless it comes from our own page."""

    def initialize(self, shared: Bench) -> None:
        self.shared = shared

    def set_default_headers(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("X-Frame-Options", "DENY")
        self.set_header(
            "Content-Security-Policy",
            "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
            "img-src 'self' data:; connect-src 'self'",
        )

    def token(self) -> str | None:
        return self.get_cookie(self.shared.cookie)

    def prepare(self) -> None:
        self.shared.admit(self.request, self.token())

    def write_error(self, status_code: int, **_: Any) -> None:
        what = str(status_code)
        if status_code == 404:
            what += f": no {self.request.path[:80]!r}"
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"opc4 live: {what}; open the address that opc4 live printed\n")

    async def answer(self, work: Callable[[], Any]) -> None:
        """Send what `work` returns as JSON; bad input is one line with status 400."""
        self.set_header("Content-Type", "application/json")
        pool = self.shared.pool
        try:
            result = pool.submit(lambda: msgspec.json.encode(work(), enc_hook=float))
            text = await asyncio.wrap_future(result)
        except (InputError, RunError, msgspec.DecodeError) as error:
            self.set_status(400)
            text = msgspec.json.encode({"error": " ".join(str(error).split())})
        self.finish(text)


class _Page(_Handler):
    """The page itself: the only address that takes the token from its query."""

    def token(self) -> str | None:
        return self.get_query_argument("token", None) or super().token()

    def get(self) -> None:
        name, value = self.shared.cookie, self.shared.token
        self.set_cookie(name, value, httponly=True, samesite="Strict", path="/")
        self.finish(page())


class _Api(_Handler):
    """What the page offers, runs and compares."""

    async def get(self, what: str) -> None:
        shared = self.shared
        await self.answer_one_of(what, {
            "vocabulary": lambda: bench.vocabulary(shared.scenarios) | {"started": shared.started},
            "runs": lambda: runs.listed(shared.folder),
        })  # fmt: skip

    async def answer_one_of(self, what: str, works: Mapping[str, Callable[[], Any]]) -> None:
        if what not in works:
            raise web.HTTPError(405)
        await self.answer(works[what])

    async def post(self, what: str) -> None:
        body, scenarios, decode = self.request.body, self.shared.scenarios, msgspec.json.decode
        ours = partial(msgspec.structs.replace, firmware=self.shared.firmware)

        def compare() -> dict[str, Any]:
            before, after = decode(body, type=tuple[Asked, Asked])
            return bench.compare(ours(before), ours(after), scenarios)

        await self.answer_one_of(what, {
            "frames": lambda: bench.frames(ours(decode(body, type=Asked)), scenarios),
            "values": lambda: bench.values_of(ours(decode(body, type=Asked)), scenarios),
            "compare": compare,
            "runs": lambda: runs.compared(self.shared.folder, decode(body, type=list[str])),
        })  # fmt: skip


class _RunPage(_Handler):
    """A page or picture that a command has written."""

    def get(self, name: str, file: str) -> None:
        try:
            path = runs.inside(self.shared.folder, name) / file
        except InputError:
            raise web.HTTPError(404) from None
        kind = {
            "report.html": "text/html; charset=utf-8",
            "shift.png": "image/png",
            "shift.svg": "image/svg+xml",
        }.get(file)
        if kind is None or path.is_symlink() or not path.is_file():
            raise web.HTTPError(404)
        self.set_header("Content-Type", kind)
        self.finish(path.read_bytes())


class _Listener(websocket.WebSocketHandler):
    """The frames of a run on the local bus, which another process has started."""

    def initialize(self, shared: Bench) -> None:
        self.shared = shared
        self.ended = threading.Event()

    def check_origin(self, origin: str) -> bool:
        return origin == self.shared.origin

    def prepare(self) -> None:
        self.shared.admit(self.request, self.get_cookie(self.shared.cookie))

    def on_message(self, message: str | bytes) -> None:
        if self.ended.is_set() or not isinstance(message, str) or not message.isprintable():
            self.close(1003, "expected the name of a local bus, once")
            return
        loop = asyncio.get_running_loop()

        def send(text: str) -> None:
            loop.call_soon_threadsafe(self._send, text)

        threading.Thread(target=_listen, args=(message, self.ended, send), daemon=True).start()

    def _send(self, text: str) -> None:
        if self.ws_connection is not None:
            self.write_message(text)

    def on_close(self) -> None:
        self.ended.set()


def _listen(name: str, ended: threading.Event, send: Callable[[str], object]) -> None:
    """Send the frames of the local bus of that name until the page or the run ends."""
    import can

    frames: list[list[Any]] = []
    start_s: float | None = None
    why = ""
    try:
        with can.Bus(interface="opc4local", channel=name) as bus:
            while not ended.is_set():
                while len(frames) < 500 and (message := bus.recv(0.1)) is not None:
                    if start_s is None:  # simulated time, or after a year the clock of a run
                        start_s = message.timestamp if message.timestamp > 3.15e7 else 0.0
                    frames.append(bench.heard(message, start_s))
                send(json.dumps({"frames": frames}))
                frames = []
    except can.CanError as error:
        why = str(error)
    send(json.dumps({"frames": frames, "end": why}))


class _Server(httpserver.HTTPServer):
    """A server with a bounded number of connections."""

    log: Log = print

    def handle_stream(self, stream: iostream.IOStream, address: tuple[Any, ...]) -> None:
        if len(self._connections) >= MAX_CONNECTIONS:
            self.log(f"refused: connection {MAX_CONNECTIONS + 1}; the limit is {MAX_CONNECTIONS}")
            stream.close()
            return
        super().handle_stream(stream, address)


def application(shared: Bench) -> web.Application:
    """Return the addresses of the bench."""
    handlers = {
        r"/": _Page,
        r"/api/(vocabulary|runs|frames|values|compare)": _Api,
        r"/runs/([^/]+)/([^/]+)": _RunPage,
        r"/bus": _Listener,
    }
    return web.Application(
        [(pattern, handler, {"shared": shared}) for pattern, handler in handlers.items()],
        default_handler_class=_Nothing,
        default_handler_args={"shared": shared},
        websocket_max_message_size=1 << 12,
        log_function=lambda handler: None,
    )


class _Nothing(_Handler):
    """Any other address."""

    def prepare(self) -> None:
        super().prepare()
        raise web.HTTPError(404)


@cache
def page() -> str:
    """Return the page, complete in one file."""
    from sil.report.plots import PlotGroup
    from sil.report.shell import Head, render

    library = [PlotGroup("", "{}", "", True)]  # so that the shell carries uPlot and the themes
    return render("live.html", Head("live", "Live bench"), library)


async def serve(shared: Bench, port: int, ready: Callable[[str], None]) -> None:
    """Serve until cancelled; `ready` is called with the address. Raises InputError for a port in use."""
    try:
        listening = socket.create_server((HOST, port), backlog=MAX_CONNECTIONS)
    except OSError as error:
        why = os.strerror(error.errno or 0)
        raise InputError(f"--port {port}: {why}; expected a free one, or 0") from None
    listening.setblocking(False)
    shared.port = listening.getsockname()[1]
    server = _Server(
        application(shared),
        max_body_size=1 << 20,
        max_buffer_size=1 << 20,
        idle_connection_timeout=60.0,
    )
    server.log = shared.log
    server.add_socket(listening)
    ready(shared.address)
    try:
        await asyncio.Event().wait()
    finally:
        server.stop()
        shared.pool.shutdown(wait=False, cancel_futures=True)
