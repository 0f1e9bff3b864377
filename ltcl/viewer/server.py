# SPDX-License-Identifier: BSD-3-Clause
"""`Viewer`: the server of the page.

Whoever may not ask (`access`) gets 403 for any address. A page asks through one WebSocket
(`client`).
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import ipaddress
import logging
import socket
import threading
import time
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.errors import InputError
from ltcl.viewer import messages, page_files
from ltcl.viewer.client import READ_SECONDS, Client, PageGone, Threads

try:
    import uvicorn
    from starlette.requests import HTTPConnection
    from starlette.responses import Response
    from starlette.websockets import WebSocket
    from uvicorn.protocols.http.h11_impl import H11Protocol

    from ltcl.viewer.access import Access, new_token, open_in_browser, origin_of, token_of_port
except ImportError as error:
    raise InputError(checks.missing_extra("starlette", "view", "a viewer", error)) from None

TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
MAX_PAGES = 32
# Connections that are no page yet.
MAX_CONNECTIONS = 256
# Bytes to a page: a picture is handed over at once.
SEND_BUFFER = 1 << 21
# Codes by which a WebSocket is closed (RFC 6455): bad data; try again later.
POLICY_VIOLATION = 1008
TRY_AGAIN_LATER = 1013
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


class SocketCarrier:
    """Carries messages through a WebSocket."""

    def __init__(self, websocket: WebSocket) -> None:
        self._websocket = websocket

    async def receive(self) -> str | bytes:
        """Return the next message of the page; PageGone if it has gone."""
        event = await self._websocket.receive()
        if event["type"] != "websocket.receive":
            raise PageGone
        return event.get("text") or event.get("bytes") or b""

    async def send(self, message: str | bytes) -> None:
        """Hand a message over to the socket, once there is room."""
        kind = "text" if isinstance(message, str) else "bytes"
        await self._websocket.send({"type": "websocket.send", kind: message})


class Viewer(contextlib.AbstractContextManager):
    """A viewer in threads of its own, until `close` or the end of a with block.

    `url` is the address of its page.
    """

    def __init__(
        self,
        scene: Any,
        host: str = "127.0.0.1",
        port: int = 0,
        open_browser: bool = True,
        origin: str = "",
    ) -> None:
        self._scene = scene
        self._clients: list[Client] = []
        self._threads = Threads()
        self._files = page_files.read_page()
        # A wrong one is refused before the port is opened.
        origin_of(origin)
        listening, token = _listen(host, port)
        address = ipaddress.ip_address(listening.getsockname()[0])
        if not address.is_loopback:
            # The token travels unencrypted, so that it must not be used again.
            token = new_token()
        name = socket.gethostname() if address.is_unspecified else host
        names = ("127.0.0.1", "localhost", name)
        self._access = Access(token, names, listening.getsockname()[1], origin)
        self.url = self._access.url
        self._uvicorn = uvicorn.Server(self._configuration())
        self._thread = threading.Thread(target=self._uvicorn.run, args=([listening],), daemon=True)
        self._thread.start()
        if not address.is_loopback:
            _logger.warning(
                "%s is open to the network, unencrypted: whoever has it can compute", self.url
            )
        self._redirect: Path | None = None
        if open_browser:
            self._redirect = open_in_browser(self.url)

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
        if self._redirect is not None:
            self._redirect.unlink(missing_ok=True)

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ltcl Viewer at {self.url}>"

    def _repr_html_(self) -> str:
        style = "width:100%;height:720px;border:0"
        return f'<iframe src="{html.escape(self.url)}" style="{style}"></iframe>'

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
        place = scope["path"].removeprefix(self._access.prefix)
        token, slash, path = place.removeprefix("/").partition("/")
        is_reading = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        connection = HTTPConnection(scope)
        refusal = self._access.refusal(connection, token, is_reading)
        is_allowed = refusal == ""
        if scope["type"] == "websocket":
            websocket = WebSocket(scope, receive, send)
            if is_allowed and path == "socket":
                await self._serve(websocket)
            else:
                await websocket.close()
            return
        response = Response(refusal, 403, media_type="text/plain")
        if is_allowed:
            route = "/"
            if slash:
                route = path
            response = self._respond(route, is_reading)
            host = connection.headers.get("host", "")
            for name, value in HEADERS.items():
                response.headers[name] = value.format(host)
        await response(scope, receive, send)

    def _respond(self, path: str, is_reading: bool) -> Response:
        """Answer a request for a file of the page."""
        pages = {"": self._scene.page, "projector": "projector.html"}
        name = pages.get(path, path)
        content = self._files.get(name)
        if content is None or not is_reading:
            return Response("not found", 404)
        return Response(content, media_type=TYPES[Path(name).suffix])

    async def _serve(self, websocket: WebSocket) -> None:
        """Serve a page until it goes."""
        await websocket.accept()
        if len(self._clients) >= MAX_PAGES:
            reason = f"{MAX_PAGES} pages are open here, and there may be no more"
            await websocket.close(TRY_AGAIN_LATER, reason)
            return
        carrier = SocketCarrier(websocket)
        client = Client(carrier, self._scene, self._threads, self._clients)
        self._clients.append(client)
        try:
            await client.serve()
        except* InputError as errors:
            reason = str(errors.exceptions[0])[:100]
            await asyncio.wait_for(websocket.close(POLICY_VIOLATION, reason), READ_SECONDS)
        except* (TimeoutError, PageGone):
            websocket.state.abort()
        finally:
            self._clients.remove(client)


def _listen(host: str, port: int) -> tuple[socket.socket, str]:
    """Open the port; return it with its token."""
    try:
        if not host:
            # An empty host would be any address.
            raise OSError("it is empty")
        checks.count("port", port, least=0, most=65535)
        token = token_of_port(port) if port else new_token()
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.create_server((host, port), family=family)
    except OSError as error:
        problem = f"host is {host!r}, port {port}: {error}"
        raise InputError(f"{problem}; they must be free here") from None
    # Connections inherit these. Without the first an answer after another waits 40 ms.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    return listening, token
