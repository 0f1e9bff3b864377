# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's server: who may ask, and what is sent to whom.

Addresses begin with a random token. Whoever lacks it, or comes from another origin or under another
host's name (DNS rebinding), gets 403 whatever is asked for. A page asks through one WebSocket. Each
kind of question has a thread, so that a product does not wait for a solve; what a page asks again
takes the place of what it has waiting. A page that does not read its answers is closed, and delays
nobody.
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
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
except ImportError as error:
    raise InputError(f"a viewer needs Starlette ({error}); pip install 'ltcl[view]'") from None

TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".json": "application/json",
}
TYPES |= {".svg": "image/svg+xml", ".png": "image/png", ".exr": "image/x-exr"}
PAGES, CONNECTIONS = 32, 256
PATIENCE = 5.0  # seconds for a page to read an answer
_BUFFER = 1 << 21  # bytes to a page: a picture is handed over at once
_PERIOD = 0.1  # seconds between two reports of progress
_KEPT = 86400.0  # seconds that a token on a named port serves
_logger = logging.getLogger(__name__)
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; media-src blob:; connect-src 'self' ws://{}; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'self' http://127.0.0.1:* http://localhost:*",  # notebooks
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class _Superseded(Exception):
    """Nobody waits for what is computed any more."""


class _Client:
    """A page's socket, and of each kind of question the newest that waits."""

    def __init__(self, socket: WebSocket, viewer: Viewer) -> None:
        self.socket, self.viewer, self.scene = socket, viewer, viewer._scene
        self.loop, self.changed = asyncio.get_running_loop(), asyncio.Event()
        self.waiting: dict[str, tuple[float, dict[str, Any]]] = {}
        self.tasks: dict[str, asyncio.Task[None]] = {}

    async def serve(self) -> None:
        """Take questions until the page goes; InputError for what is none."""
        await self.send(messages.encode({"do": "hello", **self.scene.hello()}))
        async with asyncio.TaskGroup() as group:
            while (event := await self.socket.receive())["type"] == "websocket.receive":
                header, arrays = messages.decode(event.get("text") or event.get("bytes") or b"")
                do = checks.one_of("do", header.pop("do"), self.scene.questions)
                self.waiting[do] = header.pop("id"), header | arrays
                if do not in self.tasks or self.tasks[do].done():
                    self.tasks[do] = group.create_task(self.answer(do))
                if do == "projector" and "show" not in self.tasks:
                    self.tasks["show"] = group.create_task(self.show())
            raise WebSocketDisconnect

    async def answer(self, do: str) -> None:
        """Answer questions of a kind while there are any; projector windows look for a new pattern."""
        while do in self.waiting:
            message = await self.viewer._run(do, self._compute, do, *self.waiting.pop(do))
            if message is not None:
                await self.send(message)
            for client in self.viewer._clients:
                client.changed.set()

    async def show(self) -> None:
        """Send the codes of every new pattern to a projector window."""
        shown = None
        while True:
            if shown is not (pattern := self.scene.pattern):
                codes = await self.viewer._run("show", self.scene.codes, pattern, self.scene.white)
                await self.send(
                    messages.encode({"do": "show", "title": self.scene.title}, {"codes": codes})
                )
                shown = pattern
            await self.changed.wait()
            self.changed.clear()

    async def send(self, message: str | bytes) -> None:
        """TimeoutError where the other side does not read."""
        kind = "text" if isinstance(message, str) else "bytes"
        await asyncio.wait_for(
            self.socket.send({"type": "websocket.send", kind: message}), PATIENCE
        )

    def _compute(self, do: str, number: float, asked: dict[str, Any]) -> str | bytes | None:
        """The message that answers; None where it came too late. In a thread."""
        reported = time.monotonic()

        def between(iteration: int, residual: float) -> None:
            nonlocal reported
            if self not in self.viewer._clients or do in self.waiting:
                raise _Superseded
            if (now := time.monotonic()) > reported + _PERIOD:
                facts = {
                    "id": number,
                    "step": do,
                    "done": iteration,
                    "total": None,
                    "residual": residual,
                }
                message = messages.encode({"do": "progress", **facts})
                asyncio.run_coroutine_threadsafe(self.send(message), self.loop)
                reported = now

        try:
            facts, pictures = self.scene.answer(do, asked, between)
            return messages.encode({"id": number, "do": do, **facts}, pictures)
        except _Superseded:
            return None
        except Exception as error:  # noqa: BLE001 - the next question may go well
            kind = (
                "" if isinstance(error, LtclError) else f"internal error: {type(error).__name__}: "
            )
            line = kind + " ".join(str(error).split())
            return messages.encode({"id": number, "do": do, "error": line})


