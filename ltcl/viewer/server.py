# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's server: who may ask, whose turn it is, and what is sent to whom.

Addresses begin with a random token. Whoever lacks it, or comes from another origin or under another host's
name (DNS rebinding), gets 403 whatever is asked for. A page asks through one WebSocket. One thread computes,
since the device is one; clients take turns, and what one asks again takes the place of what it has waiting. A
client that does not read its answers is closed, and delays nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import ipaddress
import secrets
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import uvicorn
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.websockets import WebSocket
from uvicorn.protocols.http.h11_impl import H11Protocol

from ltcl import checks
from ltcl.errors import InputError, LtclError
from ltcl.viewer import messages
from ltcl.viewer.answers import LARGEST_FILE, LONG, QUICK, Scene

TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json"}
TYPES |= {".svg": "image/svg+xml", ".png": "image/png", ".exr": "image/x-exr"}
SOCKETS, CONNECTIONS = 32, 256
PATIENCE, LIFETIME = 5.0, 60.0  # seconds for a client to read an answer, or to ask; of what is no socket
_PERIOD = 0.1  # seconds between two reports of progress
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


class _Latest:
    """What waits, by keys and in their order; a new value takes the place of one with its key."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}
        self._ready = asyncio.Event()

    def put(self, key: str, value: Any) -> None:
        self.values[key] = value
        self._ready.set()

    async def get(self) -> Any:
        while not self.values:
            self._ready.clear()
            await self._ready.wait()
        return self.values.pop(next(iter(self.values)))


class Turns:
    """One computation at a time, first come, first served; a solve lets others by between its steps."""

    def __init__(self) -> None:
        self._turn, self._queue = asyncio.Lock(), 0

    async def take(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """`call` in a thread, when it is its turn; not to be cancelled, as the thread goes on."""
        await self._wait()
        try:
            return await asyncio.to_thread(call, *arguments)
        finally:
            self._turn.release()

    def let_by(self, loop: asyncio.AbstractEventLoop) -> None:
        """Wait, in the thread that computes, until those that wait had their turn."""
        if self._queue:
            self._turn.release()
            asyncio.run_coroutine_threadsafe(self._wait(), loop).result()

    async def _wait(self) -> None:
        self._queue += 1
        await self._turn.acquire()
        self._queue -= 1


class Client:
    """A socket: questions that wait, by what they ask, and news to be sent, by what they tell."""

    def __init__(self, socket: WebSocket, scene: Scene, turns: Turns, clients: list[Client]) -> None:
        self.socket, self.scene, self.turns, self.clients = socket, scene, turns, clients
        self.questions, self.news, self.loop = _Latest(), _Latest(), asyncio.get_running_loop()
        self.projects = False

    async def receive(self) -> None:
        """Take questions until the socket is closed; InputError for what is none."""
        while (event := await self.socket.receive())["type"] == "websocket.receive":
            header, arrays = messages.decode(event.get("text") or event.get("bytes") or b"")
            do = checks.one_of("do", header["do"], (*QUICK, *LONG))
            self.questions.put(do, (header.pop("id"), header.pop("do"), header | arrays))

    async def answer(self) -> None:
        """Answer one question after the other; what changes the pattern is news for projector windows."""
        while True:
            _, do, _ = question = await self.questions.get()
            pattern = self.scene.pattern
            message = await asyncio.shield(self.turns.take(self._computed, *question))
            if message is not None:
                await self.send(message)
            self.projects |= do == "projector"
            if self.scene.pattern is not pattern or do == "projector":
                if windows := [client for client in self.clients if client.projects]:
                    codes = await asyncio.to_thread(self.scene.codes, self.scene.pattern, self.scene.white)
                    for client in windows:
                        client.news.put("show", messages.encode({"do": "show"}, {"codes": codes}))

    async def tell(self) -> None:
        """Send news."""
        while True:
            await self.send(await self.news.get())

    async def send(self, message: str | bytes) -> None:
        """TimeoutError where the other side does not read."""
        kind = "text" if isinstance(message, str) else "bytes"
        await asyncio.wait_for(self.socket.send({"type": "websocket.send", kind: message}), PATIENCE)

    def _computed(self, number: float, do: str, asked: dict[str, Any]) -> str | bytes | None:
        """The message that answers; None where it came too late. In a thread."""
        reported = time.monotonic()

        def between(iteration: int, residual: float) -> None:
            nonlocal reported
            if self not in self.clients or do in self.questions.values:
                raise _Superseded
            if (now := time.monotonic()) > reported + _PERIOD:
                facts = {"id": number, "step": do, "done": iteration, "total": None, "residual": residual}
                message = messages.encode({"do": "progress", **facts})
                self.loop.call_soon_threadsafe(self.news.put, "progress", message)
                reported = now
            self.turns.let_by(self.loop)

        try:
            facts, pictures = self.scene.answer(do, asked, between)
        except _Superseded:
            return None
        except Exception as error:  # noqa: BLE001 - the next question may go well
            kind = "" if isinstance(error, LtclError) else f"internal error: {type(error).__name__}: "
            facts, pictures = {"error": kind + " ".join(str(error).split())}, {}
        return messages.encode({"id": number, "do": do, **facts}, pictures)


class _Http(H11Protocol):
    """Connections that stay silent, or last, give way to others."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.app_state = {"abort": transport.abort}  # of a socket, too: close would wait for its reader
        self.loop.call_later(PATIENCE, lambda: self.scope is None and self._drop())
        self.loop.call_later(LIFETIME, self._drop)
        if len(plain := [each for each in self.connections if isinstance(each, _Http)]) > CONNECTIONS:
            plain[0].transport.abort()

    def _drop(self) -> None:
        if self in self.connections:  # and has not become a socket
            self.transport.abort()


