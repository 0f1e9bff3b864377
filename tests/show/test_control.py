# SPDX-License-Identifier: BSD-3-Clause
"""A show that OSC controls, with messages of python-osc over UDP."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pythonosc.udp_client import DispatchClient

import ltcl
from ltcl import errors, images
from ltcl.show.control import OscServer, ShowControl
from ltcl.show.projection import Projection
from ltcl.viewer.answers import ViewerScene

PATIENCE = 20.0


class Client(DispatchClient):
    """Another program, which sends and takes messages."""

    def __init__(self, port: int) -> None:
        super().__init__("127.0.0.1", port)
        self.answers: list[tuple[str, tuple[Any, ...]]] = []
        self.dispatcher.set_default_handler(self.take)

    def close(self) -> None:
        # The client of python-osc has no way to close its socket.
        self._sock.close()

    def take(self, address: str, *values: Any) -> None:
        self.answers.append((address, values))

    def ask(self, address: str, *values: Any) -> tuple[str, tuple[Any, ...]]:
        """Send a message, and wait for its answer."""
        self.send_message(address, values)
        end = time.monotonic() + PATIENCE
        while not self.answers and time.monotonic() < end:
            self.handle_messages(0.2)
        return self.answers.pop()


@pytest.fixture
def pictures(tmp_path) -> Path:
    images.write(tmp_path / "card.png", np.full((4, 8), 0.1), bits=16)
    return tmp_path


@pytest.fixture
def show(device, pictures) -> Iterator[tuple[Projection, Client, ShowControl]]:
    T = ltcl.scenes.dihedral(4, albedo=0.5).transport(device=device)
    control = ShowControl(pictures)
    projection = Projection(ViewerScene(T, "T", {}, None), 0.2, fps=25.0, control=control)
    with OscServer(control, 0) as server:
        client = Client(server.port)
        yield projection, client, control
        client.close()


FRAME = np.full((4, 8, 3), 200, np.uint8)


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def codes_after(show, address: str, *values: Any) -> np.ndarray:
    """Codes of a frame after a message."""
    projection, client, control = show
    before = control.state
    client.send_message(address, values)
    wait_until(lambda: control.state is not before)
    return projection.codes(FRAME)


def test_gain_follows_messages(show):
    dim = show[0].codes(FRAME)
    bright = codes_after(show, "/ltcl/gain", 0.4)
    assert show[0].statistics.gain == pytest.approx(0.4)
    ratio = images.from_srgb(bright / 255.0).mean() / images.from_srgb(dim / 255.0).mean()
    assert ratio == pytest.approx(2.0, rel=0.05)
    codes_after(show, "/ltcl/gain", "follow")
    assert show[0].statistics.gain > 0.4


def test_bounds_limit_light(show):
    assert show[0].codes(FRAME).max() > 60
    # White stands for the upper bound, so that codes rise as that falls.
    codes = codes_after(show, "/ltcl/bounds", 0.0, 0.01)
    assert codes.min() == 255
    # Bounds that cannot be change nothing; the sender hears of it.
    address, values = show[1].ask("/ltcl/bounds", 0.5, 0.2)
    assert address == "/ltcl/error"
    assert "bounds" in values[0]


def test_black_and_off_and_on(show):
    shown = show[0].codes(FRAME)
    assert codes_after(show, "/ltcl/blackout", 1).max() == 0
    np.testing.assert_array_equal(codes_after(show, "/ltcl/blackout", 0), shown)
    assert codes_after(show, "/ltcl/projector", 1, 0).max() == 0
    np.testing.assert_array_equal(codes_after(show, "/ltcl/projector", 1, 1), shown)


def test_freeze_keeps_codes(show):
    projection, _, _ = show
    shown = projection.codes(FRAME)
    codes_after(show, "/ltcl/freeze", 1)
    np.testing.assert_array_equal(projection.codes(FRAME // 4), shown)
    codes_after(show, "/ltcl/freeze", 0)
    assert projection.codes(FRAME // 4).mean() < shown.mean()


def test_picture_replaces_film(show):
    projection, _, _ = show
    card = codes_after(show, "/ltcl/picture", "card.png")
    np.testing.assert_array_equal(projection.codes(FRAME // 2), card)
    film = codes_after(show, "/ltcl/picture")
    assert film.mean() > card.mean()


def test_statistics_come_back(show):
    projection, client, _ = show
    for _ in range(3):
        projection.codes(FRAME)
    address, values = client.ask("/ltcl/statistics")
    assert address == "/ltcl/statistics"
    frames, dropped, p50, p99, gain = values
    assert (frames, dropped) == (3, 0)
    assert 0.0 < p50 <= p99
    assert gain == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("address", "values", "names"),
    [
        ("/ltcl/gain", [0.0], "gain is 0"),
        ("/ltcl/gain", [], "has 0 values; it must have 1"),
        ("/ltcl/gain", ["loud"], "gain"),
        ("/ltcl/blackout", [2], "it must be 0 or 1"),
        ("/ltcl/projector", [2, 1], "projector is 2"),
        ("/ltcl/picture", ["../card.png"], "it must be a name in"),
        ("/ltcl/picture", ["none.png"], "no such file"),
        ("/ltcl/colour", [1], "is no address"),
        ("/other", [1], "is no address"),
    ],
)
def test_bad_messages_are_answered(show, address, values, names):
    projection, client, control = show
    before = control.state
    answer, texts = client.ask(address, *values)
    assert answer == "/ltcl/error"
    assert names in texts[0]
    assert control.state is before
    assert projection.codes(FRAME).max() > 0


def test_listens_on_loopback_unless_told():
    with OscServer(ShowControl(), 0) as server:
        assert server.host == "127.0.0.1"
        with pytest.raises(
            errors.InputError, match=f"OSC cannot listen on 127.0.0.1:{server.port}"
        ):
            OscServer(ShowControl(), server.port)
