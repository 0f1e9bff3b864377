# SPDX-License-Identifier: BSD-3-Clause
"""`Window`: a projector window in the browser, as a display.

The next picture goes to the window when that has drawn the one before, so that nothing waits on
the way.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import Any

import numpy as np

from ltcl.viewer.answers import Reply, ViewerScene
from ltcl.viewer.server import Viewer

# Seconds between two looks at a window, in which Ctrl-C is heard.
POLL_SECONDS = 0.1


class Window(ViewerScene, contextlib.AbstractContextManager):
    """Windows of a browser, all that are open, in place of a `ltcl.acquisition.rigs.Display`.

    `address` are arguments of `Viewer`. Space, an arrow or page key there is a key pressed. Windows
    keep the last picture when this is closed.
    """

    page = "projector.html"

    def __init__(self, title: str, **address: Any) -> None:
        super().__init__(None, title, {}, None)
        self._drawn_at = 0.0
        self._is_drawn = threading.Event()
        self._is_pressed = threading.Event()
        self._viewer = Viewer(self, **address)
        self.url = self._viewer.url

    @property
    def questions(self) -> tuple[str, ...]:
        """Questions that a window may ask."""
        return ("projector", "next")

    def show(self, codes: np.ndarray) -> float:
        """Show codes (h, w[, 3]), uint8 or in [0, 1], once a window has drawn those before.

        Returns the time when it had drawn them.
        """
        drawn_at = self.wait()
        self._is_drawn.clear()
        is_ready = codes.dtype == np.uint8
        self.pattern = codes if is_ready else np.rint(255 * codes).astype(np.uint8)
        self._viewer.refresh()
        return drawn_at

    def wait(self, seconds: float = math.inf) -> float:
        """Wait until a window has drawn the picture, or for so long; return when it did."""
        end = time.monotonic() + seconds
        while not self._is_drawn.wait(POLL_SECONDS) and time.monotonic() < end:
            pass
        return self._drawn_at

    def key_pressed(self) -> bool:
        """True if a key was pressed since the last call."""
        was_pressed = self._is_pressed.is_set()
        self._is_pressed.clear()
        return was_pressed

    def close(self) -> None:
        """Close the viewer."""
        self._viewer.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def projector(self) -> Reply:
        """Take note of a window that is there, or has drawn."""
        self._drawn_at = time.monotonic()
        self._is_drawn.set()
        return {}, {}

    def next(self) -> Reply:
        """Take note of a key."""
        self._is_pressed.set()
        return {}, {}
