# SPDX-License-Identifier: BSD-3-Clause
"""`Display` on SDL's dummy driver, pixel by pixel; `show` of folders and pictures on it."""

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
from ltcl.errors import AcquisitionError, FileError, InputError, LtclError

random = np.random.default_rng()


@pytest.fixture(autouse=True)
def dummy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def screen() -> np.ndarray:
    """(H, W, 3)."""
    surface = pygame.display.get_surface()
    assert surface is not None
    return pygame.surfarray.array3d(surface).swapaxes(0, 1)


def blocks(levels: np.ndarray) -> np.ndarray:
    """The screen under these levels, (H, W, 3)."""
    h, w = levels.shape[:2]
    expected = np.zeros_like(screen())
    H, W = expected.shape[:2]
    side = min(H // h, W // w)
    top = (H - h * side) // 2
    left = (W - w * side) // 2
    colours = np.kron(levels.reshape(h, w, -1), np.ones((side, side, 1)))
    expected[top : top + h * side, left : left + w * side] = colours
    return expected


@pytest.mark.parametrize("shape", [(3, 5, 3), (16, 16)])
def test_pixels_are_square_blocks_in_the_middle(shape: tuple[int, ...]) -> None:
    levels = random.permutation(256).repeat(3)[: np.prod(shape)].reshape(shape)
    with Display((shape[0], shape[1])) as display:
        display.show(levels / 255)
        np.testing.assert_array_equal(screen(), blocks(levels))
        (rate, *_) = pygame.display.get_desktop_refresh_rates()
        assert display.period == pytest.approx(1 / rate)
        assert display.describe()["size"] == screen().shape[:2]


@pytest.mark.parametrize(("kind", "key"), [(pygame.QUIT, 0), (pygame.KEYDOWN, pygame.K_ESCAPE)])
def test_escape_and_the_windows_button_end_it(kind: int, key: int) -> None:
    """Closed, it can be opened again; two at a time cannot."""
    for _ in range(2):
        with Display((4, 4)) as display:
            with pytest.raises(InputError, match="pygame shows a window"):
                Display((2, 2))
            pygame.event.post(pygame.event.Event(kind, {"key": key}))
            for reason in ("Escape", "display is closed"):
                with pytest.raises(AcquisitionError, match=reason):
                    display.show(np.ones((4, 4)))


@pytest.mark.parametrize(
    ("change", "codes", "message"),
    [
        ({"grid": (1 << 20, 1)}, None, "grid is"),
        ({"grid": (2, 0)}, None, "grid is"),
        ({"index": 7}, None, "index is 7"),
        ({"index": -1}, None, "index is -1"),
        ({}, np.zeros((2, 3)), "codes"),
        ({}, np.full((2, 2), 1.1), "codes"),
        ({}, "white", "codes"),
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


@pytest.mark.parametrize("name", ["dummy", "offscreen"])
def test_an_invisible_display_is_opened_only_if_asked_for(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Without a desktop SDL takes such a driver by itself."""
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(variable, raising=False)
    with pytest.raises(AcquisitionError, match="no display can be opened"):
        Display((2, 2))
    monkeypatch.setenv("SDL_VIDEODRIVER", name)
    Display((2, 2)).close()


@pytest.fixture
def scan(tmp_path: Path) -> FolderRig:
    rig = FolderRig(tmp_path, (2, 2), projector=(4, 8))
    rig.prepare([(np.eye(2), 0.5), (np.ones((2, 2)), 0.5), (np.eye(2), 0.25)])
    return rig


def photograph(rig: FolderRig, number: int) -> None:
    images.write(rig.folder / f"photographs/photo_{number:06d}.png", np.eye(2))


@pytest.mark.parametrize("advance", ["key", "arrival", 0.02])
def test_patterns_are_shown_in_the_order_of_the_list(scan: FolderRig, advance: Any) -> None:
    """Pictures have 4 x 8 pixels; patterns that are photographed already are left out."""
    photograph(scan, 2)
    large = np.kron([[0, 1, 0, 0], [0, 0, 1, 0]], np.full((2, 2), 255))
    shots = []

    def progress(shot: Any, done: int, total: int) -> None:
        np.testing.assert_array_equal(screen(), blocks(large))
        shots.append((shot.number, shot.seconds, done, total))
        if advance == "arrival":
            photograph(scan, shot.number)
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_SPACE))

    assert show(scan.folder, 0, advance, progress) == 2
    assert shots == [(1, 0.5, 0, 2), (3, 0.25, 1, 2)]
    assert pygame.display.get_surface() is None


def test_a_folder_of_pictures_is_shown_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 9, 100):
        images.write(
            tmp_path / f"frame_{number}.png", np.full((1, 1), number / 255), encoding="linear"
        )
    (tmp_path / "notes.txt").write_text("none")
    shown = []
    assert show(tmp_path, 0, 0.01, lambda *_: shown.append(screen().max())) == 3
    assert shown == [9, 10, 100]


def test_one_picture_is_shown_alone_with_the_blocks_of_a_scan(tmp_path: Path) -> None:
    codes = random.integers(0, 256, (2, 3))
    for name in ("pattern.png", "pattern.exr"):  # as 'ltcl compensate' leaves them
        images.write(tmp_path / name, codes / 255, encoding="linear")
    shown = []

    def progress(*_: Any) -> None:
        shown.append((screen(), blocks(codes)))

    assert show(tmp_path / "pattern.png", 0, 0.01, progress) == 1
    np.testing.assert_array_equal(*shown[0])


@pytest.mark.parametrize("how", ["crop", "letterbox", "stretch"])
def test_pictures_are_scaled_as_asked(tmp_path: Path, how: str) -> None:
    """A square picture larger than the display is refused without a way to scale it."""
    codes = np.tile(np.linspace(0.2, 1.0, 4000), (4000, 1))
    images.write(tmp_path / "large.png", codes, encoding="linear")
    with pytest.raises(InputError, match="the projector has"):
        show(tmp_path / "large.png", 0, 0.01)
    shown = []
    show(tmp_path / "large.png", 0, 0.01, lambda *_: shown.append(screen()), how)
    size = shown[0].shape[:2]
    stored = images.read(tmp_path / "large.png", encoding="linear")
    expected = np.rint(255 * images.resize(stored, size, how))
    np.testing.assert_array_equal(shown[0], np.broadcast_to(expected[..., None], shown[0].shape))


def test_patterns_of_an_acquisition_are_not_scaled(scan: FolderRig) -> None:
    with pytest.raises(InputError, match="resize is 'crop'"):
        show(scan.folder, 0, 0.01, resize="crop")
    with pytest.raises(InputError, match="resize is 'fit'"):
        show(scan.folder, 0, 0.01, resize="fit")


def test_of_the_results_of_a_compensation_the_patterns_are_shown(tmp_path: Path) -> None:
    for number in (2, 10):
        pattern = np.full((2, 3), number / 255)
        images.write(tmp_path / f"p{number}_pattern.png", pattern, encoding="linear")
        images.write(tmp_path / f"p{number}_pattern.exr", pattern)
        images.write(tmp_path / f"p{number}_appearance.png", np.ones((9, 9)))
    images.write(tmp_path / "compensate.png", np.ones((20, 20)))
    (tmp_path / "compensate.json").write_text("{}")
    shown = []
    assert (
        show(tmp_path, 0, 0.01, lambda shot, *_: shown.append((shot.pattern, screen().max()))) == 2
    )
    assert shown == [("p2_pattern.png", 2), ("p10_pattern.png", 10)]


@pytest.mark.parametrize(
    ("name", "value"), [("advance", "mouse"), ("advance", 0.0), ("display", 9)]
)
def test_folders_and_displays_that_cannot_be_used_are_named(
    scan: FolderRig, name: str, value: Any
) -> None:
    with pytest.raises(InputError, match=f"(index|advance) is {value!r}"):
        show(**{"folder": scan.folder, name: value})
    begun = scan.folder / "begun"
    begun.mkdir()
    (begun / "acquisition.toml").touch()
    with pytest.raises(FileError, match=f"{begun}: has no shooting list"):
        show(begun)
    with pytest.raises(FileError, match="nowhere"):
        show("nowhere")
