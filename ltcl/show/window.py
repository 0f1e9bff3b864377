# SPDX-License-Identifier: BSD-3-Clause
"""`Window`: a projector window in the browser, shown to in turn; and `play`, a film compensated as it runs.

What is shown next goes to the window when that has drawn what it had, so nothing waits on the way.
While a frame is drawn the next one is computed: the first that can be there in time.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from itertools import islice
from statistics import median
from typing import Any

import numpy as np

from ltcl import images
from ltcl.images.frames import Frame, Source
from ltcl.tasks.compensation import compensate
from ltcl.viewer.answers import Reply, Scene
from ltcl.viewer.server import Viewer

_POLL = 0.1  # seconds, in which Ctrl-C is heard
_PAUSE = 1.0  # without a window for longer, a film waits
_RECENT = 5  # frames by which the next one is timed: the median, as other work delays single ones
_SAMPLE = 8  # frames that decide on the gain


class Window(Scene, contextlib.AbstractContextManager):
    """Windows of a browser, whichever are open, in the place of a `ltcl.acquisition.rigs.Display`.

    `address` are arguments of `Viewer`. Space, an arrow or page key there is a key pressed.
    """

    page = "projector.html"
    questions = ("projector", "next")

    def __init__(self, title: str, **address: Any) -> None:
        super().__init__(None, title, {}, None)
        self._drawn = 0.0
        self._is_drawn, self._pressed = threading.Event(), threading.Event()
        self._viewer = Viewer(self, **address)
        self.url, self.close = self._viewer.url, self._viewer.close  # windows keep what they show

    def show(self, codes: np.ndarray) -> float:
        """Show codes (h, w[, 3]), uint8 or in [0, 1], when a window is there that drew those before; when."""
        drawn = self.wait()
        self._is_drawn.clear()
        self.pattern = codes if codes.dtype == np.uint8 else np.rint(255 * codes).astype(np.uint8)
        self._viewer.refresh()
        return drawn

    def wait(self, patience: float = math.inf) -> float:
        """Until a window drew what there is, or so many seconds: the time when it did."""
        end = time.monotonic() + patience
        while not self._is_drawn.wait(_POLL) and time.monotonic() < end:
            pass
        return self._drawn

    def key_pressed(self) -> bool:
        """Whether one was, since the last call."""
        was_pressed = self._pressed.is_set()
        self._pressed.clear()
        return was_pressed

    def __exit__(self, *_: object) -> None:
        self.close()

    def projector(self) -> Reply:
        """One is there, or has drawn."""
        self._drawn = time.monotonic()
        self._is_drawn.set()
        return {}, {}

    def next(self) -> Reply:
        """A key was pressed."""
        self._pressed.set()
        return {}, {}


def play(
    scene: Scene,
    film: Source,
    window: Window,
    gain: float | str,
    progress: Callable[..., None],
    **settings: Any,
) -> dict[str, Any]:
    """Show a film compensated for the T of `scene` at its own pace, and return what was reached.

    `settings` are of `ltcl.compensate`; a `gain` "auto" is the largest for frames from all of the
    film. `frames_per_second` are those shown; `latency` is the median of seconds from when a frame
    was due until a window had drawn it.
    """
    inverse, background = settings.get("inverse"), settings.get("background")
    settings["clamp"] = scene.T.is_square  # else light is found within the bounds only

    def picture(frame: Frame) -> np.ndarray:
        light, grid = frame.picture(), scene.T.camera_grid
        return light if light.shape[:2] == grid else images.resize(light, grid)

    if isinstance(gain, str) or inverse is not None:  # whose settings are checked so, once
        every = max((film.count or _SAMPLE) // _SAMPLE, 1)
        sampled = islice(film, 0, every * _SAMPLE if isinstance(gain, str) else 1, every)
        sample = [np.atleast_3d(picture(frame)) for frame in sampled]
        pictures = np.stack([np.broadcast_to(each, (*each.shape[:2], 3)) for each in sample])
        gain = compensate(scene.T, pictures, gain=gain, **settings).gain

    def pattern(desired: np.ndarray) -> np.ndarray:
        if inverse is None:
            return compensate(scene.T, desired, gain=gain, **settings).pattern
        target = gain * np.atleast_3d(
            desired
        )  # and its light alone: the error of that costs as much
        target = target if background is None else target - np.atleast_3d(background)
        return inverse.pattern(target if target.shape[2] == 3 else target[..., 0])

    now, period, title, late = time.monotonic, 1.0 / (film.fps or 25.0), window.title, list[float]()
    computing, drawing = deque([0.0], _RECENT), deque([0.0], _RECENT)  # seconds of frames
    start, sent, number, shown = (
        0.0,
        0.0,
        0,
        0,
    )  # when frame 0 was due, the last one sent; its number
    facts = dict[str, Any]()
    for frame in film:
        begun = now()
        earliest = max(begun + median(computing), sent + median(drawing))
        if shown and start + (frame.number + 1) * period < earliest:
            continue
        codes = scene.codes(pattern(picture(frame)), 1.0)
        ready = now()
        if shown:  # kernels were built for the first one
            computing.append(ready - begun)
            time.sleep(max(start + frame.number * period - ready, 0.0))
        asked = now()
        drawn = window.show(codes)
        if shown and now() - asked < _PAUSE:
            late.append(drawn - start - number * period)
            drawing.append(drawn - sent)
        else:  # the film waited for a window
            start = now() - frame.number * period
        sent, number, shown = now(), frame.number, shown + 1
        facts = {"shown": shown, "dropped": number - shown, "gain": gain}
        facts |= {"frames_per_second": shown / (sent - start), "latency": median(late or [0.0])}
        text = "{frames_per_second:.1f} frames/s, {dropped} dropped, latency {latency:.3f} s"
        window.title = f"{title}: {(text := text.format(**facts))}"
        progress("playing", number, film.count, detail=f": {text}")
    window.wait(_PAUSE)
    return facts
