# SPDX-License-Identifier: BSD-3-Clause
"""A show that OSC controls, with messages of python-osc over UDP."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from pythonosc.osc_bundle_builder import OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder
from pythonosc.udp_client import DispatchClient

import ltcl
from ltcl import errors, images
from ltcl.show.control import OscServer, ShowControl
from ltcl.show.pipes import RawVideo
from ltcl.show.projection import Projection
from ltcl.viewer.answers import ViewerScene
from tests.transport import projectors
from tests.transport.projectors import CAMERA, LEFT, RIGHT

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
FRAME_OF_TWO = np.full((*CAMERA, 3), 150, np.uint8)


def frame_of(projection: Projection) -> np.ndarray:
    """The frame of a show of one projector, or of two."""
    return FRAME if projection.projectors == 1 else FRAME_OF_TWO


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
    return projection.codes(frame_of(projection))


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


@pytest.fixture(scope="module")
def two(device) -> Any:
    """Two projectors side by side, of other sizes."""
    return ltcl.combine(projectors.transports(device, projectors.corner()))


@pytest.fixture
def show_of_two(two) -> Iterator[tuple[Projection, Client, ShowControl]]:
    control = ShowControl()
    projection = Projection(ViewerScene(two, "two", {}, None), 0.2, fps=25.0, control=control)
    with OscServer(control, 0) as server:
        client = Client(server.port)
        yield projection, client, control
        client.close()


def test_projectors_of_a_combination(show_of_two, two):
    projection, client, control = show_of_two
    shown = projection.codes(FRAME_OF_TWO)
    left, right = two.split(shown)
    assert left.max() > 0
    assert right.max() > 0

    def check(codes: np.ndarray, has_left: bool, has_right: bool) -> None:
        patterns = two.split(codes)
        assert codes.dtype == np.uint8
        np.testing.assert_array_equal(patterns[0], left * has_left)
        np.testing.assert_array_equal(patterns[1], right * has_right)

    check(codes_after(show_of_two, "/ltcl/projector", 2, 0), True, False)
    # What is off stays so while others are switched, and under black.
    assert codes_after(show_of_two, "/ltcl/blackout", 1).max() == 0
    check(codes_after(show_of_two, "/ltcl/blackout", 0), True, False)
    check(codes_after(show_of_two, "/ltcl/freeze", 1), True, False)
    # Frozen codes stay as they are.
    check(codes_after(show_of_two, "/ltcl/projector", 2, 1), True, False)
    check(codes_after(show_of_two, "/ltcl/freeze", 0), True, True)
    check(codes_after(show_of_two, "/ltcl/projector", 1, 0), False, True)
    assert codes_after(show_of_two, "/ltcl/projector", 2, 0).max() == 0
    check(codes_after(show_of_two, "/ltcl/projector", 1, 1), True, False)
    # Frames of black alone, or frozen, are not computed.
    _, values = client.ask("/ltcl/statistics")
    assert values[:2] == (6, 0)
    before = control.state
    address, texts = client.ask("/ltcl/projector", 3, 0)
    assert address == "/ltcl/error"
    assert texts == ("/ltcl/projector: projector is 3; it must be at most 2",)
    assert control.state is before


def test_projectors_are_not_known_before_the_show(two):
    control = ShowControl()
    control.set_projector(1, False)
    with pytest.raises(errors.InputError, match="projector is 2, but the show has not begun"):
        control.set_projector(2, False)
    Projection(ViewerScene(two, "two", {}, None), 0.2, fps=25.0, control=control).close()
    control.set_projector(2, False)
    assert control.state.off == {1, 2}


def streams_of(program: subprocess.Popen[bytes]) -> tuple[IO[bytes], IO[bytes], IO[bytes]]:
    """The pipes to and from a program."""
    assert program.stdin is not None
    assert program.stdout is not None
    assert program.stderr is not None
    return program.stdin, program.stdout, program.stderr


def test_play_switches_projectors(two, tmp_path):
    """`ltcl play --pipe` of a combination, whose second projector goes off and on."""
    path = tmp_path / "two.npz"
    ltcl.save(path, two)
    frame = RawVideo(width=CAMERA[1], height=CAMERA[0])
    target = RawVideo(width=two.grid[1], height=two.grid[0])
    words = [sys.executable, "-m", "ltcl", "play", "--pipe", "--gain", "0.2", "--osc", "0"]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [*words, "-", str(path)], stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0
    ) as program:
        stdin, stdout, stderr = streams_of(program)
        told = stderr.readline().decode()
        port = re.search(r"OSC on 127\.0\.0\.1:(\d+)", told)
        assert port is not None, told
        client = Client(int(port[1]))

        def shown(*message: Any) -> tuple[np.ndarray, ...]:
            """The patterns of a frame after a message."""
            if message:
                client.send_message("/ltcl/projector", message)
                # Messages are obeyed in turn.
                assert client.ask("/ltcl/statistics")[0] == "/ltcl/statistics"
            stdin.write(frame.to_bytes(FRAME_OF_TWO))
            data = b""
            while len(data) < target.frame_bytes:
                piece = stdout.read(target.frame_bytes - len(data))
                assert piece, stderr.read().decode()
                data += piece
            return two.split(target.from_bytes(data))

        left, right = shown()
        assert left.shape == (*LEFT.grid, 3)
        assert right.shape == (*RIGHT.grid, 3)
        assert right.max() > 0
        alone, dark = shown(2, 0)
        np.testing.assert_array_equal(alone, left)
        assert dark.max() == 0
        np.testing.assert_array_equal(shown(2, 1)[1], right)
        address, texts = client.ask("/ltcl/projector", 3, 0)
        assert address == "/ltcl/error"
        assert "projector is 3; it must be at most 2" in texts[0]
        client.close()
        stdin.close()
        assert program.wait(PATIENCE) == 0


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
        ("/ltcl/projector", [2, 1], "projector is 2; it must be at most 1"),
        ("/ltcl/picture", ["../card.png"], "it must be a name in"),
        ("/ltcl/picture", ["none.png"], "no such file"),
        ("/ltcl/picture", [3], "picture is 3; it must be the name"),
        ("/ltcl/statistics", ["x"], "port is 'x'; it must be a whole number"),
        ("/ltcl/statistics", [0], "port is 0; it must be a whole number"),
        ("/ltcl/statistics", [99999], "port is 99999; it must be at most 65535"),
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


@pytest.mark.parametrize("numbers", [(1, 0), (1.0, 0.0)])
def test_controllers_may_send_floats(show, numbers):
    """Many tablets send nothing else."""
    _, client, control = show
    client.send_message("/ltcl/projector", numbers)
    wait_until(lambda: control.state.off == {1})


def test_a_bundle_for_later_holds_up_nothing(show):
    _, client, control = show
    builder = OscBundleBuilder(int(time.time()) + 3600)
    message = OscMessageBuilder(address="/ltcl/gain")
    message.add_arg(0.5)
    builder.add_content(message.build())
    client.send(builder.build())
    wait_until(lambda: control.state.gain == 0.5)


@pytest.mark.parametrize("datagram", [b"", b"garbage", b"/\xff\xfe\0,i\0\0\0\0\0\1", b"#bundle\0"])
def test_other_datagrams_are_answered(show, capfd, datagram):
    _, client, control = show
    before = control.state
    client._sock.sendto(datagram, ("127.0.0.1", client._port))
    client.send_message("/ltcl/freeze", [1])
    wait_until(lambda: control.state.is_frozen)
    assert replace(control.state, is_frozen=False) == before
    assert "Traceback" not in capfd.readouterr().err


def test_listens_on_loopback_unless_told():
    with OscServer(ShowControl(), 0) as server:
        assert server.host == "127.0.0.1"
        with pytest.raises(
            errors.InputError, match=f"OSC cannot listen on 127.0.0.1:{server.port}"
        ):
            OscServer(ShowControl(), server.port)
