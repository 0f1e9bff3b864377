# SPDX-License-Identifier: BSD-3-Clause
"""Hostile requests: none passes or crashes the viewer; memory is bounded, others are served."""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

import ltcl
from ltcl.viewer import client, messages, server
from tests.viewer.page import Page, question

pytestmark = pytest.mark.slow

GROWTH = 64 << 20  # bytes of memory that a suite of hostile requests may cost
KEY = (
    "Upgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {}==\r\n"
)
UPGRADE = KEY.format("dGhlIHNhbXBsZSBub25jZQ")


class Running:
    """`ltcl view` in a process of its own."""

    def __init__(self, process: subprocess.Popen, url: str) -> None:
        self.process = process
        self.url = url
        _, _, self.host, self.token, _ = url.split("/")
        self.port = int(self.host.split(":")[1])

    def memory(self) -> int:
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * 4096

    def raw(self, data: bytes) -> bytes:
        """Send bytes, and return the answer of the viewer."""
        received = b""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=20)
        with connection, contextlib.suppress(OSError):  # it may be closed before all is sent
            connection.sendall(data)
            connection.settimeout(2)
            while b"\r\n\r\n" not in received and (part := connection.recv(1 << 16)):
                received += part
        return received

    def request(
        self, path: str, host: str | None = None, more: str = "", method: str = "GET"
    ) -> bytes:
        lines = (
            f"{method} {path} HTTP/1.1\r\nHost: {self.host if host is None else host}\r\n{more}\r\n"
        )
        return self.raw(lines.encode("latin-1"))


