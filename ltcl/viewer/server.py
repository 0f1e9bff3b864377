# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's server: who may ask, whose turn it is, and what is sent to whom.

Addresses begin with a random token. Whoever lacks it, or comes from another origin or under another host's
name (DNS rebinding), gets 403 whatever else is asked. Pages ask through one WebSocket each. One thread
computes, since the device is one; connections take turns; what one of them asks again takes the place of what
waits. One that does not read its answers is closed, and delays nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import secrets
import socket
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from ltcl.errors import InputError, LtclError
from ltcl.viewer import messages
from ltcl.viewer.answers import QUICK, Scene

TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
SOCKETS, CONNECTIONS = 32, 256
PATIENCE, LIFETIME = 5.0, 60.0  # seconds for a socket to read an answer; for a request without a socket
_UNSENT = 2  # answers that wait for the network while the next one is computed
_PROGRESS = 0.1  # seconds between two reports
_FRAMES = "'self' http://127.0.0.1:* http://localhost:*"  # notebooks
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; media-src 'self' blob:; "
    "connect-src 'self' ws://{}; base-uri 'none'; form-action 'none'; frame-ancestors " + _FRAMES
)


class Superseded(Exception):
    """What is computed is not wanted any more."""


class Client:
    """One socket: questions that wait, by what they ask, and messages that are to be sent, by their keys."""

    def __init__(self, socket: WebSocket) -> None:
        self.socket, self.loop = socket, asyncio.get_running_loop()
        self.waiting: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
        self.unsent: dict[Any, str | bytes] = {}
        self.news, self.room = asyncio.Event(), asyncio.Event()
        self.projects = self.closed = False

    def post(self, key: Any, message: str | bytes) -> None:
        """Send a message in place of one with this key that was not sent yet; from any thread."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self.loop.call_soon_threadsafe(self._post, key, message)

    def _post(self, key: Any, message: str | bytes) -> None:
        self.unsent[key] = message
        self.news.set()

    async def send(self, worker: Worker) -> None:
        """Send what there is, for ever; TimeoutError where the other side does not read."""
        while True:
            await self.news.wait()
            self.news.clear()
            while self.unsent:
                message = self.unsent.pop(next(iter(self.unsent)))
                sent = self.socket.send_text if isinstance(message, str) else self.socket.send_bytes
                await asyncio.wait_for(sent(message), PATIENCE)
                self.room.set()
                worker.wake()

    async def receive(self, worker: Worker) -> None:
        """Take questions, for ever; none while answers pile up."""
        while True:
            event = await self.socket.receive()
            if event["type"] == "websocket.disconnect":
                return
            header, arrays = messages.decode(event.get("text") or event.get("bytes") or b"")
            worker.ask(self, header, arrays)
            while len(self.unsent) > 4 * _UNSENT:
                self.room.clear()
                await self.room.wait()


class Worker(threading.Thread):
    """The thread that computes, one question at a time, clients in turn."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(name="ltcl viewer", daemon=True)
        self.scene, self.clients, self.ended = scene, deque[Client](), False
        self._changed = threading.Condition()

    def wake(self) -> None:
        """Look again for what can be done."""
        with self._changed:
            self._changed.notify()

    def ask(self, client: Client, header: dict[str, Any], arrays: dict[str, Any]) -> None:
        """Queue a question in place of one that asks for the same and waits."""
        if header["do"] == "projector":
            client.projects = True
            client.post("show", self._shown())
            return
        with self._changed:
            client.waiting[header["do"]] = header, arrays
            self._changed.notify()

    def run(self) -> None:
        """Answer until the end."""
        while not self.ended:
            with self._changed:
                turn = self._take()
                if turn is None:
                    self._changed.wait()
            if turn is not None:
                self._answer(*turn)

    def _take(self, among: tuple[str, ...] = ()) -> tuple[Client, dict[str, Any], dict[str, Any]] | None:
        for client in list(self.clients):
            if len(client.unsent) < _UNSENT:
                for do in client.waiting:
                    if not among or do in among:
                        self.clients.remove(client)
                        self.clients.append(client)
                        return client, *client.waiting.pop(do)
        return None

    def _answer(self, client: Client, header: dict[str, Any], arrays: dict[str, Any]) -> None:
        own, asked = {"id": header.pop("id"), "do": header.pop("do")}, header | arrays
        pattern, reported = self.scene.pattern, 0.0

        def between(iteration: int, residual: float) -> None:
            nonlocal reported
            if self.ended or client.closed or own["do"] in client.waiting:
                raise Superseded
            if time.monotonic() > reported + _PROGRESS:
                reported = time.monotonic()
                step = {"id": own["id"], "do": "progress", "step": own["do"], "done": iteration}
                client.post("progress", messages.encode(step | {"residual": residual}))
            with self._changed:  # who only wants to look does not wait for the end of a solve
                turn = self._take(QUICK)
            if turn is not None:
                self._answer(*turn)

        try:
            facts, pictures = self.scene.answer(own["do"], asked, between)
            message = messages.encode(own | facts, pictures)
        except Superseded:
            return
        except LtclError as error:
            message = messages.encode(own | {"error": " ".join(str(error).split())})
        except Exception as error:  # noqa: BLE001 - the next question may go well
            message = messages.encode(own | {"error": f"internal error: {type(error).__name__}: {error}"})
        client.post(("answer", own["id"]), message)
        if self.scene.pattern is not pattern:
            windows = [each for each in self.clients if each.projects]
            shown = self._shown() if windows else ""
            for window in windows:
                window.post("show", shown)

    def _shown(self) -> bytes:
        return messages.encode({"do": "show"}, {"codes": self.scene.codes()})


