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

from ltcl.images.frames import Source
from ltcl.show.projection import Projection
from ltcl.show.window import Window
from ltcl.tasks.compensation import FrameStatistics
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
    """Pace of a film, as it was shown.

    Attributes
    ----------
    shown, dropped : int
    gain : float
    frames_per_second : float
        Shown frames a second.
    latency : float
        The median of the seconds between the due time of a frame and the end of its drawing.
    computing_p50, computing_p99 : float
        Seconds from the codes of a frame to those of its pattern: the median, and what 99 % are
        below.
    """

    shown: int
    dropped: int
    gain: float
    frames_per_second: float
    latency: float
    computing_p50: float
    computing_p99: float

    def __str__(self) -> str:
        pace = f"{self.frames_per_second:.1f} frames/s"
        computing = f"p99 {1e3 * self.computing_p99:.1f} ms"
        return f"{pace}, {self.dropped} dropped, latency {self.latency:.3f} s, {computing}"


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
    those of `ltcl.Compensator`; a `gain` "auto" is the largest for frames from all parts of the
    film, "follow" one that goes after it.
    """
    fps = film.fps or DEFAULT_FPS
    sample: list[np.ndarray] = []
    if gain == "auto":
        sample = sample_film(film)
    projection = Projection(scene, gain, film=sample, fps=fps, resize=resize, **settings)
    timing = _Timing(period=1.0 / fps)
    title = window.title
    for frame in film:
        begun_at = time.monotonic()
        timing.place(frame.number, frame.seconds)
        if timing.is_too_late(frame.number, begun_at):
            continue
        codes = projection.codes(frame.srgb())
        timing.wait_until_due(frame.number, begun_at)
        asked_at = time.monotonic()
        drawn_at = window.show(codes)
        timing.record(frame.number, asked_at, drawn_at)
        pace = timing.pace(projection.statistics)
        window.title = f"{title}: {pace}"
        progress("playing", frame.number, film.count, detail=f": {pace}")
    window.wait(PAUSE_SECONDS)
    return timing.pace(projection.statistics)


def sample_film(film: Source) -> list[np.ndarray]:
    """Take frames from all parts of a film."""
    step = max((film.count or SAMPLE_FRAMES) // SAMPLE_FRAMES, 1)
    return [frame.srgb() for frame in islice(film, 0, SAMPLE_FRAMES * step, step)]


@dataclass(kw_only=True)
class _Timing:
    """When frames are due, and how long they take."""

    # Seconds from one frame of the film to the next.
    period: float
    # By how much the time of the film is ahead of its rate.
    offset: float = 0.0
    # When frame 0 was due.
    start: float = 0.0
    # When the last frame was sent and was due, its number, and how many were shown.
    sent_at: float = 0.0
    sent_due: float = 0.0
    number: int = 0
    shown: int = 0
    # Seconds of the last frames, and of all frames.
    computing: deque[float] = field(default_factory=lambda: deque([0.0], TIMED_FRAMES))
    drawing: deque[float] = field(default_factory=lambda: deque([0.0], TIMED_FRAMES))
    latencies: list[float] = field(default_factory=list)

    def place(self, number: int, seconds: float | None) -> None:
        """Take note of the time of a frame by its own time stamp: a film may have no one rate."""
        if seconds is not None:
            # Frames are numbered from 1.
            self.offset = seconds - (number - 1) * self.period

    def due_at(self, number: int) -> float:
        """Return when a frame is due, at the time stamps so far."""
        return self.start + number * self.period + self.offset

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
            self.latencies.append(drawn_at - self.sent_due)
            self.drawing.append(drawn_at - self.sent_at)
        else:
            # The film waited for a window.
            self.start = time.monotonic() - number * self.period - self.offset
        self.sent_at = time.monotonic()
        self.sent_due = self.due_at(number)
        self.number = number
        self.shown += 1

    def pace(self, computed: FrameStatistics) -> Pace:
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
            gain=computed.gain,
            frames_per_second=rate,
            latency=latency,
            computing_p50=computed.latency_p50,
            computing_p99=computed.latency_p99,
        )
