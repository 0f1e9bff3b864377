# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's server: who may ask, whose turn it is, and what is sent to whom.

Addresses begin with a random token. Whoever lacks it, or comes from another origin or under another host's
name (DNS rebinding), gets 403 whatever is asked for. A page asks through one WebSocket. The device computes
one thing at a time: clients take turns, and what one asks again takes the place of what it has waiting. A
client that does not read its answers is closed, and delays nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import ipaddress
import logging
import os
import re
import secrets
import socket
import threading
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

import uvicorn
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from ltcl import checks
from ltcl.device import tuning
from ltcl.errors import InputError, LtclError
from ltcl.viewer import messages
from ltcl.viewer.answers import LARGEST_FILE, LONG

TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json"}
TYPES |= {".svg": "image/svg+xml", ".png": "image/png", ".exr": "image/x-exr"}
SOCKETS, CONNECTIONS = 32, 256
BUFFER = 1 << 20  # bytes to a client: a picture is handed over at once
PATIENCE, LIFETIME = 5.0, 60.0  # seconds for a client to read an answer, or to ask; of what is no socket
_PERIOD = 0.1  # seconds between two reports of progress
_LOOK = 1.0  # seconds between two looks into the folder of a scan
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)  # Windows has none
_KEPT = 86400.0  # seconds for which the token of a port is used again
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


class Turns:
    """One computation at a time, first come, first served; a solve lets quick ones by between its steps."""

    def __init__(self) -> None:
        self._turn, self._solve, self._queue = asyncio.Lock(), asyncio.Lock(), 0

    async def take(self, is_long: bool, call: Callable[..., Any], *arguments: Any) -> Any:
        """`call` in a thread, when it is its turn; not to be cancelled, as the thread would go on."""
        async with self._solve if is_long else contextlib.nullcontext():
            await self._wait()
            try:
                return await asyncio.to_thread(call, *arguments)
            finally:
                self._turn.release()

    def let_by(self, loop: asyncio.AbstractEventLoop) -> None:
        """In the thread that computes: wait until those that wait had their turn."""
        if self._queue:
            asyncio.run_coroutine_threadsafe(self._wait(again=True), loop).result()

    async def _wait(self, again: bool = False) -> None:
        if again:
            self._turn.release()
        self._queue += 1
        await self._turn.acquire()
        self._queue -= 1