@pytest.fixture(scope="module")
def running(tmp_path_factory, device) -> Iterator[Running]:
    file = tmp_path_factory.mktemp("view") / "T.npz"
    ltcl.save(file, ltcl.scenes.dihedral(4, albedo=0.5).transport())
    words = [sys.executable, "-m", "ltcl", "view", str(file), "--no-browser"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        yield Running(process, process.stderr.readline().split()[0])
        process.terminate()


@pytest.fixture(autouse=True)
def unharmed(request) -> Iterator[None]:
    """After each test the viewer lives, has not grown, and answers."""
    if "running" not in request.fixturenames:
        yield
        return
    running = request.getfixturevalue("running")
    with Page(running.url) as page:
        page.ask("column", pixel=[0, 0])
        page.ask("compensate", picture=1)
    before = running.memory()
    yield
    assert running.process.poll() is None
    with Page(running.url) as page:
        assert "picture" in page.ask("column", pixel=[0, 0])
    assert running.memory() - before < GROWTH


def status(response: bytes) -> int:
    return int(response.split()[1]) if response.startswith(b"HTTP/1.1 ") else 0


def test_ways_out_of_the_table_of_files(running):
    ups = [
        "..",
        "%2e%2e",
        "%2E.",
        "..%2f",
        "%252e%252e",
        "..%5c",
        "..\\",
        "%c0%ae%c0%ae",
        "%uff0e%uff0e",
        "....//",
    ]
    ends = ["etc/passwd", "server.py", "page/index.html", "T.npz"]
    paths = [f"{up}/{up}/{end}" for up, end in itertools.product(ups, ends)]
    paths += [
        "/",
        "//",
        "index.html/",
        "/index.html",
        "index.html%00",
        "index.html%00.js",
        "INDEX.HTML",
        "page/",
    ]
    paths += [
        "index.html~",
        ".index.html.swp",
        "index.html::$DATA",
        "CON",
        "~root",
        "file:///etc/passwd",
        "%",
        "*",
    ]
    paths += [
        "result/",
        "result/../T.npz",
        "result/x.exr",
        "result/report.json/..",
        "result/%2e%2e/T.npz",
    ]
    paths += [
        "a" * 5000,
        "%00",
        "%0d%0aSet-Cookie:%20a=b",
        "?/../../etc/passwd&",
        "socket",
        "picture",
        "projector/",
    ]
    good = [f"/{running.token}/{path}" for path in paths if not path.startswith("?")]
    for path in good:
        response = running.request(path)
        assert status(response) in (400, 404), (path, response)
        assert b"root:" not in response
    for path in [*paths, "", "index.html"]:
        response = running.request(f"/{path.lstrip('/')}")
        assert status(response) in (400, 403), (path, response)


@pytest.mark.slow
def test_wrong_tokens_hosts_and_origins(running):
    token = running.token
    own = running.host
    wrong = [
        "",
        "x",
        token[:-1],
        token + "x",
        token.swapcase(),
        token[::-1],
        "%00" + token,
        token + "%00",
        token + "%20",
    ]
    wrong += ["%2f" + token, f".%2f{token}", f"x/../{token}", "ü", "%ff"]
    wrong = [f"/{each}/" for each in wrong] + [f"//{token}/", f"/?/{token}/", f"http://{own}/"]
    names = [
        "",
        "evil.example",
        "127.0.0.1",
        f"evil.example:{running.port}",
        "127.0.0.1:1",
        f"127.0.0.1.evil:{running.port}",
    ]
    names += [
        f"{own}.",
        f"evil@{own}",
        f"{own}, evil",
        f"[::ffff:127.0.0.1]:{running.port}",
        f"0.0.0.0:{running.port}",
    ]
    names += [
        f"127.0.0.2:{running.port}",
        f"2130706433:{running.port}",
        f"localhost.evil:{running.port}",
    ]
    origins = [
        "null",
        "",
        "http://evil.example",
        f"https://{own}",
        "http://127.0.0.1:1",
        f"http://{own}.evil",
        f"http://{own}/",
    ]
    origins += [f"http://localhost:{running.port}", f"{own}", f"http://{own} http://evil"]
    cases = [(path, own, f"http://{own}") for path in wrong] + [
        (f"/{token}/", name, f"http://{name}") for name in names
    ]
    cases += [(f"/{token}/", own, origin) for origin in origins]
    for path, name, origin in cases:
        for end, method, more in (
            ("", "GET", ""),
            ("picture", "POST", "Content-Length: 0\r\n"),
            ("socket", "GET", UPGRADE),
        ):
            response = running.request(path + end, name, f"Origin: {origin}\r\n{more}", method)
            assert status(response) in (400, 403), (path, name, origin, end, response)
            assert token.encode() not in response
    for end, method, more in (
        ("picture", "POST", "Content-Length: 0\r\n"),
        ("socket", "GET", UPGRADE),
    ):
        # Without an origin.
        assert status(running.request(f"/{token}/{end}", more=more, method=method)) == 403
    two = f"Host: {own}\r\nOrigin: http://{own}\r\n"
    assert status(running.request(f"/{token}/", "evil.example", two)) == 400


@pytest.mark.slow
def test_wrong_methods_and_what_is_no_request(running):
    page = f"/{running.token}/"
    origin = f"Origin: http://{running.host}\r\nContent-Length: 0\r\n"
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "PROPFIND", "get"):
        for path in (page, page + "index.html", page + "result/report.json"):
            assert status(running.request(path, more=origin, method=method)) in (400, 404), method
    for method in ("GET", "PUT", "DELETE", "HEAD"):
        assert status(running.request(page + "picture", more=origin, method=method)) in (
            400,
            404,
        ), method
    line = f"GET {page} HTTP/1.1\r\n".encode()
    garbage = [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"\0" * 1000,
    ]
    garbage += [
        b"\r\n" * 1000,
        line,
        line + b"Host\r\n\r\n",
        line + b"\r\n",
        b"GET\r\n\r\n",
        line + b"A" * 200_000,
    ]
    garbage += [b"GET " + b"/a" * 100_000]
    garbage += [
        line + b"Host: a\r\n" + b"X: y\r\n" * 50_000 + b"\r\n",
        line.replace(b"/", b"\xff", 1) + b"\r\n",
    ]
    for data in garbage:
        assert status(running.raw(data)) != 200, data[:60]