class Viewer(contextlib.AbstractContextManager):
    """A viewer in threads of its own until `close`, or the end of a with block; `url` is its page."""

    def __init__(self, scene: Scene, host: str, port: int) -> None:
        address = _address(host)
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listening = socket.create_server((host, port), family=family)
        except (OSError, OverflowError) as error:
            raise InputError(f"host is {host!r}, port {port}: {error}; they must be free here") from None
        self.is_local = host == "localhost" or (address is not None and address.is_loopback)
        name = socket.gethostname() if address is not None and address.is_unspecified else host
        name, self._port = f"[{name}]" if ":" in name else name, self._listening.getsockname()[1]
        self._names, self._token = (
            {"127.0.0.1", "localhost", "[::1]", name.lower()},
            secrets.token_urlsafe(24),
        )
        self.url = f"http://{name}:{self._port}/{self._token}/"
        page = (Path(__file__).parent / "page").iterdir()
        self._files = {file.name: file.read_bytes() for file in page if file.suffix in TYPES}
        self._scene, self._clients, self._turns, self._decoding = scene, [], Turns(), asyncio.Lock()
        # Compression would take longer than a loopback.
        settings: dict[str, Any] = {"interface": "asgi3", "lifespan": "off", "http": _Http}
        settings |= {"ws": "websockets-sansio", "ws_max_size": messages.largest(max(scene.T.shape))}
        settings |= {"ws_per_message_deflate": False, "timeout_graceful_shutdown": 1, "proxy_headers": False}
        settings |= {"log_config": None, "log_level": "critical", "access_log": False, "server_header": False}
        self._uvicorn = uvicorn.Server(uvicorn.Config(self._application, **settings))
        self._thread = threading.Thread(target=self._uvicorn.run, args=([self._listening],), daemon=True)
        self._thread.start()

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

    async def _application(self, scope: Any, receive: Any, send: Any) -> None:
        """All requests pass here; those that may not get 403 and no word about what there is."""
        named = [(name, value.decode("latin-1")) for name, value in scope["headers"]]
        hosts, origins = ([value for name, value in named if name == key] for key in (b"host", b"origin"))
        token, slash, path = scope["path"].removeprefix("/").partition("/")
        reads = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        is_allowed = secrets.compare_digest(token.encode("utf-8", "replace"), self._token.encode())
        is_allowed &= len(hosts) == 1 and self._is_own(hosts[0])
        is_allowed &= origins == [f"http://{host}" for host in hosts] or (reads and not origins)
        if scope["type"] == "websocket":
            websocket = WebSocket(scope, receive, send)
            if is_allowed and path == "socket" and len(self._clients) < SOCKETS:
                await self._serve(websocket)
            else:
                await websocket.close()
            return
        response = Response("forbidden", 403)
        if is_allowed:
            response = await self._respond(Request(scope, receive), path if slash else "/", reads)
            response.headers.update({name: value.format(hosts[0]) for name, value in _HEADERS.items()})
        await response(scope, receive, send)

    def _is_own(self, host: str) -> bool:
        """Whether a Host header has a name that no other site can give to this server."""
        name, _, port = host.lower().rpartition(":")
        known = name in self._names or (not self.is_local and _address(name.strip("[]")) is not None)
        return known and port == str(self._port)

    async def _respond(self, request: Request, path: str, reads: bool) -> Response:
        if path == "picture" and request.method == "POST":
            name, length = (
                request.query_params.get("name", "")[:255],
                request.headers.get("content-length", ""),
            )
            try:
                checks.count("content-length", int(length) if length.isdecimal() else None, most=LARGEST_FILE)
                content = await request.body()
                async with self._decoding:
                    return JSONResponse(await asyncio.to_thread(self._scene.upload, name[:255], content))
            except LtclError as error:
                return JSONResponse({"error": " ".join(str(error).split())}, 400)
        name = {"": "index.html", "projector": "projector.html"}.get(path, path)
        content = self._files.get(name)
        if path.startswith("result/"):
            name = path.removeprefix("result/")
            content = await asyncio.to_thread(self._scene.result, name)
        if content is None or not reads:
            return Response("not found", 404)
        return Response(content, media_type=TYPES[Path(name).suffix])

    async def _serve(self, websocket: WebSocket) -> None:
        await websocket.accept()
        client = Client(websocket, self._scene, self._turns, self._clients)
        client.news.put("hello", messages.encode({"do": "hello", **self._scene.hello()}))
        self._clients.append(client)
        tasks = [asyncio.ensure_future(each()) for each in (client.receive, client.answer, client.tell)]
        try:
            (ended, *_), _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if isinstance(error := ended.exception(), InputError):
                await asyncio.wait_for(websocket.close(1008, f"{error}"[:100]), PATIENCE)
            elif error is not None:
                websocket.state.abort()
        finally:
            self._clients.remove(client)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


def _address(host: str) -> Any:
    """The IP address that a text is, or None."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host)
    return None
