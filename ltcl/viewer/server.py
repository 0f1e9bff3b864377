# SPDX-License-Identifier: BSD-3-Clause
"""`Viewer`: the server of the page; it decides who may ask.

Addresses begin with a random token. Whoever lacks it, or comes from another origin or under another
host's name (DNS rebinding), gets 403 for any address. A page asks through one WebSocket (`client`).
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import ipaddress
import logging
import os
import secrets
import socket
import threading
import time
import webbrowser
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.device import tuning
from ltcl.errors import InputError, LtclError
from ltcl.viewer import messages
from ltcl.viewer.answers import LARGEST_FILE

try:
    import uvicorn
    from starlette.requests import HTTPConnection, Request
    from starlette.responses import JSONResponse, Response
    from starlette.websockets import WebSocket, WebSocketDisconnect
    from uvicorn.protocols.http.h11_impl import H11Protocol

    from ltcl.viewer.client import READ_SECONDS, Client, Threads
except ImportError as error:
    raise InputError(f"a viewer needs Starlette ({error}); pip install 'ltcl[view]'") from None

TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".exr": "image/x-exr",
}
MAX_PAGES = 32
# Connections that are no page yet.
MAX_CONNECTIONS = 256
# Bytes to a page: a picture is handed over at once.
SEND_BUFFER = 1 << 21
# Seconds for which the token of a named port is kept: a day.
TOKEN_SECONDS = 86400.0
TOKEN_BYTES = 24
MIN_TOKEN_LENGTH = 32
MAX_NAME_LENGTH = 255
# Codes by which a WebSocket is closed (RFC 6455): bad data; try again later.
POLICY_VIOLATION = 1008
TRY_AGAIN_LATER = 1013
PAGE_FOLDER = Path(__file__).parent / "page"
HEADERS = {
    # The last line allows the frames of notebooks.
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "media-src blob:; connect-src 'self' ws://{}; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'self' http://127.0.0.1:* http://localhost:*"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_logger = logging.getLogger(__name__)


class _Connection(H11Protocol):
    """A connection that is no socket yet.

    Of too many the oldest gives way, first of all one without a request.
    """

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        # The socket of the page is aborted by this, too: closing would wait for a reader.
        self.app_state = {"abort": transport.abort}
        self.since = time.monotonic()
        open_connections = []
        for connection in self.connections:
            if isinstance(connection, _Connection) and not connection.transport.is_closing():
                open_connections.append(connection)
        if len(open_connections) > MAX_CONNECTIONS:
            oldest = min(open_connections, key=_Connection._order)
            oldest.transport.abort()

    def _order(self) -> tuple[bool, float]:
        has_request = self.scope is not None
        return has_request, self.since


def _new_token() -> str:
    return secrets.token_urlsafe(TOKEN_BYTES)


def _token_of_port(port: int) -> str:
    """Return the token of the last viewer on a port that was named, for a day.

    A page of that viewer finds the next one.
    """
    file = tuning.make_folder() / f"viewer-{port}"
    if file.exists() and time.time() > file.stat().st_mtime + TOKEN_SECONDS:
        file.unlink()
    if not file.exists():
        file.touch(0o600, exist_ok=False)
        file.write_text(_new_token(), "ascii")
    # On Windows the permissions of the folder decide.
    readers = file.stat().st_mode & 0o077 if os.name == "posix" else 0
    token = file.read_text("latin-1")
    if readers or len(token) < MIN_TOKEN_LENGTH:
        raise OSError(f"{file} is no token, or others can read it; delete it")
    return token


class Viewer(contextlib.AbstractContextManager):
    """A viewer in threads of its own, until `close` or the end of a with block.

    `url` is the address of its page.
    """

    def __init__(
        self, scene: Any, host: str = "127.0.0.1", port: int = 0, open_browser: bool = True
    ) -> None:
        self._scene = scene
        self._clients: list[Client] = []
        self._threads = Threads()
        self._files = _read_page()
        listening = self._listen(host, port)
        address = ipaddress.ip_address(listening.getsockname()[0])
        if not address.is_loopback:
            # The token travels unencrypted, so that it must not be used again.
            self._token = _new_token()
        name = socket.gethostname() if address.is_unspecified else host
        self._port = listening.getsockname()[1]
        self._names = ("127.0.0.1", "localhost", name)
        self.url = f"http://{_in_url(name)}:{self._port}/{self._token}/"
        self._uvicorn = uvicorn.Server(self._configuration())
        self._thread = threading.Thread(target=self._uvicorn.run, args=([listening],), daemon=True)
        self._thread.start()
        if not address.is_loopback:
            _logger.warning(
                "%s is open to the network, unencrypted: whoever has it can compute", self.url
            )
        if open_browser:
            webbrowser.open(self.url)

    def refresh(self) -> None:
        """Let projector windows look for a new pattern; from any thread."""
        for client in [*self._clients]:
            client.refresh()

    def wait(self) -> None:
        """Wait until the viewer is closed."""
        while self._thread.is_alive():
            # Ctrl-C interrupts a wait with a limit on any system.
            self._thread.join(0.5)

    def close(self) -> None:
        """Close the viewer; pages show that they lost it."""
        self._uvicorn.should_exit = True
        self._thread.join()

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ltcl Viewer at {self.url}>"

    def _repr_html_(self) -> str:
        style = "width:100%;height:720px;border:0"
        return f'<iframe src="{html.escape(self.url)}" style="{style}"></iframe>'

    def _listen(self, host: str, port: int) -> socket.socket:
        """Open the port, and set the token."""
        try:
            if not host:
                # An empty host would be any address.
                raise OSError("it is empty")
            checks.count("port", port, least=0, most=65535)
            self._token = _token_of_port(port) if port else _new_token()
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            listening = socket.create_server((host, port), family=family)
        except OSError as error:
            raise InputError(
                f"host is {host!r}, port {port}: {error}; they must be free here"
            ) from None
        # Connections inherit these. Without the first an answer after another waits 40 ms.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        return listening

    def _configuration(self) -> uvicorn.Config:
        return uvicorn.Config(
            self._application,
            interface="asgi3",
            lifespan="off",
            http=_Connection,
            ws="websockets-sansio",
            ws_max_size=messages.largest_question(self._scene.pixels),
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
            proxy_headers=False,
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
        )

    async def _application(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request; one that is not allowed gets 403 whatever it asks for."""
        token, slash, path = scope["path"].removeprefix("/").partition("/")
        is_reading = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        is_allowed = self._is_allowed(scope, token, is_reading)
        if scope["type"] == "websocket":
            websocket = WebSocket(scope, receive, send)
            if is_allowed and path == "socket":
                await self._serve(websocket)
            else:
                await websocket.close()
            return
        response = Response("forbidden", 403)
        if is_allowed:
            request = Request(scope, receive)
            response = await self._respond(request, path if slash else "/", is_reading)
            host = request.headers.get("host", "")
            for name, value in HEADERS.items():
                response.headers[name] = value.format(host)
        await response(scope, receive, send)

    def _is_allowed(self, scope: Any, token: str, is_reading: bool) -> bool:
        """True if token, host and origin are those of the viewer's own page."""
        headers = HTTPConnection(scope).headers
        host = headers.get("host", "")
        origins = headers.getlist("origin")
        # The address that was connected to is the last name: no other site can have it.
        names = (*self._names, scope["server"][0])
        hosts = [f"{_in_url(name)}:{self._port}".lower() for name in names]
        has_token = secrets.compare_digest(token.encode("utf-8", "replace"), self._token.encode())
        has_host = host.lower() in hosts
        has_origin = origins == [f"http://{host}"] or (is_reading and not origins)
        return has_token and has_host and has_origin

    async def _respond(self, request: Request, path: str, is_reading: bool) -> Response:
        """Answer a request for a file, or take a picture."""
        if path == "picture" and request.method == "POST":
            return await self._take_picture(request)
        pages = {"": self._scene.page, "projector": "projector.html"}
        name = pages.get(path, path)
        content = self._files.get(name)
        if path.startswith("result/"):
            name = path.removeprefix("result/")
            content = await self._threads.run("result", self._scene.result, name)
        if content is None or not is_reading:
            return Response("not found", 404)
        return Response(content, media_type=TYPES[Path(name).suffix])

    async def _take_picture(self, request: Request) -> Response:
        name = request.query_params.get("name", "")[:MAX_NAME_LENGTH]
        length = request.headers.get("content-length", "")
        try:
            size = int(length) if length.isdecimal() else None
            checks.count("length", size, most=LARGEST_FILE)
            content = await request.body()
            facts = await self._threads.run("picture", self._scene.upload, name, content)
        except LtclError as error:
            return JSONResponse({"error": " ".join(str(error).split())}, 400)
        return JSONResponse(facts)

    async def _serve(self, websocket: WebSocket) -> None:
        """Serve a page until it goes."""
        await websocket.accept()
        if len(self._clients) >= MAX_PAGES:
            reason = f"{MAX_PAGES} pages are open here, and there may be no more"
            await websocket.close(TRY_AGAIN_LATER, reason)
            return
        client = Client(websocket, self._scene, self._threads, self._clients)
        self._clients.append(client)
        try:
            await client.serve()
        except* InputError as errors:
            reason = str(errors.exceptions[0])[:100]
            await asyncio.wait_for(websocket.close(POLICY_VIOLATION, reason), READ_SECONDS)
        except* (TimeoutError, WebSocketDisconnect):
            websocket.state.abort()
        finally:
            self._clients.remove(client)


def _read_page() -> dict[str, bytes]:
    """Read all files of the page, by their names."""
    files = {}
    for file in PAGE_FOLDER.iterdir():
        if file.suffix in TYPES:
            files[file.name] = file.read_bytes()
    return files


def _in_url(address: str) -> str:
    return f"[{address}]" if ":" in address else address