class Client:
    """A socket, its questions that wait, by what they ask, and whether it is a projector window."""

    def __init__(self, socket: WebSocket, scene: Any, turns: Turns, clients: list[Client]) -> None:
        self.socket, self.scene, self.turns, self.clients = socket, scene, turns, clients
        self.questions: dict[str, tuple[float, dict[str, Any]]] = {}
        self.busy, self.tasks, self.loop = set[str](), asyncio.TaskGroup(), asyncio.get_running_loop()
        self.changed, self.followed, self.hello = asyncio.Event(), set[str](), scene.hello()

    async def receive(self) -> None:
        """Take questions until WebSocketDisconnect, or InputError for what is none."""
        while (event := await self.socket.receive())["type"] == "websocket.receive":
            header, arrays = messages.decode(event.get("text") or event.get("bytes") or b"")
            do = checks.one_of("do", header.pop("do"), self.scene.questions)
            self.questions[do] = header.pop("id"), header | arrays
            if do not in self.busy:
                self.busy.add(do)
                self.tasks.create_task(self.answer(do))
        raise WebSocketDisconnect

    async def answer(self, do: str) -> None:
        """Answer questions of a kind while there are any; projector windows look for a new pattern."""
        while do in self.questions:
            number, asked = self.questions.pop(do)
            turn = self.turns.take(do in LONG, self._compute, number, do, asked)
            if (message := await asyncio.shield(turn)) is not None:
                await self.send(message)
            for client in self.clients:
                client.changed.set()
        self.busy.remove(do)
        if do in ("projector", "scan") and do not in self.followed:
            self.followed.add(do)
            self.tasks.create_task(self.show() if do == "projector" else self.watch())

    async def show(self) -> None:
        """Send the codes of every new pattern to a projector window."""
        shown = None
        while True:
            if shown is not (pattern := self.scene.pattern):
                codes = await asyncio.to_thread(self.scene.codes, pattern, self.scene.white)
                await self.send(messages.encode({"do": "show", "title": self.scene.title}, {"codes": codes}))
                shown = pattern
            await self.changed.wait()
            self.changed.clear()

    async def watch(self) -> None:
        """Send what is new in the folder of a scan; and what its transport is, once there is one."""
        seen = 0
        while True:
            facts, pictures, seen = await asyncio.to_thread(self.scene.news, seen)
            await self.send(messages.encode({"do": "scan", **facts}, pictures))
            if self.hello["grid"] != (hello := self.scene.hello())["grid"]:
                self.hello = hello
                await self.send(messages.encode({"do": "hello", **hello}))
            await asyncio.sleep(_LOOK)

    async def send(self, message: str | bytes) -> None:
        """TimeoutError where the other side does not read."""
        kind = "text" if isinstance(message, str) else "bytes"
        await asyncio.wait_for(self.socket.send({"type": "websocket.send", kind: message}), PATIENCE)

    def _compute(self, number: float, do: str, asked: dict[str, Any]) -> str | bytes | None:
        """The message that answers; None where it came too late. In a thread."""
        reported = time.monotonic()

        def between(iteration: int, residual: float) -> None:
            nonlocal reported
            if self not in self.clients or do in self.questions:
                raise _Superseded
            if (now := time.monotonic()) > reported + _PERIOD:
                facts = {"id": number, "step": do, "done": iteration, "total": None, "residual": residual}
                message = messages.encode({"do": "progress", **facts})
                asyncio.run_coroutine_threadsafe(self.send(message), self.loop)
                reported = now
            self.turns.let_by(self.loop)

        try:
            facts, pictures = self.scene.answer(do, asked, between)
            return messages.encode({"id": number, "do": do, **facts}, pictures)
        except _Superseded:
            return None
        except Exception as error:  # noqa: BLE001 - the next question may go well
            kind = "" if isinstance(error, LtclError) else f"internal error: {type(error).__name__}: "
            line = kind + " ".join(str(error).split())
            return messages.encode({"id": number, "do": do, "error": line})


