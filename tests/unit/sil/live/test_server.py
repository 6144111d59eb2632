"""The server answers its own page only: everything else is refused, bounded and one line of log."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from can_dbc.errors import InputError
from sil.firmware.compiler import compiled
from sil.live.server import HOST, MAX_CONNECTIONS, Bench, serve
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load, shipped
from tests.conftest import ROOT, Run, run_opc4


class Served:
    """A bench that is served from a thread of its own."""

    def __init__(self, folder: Path) -> None:
        self.lines: list[str] = []
        self.bench = Bench({name: name for name in shipped()}, folder, self.lines.append)
        ready = threading.Event()

        async def until_stopped() -> None:
            self.loop = asyncio.get_running_loop()
            self.task = asyncio.ensure_future(serve(self.bench, 0, lambda address: ready.set()))
            with contextlib.suppress(asyncio.CancelledError):
                await self.task

        self.thread = threading.Thread(target=lambda: asyncio.run(until_stopped()), daemon=True)
        self.thread.start()
        assert ready.wait(30.0)

    def stop(self) -> None:
        self.loop.call_soon_threadsafe(self.task.cancel)
        self.thread.join(30.0)

    def ask(
        self, method: str, path: str, body: Any = None, **headers: str | None
    ) -> tuple[int, str, dict[str, str]]:
        """Return status, text and headers; a header given as None is left out."""
        given = {
            "Host": f"{HOST}:{self.bench.port}",
            "Cookie": f"{self.bench.cookie}={self.bench.token}",
            **{name.title(): value for name, value in headers.items()},
        }
        connection = http.client.HTTPConnection(HOST, self.bench.port, timeout=60.0)
        text = body if isinstance(body, bytes | type(None)) else json.dumps(body).encode()
        try:
            connection.request(method, path, text, {k: v for k, v in given.items() if v})
            answer = connection.getresponse()
            return answer.status, answer.read().decode(), dict(answer.headers)
        finally:
            connection.close()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("runs")
    (folder / "done").mkdir()
    (folder / "done" / "diagnosis.json").write_text('{"verdict": "named"}', encoding="utf-8")
    (folder / "done" / "report.html").write_text("<p>page</p>", encoding="utf-8")
    (folder / "done" / "secret.txt").write_text("what is read", encoding="utf-8")
    (folder.parent / "outside.txt").write_text("what is read", encoding="utf-8")
    bench = Served(folder)
    yield bench
    bench.stop()


def test_the_page_and_what_it_asks_for(served: Served) -> None:
    token = served.bench.token
    status, text, headers = served.ask("GET", f"/?token={token}", cookie=None)
    assert status == 200 and "<title>Live bench" in text and token not in text
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert json.loads(served.ask("GET", "/api/vocabulary")[1])["scenarios"]
    assert json.loads(served.ask("GET", "/api/runs")[1])[0]["state"] == "named"
    status, text, _ = served.ask("POST", "/api/frames", {"scenario": "lab_n_b"})
    assert status == 200 and len(json.loads(text)["frames"]) > 300
    status, text, headers = served.ask("GET", "/runs/done/report.html")
    assert (status, text) == (200, "<p>page</p>")


@pytest.mark.parametrize("suffix", ["py", "c", "wasm"])
def test_a_firmware_of_the_user_runs_every_scenario(
    served: Served, suffix: str, tmp_path: Path
) -> None:
    drafts, path = ROOT / "sil" / "cli" / "drafts", tmp_path / f"own.{suffix}"
    if suffix == "py":
        text = (drafts / "firmware.py").read_text()
        path.write_text(text.replace("MAX_DUTY = 1.0", "MAX_DUTY = 0.9"))
    else:
        pytest.importorskip("ziglang", reason="extra c")
        source = drafts / "firmware.c"
        path.write_bytes(source.read_bytes() if suffix == "c" else compiled(source))
    served.bench.firmware = str(path)
    status, text, _ = served.ask("POST", "/api/compare", [{"scenario": "lab_n_b"}] * 2)
    refused = served.ask("POST", "/api/frames", {"scenario": "lab_n_b", "firmware": "/etc/x.py"})
    served.bench.firmware = ""
    own = run_in_memory(load("lab_n_b", settings={"firmware": str(path)}))
    shown = json.loads(text)
    assert status == 200 and refused[0] == 200  # what the page names is not taken
    assert shown["command"] == f"opc4 run lab_n_b --firmware {path}"
    assert shown["trace_sha256"] == own.trace_sha256 != run_in_memory(load("lab_n_b")).trace_sha256


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({"cookie": None}, "has no valid token"),
        ({"cookie": "opc4_live_1=abc"}, "has no valid token"),
        ({"origin": "http://example.org"}, "came from another origin, 'http://example.org'"),
        ({"origin": "null"}, "came from another origin"),
        ({"host": "example.org"}, "asked for another host"),
    ],
)
@pytest.mark.parametrize("path", ["/", "/api/runs", "/runs/done/report.html", "/bus", "/none"])
def test_others_are_refused_with_one_line_of_log(
    served: Served, path: str, headers: dict[str, str | None], why: str
) -> None:
    before = len(served.lines)
    status, text, _ = served.ask("GET", path, **headers)
    assert status == 403 and "page" not in text.split("open")[0]
    assert len(served.lines) == before + 1 and why in served.lines[-1]
    assert "\n" not in served.lines[-1]


@pytest.mark.parametrize(
    ("path", "body", "line"),
    [
        ("/api/frames", b"{", "truncated"),
        ("/api/frames", b"\xff\xfe", "JSON is malformed"),
        ("/api/frames", [1], "Expected `object`, got `array`"),
        ("/api/frames", {"scenario": "lab_n_b", "path": "/etc"}, "unknown field `path`"),
        ("/api/frames", {"scenario": 3}, "Expected `str`, got `int`"),
        ("/api/compare", {"scenario": "lab_n_b"}, "Expected `array`"),
        ("/api/runs", ["../outside.txt"], "no output '../outside.txt'"),
        ("/api/runs", ["done"], "has no trace.csv"),
    ],
)
def test_malformed_messages_are_one_line(served: Served, path: str, body: Any, line: str) -> None:
    status, text, _ = served.ask("POST", path, body)
    assert status == 400 and line in json.loads(text)["error"]
    assert "\n" not in json.loads(text)["error"]


@pytest.mark.parametrize(
    "path",
    ["/runs/done/secret.txt", "/runs/..%2Foutside.txt/report.html", "/runs/../outside.txt",
     "/runs/done/..%2F..%2Foutside.txt", "/etc/passwd", "/live.js", "/runs/%00/report.html"],
)  # fmt: skip
def test_nothing_else_is_read(served: Served, path: str) -> None:
    status, text, _ = served.ask("GET", path)
    assert status in (400, 404) and "what is read" not in text
    assert text.count("\n") == 1 and (status == 400 or text.startswith("opc4 live: 404: no '/"))


def test_a_huge_request_is_refused(served: Served) -> None:
    try:
        status, _, _ = served.ask("POST", "/api/frames", b" " * (2 << 20))
    except (ConnectionError, http.client.HTTPException):
        status = 400  # closed before all of it was sent
    assert status in (400, 413)
    assert served.ask("GET", "/api/vocabulary")[0] == 200


def test_a_thousand_connections_are_bounded(served: Served) -> None:
    connections, before = [], len(served.lines)
    try:
        for _ in range(1000):
            one = socket.create_connection((HOST, served.bench.port), timeout=120.0)
            connections.append(one)
        for one in connections[MAX_CONNECTIONS + 8 :]:
            assert one.recv(1) == b""  # closed by the server
        assert any("the limit is" in line for line in served.lines[before:])
    finally:
        for one in connections:
            one.close()
    assert served.ask("GET", "/api/vocabulary")[0] == 200


def test_a_port_in_use_is_one_line(served: Served) -> None:
    with pytest.raises(
        InputError, match=f"--port {served.bench.port}: Address already in use; expected"
    ):
        asyncio.run(serve(Bench({}, Path(), print), served.bench.port, print))


def test_bad_arguments_are_refused(opc4: Run, tmp_path: Path) -> None:
    for arguments, line in (
        (["--port", "99999"], "--port 99999: expected 0 to 65535"),
        (["--runs", "missing"], "missing: --runs: no such folder"),
        (["none.toml"], "none.toml: file: not found"),
        (["--firmware", "none.c"], "none.c: no such file; expected FILE.c or FILE.wasm"),
    ):
        done = run_opc4(tmp_path, "live", "--no-browser", *arguments)
        assert done.returncode == 2 and line in done.stderr and done.stderr.count("\n") == 1
