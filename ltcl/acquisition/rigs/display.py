# SPDX-License-Identifier: BSD-3-Clause
"""`Display`: codes, full screen, on a projector that is a display of this computer (extra `projector`).

Pixels of the projector's grid become square blocks of whole display pixels, without smoothing: code x in
[0, 1] is fed as round(255 x) to each pixel of its block. Around the blocks it is black. pygame-ce (SDL 2)
draws. Known limits: 8 bits; one display in a process; to be used from the main thread.
"""

from __future__ import annotations

import contextlib
import os
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import as_codes, load_extra
from ltcl.errors import AcquisitionError, InputError

_SETTINGS = {  # SDL and pygame read them from the environment alone
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",  # pygame would greet on stdout
    "SDL_NO_SIGNAL_HANDLERS": "1",  # Ctrl-C stays with Python
    "SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS": "0",  # the pattern stays while somebody works on the other display
}


def enlarge(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture (h, w[, c]) in square blocks of whole pixels, as large as fit, centred in `size` (H, W).

    >>> enlarge(np.array([[1, 2]]), (3, 5))
    array([[1, 1, 2, 2, 0],
           [1, 1, 2, 2, 0],
           [0, 0, 0, 0, 0]])
    """
    (h, w), (H, W) = picture.shape[:2], size
    side = min(H // h, W // w)
    if side < 1:
        raise InputError(f"grid is {w} x {h} pixels; the projector has {W} x {H}")
    top, left = (H - side * h) // 2, (W - side * w) // 2
    large = np.zeros((H, W, *picture.shape[2:]), picture.dtype)
    blocks = picture.repeat(side, axis=0).repeat(side, axis=1)
    large[top : top + side * h, left : left + side * w] = blocks
    return large


class Display(contextlib.AbstractContextManager):
    """One display, full screen, that shows codes.

    Parameters
    ----------
    grid : (h, w)
        Of the projector's pixels that are to be told apart; at most the display's.
    index : int, optional
        Which display, from 0; None: the second where there are two or more, else the only one.

    InputError where there is no such display, the grid does not fit, or pygame has a window already;
    AcquisitionError where pygame-ce is not installed, or there is no display that goes full screen.

    Examples
    --------
    >>> import os
    >>> os.environ["SDL_VIDEODRIVER"] = "dummy"  # a display that nobody sees, for tests
    >>> with Display((3, 4)) as display:
    ...     display.show(np.eye(3, 4))
    """

    def __init__(self, grid: tuple[int, int], *, index: int | None = None) -> None:
        self.grid = checks.grid("grid", grid)
        for name, value in _SETTINGS.items():
            os.environ.setdefault(name, value)
        self._screen: Any = None
        self._pygame = load_extra("pygame", "projector", "a display")
        if self._pygame.display.get_surface() is not None:
            raise InputError("pygame shows a window in this process already; close it first")
        try:
            self._pygame.display.init()
            self._open(index)
        except self._pygame.error as error:
            self.close()
            raise AcquisitionError(f"no display can be opened: {error}") from error
        except BaseException:
            self.close()
            raise

    def show(self, codes: Any) -> None:
        """Show codes, (h, w) or (h, w, 3) in [0, 1]; returns when they are handed to the display.

        InputError for other codes; AcquisitionError where the display was closed, by its window's button or
        the Escape key.
        """
        codes = as_codes(codes, self.grid, 3)
        self.key_pressed()
        levels = enlarge(np.rint(codes * 255).astype(np.uint8), self.size)
        levels = np.broadcast_to(levels[..., None] if levels.ndim == 2 else levels, (*self.size, 3))
        self._pygame.surfarray.blit_array(self._screen, levels.swapaxes(0, 1))  # pygame counts pixels (x, y)
        self._pygame.display.flip()

    def key_pressed(self) -> bool:
        """Process the window's events: whether a key was pressed since the last call. Errors as of `show`."""
        if self._screen is None:
            raise AcquisitionError("the display is closed")
        pygame, pressed = self._pygame, False
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
                self.close()
                raise AcquisitionError("the display was closed by its window or the Escape key")
            pressed |= event.type == pygame.KEYDOWN
        return pressed

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        return {
            "kind": "display",
            "index": self.index,
            "size": list(self.size),
            "period": self.period,
            "driver": self._driver,
        }

    def close(self) -> None:
        """Give the display back; it cannot show anything after that."""
        self._screen = None
        self._pygame.display.quit()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, index: int | None) -> None:
        display = self._pygame.display
        sizes = display.get_desktop_sizes()
        if not sizes:
            raise AcquisitionError("there is no display")
        if index is None:
            index = min(1, len(sizes) - 1)
        if checks.count("index", index, least=0) >= len(sizes):
            known = ", ".join(f"{k}: {w} x {h}" for k, (w, h) in enumerate(sizes))
            raise InputError(f"index is {index}; it must be one of the displays there are ({known})")
        (w, h), self.index = sizes[index], index
        self.size = h, w
        enlarge(np.zeros(self.grid), self.size)  # refuses what does not fit
        rate = display.get_desktop_refresh_rates()[index]
        self.period = 1.0 / rate if rate > 0 else None
        self._screen = display.set_mode((w, h), self._pygame.FULLSCREEN, display=index)
        if self._screen.get_size() != (w, h):
            actual = self._screen.get_size()
            raise AcquisitionError(f"full screen is {actual}, not {w, h}; switch the desktop's scaling off")
        self._driver = display.get_driver()
        self._pygame.mouse.set_visible(False)
        display.set_allow_screensaver(False)
        self._screen.fill((0, 0, 0))
        display.flip()
