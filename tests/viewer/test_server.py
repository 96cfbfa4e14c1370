"""Whom the viewer's server lets in, where it listens, and what it says where it cannot."""

from __future__ import annotations

import importlib.util
import socket
import struct
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.support.tiny_scenes import ring
from warpnerf.checks import InputError
from warpnerf.viewer.server import address, close_server, may_enter, open_server

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from page_client import PageClient, connection

NAMES = {"localhost", "box.lan"}


@pytest.fixture
def server() -> Iterator[Any]:
    server = open_server("127.0.0.1", 0)
    yield server
    close_server(server)


@pytest.mark.parametrize(
    ("host", "origin", "welcome"),
    [
        ("127.0.0.1:8080", None, True),
        ("localhost:8080", "http://localhost:8080", True),
        ("LOCALHOST:8080", "http://localhost:8080", True),
        ("[::1]:8080", "http://[::1]:8080", True),
        ("192.168.1.7:8080", "http://192.168.1.7:8080", True),
        ("box.lan", "https://box.lan", True),
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "http://127.0.0.1:9999", False),
        ("127.0.0.1:8080", "http://localhost:8080", False),
        ("127.0.0.1:8080", "null", False),
        ("127.0.0.1:8080", "file://", False),
        ("evil.example:8080", "http://evil.example:8080", False),  # pointed at this machine
        ("evil.example:8080", None, False),
        ("localhost.evil.example", None, False),
        ("", None, False),
        ("[:8080", None, False),
    ],
)
def test_who_may_enter(host: str, origin: str | None, welcome: bool) -> None:
    headers = Headers([("Host", host)] + ([("Origin", origin)] if origin else []))
    assert may_enter(headers, NAMES) is welcome


def test_a_request_names_one_host() -> None:
    assert not may_enter(Headers(), NAMES)
    assert not may_enter(Headers([("Host", "localhost"), ("Host", "localhost")]), NAMES)
    twice = [("Host", "localhost"), ("Origin", "http://localhost"), ("Origin", "http://localhost")]
    assert not may_enter(Headers(twice), NAMES)


def test_the_page_is_served_to_those_who_ask_by_name(server: Any) -> None:
    page = address(server)
    with urllib.request.urlopen(page, timeout=120) as answer:
        assert answer.status == 200 and b"<html" in answer.read(1000)
    request = urllib.request.Request(page, headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request, timeout=120)
    assert refused.value.code == 403


@pytest.mark.parametrize("origin", ["http://evil.example", "http://[", "null"])
def test_a_foreign_page_gets_no_connection(server: Any, origin: Any) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connection(server.get_port(), origin=origin)
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    "garbage",
    [
        b"",
        b"\xff\x00\x01",
        "text",
        msgspec.msgpack.encode({"type": "NoSuchMessage"}),
        msgspec.msgpack.encode({"type": "ViewerCameraMessage", "fov": "wide"}),
        msgspec.msgpack.encode([1, 2, 3]),
        b"\x00" * (2 << 20),
    ],
    ids=["empty", "bytes", "text", "type", "field", "list", "large"],
)
def test_garbage_ends_that_connection_only(
    server: Any, garbage: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    with connection(server.get_port()) as other:
        other.send(garbage)
        with pytest.raises(ConnectionClosed):
            while True:
                other.recv(timeout=120)
    with PageClient(server.get_port()) as page:
        page.wait(lambda page: page.messages)
    assert "Traceback" not in capfd.readouterr().err


UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
)
PAGE = b"Sec-WebSocket-Protocol: viser-v1.1.1\r\n\r\n"


def test_a_port_scan_is_not_mentioned(server: Any, capfd: pytest.CaptureFixture[str]) -> None:
    """Whatever it sends, and however it leaves; pages are served as before."""
    said = [
        b"",
        b"\x16\x03\x01\x02\x00\x01\x00",
        b"\xff" * 3000,
        b"GET / HTTP/1.0\r\n\r\n",
        b"OPTIONS * RTSP/1.0\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET /%00 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: \xff\xfe\r\n\r\n",
        UPGRADE[:60],
        UPGRADE + b"\r\n",
        UPGRADE + b"Sec-WebSocket-Protocol: chat\r\n\r\n",
        UPGRADE + PAGE,
        UPGRADE + PAGE + b"\x82\x05hello",
    ]
    reset = struct.pack("ii", 1, 0)  # leave without a farewell
    for data in said:
        for seconds in (0.0, 0.1):
            for abruptly in (False, True):
                with socket.create_connection(("127.0.0.1", server.get_port())) as scanner:
                    scanner.sendall(data)
                    time.sleep(seconds)
                    if abruptly:
                        scanner.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
    with PageClient(server.get_port()) as page:
        page.wait(lambda page: page.messages)
    time.sleep(0.2)
    assert capfd.readouterr() == ("", "")


def test_no_page_can_have_the_world_served(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import viser._viser

    tunnels: list[Any] = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *arguments: tunnels.append(arguments))
    with PageClient(server.get_port()) as page:
        page.say({"type": "ShareUrlRequest"})
        page.look_from(ring(3)[0][:3])
        page.wait(lambda page: page.messages)
        page.wait(lambda page: server.get_clients())  # so that the first message was read, too
    close_server(server)  # and all threads have ended
    assert not tunnels


def test_it_says_nothing_by_itself(capfd: pytest.CaptureFixture[str]) -> None:
    close_server(open_server("127.0.0.1", 0))
    assert capfd.readouterr().out == ""


def test_a_named_port_must_be_free() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=rf"--port {port} .* in use"):
            open_server("127.0.0.1", port)


def test_without_a_port_the_next_free_one_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr("warpnerf.viewer.server.PORT", port)
        server = open_server("127.0.0.1", None)
        assert server.get_port() > port
        close_server(server)


@pytest.mark.parametrize(
    ("host", "port", "says"),
    [
        ("127.0.0.1", 70_000, "--port 70000"),
        ("127.0.0.1", -1, "--port -1"),
        ("203.0.113.7", 0, "--host 203.0.113.7"),
        ("no.such.host.invalid", 0, "--host no.such.host.invalid"),
        ("a" * 400, 0, "--host a"),
    ],
)
def test_where_one_cannot_listen_is_refused(host: str, port: int, says: str) -> None:
    with pytest.raises(InputError, match=says):
        open_server(host, port)


def test_viser_missing_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r'^the viewer needs viser: pip install "warp.*\[viewer\]"'
    ):
        open_server("127.0.0.1", 0)


def test_a_viser_that_cannot_be_guarded_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its next version may open its port in another way; then nobody is let in."""
    import viser

    class Other:
        def stop(self) -> None:
            pass

    monkeypatch.setattr(viser, "ViserServer", lambda **options: Other())
    with pytest.raises(InputError, match="whom to let in"):
        open_server("127.0.0.1", 0)
    assert "websockets.asyncio.server" in sys.modules