class _Http(H11Protocol):
    """Connections that stay silent, or last, give way to others."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.app_state = {"abort": transport.abort}  # of its socket, too: close would wait for a reader
        # asyncio sets it for sockets of another making only; without it an answer after another waits 40 ms.
        own = transport.get_extra_info("socket")
        own.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
        self.since = time.monotonic()
        self.loop.call_later(PATIENCE, lambda: self.scope is None and self._drop())
        self.loop.call_later(LIFETIME, self._drop)
        plain = [each for each in self.connections if isinstance(each, _Http)]
        plain = [each for each in plain if not each.transport.is_closing()]
        if len(plain) > CONNECTIONS:
            min(plain, key=lambda each: (each.scope is not None, each.since)).transport.abort()

    def _drop(self) -> None:
        if self in self.connections:  # and has not become a socket
            self.transport.abort()


def _token(port: int) -> str:
    """The token of the last viewer on a port that was named, so that its pages find the next one.

    Its file is its owner's alone, and serves for a day on loopback. Pages that try again tell it to whatever
    has the port: where users do not trust each other, close them, or name no port and get a new token.
    """
    opened = os.open(tuning.make_folder() / f"viewer-{port}", os.O_RDWR | os.O_CREAT | _NO_LINK, 0o600)
    with open(opened, "r+", encoding="ascii", errors="replace") as file:
        state, token = os.fstat(opened), file.read()
        is_own = os.name != "posix" or (state.st_uid == os.getuid() and not state.st_mode & 0o077)
        if not is_own or time.time() > state.st_mtime + _KEPT or not re.fullmatch(r"[\w-]{32}", token):
            token = secrets.token_urlsafe(24)
        if is_own:
            file.seek(0)
            file.truncate()
            file.write(token)
    return token


class Viewer(contextlib.AbstractContextManager):
    """A viewer in threads of its own until `close`, or the end of a with block; `url` is its page."""

    def __init__(self, scene: Any, host: str, port: int, open_browser: bool) -> None:
        try:
            if not host:  # which would be anywhere
                raise OSError("it is empty")
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            place = host, checks.count("port", port, least=0, most=65535)
            token, both = _token(port) if port else "", host == "::" and socket.has_dualstack_ipv6()
            listening = socket.create_server(place, family=family, dualstack_ipv6=both)
        except OSError as error:
            raise InputError(f"host is {host!r}, port {port}: {error}; they must be free here") from None
        address, self._port = listening.getsockname()[:2]
        is_local = ipaddress.ip_address(address).is_loopback
        self._token = token if token and is_local else secrets.token_urlsafe(24)
        name = socket.gethostname() if ipaddress.ip_address(address).is_unspecified else host
        name = f"[{name}]" if ":" in name else name
        self._names = {"127.0.0.1", "localhost", "[::1]", name.lower()}
        self.url = f"http://{name}:{self._port}/{self._token}/"
        page = (Path(__file__).parent / "page").iterdir()
        self._files = {file.name: file.read_bytes() for file in page if file.suffix in TYPES}
        self._scene, self._clients = scene, list[Client]()
        self._turns, self._decoding = Turns(), asyncio.Lock()
        settings: dict[str, Any] = {"interface": "asgi3", "lifespan": "off", "http": _Http}
        settings |= {"ws": "websockets-sansio", "ws_max_size": messages.largest(scene.pixels)}
        settings |= {"ws_per_message_deflate": False, "timeout_graceful_shutdown": 1, "proxy_headers": False}
        settings |= {"log_config": None, "log_level": "critical", "access_log": False, "server_header": False}
        self._uvicorn = uvicorn.Server(uvicorn.Config(self._application, **settings))
        self._thread = threading.Thread(target=self._uvicorn.run, args=([listening],), daemon=True)
        self._thread.start()
        if not is_local:
            _logger.warning("%s is open to the network, unencrypted: whoever has it can compute", self.url)
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

    async def _application(self, scope: Any, receive: Any, send: Any) -> None:
        """All requests pass here; those that may not get 403 and no word about what there is."""
        named = [(name, value.decode("latin-1")) for name, value in scope["headers"]]
        hosts, origins = ([value for name, value in named if name == key] for key in (b"host", b"origin"))
        own = scope["server"][0].removeprefix("::ffff:")  # which was connected to: no other site can have it
        own = {f"{name}:{self._port}" for name in (*self._names, f"[{own}]" if ":" in own else own)}
        token, slash, path = scope["path"].removeprefix("/").partition("/")
        reads = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        is_allowed = secrets.compare_digest(token.encode("utf-8", "replace"), self._token.encode())
        is_allowed &= len(hosts) == 1 and hosts[0].lower() in own
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

    async def _respond(self, request: Request, path: str, reads: bool) -> Response:
        if path == "picture" and request.method == "POST":
            name, length = request.query_params.get("name", ""), request.headers.get("content-length", "")
            try:
                checks.count("length", int(length) if length.isdecimal() else None, most=LARGEST_FILE)
                content = await request.body()
                async with self._decoding:
                    return JSONResponse(await asyncio.to_thread(self._scene.upload, name[:255], content))
            except LtclError as error:
                return JSONResponse({"error": " ".join(str(error).split())}, 400)
        name = {"": self._scene.page, "projector": "projector.html"}.get(path, path)
        content = self._files.get(name)
        if path.startswith("result/"):
            name = path.removeprefix("result/")
            content = await asyncio.to_thread(self._scene.result, name)
        if content is None or not reads:
            return Response("not found", 404)
        return Response(content, media_type=TYPES[Path(name).suffix])

    async def _serve(self, websocket: WebSocket) -> None:
        client = Client(websocket, self._scene, self._turns, self._clients)
        self._clients.append(client)
        try:
            await websocket.accept()
            async with client.tasks:
                await client.send(messages.encode({"do": "hello", **client.hello}))
                await client.receive()
        except* InputError as errors:
            await asyncio.wait_for(websocket.close(1008, f"{errors.exceptions[0]}"[:100]), PATIENCE)
        except* (TimeoutError, WebSocketDisconnect):
            websocket.state.abort()
        finally:
            self._clients.remove(client)
