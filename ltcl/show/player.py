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
from ltcl.errors import InputError
from ltcl.images.frames import Frame, Source
from ltcl.show.window import Window
from ltcl.tasks.compensation import Compensator, FrameStatistics
from ltcl.viewer.answers import ViewerScene

# Seconds without a window after which a film waits, instead of dropping frames.
PAUSE_SECONDS = 1.0
# Frames by which the next one is timed: the median, as other work delays single ones.
TIMED_FRAMES = 5
# Frames that decide on the gain.
SAMPLE_FRAMES = 8
DEFAULT_FPS = 25.0
# Of the time from frame to frame: what projected steps may take, where light cannot be undone.
STEPS_SHARE = 0.5


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
    period = 1.0 / (film.fps or DEFAULT_FPS)
    compensator = _FrameCompensator(scene, gain, resize, period, settings)
    compensator.prepare(film)
    timing = _Timing(period=period)
    title = window.title
    for frame in film:
        begun_at = time.monotonic()
        if timing.is_too_late(frame.number, begun_at):
            continue
        codes = compensator.codes(frame)
        timing.wait_until_due(frame.number, begun_at)
        asked_at = time.monotonic()
        drawn_at = window.show(codes)
        timing.record(frame.number, asked_at, drawn_at)
        pace = timing.pace(compensator.statistics)
        window.title = f"{title}: {pace}"
        progress("playing", frame.number, film.count, detail=f": {pace}")
    window.wait(PAUSE_SECONDS)
    return timing.pace(compensator.statistics)


class _FrameCompensator:
    """The codes of the projector for each frame of a film."""

    def __init__(
        self,
        scene: ViewerScene,
        gain: float | str,
        resize: str,
        period: float,
        settings: dict[str, Any],
    ) -> None:
        self._T = scene.T
        self._setup = scene.setup
        self._resize = resize
        self._period = period
        self._gain = gain
        self._settings = settings

    @property
    def statistics(self) -> FrameStatistics:
        """Numbers of the frames so far."""
        return self._compensator.statistics

    def prepare(self, film: Source) -> None:
        """Make the compensator, with the gain of frames from all parts of the film."""
        settings = {**self._settings, "gain": self._gain}
        if self._setup is not None:
            settings["encode"] = self._setup.calibration.projector
        if self._gain == "auto":
            step = max((film.count or SAMPLE_FRAMES) // SAMPLE_FRAMES, 1)
            frames = islice(film, 0, SAMPLE_FRAMES * step, step)
            settings["film"] = [self._picture(frame) for frame in frames]
        fps = 1.0 / self._period
        try:
            # For a camera of other pixels light is found only within the bounds.
            self._compensator = Compensator(self._T, clamp=self._T.is_square, fps=fps, **settings)
        except InputError:
            # Bad settings are refused once more; light that fixed steps do not undo is no reason.
            deadline = 1e3 * STEPS_SHARE * self._period
            self._compensator = Compensator(self._T, deadline_ms=deadline, fps=fps, **settings)

    def codes(self, frame: Frame) -> np.ndarray:
        """Return uint8 codes on the pixels of the projector for a frame."""
        codes = self._compensator(self._picture(frame))
        if self._setup is not None:
            return self._setup.blocks.enlarged(codes)
        return codes

    def _picture(self, frame: Frame) -> np.ndarray:
        """Return sRGB codes or the light of a frame, on the camera's grid."""
        grid = self._T.camera_grid
        codes = frame.srgb()
        if codes.shape[:2] == grid:
            return codes
        return images.resize(frame.picture(), grid, self._resize)


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
