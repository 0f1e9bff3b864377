# SPDX-License-Identifier: BSD-3-Clause
"""Tests of a camera and a display, before the first photograph of a `LiveRig`.

exposure   at most 1/15 s, halved until white saturates less than a hundredth of the cells
noise      largest change of a cell between frames of the same picture, black and white
dimming    a strip of white, then all white: no cell may get darker, as by a fast automatic
           exposure
latency    from a flash until all but a hundredth of the cells show it, to a tenth of the
           contrast
drift      of the mean, right after a flash and at rest, by a slow automatic exposure or white
           balance
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ltcl.acquisition.rigs.link import CameraLink, relative_drift
from ltcl.errors import AcquisitionError

# Seconds of the longest exposure that is tried, and the number of exposures, each half of the one
# before.
LONGEST_TRIAL = 1 / 15
EXPOSURE_TRIALS = 6

# Frames of the same picture, black and white.
NOISE_FRAMES = 6

# Flashes to white, and as many to black.
FLASHES = 4

# Difference from a flash that has arrived, of white.
ARRIVED_SHARE = 0.1

# Share of cells that may differ more.
MAX_OUTLIER_SHARE = 0.01

# Factor over the largest noise among some ten thousand differences.
NOISE_SAFETY = 1.5

# A code of the coarsest camera: smaller changes count as none.
CODE_STEP = 1 / 255

# Changes must be visible: at least so many times the noise.
VISIBLE_FACTOR = 4.0

# Noise of more than this part of full scale is flicker.
MAX_NOISE = 0.1

# Cells above, of full scale, may be saturated.
SATURATED = 0.98


class Survey(NamedTuple):
    """Results of the tests, in parts of full scale if nothing else is said."""

    latency: float  # the most seconds from a change to its first frame
    seconds: float  # exposure of the tests
    tolerance: float  # change of a cell that noise explains
    contrast: float  # largest difference of a cell between white and black
    drift: float  # relative change of the brightness between identical frames


class SurveyTests:
    """The tests; within `patience` seconds everything is at rest.

    AcquisitionError for a set-up that cannot be measured.
    """

    def __init__(
        self,
        link: CameraLink,
        exposures: tuple[float, ...] | None,
        *,
        patience: float,
        max_drift: float,
    ) -> None:
        self.link = link
        self.exposures = exposures
        self.patience = patience
        self.max_drift = max_drift

    def run(self) -> Survey:
        """Run the tests, in an exposure in which white is not saturated."""
        seconds = self._choose_exposure()
        black_frames = self._uniform_frames(0.0, NOISE_FRAMES)
        white_frames = self._uniform_frames(1.0, NOISE_FRAMES)
        noise = max(_frame_noise(black_frames), _frame_noise(white_frames))
        if noise > MAX_NOISE:
            raise AcquisitionError(
                f"frames of the same picture differ by {noise:.1%} of full scale: "
                "something flickers or moves, or the display's period is wrong"
            )
        black = black_frames[-1]
        white = white_frames[-1]
        contrast = float((white - black).max())
        if contrast < VISIBLE_FACTOR * max(noise, CODE_STEP):
            raise AcquisitionError(
                f"the camera does not see the display: white is {contrast:.2%} of full scale above "
                f"black, noise {noise:.2%}, at {seconds:.4g} s; open the aperture, or aim"
            )
        tolerance = NOISE_SAFETY * (noise + CODE_STEP)
        self._check_dimming(white, tolerance)
        accuracy = max(tolerance, ARRIVED_SHARE * contrast)
        latency = self._measure_latency(black, white, accuracy)
        mean_at_rest = white_frames.mean(axis=(0, 1, 2))
        return Survey(
            latency=latency,
            seconds=seconds,
            tolerance=tolerance,
            contrast=contrast,
            drift=self._measure_drift(white, mean_at_rest, accuracy),
        )

    def _choose_exposure(self) -> float:
        """The longest exposure tried in which white is not saturated; it is set."""
        trials = (LONGEST_TRIAL / 2.0 ** np.arange(EXPOSURE_TRIALS)).tolist()
        offered = self.exposures
        if offered is None:
            offered = trials
        seconds = LONGEST_TRIAL
        for longest in trials:
            possible = [exposure for exposure in offered if exposure <= longest]
            seconds = max(possible, default=min(offered))
            self.link.expose(seconds)
            white = self._uniform_frames(1.0, 1)
            if np.mean(white > SATURATED) <= MAX_OUTLIER_SHARE:
                return seconds
        raise AcquisitionError(f"white is saturated at {seconds:.4g} s; reduce aperture or gain")

    def _check_dimming(self, white: np.ndarray, tolerance: float) -> None:
        """Refuse a camera that makes a strip darker when the rest is lit."""
        h, w = self.link.grid
        is_strip = np.arange(w) < max(1, w // 4)
        self.link.show(np.broadcast_to(is_strip, (h, w)).astype(np.float32))
        (strip,) = self._frames_at_rest(1)
        dimmed = float((strip - white).max())
        if dimmed > tolerance:
            raise AcquisitionError(
                f"the camera adapts: a strip is {dimmed:.1%} of full scale darker when the rest is "
                "lit; switch off automatic exposure and dynamic contrast"
            )

    def _measure_latency(self, black: np.ndarray, white: np.ndarray, accuracy: float) -> float:
        """The most seconds until a flash, to white or to black, shows."""
        self._uniform_frames(0.0, 1)
        latency = 0.0
        for _ in range(FLASHES):
            latency = max(latency, self._wait_for_flash(1.0, white, accuracy))
            latency = max(latency, self._wait_for_flash(0.0, black, accuracy))
        return latency

    def _measure_drift(self, white: np.ndarray, mean_at_rest: np.ndarray, accuracy: float) -> float:
        """Relative change of the brightness between right after a flash and at rest."""
        self._wait_for_flash(1.0, white, accuracy)
        # One frame later: the exposure of the first may have begun too early.
        mean = self.link.frame().cells.mean(axis=(0, 1))
        drift = relative_drift(mean, mean_at_rest, CODE_STEP)
        if drift > self.max_drift:
            raise AcquisitionError(
                f"the camera drifts by {drift:.1%} between identical shots, "
                f"drift={self.max_drift:g}: switch off automatic exposure, white balance, "
                "flickering lamps"
            )
        return drift

    def _wait_for_flash(self, code: float, after: np.ndarray, accuracy: float) -> float:
        """Seconds until a flash of a code shows, as the cells `after`."""
        self.link.show_uniform(code)
        while True:
            frame = self.link.frame()
            is_different = np.abs(frame.cells - after) > accuracy
            if np.mean(is_different) <= MAX_OUTLIER_SHARE:
                return max(frame.waited, 0.0)
            if frame.waited > self.patience + self.link.seconds:
                raise AcquisitionError(
                    f"no flash of the display is seen within {frame.waited:.2g} s"
                )

    def _uniform_frames(self, code: float, count: int) -> np.ndarray:
        """Cells of frames of one code at rest, (count, a, b, channels)."""
        self.link.show_uniform(code)
        return self._frames_at_rest(count)

    def _frames_at_rest(self, count: int) -> np.ndarray:
        self.link.settle(self.patience + self.link.seconds)
        return self.link.frames(count)


def _frame_noise(frames: np.ndarray) -> float:
    """The largest change of a cell between two frames in a row."""
    return float(np.abs(np.diff(frames, axis=0)).max())
