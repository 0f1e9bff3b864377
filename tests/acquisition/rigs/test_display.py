# SPDX-License-Identifier: BSD-3-Clause
"""`Display` on SDL's dummy driver: what its surface holds, pixel by pixel; `show` on it and on a recorder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pygame
import pytest

from ltcl import images
from ltcl.acquisition import Display, FolderRig
from ltcl.acquisition.rigs import show
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError


@pytest.fixture(autouse=True)
def dummy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def screen() -> np.ndarray:
    """(H, W, 3)."""
    surface = pygame.display.get_surface()
    assert surface is not None
    return pygame.surfarray.array3d(surface).swapaxes(0, 1)


@pytest.mark.parametrize("shape", [(3, 5, 3), (16, 16)])
def test_pixels_are_square_blocks_in_the_middle(shape: tuple[int, ...]) -> None:
    levels = np.random.default_rng(1).permutation(256).repeat(3)[: np.prod(shape)].reshape(shape)
    h, w = shape[:2]
    with Display((h, w)) as display:
        height, width = display.size
        side = min(height // h, width // w)
        display.show(levels / 255)
        top, left = (height - h * side) // 2, (width - w * side) // 2
        expected = np.zeros((height, width, 3), np.uint8)
        colours = levels if levels.ndim == 3 else levels[..., None].repeat(3, axis=-1)
        expected[top : top + h * side, left : left + w * side] = np.kron(colours, np.ones((side, side, 1)))
        np.testing.assert_array_equal(screen(), expected)
        (rate, *_) = pygame.display.get_desktop_refresh_rates()
        assert display.period == pytest.approx(1 / rate)
        assert display.describe()["size"] == [height, width]


@pytest.mark.parametrize("event", [{"type": pygame.QUIT}, {"type": pygame.KEYDOWN, "key": pygame.K_ESCAPE}])
def test_escape_and_the_windows_button_end_it(event: dict) -> None:
    with Display((4, 4)) as display:
        display.show(np.zeros((4, 4)))
        pygame.event.post(pygame.event.Event(event.pop("type"), event))
        with pytest.raises(AcquisitionError, match="closed by its window or the Escape key"):
            display.show(np.ones((4, 4)))
        with pytest.raises(AcquisitionError, match="the display is closed"):
            display.show(np.ones((4, 4)))


def test_one_window_at_a_time(tmp_path: Path) -> None:
    for _ in range(2):  # closed, it can be opened again
        with Display((2, 2)) as display:
            with pytest.raises(InputError, match="pygame shows a window"):
                Display((2, 2))
            display.show(np.ones((2, 2)))
            assert screen().max() == 255


@pytest.mark.parametrize(
    ("change", "codes", "message"),
    [
        ({"grid": (1 << 20, 1)}, None, "grid is 1 x 1048576 pixels"),
        ({"index": 7}, None, "index is 7; .*0: "),
        ({"index": -1}, None, "index is -1"),
        ({"grid": (2, 0)}, None, "grid is"),
        *(({}, codes, "codes") for codes in (np.zeros((2, 3)), np.full((2, 2), 1.1), "white")),
    ],
)
def test_what_cannot_be_shown_is_refused(change: dict[str, Any], codes: Any, message: str) -> None:
    with pytest.raises(LtclError, match=message), Display(**{"grid": (2, 2), **change}) as display:
        display.show(codes)
    assert pygame.display.get_surface() is None


def test_no_driver_and_no_pygame_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    with pytest.raises(AcquisitionError, match="no display can be opened: "):
        Display((2, 2))
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(AcquisitionError, match=r"needs pygame.*ltcl\[projector\]"):
        Display((2, 2))


class Recorder:
    """A display that keeps what it shows; its key is always down."""

    def __init__(self) -> None:
        self.shown: list[np.ndarray] = []
        self.polls = 0

    def show(self, codes: np.ndarray) -> None:
        self.shown.append(codes)

    def key_pressed(self) -> bool:
        self.polls += 1
        return True


SHOTS = [(np.eye(2), 0.5), (np.ones((2, 2)), 0.5), (np.eye(2), 0.25)]


@pytest.fixture
def scan(tmp_path: Path) -> FolderRig:
    rig = FolderRig(tmp_path, (2, 2), projector=(4, 8))
    rig.prepare(SHOTS)
    return rig


def photograph(rig: FolderRig, number: int) -> None:
    images.write(rig.folder / f"photographs/photo_{number:06d}.png", np.eye(2))


@pytest.mark.parametrize("advance", ["key", 0.02])
def test_patterns_are_shown_in_the_order_of_the_list(scan: FolderRig, advance: Any) -> None:
    photograph(scan, 2)
    display, steps = Recorder(), []
    assert show(scan.folder, display, advance, lambda *step: steps.append(step)) == 2
    large = np.kron([[0, 1, 0, 0], [0, 0, 1, 0]], np.ones((2, 2)))
    np.testing.assert_array_equal(display.shown, [large, large])
    assert show(scan.folder, 0, 0.01) == 2  # on a display of this computer
    assert pygame.display.get_surface() is None
    assert [(shot.number, shot.seconds, done, total) for shot, done, total in steps] == [
        (1, 0.5, 0, 2),
        (3, 0.25, 1, 2),
    ]


def test_the_next_one_comes_when_its_photograph_arrives(scan: FolderRig) -> None:
    display = Recorder()
    polls = []

    def take(shot: Any, done: int, total: int) -> None:
        photograph(scan, shot.number)
        polls.append(display.polls)

    assert show(scan.folder, display, "arrival", take) == 3
    assert polls == [0, 1, 2]
    assert show(scan.folder, display, "arrival") == 0


def test_a_folder_of_pictures_is_shown_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 9, 100):
        images.write(tmp_path / f"frame_{number}.png", np.full((1, 1), number / 255), encoding="linear")
    (tmp_path / "notes.txt").write_text("none")
    display = Recorder()
    assert show(tmp_path, display) == 3
    np.testing.assert_allclose(np.ravel(display.shown), np.array([9, 10, 100]) / 255, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "error", "part"),
    [
        ({"advance": "mouse"}, InputError, "advance is 'mouse'"),
        ({"advance": 0.0}, InputError, r"advance is 0\.0"),
        ({"display": object()}, InputTypeError, "display is a object without show, key_pressed"),
        ({"display": 9}, InputError, "index is 9"),
        ({"folder": "nowhere"}, FileError, "nowhere: has no shooting list"),
    ],
)
def test_folders_and_displays_that_cannot_be_used_are_named(
    scan: FolderRig, change: Any, error: type[Exception], part: str
) -> None:
    with pytest.raises(error, match=part):
        show(**{"folder": scan.folder, "display": Recorder(), **change})
