# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's server: who may ask, whose turn it is, and what is sent to whom.

Addresses begin with a random token. Whoever lacks it, or comes from another origin or under another host's
name (DNS rebinding), gets 403 whatever is asked for. A page asks through one WebSocket. One thread computes,
since the device is one; clients take turns, and what one asks again replaces what it has waiting. A client
that does not read its answers is closed, and delays nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import ipaddress
import itertools
import secrets
import socket
import threading
import time
from pathlib import Path
from typing import Any

import uvicorn
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.websockets import WebSocket
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from ltcl import checks
from ltcl.errors import InputError, LtclError
from ltcl.viewer import messages
from ltcl.viewer.answers import LARGEST_FILE, QUICK, Scene

TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json"}
TYPES |= {".svg": "image/svg+xml", ".png": "image/png", ".exr": "image/x-exr"}
SOCKETS, CONNECTIONS, UPLOADS = 32, 256, 4
PATIENCE, LIFETIME = 5.0, 60.0  # seconds for a client to read an answer, or to ask; of what is no socket
_UNSENT = 2  # answers that wait for the network while the next one is computed
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


class Client:
    """A socket: questions that wait, by what they ask, and messages to be sent, by their keys."""

    def __init__(self, socket: WebSocket) -> None:
        self.socket, self.loop, self.changed = socket, asyncio.get_running_loop(), asyncio.Event()
        self.waiting: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
        self.unsent: dict[Any, str | bytes] = {}
        self.projects, self.closed, self.turn = False, False, 0

    def post(self, key: Any, message: str | bytes) -> None:
        """Send a message, in place of one with this key that still waits; from any thread."""

        def put() -> None:
            self.unsent[key] = message
            self.changed.set()

        with contextlib.suppress(RuntimeError):  # the loop has ended
            self.loop.call_soon_threadsafe(put)

    async def send(self, worker: Worker) -> None:
        """Send what there is, until TimeoutError: the other side does not read."""
        while True:
            if not self.unsent:
                self.changed.clear()
                await self.changed.wait()
            message = self.unsent.pop(next(iter(self.unsent)))
            kind = "text" if isinstance(message, str) else "bytes"
            await asyncio.wait_for(self.socket.send({"type": "websocket.send", kind: message}), PATIENCE)
            worker.wake()

    async def receive(self, worker: Worker) -> None:
        """Take questions to the end, none while answers pile up; InputError for what is no question."""
        while (event := await self.socket.receive())["type"] == "websocket.receive":
            header, arrays = messages.decode(event.get("text") or event.get("bytes") or b"")
            self.waiting[header["do"]] = header, arrays
            worker.wake()
            while len(self.unsent) > 2 * _UNSENT or len(self.waiting) > 2 * len(QUICK):
                await asyncio.sleep(_PERIOD)


class Worker(threading.Thread):
    """The thread that computes: one question at a time, clients in turn."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(name="ltcl viewer", daemon=True)
        self.scene, self.clients, self.ended = scene, list[Client](), False
        self._shown, self._work, self._turns = scene.pattern, threading.Event(), itertools.count(1)

    def wake(self) -> None:
        """Look for questions."""
        self._work.set()

    def run(self) -> None:
        """Answer until the end."""
        while not self.ended:
            self._work.wait()
            self._work.clear()
            while self._answer_next():
                pass

    def _answer_next(self, among: tuple[str, ...] = ()) -> bool:
        """Answer a question of the client that waits longest for its turn, if there is one."""
        for client in sorted(self.clients, key=lambda client: client.turn):
            for do in list(client.waiting) if len(client.unsent) < _UNSENT else ():
                if not among or do in among:
                    client.turn = next(self._turns)
                    self._answer(client, *client.waiting.pop(do))
                    return True
        return False

    def _answer(self, client: Client, header: dict[str, Any], arrays: dict[str, Any]) -> None:
        number, do = header.pop("id"), header.pop("do")
        reported = time.monotonic()

        def between(iteration: int, residual: float) -> None:
            nonlocal reported
            if self.ended or client.closed or do in client.waiting:
                raise _Superseded
            if (now := time.monotonic()) > reported + _PERIOD:
                facts = {"step": do, "done": iteration, "total": None, "residual": residual}
                client.post("progress", messages.encode({"do": "progress", "id": number, **facts}))
                reported = now
            self._answer_next(QUICK)  # who only wants to look does not wait for the end of a solve

        try:
            facts, pictures = self.scene.answer(do, header | arrays, between)
        except _Superseded:
            return
        except Exception as error:  # noqa: BLE001 - the next question may go well
            kind = "" if isinstance(error, LtclError) else f"internal error: {type(error).__name__}: "
            facts, pictures = {"error": kind + " ".join(str(error).split())}, {}
        client.post(("answer", number), messages.encode({"id": number, "do": do, **facts}, pictures))
        client.projects |= do == "projector"
        if self.scene.pattern is not self._shown or do == "projector":
            self._shown = self.scene.pattern
            if windows := [each for each in list(self.clients) if each.projects]:
                shown = messages.encode({"do": "show"}, {"codes": self.scene.codes()})
                for window in windows:
                    window.post("show", shown)


class _Http(H11Protocol):
    """Connections that stay silent, or last, give way to others."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.loop.call_later(PATIENCE, lambda: self.scope is None and self._drop())
        self.loop.call_later(LIFETIME, self._drop)
        plain = [each for each in self.connections if isinstance(each, _Http)]
        if len(plain) > CONNECTIONS:
            plain[0].transport.abort()

    def _drop(self) -> None:
        if self in self.connections:  # and has not become a socket
            self.transport.abort()


