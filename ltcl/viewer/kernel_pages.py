# SPDX-License-Identifier: BSD-3-Clause
"""`KernelPages`: pages that ask through the kernel of a notebook.

Each view of a widget is a page of its own, whose name is in all of its messages:

    to Python  {"page": name, "event": "open" or "close"}
               {"page": name, "text": message}
               {"page": name, "more": bool} with bytes, parts of a message, in their order
    to a page  {"page": name, "text": message}, {"page": name} with the bytes of a message
               {"page": name, "computing": true} where an answer takes its time
               {"page": name, "lost": reason}

The kernel may be busy with a cell, and its messages wait. What has come is answered in a thread,
with an event loop of its own.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any

from ltcl.errors import InputError
from ltcl.viewer import messages
from ltcl.viewer.client import Client, PageGone, Threads

# Pages at a time; the oldest gives way, which may have gone without a word.
MAX_PAGES = 32
# Seconds without an answer after which a page is told that one is computed.
COMPUTING_SECONDS = 1.0
# Seconds without a page after which the memory of the device is given back.
IDLE_SECONDS = 60.0
# Content and buffers of a message to the front end.
Send = Callable[[dict[str, Any], list[bytes]], None]


class CommCarrier:
    """Carries messages of one page through the kernel."""

    def __init__(self, page: str, send: Send, largest: int) -> None:
        self.page = page
        self._send = send
        self._largest = largest
        self._parts: list[bytes] = []
        self._computing: asyncio.TimerHandle | None = None
        self._arrived: asyncio.Queue[str | bytes | None] = asyncio.Queue()

    def take(self, content: dict[str, Any], buffers: list[bytes]) -> None:
        """Take a message, or a part of one."""
        text = content.get("text")
        if isinstance(text, str):
            self._put(text)
            return
        self._parts += buffers
        if sum(map(len, self._parts)) > self._largest:
            # It is no question; the client says so.
            self._parts = [b""]
        if not content.get("more"):
            self._put(b"".join(self._parts))
            self._parts = []

    def _put(self, message: str | bytes) -> None:
        self._arrived.put_nowait(message)
        self._stop_telling()
        loop = asyncio.get_running_loop()
        self._computing = loop.call_later(COMPUTING_SECONDS, self._tell)

    def _tell(self) -> None:
        self._send({"page": self.page, "computing": True}, [])

    def _stop_telling(self) -> None:
        if self._computing is not None:
            self._computing.cancel()

    def leave(self) -> None:
        """Take note that the page has gone."""
        self._stop_telling()
        self._arrived.put_nowait(None)

    def lose(self, reason: str) -> None:
        """Tell the page that there is nobody to ask."""
        self._send({"page": self.page, "lost": reason}, [])

    async def receive(self) -> str | bytes:
        """Return the next message of the page; PageGone if it has gone."""
        message = await self._arrived.get()
        if message is None:
            raise PageGone
        return message

    async def send(self, message: str | bytes) -> None:
        """Hand a message over to the kernel, which never waits for a page."""
        self._stop_telling()
        if isinstance(message, str):
            self._send({"page": self.page, "text": message}, [])
        else:
            self._send({"page": self.page}, [message])


class KernelPages:
    """All pages of a widget, until `close`.

    `send` gives a message to the front end, from any thread. When no page has been open for
    `IDLE_SECONDS`, the scene lets go of its transport, and takes it up again for the next page.
    """

    def __init__(self, scene: Any, send: Send) -> None:
        self._scene: Any = scene
        self._send = send
        self._clients: list[Client] = []
        self._threads = Threads()
        self._carriers: dict[str, CommCarrier] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._idle: asyncio.TimerHandle | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def take(self, content: Any, buffers: list[bytes]) -> None:
        """Take a message of the front end; from any thread."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._deliver, content, buffers)

    def close(self) -> None:
        """End all pages and their computations, and let go of the scene."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._threads.close()
        self._scene = None

    def _run(self) -> None:
        """Run the event loop; at its end no page is left."""
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            self._loop.run_until_complete(asyncio.wait(self._tasks))
        self._loop.close()

    def _deliver(self, content: Any, buffers: list[bytes]) -> None:
        """Give a message to its page."""
        if not isinstance(content, dict) or not isinstance(content.get("page"), str):
            return
        page = content["page"]
        if content.get("event") == "open":
            if page not in self._carriers:
                self._open(page)
        elif page not in self._carriers:
            return
        elif content.get("event") == "close":
            self._carriers[page].leave()
        else:
            self._carriers[page].take(content, buffers)

    def _open(self, page: str) -> None:
        largest = messages.largest_question(self._scene.pixels)
        carrier = CommCarrier(page, self._send, largest)
        if not self._scene.resume():
            carrier.lose("The transport is no longer in memory: run the cell again")
            return
        if len(self._carriers) >= MAX_PAGES:
            oldest = next(iter(self._carriers))
            self._carriers.pop(oldest).leave()
        self._carriers[page] = carrier
        if self._idle is not None:
            self._idle.cancel()
        task = self._loop.create_task(self._serve(carrier))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, carrier: CommCarrier) -> None:
        """Serve a page until it goes."""
        client = Client(carrier, self._scene, self._threads, self._clients)
        self._clients.append(client)
        try:
            await client.serve()
        except* InputError as errors:
            carrier.lose(str(errors.exceptions[0]))
        except* PageGone:
            pass
        finally:
            self._clients.remove(client)
            self._carriers.pop(carrier.page, None)
            if not self._clients:
                self._idle = self._loop.call_later(IDLE_SECONDS, self._release)

    def _release(self) -> None:
        if not self._clients:
            self._scene.release()
