# SPDX-License-Identifier: BSD-3-Clause
"""Control of a running show: by Python, or by OSC (Open Sound Control) over UDP.

`ShowControl` holds what is asked for; the projection looks at it before each frame. `OscServer`
takes messages for it:

    /ltcl/gain G            brightness of the target, or "follow"
    /ltcl/bounds LOW HIGH   darkest and brightest light of the projector
    /ltcl/picture NAME      a picture of the folder in place of the film; without NAME the film
    /ltcl/blackout 1        black, or 0
    /ltcl/freeze 1          the codes of the last frame stay, or 0
    /ltcl/projector N 1     projector N of a combination, counted from 1, is on, or 0
    /ltcl/statistics [PORT] asks for these, at the port of the sender or at PORT

and answers, to the sender,

    /ltcl/statistics FRAMES DROPPED P50 P99 GAIN   times in seconds
    /ltcl/error TEXT

Known limit: UDP has no senders that can be trusted; whoever reaches the port controls the show.
"""

from __future__ import annotations

import contextlib
import logging
import math
import socketserver
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.errors import InputError, LtclError
from ltcl.tasks.compensation import FrameStatistics

PREFIX = "/ltcl/"
MAX_PORT = 65535
FOLLOW = "follow"

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ShowState:
    """State that the operator of a show asks for.

    Attributes
    ----------
    gain : float, "follow" or None
        None: the one that the show began with.
    bounds : (float, float) or None
    picture : ndarray or None
        Shown in place of the film.
    is_black, is_frozen : bool
    off : frozenset of int
        Projectors that get black, counted from 1.
    """

    gain: float | str | None = None
    bounds: tuple[float, float] | None = None
    picture: np.ndarray | None = None
    is_black: bool = False
    is_frozen: bool = False
    off: frozenset[int] = frozenset()


class ShowControl:
    """Requests to a running show; any thread may call it.

    Parameters
    ----------
    pictures : Path, optional
        Folder of the pictures that may be shown in place of the film.

    Examples
    --------
    >>> control = ShowControl()
    >>> control.set_gain(0.5)
    >>> control.set_black(True)
    >>> control.state.gain, control.state.is_black
    (0.5, True)
    """

    def __init__(self, pictures: Path | None = None) -> None:
        self._pictures = pictures
        self._lock = threading.Lock()
        self.state = ShowState()
        # Projectors of the show; None before it has begun.
        self.projectors: int | None = None
        # The show says here what it has done, and tells errors there.
        self.read_statistics: Callable[[], FrameStatistics] | None = None
        self.on_error: Callable[[str], None] = _logger.warning

    def set_gain(self, gain: float | str) -> None:
        """Set the gain, a number above 0 or "follow"."""
        if gain != FOLLOW:
            gain = checks.number("gain", gain, above=0.0)
        self._update(gain=gain)

    def set_bounds(self, low: float, high: float) -> None:
        """Set the darkest and the brightest light of the projector."""
        self._update(bounds=checks.interval("bounds", (low, high)))

    def show_picture(self, name: str | None) -> None:
        """Show a picture of the folder in place of the film; None shows the film."""
        if name is None or name == "":
            self._update(picture=None)
            return
        if not isinstance(name, str):
            raise InputError(f"picture is {name!r}; it must be the name of a picture")
        if self._pictures is None:
            raise InputError(f"picture is {name!r}, but there is no folder of pictures")
        if Path(name).name != name or name.startswith("."):
            raise InputError(f"picture is {name!r}; it must be a name in {self._pictures}")
        self._update(picture=images.read(self._pictures / name))

    def set_black(self, is_black: bool) -> None:
        """Show black, or the film again."""
        self._update(is_black=is_black)

    def set_frozen(self, is_frozen: bool) -> None:
        """Keep the codes of the last frame, or go on."""
        self._update(is_frozen=is_frozen)

    def set_projector(self, number: int, is_on: bool) -> None:
        """Switch a projector on or off; one that is off gets black."""
        checks.count("projector", number)
        if self.projectors is None and number > 1:
            raise InputError(
                f"projector is {number}, but the show has not begun; its projectors are not known "
                "yet"
            )
        checks.count("projector", number, most=self.projectors)
        with self._lock:
            others = self.state.off - {number}
            off = others if is_on else others | {number}
            self.state = replace(self.state, off=off)

    def statistics(self) -> FrameStatistics:
        """Numbers of the show so far; InputError before it has begun."""
        if self.read_statistics is None:
            raise InputError("the show has not begun; there are no statistics yet")
        return self.read_statistics()

    def _update(self, **values: Any) -> None:
        with self._lock:
            self.state = replace(self.state, **values)


