# SPDX-License-Identifier: BSD-3-Clause
"""`play`: a film compensated as it runs, in a projector window.

While a frame is drawn the next one is computed: the first that can be there in time. A frame that
would be late is dropped.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from statistics import median
from typing import Any

import numpy as np

from ltcl import images
from ltcl.images.frames import Frame, Source
from ltcl.show.window import Window
from ltcl.tasks.compensation import compensate
from ltcl.viewer.answers import ViewerScene

# Seconds without a window after which a film waits, instead of dropping frames.
PAUSE_SECONDS = 1.0
# Frames by which the next one is timed: the median, as other work delays single ones.
TIMED_FRAMES = 5
# Frames that decide on the gain.
SAMPLE_FRAMES = 8
DEFAULT_FPS = 25.0


@dataclass(frozen=True, kw_only=True)
class Pace:
    """Pace of a film, as it was shown."""

    shown: int
    dropped: int
    gain: float
    frames_per_second: float
    latency: float

    def __str__(self) -> str:
        pace = f"{self.frames_per_second:.1f} frames/s"
        return f"{pace}, {self.dropped} dropped, latency {self.latency:.3f} s"


def play(
    scene: ViewerScene,
    film: Source,
    window: Window,
    gain: float | str,
    progress: Callable[..., None],
    resize: str = "letterbox",
    **settings: Any,
) -> Pace:
    """Show a film compensated for the T of `scene` at the film's own pace.

    Frames of another size are scaled by `resize`, as `ltcl.images.resize` does. `settings` are
    those of `ltcl.compensate`; a `gain` "auto" is the largest for frames from all
    parts of the film. In the result `frames_per_second` counts shown frames, and `latency` is the
    median of the seconds between the due time of a frame and the end of its drawing.
    """
    compensator = _FrameCompensator(scene, gain, resize, settings)
    compensator.prepare(film)
    timing = _Timing(period=1.0 / (film.fps or DEFAULT_FPS))
    title = window.title
    for frame in film:
        begun_at = time.monotonic()
        if timing.is_too_late(frame.number, begun_at):
            continue
        codes = scene.codes(compensator.pattern(frame), 1.0)
        timing.wait_until_due(frame.number, begun_at)
        asked_at = time.monotonic()
        drawn_at = window.show(codes)
        timing.record(frame.number, asked_at, drawn_at)
        pace = timing.pace(compensator.gain)
        window.title = f"{title}: {pace}"
        progress("playing", frame.number, film.count, detail=f": {pace}")
    window.wait(PAUSE_SECONDS)
    return timing.pace(compensator.gain)


class _FrameCompensator:
    """The pattern for each frame of a film, with one gain."""

    def __init__(
        self, scene: ViewerScene, gain: float | str, resize: str, settings: dict[str, Any]
    ) -> None:
        self._T = scene.T
        self._resize = resize
        # For a camera of other pixels light is found only within the bounds.
        self._settings = {**settings, "clamp": scene.T.is_square}
        self._inverse = settings.get("inverse")
        self._background = settings.get("background")
        self._gain = gain

    @property
    def gain(self) -> float:
        """The gain of all frames, once it is known."""
        return float(self._gain)

    def prepare(self, film: Source) -> None:
        """Find the gain, and let `compensate` check the settings with an inverse once."""
        is_auto = isinstance(self._gain, str)
        if not is_auto and self._inverse is None:
            return
        count = SAMPLE_FRAMES if is_auto else 1
        step = max((film.count or SAMPLE_FRAMES) // SAMPLE_FRAMES, 1)
        sample = []
        for frame in islice(film, 0, count * step, step):
            picture = np.atleast_3d(self._picture(frame))
            sample.append(np.broadcast_to(picture, (*picture.shape[:2], 3)))
        result = compensate(self._T, np.stack(sample), gain=self._gain, **self._settings)
        self._gain = result.gain

    def pattern(self, frame: Frame) -> np.ndarray:
        """Return the light of the projector for a frame."""
        desired = self._picture(frame)
        if self._inverse is None:
            return compensate(self._T, desired, gain=self._gain, **self._settings).pattern
        # Without the error of the result, which costs as much as the pattern.
        target = self.gain * np.atleast_3d(desired)
        if self._background is not None:
            target = target - np.atleast_3d(self._background)
        if target.shape[2] != 3:
            target = target[..., 0]
        return self._inverse.pattern(target)

    def _picture(self, frame: Frame) -> np.ndarray:
        """Return the light of a frame on the camera's grid."""
        light = frame.picture()
        grid = self._T.camera_grid
        if light.shape[:2] == grid:
            return light
        return images.resize(light, grid, self._resize)


@dataclass(kw_only=True)
class _Timing:
    """When frames are due, and how long they take."""

    # Seconds from one frame of the film to the next.
    period: float
    # When frame 0 was due.
    start: float = 0.0
    # When the last frame was sent, its number, and how many were shown.
    sent_at: float = 0.0
    number: int = 0
    shown: int = 0
    # Seconds of the last frames, and of all frames.
    computing: deque[float] = field(default_factory=lambda: deque([0.0], TIMED_FRAMES))
    drawing: deque[float] = field(default_factory=lambda: deque([0.0], TIMED_FRAMES))
    latencies: list[float] = field(default_factory=list)

    def due_at(self, number: int) -> float:
        """Return when a frame is due."""
        return self.start + number * self.period

    def is_too_late(self, number: int, now: float) -> bool:
        """True if the next frame will be due before this one can be there."""
        computed_at = now + median(self.computing)
        window_free_at = self.sent_at + median(self.drawing)
        return self.shown > 0 and self.due_at(number + 1) < max(computed_at, window_free_at)

    def wait_until_due(self, number: int, begun_at: float) -> None:
        """Take note of a computed frame, and wait for its time."""
        # The first frame is shown at once. Kernels were built for it, which takes longer.
        if self.shown:
            ready_at = time.monotonic()
            self.computing.append(ready_at - begun_at)
            time.sleep(max(self.due_at(number) - ready_at, 0.0))

    def record(self, number: int, asked_at: float, drawn_at: float) -> None:
        """Take note of a frame that was sent when the window had drawn the one before."""
        has_waited = time.monotonic() - asked_at >= PAUSE_SECONDS
        if self.shown and not has_waited:
            self.latencies.append(drawn_at - self.due_at(self.number))
            self.drawing.append(drawn_at - self.sent_at)
        else:
            # The film waited for a window.
            self.start = time.monotonic() - number * self.period
        self.sent_at = time.monotonic()
        self.number = number
        self.shown += 1

    def pace(self, gain: float) -> Pace:
        """Return the pace so far."""
        rate = 0.0
        latency = 0.0
        if self.shown:
            rate = self.shown / (self.sent_at - self.start)
        if self.latencies:
            latency = median(self.latencies)
        return Pace(
            shown=self.shown,
            dropped=self.number - self.shown,
            gain=gain,
            frames_per_second=rate,
            latency=latency,
        )