class _Socket(WebSocketsSansIOProtocol):
    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.app_state = {"abort": transport.abort}  # which, unlike close, does not wait for a reader


class Viewer:
    """A viewer in threads of its own until `close`, or the end of a with block; `url` is its page."""

    def __init__(self, scene: Scene, host: str, port: int) -> None:
        token, address = secrets.token_urlsafe(24), _address(host)
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listening = socket.create_server((host, checks.count("port", port, least=0)), family=family)
        except (OSError, OverflowError) as error:
            raise InputError(f"host is {host!r}, port {port}: {error}; they must be free here") from None
        self.is_local = host == "localhost" or (address is not None and address.is_loopback)
        name = socket.gethostname() if address is not None and address.is_unspecified else host
        name, self._port = f"[{name}]" if ":" in name else name, self._listening.getsockname()[1]
        self._names = {"127.0.0.1", "localhost", "[::1]", name.lower()}
        self.url, self._token = f"http://{name}:{self._port}/{token}/", token.encode()
        page = (Path(__file__).parent / "page").iterdir()
        self._files = {file.name: file.read_bytes() for file in page if file.suffix in TYPES}
        self._worker = Worker(scene)
        self._uploads, self._decoding = asyncio.Semaphore(UPLOADS), asyncio.Lock()
        config = uvicorn.Config(
            self._application,
            interface="asgi3",
            http=_Http,
            ws=_Socket,
            ws_max_size=messages.largest(max(scene.T.shape)),
            ws_per_message_deflate=False,  # which takes longer than a loopback
            lifespan="off",
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=1,
        )
        self._uvicorn = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._uvicorn.run, args=([self._listening],), daemon=True)
        self._worker.start()
        self._thread.start()

    def wait(self) -> None:
        """Until the viewer is closed."""
        while self._thread.is_alive():
            self._thread.join(0.5)  # which Ctrl-C interrupts on any system

    def close(self) -> None:
        """End it; pages say that they lost it."""
        self._worker.ended = self._uvicorn.should_exit = True
        self._worker.wake()
        self._thread.join()

    def __enter__(self) -> Viewer:
        return self

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
        is_allowed = secrets.compare_digest(token.encode("utf-8", "replace"), self._token)
        is_allowed &= len(hosts) == 1 and self._is_own(hosts[0])
        is_allowed &= origins == [f"http://{hosts[0]}" if hosts else ""] or (reads and not origins)
        if scope["type"] == "websocket":
            websocket = WebSocket(scope, receive, send)
            if is_allowed and path == "socket" and len(self._worker.clients) < SOCKETS:
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
            return await self._upload(request)
        name = {"": "index.html", "projector": "projector.html"}.get(path, path)
        content = self._files.get(name)
        if path.startswith("result/"):
            name = path.removeprefix("result/")
            content = await asyncio.to_thread(self._worker.scene.result, name)
        if content is None or not reads:
            return Response("not found", 404)
        return Response(content, media_type=TYPES[Path(name).suffix])

    async def _upload(self, request: Request) -> Response:
        name, content = request.query_params.get("name", "")[:255], bytearray()
        async with self._uploads:
            async for chunk in request.stream():
                content += chunk
                if len(content) > LARGEST_FILE:
                    return JSONResponse({"error": f"{name!r} has more than {LARGEST_FILE} bytes"}, 413)
            async with self._decoding:
                try:
                    return JSONResponse(await asyncio.to_thread(self._worker.scene.upload, name, content))
                except LtclError as error:
                    return JSONResponse({"error": " ".join(str(error).split())}, 400)

    async def _serve(self, websocket: WebSocket) -> None:
        await websocket.accept()
        client, worker = Client(websocket), self._worker
        client.post("hello", messages.encode({"do": "hello", **worker.scene.hello()}))
        worker.clients.append(client)
        tasks = [asyncio.ensure_future(each(worker)) for each in (client.receive, client.send)]
        try:
            (ended, *_), _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if isinstance(error := ended.exception(), InputError):
                await asyncio.wait_for(websocket.close(1008, f"{error}"[:100]), PATIENCE)
            elif error is not None:
                websocket.state.abort()
        finally:
            client.closed = True
            worker.clients.remove(client)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


def _address(host: str) -> Any:
    """The IP address that a text is, or None."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host)
    return None