class _Http(H11Protocol):
    """Connections that stay silent, or hold on, give way to others."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.loop.call_later(PATIENCE, lambda: self.scope is None and self._drop())
        self.loop.call_later(LIFETIME, self._drop)
        if len(self.connections) > CONNECTIONS:
            oldest = next((each for each in self.connections if isinstance(each, _Http)), self)
            oldest.transport.abort()

    def _drop(self) -> None:
        if self in self.connections:  # and no socket
            self.transport.abort()


class _Socket(WebSocketsSansIOProtocol):
    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.app_state = {"abort": transport.abort}  # which, unlike close, does not wait for a reader


class Server:
    """The application, and uvicorn in a thread of its own; `url` has the token."""

    def __init__(self, scene: Scene, host: str, port: int) -> None:
        self.scene, self.worker, self.token = scene, Worker(scene), secrets.token_urlsafe(24)
        self._files = {
            file.name: (TYPES[file.suffix], file.read_bytes())
            for file in (Path(__file__).parent / "page").iterdir()
            if file.suffix in TYPES
        }
        self._host, address = host.lower(), ipaddress_of(host)
        self.is_local = self._host == "localhost" or (address is not None and address.is_loopback)
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listening = socket.create_server((host, port), family=family)
        except OSError as error:
            raise InputError(f"host is {host!r} and port {port}: {error.strerror or error}") from None
        self.port = self._listening.getsockname()[1]
        shown = socket.gethostname() if address is not None and address.is_unspecified else host
        self.url = f"http://{f'[{shown}]' if ':' in shown else shown}:{self.port}/{self.token}/"
        routes = [
            Route("/", self._file),
            Route("/{name}", self._file),
            WebSocketRoute("/socket", self._socket),
        ]
        self._application = Starlette(routes=routes)
        self._application.router.redirect_slashes = False
        T = scene.T
        config = uvicorn.Config(
            self._guard,
            http=_Http,
            ws=_Socket,
            ws_max_size=messages.largest(max(T.shape)),
            ws_per_message_deflate=False,  # which takes longer than a loopback
            lifespan="off",
            interface="asgi3",
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=1,
        )
        self._uvicorn = uvicorn.Server(config)
        run = {"sockets": [self._listening]}
        self._thread = threading.Thread(target=self._uvicorn.run, kwargs=run, name="ltcl server", daemon=True)
        self.worker.start()
        self._thread.start()

    def wait(self) -> None:
        """Until the server ends."""
        while self._thread.is_alive():
            self._thread.join(0.5)  # which Ctrl-C interrupts on any system

    def close(self) -> None:
        """End it; pages say that they lost it."""
        self.worker.ended = self._uvicorn.should_exit = True
        self.worker.wake()
        self._thread.join()

    async def _guard(self, scope: Any, receive: Any, send: Any) -> None:
        """Everything passes here: 403 without a word about what there is, unless all is right."""
        headers: dict[bytes, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name, []).append(value.decode("latin-1"))
        hosts, origins = headers.get(b"host", []), headers.get(b"origin", [])
        token, slash, name = scope["path"].removeprefix("/").partition("/")
        is_own = secrets.compare_digest(token.encode("utf-8", "replace"), self.token.encode())
        is_own &= len(hosts) == 1 and self._is_host(hosts[0])
        plain = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        is_own &= origins == [f"http://{''.join(hosts)}"] or (plain and not origins)
        if not is_own:
            if scope["type"] == "websocket":
                await receive()
                await send({"type": "websocket.close"})
            else:
                await Response("forbidden", 403)(scope, receive, send)
            return
        policy = _POLICY.format(hosts[0])
        safe = {"content-security-policy": policy, "x-content-type-options": "nosniff"}
        safe |= {"referrer-policy": "no-referrer", "cache-control": "no-store"}
        safe |= {"cross-origin-resource-policy": "same-origin"}

        async def safely(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] += [(name.encode(), value.encode()) for name, value in safe.items()]
            await send(message)

        await self._application({**scope, "path": slash + name, "root_path": ""}, receive, safely)

    def _is_host(self, name: str) -> bool:
        """Whether a Host header means this server, by a name that no other site can give it."""
        host, _, port = name.rpartition(":")
        host = host.strip("[]").lower()
        if port != str(self.port):
            return False
        address = ipaddress_of(host)
        if self.is_local:
            return host == "localhost" or (address is not None and address.is_loopback)
        return address is not None or host in ("localhost", self._host, socket.gethostname().lower())

    async def _file(self, request: Request) -> Response:
        name = request.path_params.get("name", "index.html")
        kind, content = self._files.get({"projector": "projector.html"}.get(name, name), (None, b"not found"))
        return Response(content, 200 if kind else 404, media_type=kind or "text/plain")

    async def _socket(self, socket: WebSocket) -> None:
        if len(self.worker.clients) >= SOCKETS:
            await socket.close()
            return
        await socket.accept()
        client = Client(socket)
        client._post("hello", messages.encode({"do": "hello", **self.scene.hello()}))
        self.worker.clients.append(client)
        tasks = [asyncio.ensure_future(each(self.worker)) for each in (client.receive, client.send)]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                with contextlib.suppress(WebSocketDisconnect):
                    task.result()
        except TimeoutError:
            socket.state.abort()
        except InputError as error:
            await asyncio.wait_for(socket.close(1008, str(error)[:100]), PATIENCE)
        finally:
            client.closed = True
            client.waiting.clear()
            self.worker.clients.remove(client)
            for task in tasks:
                task.cancel()


def ipaddress_of(host: str) -> Any:
    """The address that a text is, or None of a name."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host)
    return None
