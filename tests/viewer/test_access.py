# SPDX-License-Identifier: BSD-3-Clause
"""Proxies and forwarded ports, and what other users of the machine can read."""

from __future__ import annotations

import contextlib
import http.client
import os
import socket
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import ltcl
from ltcl.errors import InputError
from ltcl.show.window import Window
from ltcl.viewer import access

T = ltcl.Transport(np.eye(6) / 2, (2, 3))
FORWARDED = "http://localhost:9000"
HUB = "https://hub.example.org"
PROXIED = f"{HUB}/user/me/proxy/8123"


class Served:
    """A viewer, with its port and token."""

    def __init__(self, url: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.viewer = ltcl.view(T, open_browser=False, port=self.port, origin=url)
        self.token = self.viewer.url.split("/")[-2]
        self.host = f"127.0.0.1:{self.port}"

    def get(self, host: str, path: str = "", prefix: str = "", **headers: str) -> tuple[int, str]:
        """Status and text of a request, as a proxy sends it on."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        place = f"{prefix}/{self.token}/{path}"
        with contextlib.closing(connection):
            connection.request("GET", place, headers={"Host": host or self.host, **headers})
            answer = connection.getresponse()
            return answer.status, answer.read().decode()

    def opens_socket(self, host: str, origin: str) -> bool:
        """Whether the page's socket opens."""
        url = f"ws://{host or self.host}/{self.token}/socket"
        settings: dict[str, Any] = {"origin": origin or f"http://{self.host}"}
        with (
            contextlib.suppress(InvalidStatus),
            socket.create_connection(("127.0.0.1", self.port)) as to_viewer,
            connect(url, sock=to_viewer, **settings),
        ):
            return True
        return False


@pytest.fixture
def served(
    request: pytest.FixtureRequest,
    device: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> Iterator[Served]:
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path))
    served = Served(request.param)
    with served.viewer:
        yield served


# --origin, and the host and origin of a request; an empty one is the viewer's own.
ALLOWED = [
    ("", "", ""),
    (FORWARDED, "", ""),
    (FORWARDED, "localhost:9000", FORWARDED),
    (FORWARDED, "", FORWARDED),
    (f"{FORWARDED}/", "localhost:9000", FORWARDED),
    ("http://LOCALHOST:9000", "localhost:9000", FORWARDED),
    (PROXIED, "hub.example.org", HUB),
    (PROXIED, "", HUB),
    ("https://hub.example.org:443", "hub.example.org", HUB),
]
REFUSED = [
    ("", "localhost:9000", FORWARDED),
    ("", "hub.example.org", HUB),
    ("", "", FORWARDED),
    (FORWARDED, "localhost:9001", "http://localhost:9001"),
    (FORWARDED, "hub.example.org", HUB),
    (FORWARDED, "localhost:9000", "http://evil.example"),
    (PROXIED, "hub.example.org", "http://hub.example.org"),
    (PROXIED, "hub.example.org:8443", f"{HUB}:8443"),
]


@pytest.mark.parametrize(("served", "host", "origin"), ALLOWED, indirect=["served"])
def test_the_named_address_is_served(served: Served, host: str, origin: str) -> None:
    assert served.get(host)[0] == 200
    assert served.opens_socket(host, origin)


@pytest.mark.parametrize(("served", "host", "origin"), REFUSED, indirect=["served"])
def test_other_addresses_are_refused_in_words(
    served: Served, host: str, origin: str, caplog: pytest.LogCaptureFixture
) -> None:
    status, text = served.get(host, Origin=origin)
    assert status == 403
    assert not served.opens_socket(host, origin)
    for words in (text, caplog.text):
        assert origin in words
        assert f"http://{served.host}" in words
        assert f"--origin {origin}" in words
        assert served.token not in words
    assert len(caplog.records) == 1


@pytest.mark.parametrize("served", [PROXIED], indirect=True)
def test_a_proxy_may_keep_the_path(served: Served) -> None:
    assert served.viewer.url == f"{PROXIED}/{served.token}/"
    assert served.get("hub.example.org", "main.js", "/user/me/proxy/8123")[0] == 200
    assert served.get("hub.example.org", "main.js")[0] == 200
    assert served.get("hub.example.org", "main.js", "/user/you/proxy/8123")[0] == 403


@pytest.mark.parametrize("served", [FORWARDED], indirect=True)
def test_without_the_token_no_address_is_told(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    served.token += "x"
    status, text = served.get("hub.example.org")
    assert status == 403
    assert "token" in text
    for known in (served.host, FORWARDED, served.token[:-1]):
        assert known not in text
    assert caplog.text == ""


@pytest.mark.parametrize(
    "url",
    [
        "localhost:9000",
        "ftp://localhost",
        "http://",
        "http://me@hub",
        "http://hub/?a=b",
        "http://a b",
    ],
)
def test_what_is_no_address_is_refused(device: Any, url: str) -> None:
    with pytest.raises(InputError, match="origin is"):
        ltcl.view(T, open_browser=False, origin=url)


def view() -> Any:
    return ltcl.view(T)


def window() -> Any:
    return Window("patterns")


@pytest.mark.parametrize("has_snaps", [False, True])
@pytest.mark.parametrize("start", [view, window])
def test_the_browser_is_given_a_file_that_only_its_owner_can_read(
    device: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    start: Any,
    has_snaps: bool,
) -> None:
    arguments: list[str] = []
    monkeypatch.setattr(webbrowser, "open", arguments.append)
    monkeypatch.setattr(access, "SNAP_FOLDER", tmp_path if has_snaps else tmp_path / "none")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    with start() as viewer:
        (argument,) = arguments
        token = viewer.url.split("/")[3]
        assert token not in argument
        file = Path(unquote(urlsplit(argument).path))
        assert (file.parent == tmp_path) == has_snaps
        assert os.name != "posix" or file.stat().st_mode & 0o777 == 0o600
        assert f"url={viewer.url}" in file.read_text("utf-8")
    assert not file.exists()


def test_a_browser_without_a_file_is_a_warning(
    device: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(access, "SNAP_FOLDER", tmp_path)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "none")
    with ltcl.view(T) as viewer:
        assert viewer.url in caplog.text