class _Http(H11Protocol):
    """A connection that is no socket yet: of too many the oldest gives way, first one that asked nothing."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.app_state = {
            "abort": transport.abort
        }  # of its socket, too: close would wait for a reader
        self.since = time.monotonic()
        plain = [each for each in self.connections if isinstance(each, _Http)]
        plain = [each for each in plain if not each.transport.is_closing()]
        if len(plain) > CONNECTIONS:
            min(plain, key=lambda each: (each.scope is not None, each.since)).transport.abort()


def _token(port: int) -> str:
    """The token of the last viewer on a port that was named, for a day: pages of that find the next one."""
    file = tuning.make_folder() / f"viewer-{port}"
    if file.exists() and time.time() > file.stat().st_mtime + _KEPT:
        file.unlink()
    if not file.exists():
        file.touch(0o600, exist_ok=False)
        file.write_text(secrets.token_urlsafe(24), "ascii")
    others_read = os.name == "posix" and file.stat().st_mode & 0o077  # elsewhere the folder decides
    if len(token := file.read_text("latin-1")) < 32 or others_read:
        raise OSError(f"{file} is no token, or others can read it; delete it")
    return token


class Viewer(contextlib.AbstractContextManager):
    """A viewer in threads of its own until `close`, or the end of a with block; `url` is its page."""

    def __init__(
        self, scene: Any, host: str = "127.0.0.1", port: int = 0, open_browser: bool = True
    ) -> None:
        try:
            if not host:  # which would be anywhere
                raise OSError("it is empty")
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            place = host, checks.count("port", port, least=0, most=65535)
            self._token = _token(port) if port else secrets.token_urlsafe(24)
            listening = socket.create_server(place, family=family)
        except OSError as error:
            raise InputError(
                f"host is {host!r}, port {port}: {error}; they must be free here"
            ) from None
        own = ipaddress.ip_address(listening.getsockname()[0])
        if not own.is_loopback:  # where it travels unencrypted
            self._token = secrets.token_urlsafe(24)
        # Connections have these, too. Without the first one an answer after another waits 40 ms.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        name, self._port = (
            socket.gethostname() if own.is_unspecified else host,
            listening.getsockname()[1],
        )
        self._names = "127.0.0.1", "localhost", name
        self.url = f"http://{_in_url(name)}:{self._port}/{self._token}/"
        page = (Path(__file__).parent / "page").iterdir()
        self._files = {file.name: file.read_bytes() for file in page if file.suffix in TYPES}
        self._scene, self._clients = scene, list[_Client]()
        self._threads = defaultdict[str, ThreadPoolExecutor](lambda: ThreadPoolExecutor(1))
        settings: dict[str, Any] = {"interface": "asgi3", "lifespan": "off", "http": _Http}
        settings |= {"ws": "websockets-sansio", "ws_max_size": messages.largest(scene.pixels)}
        settings |= {
            "ws_per_message_deflate": False,
            "timeout_graceful_shutdown": 1,
            "proxy_headers": False,
        }
        settings |= {
            "log_config": None,
            "log_level": "critical",
            "access_log": False,
            "server_header": False,
        }
        self._uvicorn = uvicorn.Server(uvicorn.Config(self._application, **settings))
        self._thread = threading.Thread(target=self._uvicorn.run, args=([listening],), daemon=True)
        self._thread.start()
        if not own.is_loopback:
            _logger.warning(
                "%s is open to the network, unencrypted: whoever has it can compute", self.url
            )
        if open_browser:
            webbrowser.open(self.url)

    def refresh(self) -> None:
        """Let projector windows look for a new pattern; from any thread."""
        for client in [*self._clients]:
            client.loop.call_soon_threadsafe(client.changed.set)

    def wait(self) -> None:
        """Until the viewer is closed."""
        while self._thread.is_alive():
            self._thread.join(0.5)  # which Ctrl-C interrupts on any system

    def close(self) -> None:
        """End it; pages say that they lost it."""
        self._uvicorn.should_exit = True
        self._thread.join()

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ltcl Viewer at {self.url}>"

    def _repr_html_(self) -> str:
        return f'<iframe src="{html.escape(self.url)}" style="width:100%;height:720px;border:0"></iframe>'

    async def _run(self, kind: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """What a call returns, in the thread for its kind, one after the other."""
        return await asyncio.get_running_loop().run_in_executor(
            self._threads[kind], call, *arguments
        )

    async def _application(self, scope: Any, receive: Any, send: Any) -> None:
        """All requests pass here; those that may not get 403 and no word about what there is."""
        headers = HTTPConnection(scope).headers
        host, origins = headers.get("host", ""), headers.getlist("origin")
        names = (
            *self._names,
            scope["server"][0],
        )  # the last was connected to: no other site can have it
        token, slash, path = scope["path"].removeprefix("/").partition("/")
        reads = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        is_allowed = secrets.compare_digest(token.encode("utf-8", "replace"), self._token.encode())
        is_allowed &= host.lower() in [f"{_in_url(name)}:{self._port}".lower() for name in names]
        is_allowed &= origins == [f"http://{host}"] or (reads and not origins)
        if scope["type"] == "websocket":
            websocket = WebSocket(scope, receive, send)
            await (self._serve(websocket) if is_allowed and path == "socket" else websocket.close())
            return
        response = Response("forbidden", 403)
        if is_allowed:
            response = await self._respond(Request(scope, receive), path if slash else "/", reads)
            response.headers.update({name: value.format(host) for name, value in _HEADERS.items()})
        await response(scope, receive, send)

    async def _respond(self, request: Request, path: str, reads: bool) -> Response:
        if path == "picture" and request.method == "POST":
            name, length = (
                request.query_params.get("name", ""),
                request.headers.get("content-length", ""),
            )
            try:
                checks.count(
                    "length", int(length) if length.isdecimal() else None, most=LARGEST_FILE
                )
                content = await request.body()
                return JSONResponse(
                    await self._run("picture", self._scene.upload, name[:255], content)
                )
            except LtclError as error:
                return JSONResponse({"error": " ".join(str(error).split())}, 400)
        name = {"": self._scene.page, "projector": "projector.html"}.get(path, path)
        content = self._files.get(name)
        if path.startswith("result/"):
            name = path.removeprefix("result/")
            content = await self._run("result", self._scene.result, name)
        if content is None or not reads:
            return Response("not found", 404)
        return Response(content, media_type=TYPES[Path(name).suffix])

    async def _serve(self, websocket: WebSocket) -> None:
        await websocket.accept()
        if len(self._clients) >= PAGES:
            await websocket.close(1013, f"{PAGES} pages are open here, and there may be no more")
            return
        self._clients.append(client := _Client(websocket, self))
        try:
            await client.serve()
        except* InputError as errors:
            await asyncio.wait_for(websocket.close(1008, f"{errors.exceptions[0]}"[:100]), PATIENCE)
        except* (TimeoutError, WebSocketDisconnect):
            websocket.state.abort()
        finally:
            self._clients.remove(client)


def _in_url(address: str) -> str:
    return f"[{address}]" if ":" in address else address
