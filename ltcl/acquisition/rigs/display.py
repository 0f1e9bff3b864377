# SPDX-License-Identifier: BSD-3-Clause
"""`Display`: codes, full screen, on a projector that is a display of this computer; `show` of a folder there.

Pixels of the grid become square blocks of display pixels, of codes round(255 x) for x in [0, 1],
with black around. pygame-ce (SDL 2) draws. Known limits: 8 bits; one display in a process, used
from the main thread.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.acquisition.rig import Closing, as_codes, load_extra
from ltcl.acquisition.rigs.folder import FolderRig, Shot, enlarge
from ltcl.errors import AcquisitionError, FileError, InputError
from ltcl.files import as_path
from ltcl.images.frames import open_frames

_POLL = 0.05  # seconds


class Display(Closing):
    """One display, full screen, that shows codes of `grid` (h, w), at most its pixels (extra `projector`).

    `index` counts from 0; None is the second display, or the only one. InputError where it is
    missing, the grid does not fit, or pygame has a window already; AcquisitionError where pygame-ce
    is not installed, or no display goes full screen.

    Examples
    --------
    >>> os.environ["SDL_VIDEODRIVER"] = "dummy"  # a display that nobody sees, for tests
    >>> with Display((3, 4)) as display:
    ...     display.show(np.eye(3, 4))
    """

    def __init__(self, grid: tuple[int, int], *, index: int | None = None) -> None:
        self.grid = checks.grid("grid", grid)
        with contextlib.redirect_stdout(None):  # pygame prints a greeting
            self._pygame = load_extra("pygame", "projector", "a display")
        if self._pygame.display.get_surface() is not None:
            raise InputError("pygame shows a window in this process already; close it first")
        with self._closed_on_error():
            try:
                self._open(index)
            except self._pygame.error as error:
                raise AcquisitionError(f"no display can be opened: {error}") from error

    def show(self, codes: Any) -> None:
        """Show codes, (h, w) or (h, w, 3) in [0, 1]; AcquisitionError once the display is closed."""
        codes = as_codes(codes, self.grid, 3)
        self.key_pressed()
        levels = enlarge(np.rint(codes * 255).astype(np.uint8), self.size)
        levels = np.broadcast_to(levels[..., None] if levels.ndim == 2 else levels, (*self.size, 3))
        self._pygame.surfarray.blit_array(
            self._screen, levels.swapaxes(0, 1)
        )  # pygame counts pixels (x, y)
        self._pygame.display.flip()

    def key_pressed(self) -> bool:
        """Whether a key was pressed since the last call; Escape and the window's button close the display."""
        if self._screen is None:
            raise AcquisitionError("the display is closed")
        pygame, pressed = self._pygame, False
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (
                event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE
            ):
                self.close()
                raise AcquisitionError("the display was closed by its window or the Escape key")
            pressed |= event.type == pygame.KEYDOWN
        return pressed

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        return {"kind": "display", "index": self.index, "size": self.size, "period": self.period}

    def close(self) -> None:
        """Give the display back; it cannot show anything after that."""
        self._screen = None
        self._pygame.display.quit()

    def _open(self, index: int | None) -> None:
        display = self._pygame.display
        display.init()
        sizes = display.get_desktop_sizes()
        self.index = (
            min(1, len(sizes) - 1) if index is None else checks.count("index", index, least=0)
        )
        if self.index not in range(len(sizes)):
            offered = ", ".join(f"{k}: {w} x {h}" for k, (w, h) in enumerate(sizes)) or "none"
            raise InputError(f"index is {index}, of {offered}; a projector must extend the desktop")
        w, h = sizes[self.index]
        self.size = h, w
        enlarge(np.zeros(self.grid), self.size)  # refuses what does not fit
        rate = display.get_desktop_refresh_rates()[self.index]
        self.period = 1.0 / rate if rate > 0 else None
        self._screen = display.set_mode((w, h), self._pygame.FULLSCREEN, display=self.index)
        if (actual := self._screen.get_size()) != (w, h):
            raise AcquisitionError(
                f"full screen is {actual}, not {w, h}; switch the desktop's scaling off"
            )
        self._pygame.mouse.set_visible(False)
        display.set_allow_screensaver(False)


def show(
    folder: str | os.PathLike[str],
    display: Any = 1,
    advance: str | float = "key",
    progress: Callable[[Shot, int, int], None] | None = None,
) -> int:
    """Show the patterns of a folder, or one picture, full screen, one after the other; returns how many.

    Of a `FolderRig` in the order of the shooting list, without photographs that are there already;
    else the pictures of the folder by the numbers in their names. `display` counts from 0, or is an
    open one or the like: `show(codes)` and `key_pressed()`. The next pattern is shown after a
    "key", at the "arrival" of the photograph in the folder, or after so many seconds, as `advance`
    says. `progress` is called with each `Shot`, how many were before it, and how many there are.
    Errors as of `Display`; InputError or FileError for an unusable `advance`, nothing to show.

    Examples
    --------
    >>> show("nowhere")
    Traceback (most recent call last):
    ltcl.errors.FileError: nowhere: has no shooting list, which 'ltcl acquire run' writes
    """
    folder = as_path(folder)
    if isinstance(advance, str) and advance not in ("key", "arrival"):
        raise InputError(f"advance is {advance!r}; it must be 'key', 'arrival' or seconds")
    patience = (
        float("inf") if isinstance(advance, str) else checks.number("advance", advance, above=0.0)
    )
    is_picture = folder.is_file() and advance != "arrival"
    folder, name = (folder.parent, folder.name) if is_picture else (folder, "")
    rig = FolderRig(folder, (1, 1))  # any grid has the same list
    if is_picture:
        shots = [Shot(1, name, 0.0, "")]
    elif rig.shots:
        shots = [rig.shots[number - 1] for number in rig.missing()]
    elif advance == "arrival" or not folder.is_dir() or (folder / "acquisition.toml").exists():
        raise FileError(f"{folder}: has no shooting list, which 'ltcl acquire run' writes")
    else:
        shots = [Shot(frame.number, frame.name, 0.0, "") for frame in open_frames(folder)]
    if not shots:
        return 0
    h, w = images.read(folder / shots[0].pattern).shape[:2]
    is_open = hasattr(display, "show")
    with contextlib.nullcontext(display) if is_open else Display((h, w), index=display) as screen:
        for done, shot in enumerate(shots):
            screen.show(images.read(folder / shot.pattern, encoding="linear"))
            if progress is not None:
                progress(shot, done, len(shots))
            end = time.monotonic() + patience
            while time.monotonic() < end and not (screen.key_pressed() and advance == "key"):
                if advance == "arrival" and shot.number not in rig.missing():
                    break
                time.sleep(_POLL)
    return len(shots)
