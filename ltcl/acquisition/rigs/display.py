# SPDX-License-Identifier: BSD-3-Clause
"""`Display`: codes in full screen, on a projector that is a display of this computer.

Pixels of the grid become square blocks of display pixels, of codes round(255 x) for x in [0, 1],
with black around. pygame-ce (SDL 2) draws. `show` displays a folder of patterns one after the
other. Known limits: 8 bits; one display in a process, used from the main thread.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.acquisition.rig import Closing, as_codes
from ltcl.acquisition.rigs.folder import FolderRig, enlarge
from ltcl.acquisition.rigs.memory_card import number_key
from ltcl.acquisition.rigs.shooting_list import Shot
from ltcl.errors import AcquisitionError, FileError, InputError
from ltcl.files import as_path
from ltcl.images.frames import open_frames
from ltcl.images.pictures import RESIZES

# Seconds between two looks for a key or a photograph.
POLL_SECONDS = 0.05

# Drivers of SDL whose display nobody sees, which it takes without a desktop, and the variables that
# ask for a driver.
INVISIBLE_DRIVERS = ("dummy", "offscreen", "evdev")
DRIVER_VARIABLES = ("SDL_VIDEODRIVER", "SDL_VIDEO_DRIVER")

# The report of 'ltcl compensate', in whose folder some pictures are patterns, and others not.
COMPENSATION_REPORT = "compensate.json"


class Display(Closing):
    """A display in full screen that shows codes of a grid (extra `projector`).

    Parameters
    ----------
    grid : (int, int), optional
        Height and width of the codes, at most the pixels of the display; None: these pixels.
    index : int, optional
        Number of the display, from 0; None for the second display, or the only one.

    Raises
    ------
    InputError
        The display is missing, the grid does not fit, or pygame has a window already.
    AcquisitionError
        pygame-ce is not installed, or no display goes full screen.

    Examples
    --------
    >>> os.environ["SDL_VIDEODRIVER"] = "dummy"  # a display that nobody sees, for tests
    >>> with Display((3, 4)) as display:
    ...     display.show(np.eye(3, 4))
    """

    def __init__(self, grid: tuple[int, int] | None, *, index: int | None = None) -> None:
        if grid is not None:
            grid = checks.grid("grid", grid)
        with contextlib.redirect_stdout(None):  # pygame prints a greeting
            self._pygame = checks.load_extra("pygame", "projector", "a display", AcquisitionError)
        if self._pygame.display.get_surface() is not None:
            raise InputError("pygame shows a window in this process already; close it first")
        with self._closed_on_error():
            try:
                self._open(grid, index)
            except self._pygame.error as error:
                raise AcquisitionError(f"no display can be opened: {error}") from error

    def show(self, codes: Any) -> None:
        """Show codes, (h, w) or (h, w, 3) in [0, 1]; AcquisitionError if the display is closed."""
        codes = as_codes(codes, self.grid, 3)
        self.key_pressed()
        levels = enlarge(np.rint(codes * 255).astype(np.uint8), self.size)
        if levels.ndim == 2:
            levels = levels[..., None]
        levels = np.broadcast_to(levels, (*self.size, 3))
        # pygame counts pixels (x, y).
        transposed = levels.swapaxes(0, 1)
        self._pygame.surfarray.blit_array(self._screen, transposed)
        self._pygame.display.flip()

    def key_pressed(self) -> bool:
        """True if a key was pressed since the last call.

        Escape and the window's button close the display: AcquisitionError, then and afterwards.
        """
        if self._screen is None:
            raise AcquisitionError("the display is closed")
        pygame = self._pygame
        is_pressed = False
        for event in pygame.event.get():
            is_key = event.type == pygame.KEYDOWN
            is_escape = is_key and event.key == pygame.K_ESCAPE
            if is_escape or event.type == pygame.QUIT:
                self.close()
                raise AcquisitionError("the display was closed by its window or the Escape key")
            is_pressed |= is_key
        return is_pressed

    def describe(self) -> dict[str, Any]:
        """The display as plain JSON."""
        return {
            "kind": "display",
            "index": self.index,
            "size": self.size,
            "period": self.period,
        }

    def close(self) -> None:
        """Release the display; it cannot show anything afterwards."""
        self._screen = None
        self._pygame.display.quit()

    def _open(self, grid: tuple[int, int] | None, index: int | None) -> None:
        display = self._pygame.display
        display.init()
        _check_visible(display.get_driver())
        sizes = display.get_desktop_sizes()
        self.index = _choose_display(index, sizes)
        w, h = sizes[self.index]
        self.size = (h, w)
        self.grid = self.size if grid is None else grid
        # Refuses a grid that does not fit.
        enlarge(np.zeros(self.grid), self.size)
        rate = display.get_desktop_refresh_rates()[self.index]
        self.period = 1.0 / rate if rate > 0 else None
        mode = self._pygame.FULLSCREEN
        self._screen = display.set_mode((w, h), mode, display=self.index)
        actual_size = self._screen.get_size()
        if actual_size != (w, h):
            raise AcquisitionError(
                f"full screen is {actual_size}, not {w, h}; switch the desktop's scaling off"
            )
        self._pygame.mouse.set_visible(False)
        display.set_allow_screensaver(False)


def _check_visible(driver: str) -> None:
    """Refuse a driver without a display, unless the environment asks for it."""
    drivers = ",".join(os.environ.get(variable, "") for variable in DRIVER_VARIABLES)
    is_asked_for = driver.lower() in drivers.lower().split(",")
    if driver.lower() in INVISIBLE_DRIVERS and not is_asked_for:
        raise AcquisitionError(
            f"no display can be opened: there is no desktop, and SDL's driver {driver!r} shows "
            "nothing; start it on the desktop, or use --browser"
        )


def _choose_display(index: int | None, sizes: list[tuple[int, int]]) -> int:
    """Number of a display among those of `sizes` (w, h); None is the second or the only one."""
    if index is None:
        chosen = min(1, len(sizes) - 1)
    else:
        chosen = checks.count("index", index, least=0)
    if chosen not in range(len(sizes)):
        offered = [f"{k}: {w} x {h}" for k, (w, h) in enumerate(sizes)]
        displays = ", ".join(offered) if offered else "none"
        raise InputError(
            f"index is {index}; the displays are {displays}: a projector must extend the desktop"
        )
    return chosen


def show(
    folder: str | os.PathLike[str],
    display: Any = 1,
    advance: str | float = "key",
    progress: Callable[[Shot, int, int], None] | None = None,
    resize: str | None = None,
) -> int:
    """Show the patterns of a folder, or one picture, in full screen, one after the other.

    Parameters
    ----------
    folder : path
        Folder of a `FolderRig`, whose patterns come in the order of the shooting list, without
        those that are photographed already; or a folder of pictures, in the order of the numbers in
        their names, of which only the patterns if 'ltcl compensate' wrote it; or one picture.
    display : int or object
        Number of the display, from 0; or an open one, or any object with `show(codes)` and
        `key_pressed()`.
    advance : "key", "arrival" or float
        The next pattern is shown after a key, after the photograph arrives in the folder, or after
        so many seconds.
    progress : callable, optional
        Called with each `Shot`, the number of shots before it, and the number of all.
    resize : "crop", "letterbox" or "stretch", optional
        Scale pictures, as `ltcl.images.resize` does, to the pixels of the display, or, on an object
        without a `size`, to those of the first picture. None: pixels become square blocks, with
        black around. Patterns of a shooting list must stay as they are.

    Returns
    -------
    int
        The number of patterns.

    Raises
    ------
    InputError, FileError
        `advance` or `resize` cannot be used, or there is nothing to show; as in `Display`.
    AcquisitionError
        As in `Display`.

    Examples
    --------
    >>> show("nowhere")
    Traceback (most recent call last):
    ltcl.errors.FileError: nowhere: no such file or folder
    """
    folder = as_path(folder)
    if not isinstance(advance, str):
        checks.number("advance", advance, above=0.0)
    elif advance not in ("key", "arrival"):
        raise InputError(f"advance is {advance!r}; it must be 'key', 'arrival' or seconds")
    if resize is not None:
        checks.one_of("resize", resize, RESIZES)
    shots = None
    if folder.is_file() and advance != "arrival":
        shots = [Shot(1, folder.name, 0.0, "")]
        folder = folder.parent
    rig = FolderRig(folder, (1, 1))  # any grid has the same list
    if shots is None:
        shots = _shots_to_show(rig, advance)
        if resize is not None and rig.shots:
            raise InputError(
                f"resize is {resize!r}, but {folder} has the patterns of an acquisition; their "
                "pixels must stay as they are"
            )
    if not shots:
        return 0

    grid = images.read(folder / shots[0].pattern).shape[:2]
    opened: Any = contextlib.nullcontext(display)
    if not hasattr(display, "show"):
        opened = Display(grid if resize is None else None, index=display)
    with opened as screen:
        for done, shot in enumerate(shots):
            picture = images.read(folder / shot.pattern, encoding="linear")
            if resize is not None:
                scaled = images.resize(picture, getattr(screen, "size", grid), resize)
                picture = np.clip(scaled, 0.0, 1.0)
            screen.show(picture)
            if progress is not None:
                progress(shot, done, len(shots))
            _wait_for_next(screen, rig, shot, advance)
    return len(shots)


def _shots_to_show(rig: FolderRig, advance: str | float) -> list[Shot]:
    """Shots of the shooting list that are still missing, or the pictures of a plain folder."""
    if rig.shots:
        return [rig.shots[number - 1] for number in rig.missing()]
    folder: Path = rig.folder
    if not folder.exists():
        raise FileError(f"{folder}: no such file or folder")
    has_project = (folder / "acquisition.toml").exists()
    if advance == "arrival" or not folder.is_dir() or has_project:
        raise FileError(f"{folder}: has no shooting list, which 'ltcl acquire run' writes")
    shots = []
    if (folder / COMPENSATION_REPORT).exists():
        patterns = sorted(folder.glob("*_pattern.png"), key=number_key)
        for number, path in enumerate(patterns, start=1):
            shots.append(Shot(number, path.name, 0.0, ""))
        return shots
    for frame in open_frames(folder):
        shots.append(Shot(frame.number, frame.name, 0.0, ""))
    return shots


def _wait_for_next(screen: Any, rig: FolderRig, shot: Shot, advance: str | float) -> None:
    """Wait for a key, for the photograph of the shot, or for some seconds."""
    patience = math.inf if isinstance(advance, str) else advance
    end = time.monotonic() + patience
    while time.monotonic() < end:
        is_pressed = screen.key_pressed()
        if is_pressed and advance == "key":
            return
        if advance == "arrival" and shot.number not in rig.missing():
            return
        time.sleep(POLL_SECONDS)