class _DatagramServer(socketserver.UDPServer):
    """Hands each datagram and its sender to a function."""

    def __init__(
        self, address: tuple[str, int], take: Callable[[bytes, tuple[str, int]], None]
    ) -> None:
        super().__init__(address, socketserver.BaseRequestHandler)
        self._take = take

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Hand over one datagram."""
        self._take(request[0], client_address)


class OscServer(contextlib.AbstractContextManager):
    """Takes OSC messages for a show, in a thread of its own.

    Parameters
    ----------
    control : ShowControl
    port : int
        UDP port; 0 for a free one.
    host : str
        Address to listen on.

    Attributes
    ----------
    host, port : str, int
        Where it listens.

    Raises
    ------
    InputError
        python-osc is missing, or the address cannot be listened on.
    """

    def __init__(self, control: ShowControl, port: int, host: str = "127.0.0.1") -> None:
        checks.load_extra("pythonosc", "show", "OSC")
        self._control = control
        # Of the last message.
        self._sender: tuple[str, int] | None = None
        try:
            self._server = _DatagramServer((host, port), self._take)
        except (OSError, OverflowError) as error:
            raise InputError(f"OSC cannot listen on {host}:{port}: {error}") from error
        self.host, self.port = self._server.server_address[:2]
        control.on_error = self._tell_error
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="ltcl-osc", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Listen no longer."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take(self, datagram: bytes, sender: tuple[str, int]) -> None:
        """Obey the messages of a datagram."""
        from pythonosc.osc_packet import OscPacket

        self._sender = sender
        try:
            messages = OscPacket(datagram).messages
        except Exception:  # noqa: BLE001 - whatever the parser makes of bytes of strangers
            self._tell_error(f"datagram of {len(datagram)} bytes is no OSC message")
            return
        # Those of a bundle for a later time, too: waiting for it would hold up all others.
        for timed in messages:
            self._receive(sender, timed.message.address, timed.message.params)

    def _receive(self, sender: tuple[str, int], address: str, values: Sequence[Any]) -> None:
        try:
            self._obey(sender, address, values)
        except (LtclError, TypeError, ValueError) as error:
            self._tell_error(f"{address}: {' '.join(str(error).split())}")

    def _obey(self, sender: tuple[str, int], address: str, values: Sequence[Any]) -> None:
        name = address.removeprefix(PREFIX)
        control = self._control
        if name == "gain":
            control.set_gain(*_counted(values, 1))
        elif name == "bounds":
            control.set_bounds(*_counted(values, 2))
        elif name == "picture":
            control.show_picture(_counted(values, 1)[0] if values else None)
        elif name == "blackout":
            control.set_black(_flag(*_counted(values, 1)))
        elif name == "freeze":
            control.set_frozen(_flag(*_counted(values, 1)))
        elif name == "projector":
            number, is_on = _counted(values, 2)
            control.set_projector(_whole(number), _flag(is_on))
        elif name == "statistics":
            port = sender[1]
            if values:
                port = checks.count("port", _whole(*_counted(values, 1)), most=MAX_PORT)
            self._send_statistics((sender[0], port))
        else:
            raise InputError("is no address of a show")

    def _send_statistics(self, receiver: tuple[str, int]) -> None:
        numbers = self._control.statistics()
        times = [numbers.latency_p50, numbers.latency_p99]
        times = [0.0 if math.isnan(seconds) else seconds for seconds in times]
        values = [numbers.frames, numbers.dropped, *times, float(numbers.gain)]
        self._send(receiver, "statistics", values)

    def _tell_error(self, text: str) -> None:
        _logger.warning("%s", text)
        if self._sender is not None:
            self._send(self._sender, "error", [text])

    def _send(self, receiver: tuple[str, int], name: str, values: Sequence[Any]) -> None:
        from pythonosc.osc_message_builder import OscMessageBuilder

        builder = OscMessageBuilder(address=PREFIX + name)
        for value in values:
            builder.add_arg(value)
        with contextlib.suppress(OSError, OverflowError):
            self._server.socket.sendto(builder.build().dgram, receiver)


def _counted(values: Sequence[Any], count: int) -> Sequence[Any]:
    if len(values) != count:
        raise InputError(f"has {len(values)} values; it must have {count}")
    return values


def _whole(value: Any) -> Any:
    """A whole number, also from controllers that send all numbers as floats."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def _flag(value: Any) -> bool:
    if value not in (0, 1):
        raise InputError(f"is {value!r}; it must be 0 or 1")
    return bool(value)
