# SPDX-License-Identifier: BSD-3-Clause
"""`Access`: who may ask a viewer, by token, host and origin.

Addresses begin with a random token. Whoever lacks it, or comes from another origin or under another
host's name (DNS rebinding), is refused, whatever the request. Whoever has it, but asks at an
address that is not served, as through a proxy, is told which addresses are.
"""

from __future__ import annotations

import html
import logging
import os
import re
import secrets
import tempfile
import time
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from ltcl.device import tuning
from ltcl.errors import InputError

# Seconds for which the token of a named port is kept: a day.
TOKEN_SECONDS = 86400.0
TOKEN_BYTES = 24
MIN_TOKEN_LENGTH = 32
# Addresses that are refused with a warning; those that follow are refused without.
MAX_WARNINGS = 8
MAX_NAME_LENGTH = 100
# Whoever has no token hears of no address.
NOT_THE_ADDRESS = (
    "forbidden: the address of the viewer ends in a token, and this one has none, or another; "
    "open the whole address that its terminal or notebook shows"
)
DEFAULT_PORTS = {"http": ":80", "https": ":443"}
# Browsers of snap packages see the user's own folder, but no hidden or temporary one.
SNAP_FOLDER = Path("/snap")
REDIRECT = """<!doctype html>
<meta charset="utf-8">
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={url}">
<title>ltcl</title>
<a href="{url}">The viewer</a>
"""
_logger = logging.getLogger(__name__)


def new_token() -> str:
    """Return a random token."""
    return secrets.token_urlsafe(TOKEN_BYTES)


def token_of_port(port: int) -> str:
    """Return the token of the last viewer on a port that was named, for a day.

    A page of that viewer finds the next one.
    """
    file = tuning.make_folder() / f"viewer-{port}"
    if file.exists() and time.time() > file.stat().st_mtime + TOKEN_SECONDS:
        file.unlink()
    if not file.exists():
        file.touch(0o600, exist_ok=False)
        file.write_text(new_token(), "ascii")
    # On Windows the permissions of the folder decide.
    readers = file.stat().st_mode & 0o077 if os.name == "posix" else 0
    token = file.read_text("latin-1")
    if readers or len(token) < MIN_TOKEN_LENGTH:
        raise OSError(f"{file} is no token, or others can read it; delete it")
    return token


def in_url(address: str) -> str:
    """Return a host as it stands in a URL."""
    return f"[{address}]" if ":" in address else address


class Access:
    """Decides who may ask.

    `names` are the hosts of the viewer's `port`. `outside` is the URL at which a proxy or a
    forwarded port shows it to the browser; empty if there is none.
    """

    def __init__(self, token: str, names: Sequence[str], port: int, outside: str) -> None:
        self._token = token
        self._port = port
        self._hosts = [self._host(name) for name in names]
        self._outside = origin_of(outside)
        # The path that a proxy may leave before the token.
        self.prefix = urlsplit(outside).path.rstrip("/")
        self._warned: set[str] = set()
        address = outside.rstrip("/")
        if not address:
            address = f"http://{self._hosts[-1]}"
        self.url = f"{address}/{token}/"

    def refusal(self, connection: HTTPConnection, token: str, is_reading: bool) -> str:
        """Return why a request is refused; empty if it comes from the viewer's own page."""
        if not secrets.compare_digest(token.encode("utf-8", "replace"), self._token.encode()):
            return NOT_THE_ADDRESS
        if self._is_served(connection, is_reading):
            return ""
        return f"forbidden: {self._explain(connection)}"

    def _is_served(self, connection: HTTPConnection, is_reading: bool) -> bool:
        """Return True for the viewer's own addresses, and for the one outside."""
        host = _host_of(connection)
        origins = connection.headers.getlist("origin")
        if not origins and not is_reading:
            return False
        # The address that was connected to: no other site can have it.
        server = self._host(connection.scope["server"][0])
        expected = []
        if host in (*self._hosts, server):
            expected += [f"http://{host}", self._outside]
        elif self._outside and host == self._outside.partition("://")[2]:
            expected = [self._outside]
        if not origins:
            return expected != []
        return len(origins) == 1 and origins[0] in filter(None, expected)

    def _host(self, name: str) -> str:
        return f"{in_url(name)}:{self._port}".lower()

    def _explain(self, connection: HTTPConnection) -> str:
        """Tell which address was asked for and which are served; warn of it once."""
        asked = connection.headers.get("origin", f"http://{_host_of(connection)}")
        asked = re.sub(r"[^!-~]", "?", asked)[:MAX_NAME_LENGTH]
        addresses = [self._outside, *(f"http://{host}" for host in self._hosts)]
        served = " and ".join(dict.fromkeys(filter(None, addresses)))
        text = (
            f"the page was asked for at {asked}; it is served at {served}; "
            f"behind a proxy or on a forwarded port start the viewer with --origin {asked}"
        )
        if asked not in self._warned and len(self._warned) < MAX_WARNINGS:
            self._warned.add(asked)
            _logger.warning("%s", text)
        return text


def _host_of(connection: HTTPConnection) -> str:
    return connection.headers.get("host", "").lower()


def origin_of(url: str) -> str:
    """Return scheme, host and port of a URL, as browsers send them; InputError if it has none."""
    if not url:
        return ""
    parts = urlsplit(url)
    host = parts.netloc.lower()
    is_host = bool(re.fullmatch(r"[\w.-]+(:\d+)?|\[[\da-f:.]+\](:\d+)?", host))
    if parts.scheme not in DEFAULT_PORTS or not is_host or parts.query:
        raise InputError(f"origin is {url!r}; it must be a URL such as http://localhost:9000")
    return f"{parts.scheme}://{host.removesuffix(DEFAULT_PORTS[parts.scheme])}"


def open_in_browser(url: str) -> Path | None:
    """Open a page in the browser, and return a file to be deleted later; None if that fails.

    All users of a machine can read the arguments of its processes. So the browser is given a file
    that only its owner can read, and that leads to the page.
    """
    folder = Path.home() if SNAP_FOLDER.is_dir() else None
    try:
        descriptor, name = tempfile.mkstemp(prefix="ltcl-view-", suffix=".html", dir=folder)
        with open(descriptor, "w", encoding="utf-8") as file:
            file.write(REDIRECT.format(url=html.escape(url)))
    except OSError as error:
        _logger.warning("the browser cannot be opened (%s): open %s", error, url)
        return None
    path = Path(name)
    webbrowser.open(path.as_uri())
    return path
