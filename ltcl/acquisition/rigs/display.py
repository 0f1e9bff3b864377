# SPDX-License-Identifier: BSD-3-Clause
"""`Display`: codes, full screen, on a projector that is a display of this computer (extra `projector`).

Pixels of the projector's grid become blocks of whole display pixels, without smoothing: code x in [0, 1] is
fed as round(255 x) to each pixel of its block. What lies beside the blocks is black. pygame-ce (SDL 2) draws.
Known limits: 8 bits; one display in a process; to be used from the main thread.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import as_codes
from ltcl.acquisition.rigs import extras
from ltcl.errors import AcquisitionError, InputError

_SETTINGS = {
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",  # pygame would greet on stdout
    "SDL_NO_SIGNAL_HANDLERS": "1",  # Ctrl-C stays with Python
    "SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS": "0",  # the pattern stays while somebody works on the other display
}


class Display:
    """One display, full screen, that shows codes.

    Parameters
    ----------
    grid : (h, w)
        Of the projector's pixels that are to be told apart; at most the display's.
    index : int, optional
        Which display, from 0; None: the second where there are two or more, else the only one.
    scaling : "integer" or "exact"
        "integer": square blocks, as large as fit, in the middle. "exact": blocks fill the display; its sides
        must be multiples of those of the grid.

    Attributes
    ----------
    grid : (h, w)
        As given.
    size : (H, W)
        Pixels of the display.
    block : (int, int)
        Display pixels down and across for one of the grid.
    period : float or None
        Seconds between two pictures of the display, as its driver says.

    Raises
    ------
    InputError
        There is no such display, the grid does not fit, or pygame has a window already.
    AcquisitionError
        pygame-ce is not installed, there is no display at all, or it does not go full screen.

    Examples
    --------
    >>> import os
    >>> os.environ["SDL_VIDEODRIVER"] = "dummy"  # a display that nobody sees, for tests
    >>> with Display((3, 4)) as display:
    ...     display.show(np.eye(3, 4))
    ...     display.block == (display.size[0] // 3, display.size[0] // 3)
    True
    """

    def __init__(self, grid: tuple[int, int], *, index: int | None = None, scaling: str = "integer") -> None:
        self.grid = checks.grid("grid", grid)
        checks.one_of("scaling", scaling, ("integer", "exact"))
        for name, value in _SETTINGS.items():
            os.environ.setdefault(name, value)
        self._part: Any = None
        self._pygame = extras.load("pygame", "projector", "a display")
        if self._pygame.display.get_surface() is not None:
            raise InputError("pygame shows a window in this process already; close it first")
        try:
            self._pygame.display.init()
            self._open(index, scaling)
        except self._pygame.error as error:
            self.close()
            raise AcquisitionError(f"no display can be opened: {error}") from error
        except BaseException:
            self.close()
            raise

    def show(self, codes: Any) -> None:
        """Show codes, (h, w) or (h, w, 3) in [0, 1]; returns when they are handed to the display.

        Raises
        ------
        InputError, InputTypeError
            Codes of another shape or outside [0, 1].
        AcquisitionError
            The display is closed: by `close`, its window's button, or the Escape key.
        """
        codes = as_codes(codes, self.grid, 3)
        self._mind_events()
        levels = np.rint(codes * 255).astype(np.uint8)
        levels = np.broadcast_to(levels[..., None] if levels.ndim == 2 else levels, (*self.grid, 3))
        blocks = levels.repeat(self.block[0], axis=0).repeat(self.block[1], axis=1)
        across = blocks.swapaxes(0, 1)  # pygame counts pixels (x, y)
        self._pygame.surfarray.blit_array(self._part, across)
        self._pygame.display.flip()

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        return {
            "kind": "display",
            "index": self.index,
            "size": list(self.size),
            "block": list(self.block),
            "period": self.period,
            "driver": self._driver,
        }

    def close(self) -> None:
        """Give the display back; it cannot show anything after that."""
        self._part = None
        self._pygame.display.quit()

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, index: int | None, scaling: str) -> None:
        display = self._pygame.display
        sizes = display.get_desktop_sizes()
        self.index = _chosen(index, sizes)
        self.size = (sizes[self.index][1], sizes[self.index][0])
        self.block = _block(self.grid, self.size, scaling)
        rate = display.get_desktop_refresh_rates()[self.index]
        self.period = 1.0 / rate if rate > 0 else None
        screen = display.set_mode(sizes[self.index], self._pygame.FULLSCREEN, display=self.index)
        if screen.get_size() != sizes[self.index]:
            raise AcquisitionError(
                f"display {self.index} has {_pixels(sizes[self.index])} pixels, but a full screen of "
                f"{_pixels(screen.get_size())}; switch the scaling of the desktop off"
            )
        self._driver = display.get_driver()
        self._pygame.mouse.set_visible(False)
        display.set_allow_screensaver(False)
        screen.fill((0, 0, 0))
        high, wide = (cells * side for cells, side in zip(self.grid, self.block, strict=True))
        middle = (self.size[1] - wide) // 2, (self.size[0] - high) // 2
        self._part = screen.subsurface((*middle, wide, high))
        display.flip()

    def _mind_events(self) -> None:
        """Let the desktop see that the window lives, and end where somebody asks for it."""
        if self._part is None:
            raise AcquisitionError("the display is closed")
        pygame = self._pygame
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
                self.close()
                raise AcquisitionError("the display was closed by its window or the Escape key")


def _chosen(index: int | None, sizes: list[tuple[int, int]]) -> int:
    if not sizes:
        raise AcquisitionError("no display is there")
    if index is None:
        return min(1, len(sizes) - 1)
    if checks.count("index", index, least=0) >= len(sizes):
        there = ", ".join(f"{k}: {_pixels(size)}" for k, size in enumerate(sizes))
        raise InputError(f"index is {index}; it must be one of the displays there are ({there})")
    return index


def _block(grid: tuple[int, int], size: tuple[int, int], scaling: str) -> tuple[int, int]:
    down, across = (pixels // cells for pixels, cells in zip(size, grid, strict=True))
    if min(down, across) < 1:
        raise InputError(f"grid is {_pixels(grid[::-1])}; the display has {_pixels(size[::-1])} pixels")
    if scaling == "integer":
        return min(down, across), min(down, across)
    if (down * grid[0], across * grid[1]) != size:
        raise InputError(
            f"grid is {_pixels(grid[::-1])}, which does not divide the {_pixels(size[::-1])} pixels of the "
            'display; scaling "integer" leaves a black margin'
        )
    return down, across


def _pixels(size: tuple[int, ...]) -> str:
    return f"{size[0]} x {size[1]}"
