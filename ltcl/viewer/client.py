# SPDX-License-Identifier: BSD-3-Clause
"""`Client`: the questions of a page and their answers, over any `Carrier`.

A product does not wait for a solve: each kind of question has a thread. A question that a page asks
again replaces the one that waits. A page that does not read its answers is closed, and delays
nobody. A page asks through a socket (`server`) or the kernel of a notebook (`widget`).
"""

from __future__ import annotations

import asyncio
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

from ltcl import checks
from ltcl.errors import LtclError
from ltcl.viewer import messages

# Seconds within which a page has to read an answer.
READ_SECONDS = 5.0
# Seconds between two reports of progress.
PROGRESS_PERIOD = 0.1


class Superseded(Exception):
    """Nobody waits for the computation any more."""


class PageGone(Exception):
    """The page has gone."""


class Carrier(Protocol):
    """Carries messages between a page and its client, whole and in their order."""

    async def receive(self) -> str | bytes:
        """Return the next message of the page; PageGone if it has gone."""
        ...

    async def send(self, message: str | bytes) -> None:
        """Give a message to the page; TimeoutError if it does not read within `READ_SECONDS`."""
        ...


class Threads:
    """A thread for each kind of question."""

    def __init__(self) -> None:
        self._executors: defaultdict[str, ThreadPoolExecutor] = defaultdict(_one_thread)

    async def run(self, kind: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of a call in the thread for its kind, one after the other."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._executors[kind], call, *arguments)

    def close(self) -> None:
        """End the threads, without waiting for what they compute."""
        for executor in self._executors.values():
            executor.shutdown(wait=False, cancel_futures=True)
        self._executors.clear()


def _one_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1)


class Client:
    """A page, and of each kind of question the newest that waits."""

    def __init__(
        self, carrier: Carrier, scene: Any, threads: Threads, clients: list[Client]
    ) -> None:
        self._carrier = carrier
        self._scene = scene
        self._threads = threads
        # All pages that are open, this one included.
        self._clients = clients
        self._loop = asyncio.get_running_loop()
        self._pattern_changed = asyncio.Event()
        # Number and fields of a question, by kind.
        self._waiting: dict[str, tuple[float, dict[str, Any]]] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}

    async def serve(self) -> None:
        """Take questions until the page goes.

        InputError for an invalid one, PageGone, and TimeoutError if the page does not read, all in
        an ExceptionGroup.
        """
        await self._send(messages.encode({"do": "hello", **self._scene.hello()}))
        async with asyncio.TaskGroup() as group:
            while True:
                self._take(await self._carrier.receive(), group)

    def refresh(self) -> None:
        """Look for a new pattern; from any thread."""
        self._loop.call_soon_threadsafe(self._pattern_changed.set)

    def _take(self, message: str | bytes, group: asyncio.TaskGroup) -> None:
        """Let a question wait for its turn."""
        header, arrays = messages.decode(message)
        do = checks.one_of("do", header.pop("do"), self._scene.questions)
        number = header.pop("id")
        self._waiting[do] = (number, {**header, **arrays})
        if do not in self._tasks or self._tasks[do].done():
            self._tasks[do] = group.create_task(self._answer(do))
        if do == "projector" and "show" not in self._tasks:
            self._tasks["show"] = group.create_task(self._show_patterns())

    async def _answer(self, do: str) -> None:
        """Answer questions of a kind while there are any, then let windows look for patterns."""
        while do in self._waiting:
            number, asked = self._waiting.pop(do)
            message = await self._threads.run(do, self._compute, do, number, asked)
            if message is not None:
                await self._send(message)
            for client in self._clients:
                client._pattern_changed.set()

    async def _show_patterns(self) -> None:
        """Send the codes of every new pattern to a projector window."""
        shown = None
        while True:
            pattern = self._scene.pattern
            if pattern is not shown:
                white = self._scene.white
                codes = await self._threads.run("show", self._scene.codes, pattern, white)
                header = {"do": "show", "title": self._scene.title}
                await self._send(messages.encode(header, {"codes": codes}))
                shown = pattern
            await self._pattern_changed.wait()
            self._pattern_changed.clear()

    async def _send(self, message: str | bytes) -> None:
        """Send a message; TimeoutError if the page does not read."""
        # Not `wait_for`: in Python 3.11 it loses a cancellation that comes as the message is sent.
        async with asyncio.timeout(READ_SECONDS):
            await self._carrier.send(message)

    def _compute(self, do: str, number: float, asked: dict[str, Any]) -> str | bytes | None:
        """Return the message with the answer, in a thread; None if it would come too late."""
        callback = _SolveCallback(self, do, number)
        try:
            facts, pictures = self._scene.answer(do, asked, callback)
            return messages.encode({"id": number, "do": do, **facts}, pictures)
        except Superseded:
            return None
        except Exception as error:  # noqa: BLE001 - the next question may go well
            line = " ".join(str(error).split())
            if not isinstance(error, LtclError):
                line = f"internal error: {type(error).__name__}: {line}"
            return messages.encode({"id": number, "do": do, "error": line})

    def is_superseded(self, do: str) -> bool:
        """True if the page has gone, or has asked again."""
        return self not in self._clients or do in self._waiting

    def send_soon(self, header: dict[str, Any]) -> None:
        """Send a message without pictures; from any thread."""
        sending = self._send(messages.encode(header))
        asyncio.run_coroutine_threadsafe(sending, self._loop)


class _SolveCallback:
    """Reports the progress of a solve to a page, and ends one that nobody waits for."""

    def __init__(self, client: Client, do: str, number: float) -> None:
        self._client = client
        self._do = do
        self._number = number
        self._reported_at = time.monotonic()

    def __call__(self, iteration: int, residual: float) -> None:
        if self._client.is_superseded(self._do):
            raise Superseded
        now = time.monotonic()
        if now <= self._reported_at + PROGRESS_PERIOD:
            return
        self._reported_at = now
        self._client.send_soon(
            {
                "do": "progress",
                "id": self._number,
                "step": self._do,
                "done": iteration,
                "total": None,
                "residual": residual,
            }
        )
