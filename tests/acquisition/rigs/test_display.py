# SPDX-License-Identifier: BSD-3-Clause
"""`Display` on SDL's dummy driver: what its surface holds, pixel by pixel."""

from __future__ import annotations

import sys

import numpy as np
import pygame
import pytest

from ltcl.acquisition import Display
from ltcl.errors import AcquisitionError, InputError, LtclError


@pytest.fixture(autouse=True)
def dummy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def screen() -> np.ndarray:
    """(H, W, 3)."""
    surface = pygame.display.get_surface()
    assert surface is not None
    return pygame.surfarray.array3d(surface).swapaxes(0, 1)


def test_pixels_are_square_blocks_in_the_middle() -> None:
    codes = np.random.default_rng(1).random((3, 5, 3)).astype(np.float32)
    with Display((3, 5)) as display:
        height, width = display.size
        side = min(height // 3, width // 5)
        assert display.block == (side, side)
        display.show(codes)
        top, left = (height - 3 * side) // 2, (width - 5 * side) // 2
        wanted = np.zeros((height, width, 3), np.uint8)
        blocks = np.kron(np.rint(codes * 255), np.ones((side, side, 1)))
        wanted[top : top + 3 * side, left : left + 5 * side] = blocks
        np.testing.assert_array_equal(screen(), wanted)


def test_exact_blocks_fill_the_display() -> None:
    with Display((1, 1)) as display:
        height, width = display.size
    grid = (height // 2, width // 4)
    codes = np.random.default_rng(2).integers(0, 256, grid) / 255
    with Display(grid, scaling="exact") as display:
        assert display.block == (2, 4)
        display.show(codes)
        wanted = np.kron(np.rint(codes * 255), np.ones((2, 4)))
        np.testing.assert_array_equal(screen(), np.repeat(wanted[..., None], 3, axis=-1))


def test_every_level_is_shown_as_it_is() -> None:
    codes = np.arange(256).reshape(16, 16) / 255
    with Display((16, 16)) as display:
        display.show(codes)
        side = display.block[0]
        top, left = ((pixels - 16 * side) // 2 for pixels in display.size)
        shown = screen()[top : top + 16 * side : side, left : left + 16 * side : side]
    np.testing.assert_array_equal(shown, np.arange(256).reshape(16, 16, 1).repeat(3, axis=-1))


def test_the_period_is_that_of_the_driver() -> None:
    with Display((4, 4)) as display:
        (rate, *_) = pygame.display.get_desktop_refresh_rates()
        assert display.period == pytest.approx(1 / rate)
        assert display.describe()["size"] == list(display.size)


@pytest.mark.parametrize("event", [{"type": pygame.QUIT}, {"type": pygame.KEYDOWN, "key": pygame.K_ESCAPE}])
def test_escape_and_the_window_s_button_end_it(event: dict) -> None:
    with Display((4, 4)) as display:
        display.show(np.zeros((4, 4)))
        pygame.event.post(pygame.event.Event(event.pop("type"), event))
        with pytest.raises(AcquisitionError, match="closed by its window or the Escape key"):
            display.show(np.ones((4, 4)))
        with pytest.raises(AcquisitionError, match="the display is closed"):
            display.show(np.ones((4, 4)))


def test_a_closed_display_can_be_opened_again() -> None:
    for _ in range(2):
        with Display((2, 2)) as display:
            display.show(np.ones((2, 2)))
            assert screen().max() == 255


def test_a_second_window_is_refused_and_the_first_stays() -> None:
    with Display((2, 2)) as display:
        with pytest.raises(InputError, match="pygame shows a window in this process already"):
            Display((2, 2))
        display.show(np.ones((2, 2)))


def test_what_does_not_fit_is_refused() -> None:
    with Display((1, 1)) as display:
        height, width = display.size
    for arguments, message in [
        ({"grid": (height + 1, 1)}, f"the display has {width} x {height} pixels"),
        ({"grid": (height // 2 + 1, 1), "scaling": "exact"}, "does not divide"),
        ({"grid": (2, 2), "index": 7}, f"index is 7; .*0: {width} x {height}"),
        ({"grid": (2, 2), "index": -1}, "index is -1"),
        ({"grid": (2, 0)}, "grid is"),
        ({"grid": (2, 2), "scaling": "smooth"}, "scaling is 'smooth'"),
    ]:
        with pytest.raises(InputError, match=message):
            Display(**arguments)
        assert pygame.display.get_surface() is None


@pytest.mark.parametrize("codes", [np.zeros((2, 3)), np.full((2, 2), 1.1), np.full((2, 2), np.nan), "white"])
def test_bad_codes_are_refused(codes: object) -> None:
    with Display((2, 2)) as display, pytest.raises(LtclError, match="codes"):
        display.show(codes)


def test_no_driver_and_no_pygame_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    with pytest.raises(AcquisitionError, match="no display can be opened: "):
        Display((2, 2))
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(AcquisitionError, match=r'needs pygame.*pip install "ltcl\[projector\]"'):
        Display((2, 2))