def png(w: int, h: int) -> bytes:
    """A PNG of a few bytes that says it has w x h pixels."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    header = struct.pack(">IIBBBBB", w, h, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(1000))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    )


def test_uploads(running):
    bmp = b"BM" + struct.pack(
        "<IHHIIiiHHIIiiII", 200, 0, 0, 54, 40, 60_000, 60_000, 1, 24, 0, 0, 0, 0, 0, 0
    )
    files = {
        "a.png": png(100_000, 100_000),
        "b.png": png(8001, 8000),
        "c.png": png(0, 5),
        "d.bmp": bmp,
        "e.png": png(64, 64),
    }
    files |= {
        "f.exr": b"\x76\x2f\x31\x01" + bytes(300),
        "g.tif": b"II*\0\xff\xff\xff\xff",
        "h.jpg": b"\xff\xd8\xff\xe0" + bytes(99),
    }
    names: list[Any] = [
        None,
        5,
        ["a.png"],
        "",
        "a",
        "a.exe",
        "a.svg",
        "a.png\0.exe",
        "..",
        "../../a",
        "a.npz",
        "a.html",
        "a.py",
        "/etc/passwd",
        "a" * 400 + ".png",
    ]
    contents = [*files.items(), *((name, png(1, 1)) for name in names)]
    with Page(running.url) as page:
        for name, content in contents:
            answer = page.upload(name, content)
            assert [*answer] == ["error"], (name, answer)
            assert " object at " not in answer["error"]
        picture = page.ask("upload", {"content": np.zeros((1, 9, 1), np.uint8)}, name="a.png")
        assert "content is" in picture["error"]
        assert "content" in page.ask("upload", name="a.png")["error"]
    with Page(running.url) as page, pytest.raises(ConnectionClosed):
        page.upload("a.png", bytes(messages.LARGEST_FILE + messages.LARGEST_HEADER))


def frames() -> list[str | bytes]:
    """Messages of which none is a question."""
    texts: list[str | bytes] = [
        "",
        "{",
        "null",
        "[]",
        "1",
        '"do"',
        "{}",
        "\0",
        "[" * 3000,
        '{"a":' * 600,
        "\ud7ff" * 500,
        "x" * 5000,
    ]
    headers = [
        {"do": "column"},
        {"id": 1},
        {"id": 1, "do": 1},
        {"id": 1, "do": None},
        {"id": 1, "do": ["column"]},
    ]
    headers += [
        {"id": 1, "do": name}
        for name in ("", "hello", "upload", "add", "result", "__init__", "_picture", "T", "codes")
    ]
    headers += [
        {"id": bad, "do": "pictures"}
        for bad in (None, "1", [1], {}, True, float("nan"), float("inf"), 10**400)
    ]
    texts += [json.dumps(header) for header in headers]
    whole = question({"id": 1, "do": "relight"}, {"pattern": np.zeros((4, 8, 1), np.uint8)})
    assert isinstance(whole, bytes)
    texts += [
        whole[:-1],
        whole + b"\0",
        whole[4:],
        whole[:3],
        b"\xff\xff\xff\xff" + whole[4:],
        b"\0\0\0\0",
        b"",
        bytes(5000),
    ]
    entry = {"name": "pattern", "shape": [4, 8, 1], "dtype": "u1"}
    wrong = [
        {"shape": shape}
        for shape in (
            [4, 8],
            [4, 8, 1, 1],
            [-4, -8, 1],
            [4, 8, 1e0],
            [1 << 30, 8, 1],
            "481",
            None,
            [4, 8, 2],
        )
    ]
    wrong += [{"dtype": dtype} for dtype in ("f8", "O", "<f2", "u2", "", None, ["u1"], "i1")] + [
        {"name": [1]}
    ]
    wrong += [
        {"dtype": dtype, "shape": [32 // size // 8, 8, 1]} for dtype, size in (("f2", 2), ("f4", 4))
    ]
    for change in wrong:
        text = json.dumps({"id": 1, "do": "relight", "arrays": [entry | change]}).encode()
        text += b" " * (-len(text) % 4)
        texts.append(len(text).to_bytes(4, "little") + text + bytes(32))
    for arrays in ("no list", 5, [entry, entry], [5], [{}], {"a": entry}):
        text = json.dumps({"id": 1, "do": "relight", "arrays": arrays}).encode()
        text += b" " * (-len(text) % 4)
        texts.append(len(text).to_bytes(4, "little") + text + bytes(32))
    bad = np.array([np.nan, np.inf], np.float16).reshape(1, 2, 1).repeat(4, 0).repeat(4, 1)
    return [*texts, question({"id": 1, "do": "relight"}, {"pattern": bad}), bytes(1 << 17)]


@pytest.mark.slow
def test_frames(running):
    passed = 0
    for frame in frames():
        with Page(running.url) as page:
            page.socket.send(frame)
            with contextlib.suppress(ConnectionClosed):
                passed += "error" not in page.next()
    assert passed == 0
    for data in (
        b"\x82\xff" + b"\xff" * 8,
        b"\xc1\x80\0\0\0\0",
        b"\x85\x80\0\0\0\0",
        b"\x81\x05hello",
        b"\x89\xfe\xff\xff",
    ):
        with Page(running.url) as page:
            # A frame of 2^63 bytes, reserved bits, an unknown kind, no mask, a long ping.
            page.socket.socket.sendall(data)
            with pytest.raises((ConnectionClosed, TimeoutError)):
                page.socket.recv(timeout=2)


def test_a_thousand_connections_that_say_nothing(running):
    with contextlib.ExitStack() as opened:
        for number in range(1000):
            place = ("127.0.0.1", running.port)
            connection = opened.enter_context(socket.create_connection(place, timeout=20))
            if number % 2:
                with contextlib.suppress(OSError):  # closed for a newer one
                    connection.sendall(b"GET / HTTP/1.1\r\nHost: ")
        start = time.monotonic()
        with Page(running.url) as page:
            assert "picture" in page.ask("column", pixel=[0, 0])
        assert time.monotonic() - start < client.READ_SECONDS
        descriptors = len(list(Path(f"/proc/{running.process.pid}/fd").iterdir()))
        assert descriptors < server.MAX_CONNECTIONS + 100


def test_pages_are_counted_and_told_so(running):
    with contextlib.ExitStack() as opened:
        for _ in range(server.MAX_PAGES):
            opened.enter_context(Page(running.url))
        with pytest.raises(ConnectionClosed, match=f"{server.MAX_PAGES} pages"):
            Page(running.url)
    with Page(running.url) as page:
        assert "picture" in page.ask("column", pixel=[0, 0])


def read_all(connection: ClientConnection) -> None:
    while True:
        connection.recv(timeout=10)


@pytest.mark.rare
def test_one_that_does_not_read_delays_nobody_and_is_closed(monkeypatch, device):
    monkeypatch.setattr(client, "READ_SECONDS", 4.0)
    pixels = 1 << 20  # a picture of 4 MB, more than what lies in sockets
    T = scipy.sparse.csr_array((np.ones(pixels), (np.arange(pixels), np.arange(pixels) % 4)))
    T = ltcl.Transport(T, (2, 2), camera_grid=(1024, 1024))
    with (
        ltcl.view(T, open_browser=False) as viewer,
        Page(viewer.url) as page,
        socket.socket() as small,
    ):
        small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        small.connect(("127.0.0.1", int(page.origin.split(":")[2])))
        address = viewer.url.replace("http", "ws", 1) + "socket"
        with connect(address, sock=small, origin=Origin(page.origin), max_queue=1) as deaf:
            for number in range(60):
                with contextlib.suppress(ConnectionClosed):
                    deaf.send(json.dumps({"id": number, "do": "column", "pixel": [0, 0]}))
                start = time.monotonic()
                assert "pattern" in page.ask("row", pixel=[0, 0])
                assert time.monotonic() - start < 3.5  # of a busy machine
                time.sleep(0.1)
            with pytest.raises(ConnectionClosed):
                read_all(deaf)
