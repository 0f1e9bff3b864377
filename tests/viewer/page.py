# SPDX-License-Identifier: BSD-3-Clause
"""Page without a browser: it asks the viewer by its protocol, written down here once more."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import numpy as np
from websockets.sync.client import ClientConnection, connect

TYPES = {"f4": "<f4", "u1": "u1"}


def question(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> str | bytes:
    """Make a frame with arrays (h, w, c), or files (size,), their numbers as they are."""
    if not arrays:
        return json.dumps(header)
    kinds = {name: f"{array.dtype.kind}{array.dtype.itemsize}" for name, array in arrays.items()}
    entries = [
        {"name": name, "shape": list(array.shape), "dtype": kinds[name]}
        for name, array in arrays.items()
    ]
    text = json.dumps({**header, "arrays": entries}).encode()
    text += b" " * (-len(text) % 4)
    bodies = [array.tobytes() for array in arrays.values()]
    padded = b"".join(body + bytes(-len(body) % 4) for body in bodies)
    return len(text).to_bytes(4, "little") + text + padded


def answer(message: str | bytes) -> dict[str, Any]:
    """Return a header with its arrays, float64, by their names."""
    if isinstance(message, str):
        return json.loads(message)
    start = 4 + int.from_bytes(message[:4], "little")
    header = json.loads(message[4:start])
    for entry in header.pop("arrays"):
        assert start % 4 == 0
        numbers = np.frombuffer(message, TYPES[entry["dtype"]], int(np.prod(entry["shape"])), start)
        is_file = len(entry["shape"]) == 1
        picture = numbers.reshape(entry["shape"]).astype(np.float64)
        header[entry["name"]] = numbers.tobytes() if is_file else picture
        start += numbers.nbytes + -numbers.nbytes % 4
    assert start == len(message)
    return header


class Page:
    """A socket to a viewer, with its first message."""

    def __init__(self, url: str, **settings: Any) -> None:
        origin = "/".join(url.split("/")[:3])
        settings = {"origin": origin, "max_size": None, "compression": None, **settings}
        self.url = url
        self.origin = origin
        self._opened = contextlib.ExitStack()
        opening = connect(url.replace("http", "ws", 1) + "socket", **settings)
        self.socket: ClientConnection = self._opened.enter_context(opening)
        self.hello = self.next()
        self.asked = 0

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def send(self, do: str, arrays: dict[str, np.ndarray] | None = None, **fields: Any) -> int:
        """Ask without waiting; return the number of the question."""
        self.asked += 1
        self.socket.send(question({"id": self.asked, "do": do, **fields}, arrays or {}))
        return self.asked

    def next(self) -> dict[str, Any]:
        """Return the next message."""
        return answer(self.socket.recv(timeout=60))

    def upload(self, name: Any, content: bytes) -> dict[str, Any]:
        """Give a file; return the answer without its number and kind."""
        answer = self.ask("upload", {"content": np.frombuffer(content, np.uint8)}, name=name)
        del answer["id"], answer["do"]
        return answer

    def ask(self, do: str, arrays: Any = None, **fields: Any) -> dict[str, Any]:
        """Return the answer to a question, without the messages before it."""
        number = self.send(do, arrays, **fields)
        while (found := self.next()).get("id") != number or found["do"] != do:
            pass
        return found
