# SPDX-License-Identifier: BSD-3-Clause
"""`LiveRig`: a camera on a cable photographs a display.

Before the first photograph the tests of `survey` run. Then two frames in a row must be the same but
for noise, none half-changed (torn). If codes or exposure changed and the frame did not, or both
changed, it may be an old one: a flash, blocks at random, is shown in between and must be seen to
come and to go. Photographs of the same codes and seconds must be as bright.

Projectors show colours one after the other: an exposure of n + f periods, 0 < f < 1, catches up to
3 f / (n + f) more or less of one. So exposures are offered only within 2 % of a whole number of
periods.
"""

from __future__ import annotations

import logging
from typing import Any

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import (
    LONGEST,
    SHORTEST,
    Closing,
    as_exposures,
    as_shot,
    require_members,
    shot_key,
    to_unit,
)
from ltcl.acquisition.rigs.link import (
    CameraLink,
    CapturedFrame,
    cell_means,
    largest_change,
    relative_drift,
)
from ltcl.acquisition.rigs.survey import SATURATED, VISIBLE_FACTOR, Survey, SurveyTests
from ltcl.errors import AcquisitionError, InputError

_log = logging.getLogger(__name__)

# Brightness of photographs is compared relative to this part of full scale at least.
MIN_BRIGHTNESS = 0.1

# Seconds to wait beyond the slowest flash.
LATENCY_MARGIN = 0.02

# Flashes, and pairs of frames, before refusal.
MAX_TRIALS = 6

# Frames without any difference that a camera may repeat.
MAX_TWINS = 3

# Blocks along each side of a flash.
FLASH_BLOCKS = 4

# Part of an exposure by which it may differ from a whole number of periods.
MAX_PERIOD_DEVIATION = 0.02

# Periods of the exposures that are offered: 2^k and 3 2^k, 1, 2, 3, 4, 6, 8, 12, ...
POWERS_OF_TWO = [1 << k for k in range(20)]
PERIOD_COUNTS = sorted(POWERS_OF_TWO + [3 * power for power in POWERS_OF_TWO])


class LiveRig(Closing):
    """A camera that photographs a display.

    Parameters
    ----------
    camera : object
        `OpenCVCamera`, `GPhoto2Camera`, or any object with `channels`, 1 or 3; `stream`, whether
        frames come by themselves and may wait in a queue; `expose(seconds)`; and `frame()`, which
        returns uint8, uint16 or float, (H, W) or (H, W, 3). Optional members: `exposures`, seconds,
        ascending (else any within `limits`, else 1e-4 to 30); `bits` of uint16 (else 16);
        `white_level`, the code of saturated pixels (else the largest); `describe()`, a dict of
        plain JSON; `close()`.
    display : object
        `Display`, or any object with `grid`, `period` and `show(codes)`.
    period : "display", float or None
        Period in seconds of the projector's pictures, whose multiples are offered as `exposures`:
        that of the display, a number, or None for steady light (LCD, LCoS).
    drift : float
        Largest relative difference of brightness between identical shots.
    patience : float
        Seconds within which everything is at rest.

    Attributes
    ----------
    survey : Survey or None
        Results of the tests of camera and display; None before the first photograph.

    Raises
    ------
    InputError, InputTypeError
        An argument cannot be used, or no exposure of the camera is a multiple of the period.
    """

    def __init__(
        self,
        camera: Any,
        display: Any,
        *,
        period: Any = "display",
        drift: float = 0.02,
        patience: float = 1,
    ) -> None:
        require_members("camera", camera, "channels", "stream", "expose", "frame")
        require_members("display", display, "grid", "period", "show")
        self.projector_grid = checks.grid("display.grid", display.grid)
        self.channels = checks.one_of("camera.channels", camera.channels, (1, 3))
        self.bits = getattr(camera, "bits", None)
        self.white_level = getattr(camera, "white_level", None)
        exposures = getattr(camera, "exposures", None)
        self.exposures = as_exposures("camera.exposures", exposures)
        self._period = _check_period(period, display)
        if self._period is not None:
            limits = getattr(camera, "limits", (SHORTEST, LONGEST))
            self.exposures = _whole_periods(self.exposures, limits, self._period)
        self._max_drift = checks.number("drift", drift, above=0.0, below=1.0)
        self._patience = checks.number("patience", patience, above=0.0, most=60.0)
        self._link = CameraLink(camera, display, self.projector_grid)
        self.survey: Survey | None = None
        self._latency = 0.0
        self._count = 0
        # Mean of the cells of each channel, by the key of the shot.
        self._brightness: dict[str, np.ndarray] = {}
        # Codes and frame of the last photograph; unknown after an error.
        self._last_codes: np.ndarray | None = None
        self._last_frame: CapturedFrame | None = None
        self._random = np.random.default_rng(0)

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """Photograph the projection of codes.

        Parameters
        ----------
        codes : (h, w) or (h, w, 3) array_like
            Codes in [0, 1].
        seconds : float
            Exposure.

        Returns
        -------
        (H, W) or (H, W, 3) array
            Codes as the camera gave them.

        Raises
        ------
        AcquisitionError
            The camera is gone, adapts, drifts, or shows old or half-changed frames.
        """
        codes, seconds = as_shot(self, codes, seconds)
        try:
            if self.survey is None:
                self.survey = self._measure()
            self._latency = max(self._latency, self.survey.latency)
            frame = self._fresh_frame(codes, seconds, self.survey)
            self._check_brightness(shot_key(codes, seconds), frame)
        except AcquisitionError as error:
            raise AcquisitionError(f"photograph {self._count + 1}: {error}") from error
        self._count += 1
        return frame.codes

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Remember a photograph of an earlier session: one of the same shot must be as bright."""
        key = shot_key(*as_shot(self, codes, seconds))
        cells = cell_means(to_unit("image", image, self))
        self._brightness.setdefault(key, cells.mean(axis=(0, 1)))
        self._count += 1

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        return {
            "kind": "live",
            "projector_grid": self.projector_grid,
            "channels": self.channels,
            "camera": _describe_instrument(self._link.camera),
            "display": _describe_instrument(self._link.display),
            "period": self._period,
            "exposures": self.exposures,
            "survey": None if self.survey is None else self.survey._asdict(),
        }

    def close(self) -> None:
        """Close camera and display, if they can be closed."""
        for instrument in (self._link.camera, self._link.display):
            if hasattr(instrument, "close"):
                instrument.close()

    def _measure(self) -> Survey:
        tests = SurveyTests(
            self._link,
            self.exposures,
            patience=self._patience,
            max_drift=self._max_drift,
        )
        return tests.run()

    def _fresh_frame(self, codes: np.ndarray, seconds: float, survey: Survey) -> CapturedFrame:
        """A frame of `codes`, exposed for `seconds`."""
        last_codes = self._last_codes
        last_frame = self._last_frame
        self._last_codes = None
        self._last_frame = None
        has_new_codes = True
        if last_codes is not None:
            has_new_codes = not np.array_equal(last_codes, codes)
        has_new_exposure = self._link.seconds != seconds
        self._link.expose(seconds)
        if has_new_codes:
            self._link.show(codes)
        frame = self._steady_frame(survey)

        is_different = False
        if last_frame is not None:
            is_different = largest_change(frame, last_frame) > survey.tolerance
        both_changed = has_new_codes and has_new_exposure
        one_changed = has_new_codes or has_new_exposure
        if both_changed or (one_changed and not is_different):
            frame = self._frame_after_flash(codes, frame, survey)
        self._last_codes = codes.copy()
        self._last_frame = frame
        return frame

    def _steady_frame(self, survey: Survey) -> CapturedFrame:
        """The second of two frames in a row that are the same but for noise."""
        wait = self._latency + LATENCY_MARGIN
        if self._link.is_stream:
            # A frame comes at the end of its exposure, which may be longer than that of the tests.
            wait += max(0.0, self._link.seconds - survey.seconds)
        self._link.settle(wait)
        first = self._link.frame()
        twins = 0
        change = 0.0
        for _ in range(MAX_TRIALS + MAX_TWINS):
            second = self._link.frame()
            if np.array_equal(first.codes, second.codes):
                twins += 1
            else:
                twins = 0
            change = largest_change(first, second)
            may_be_repeated = 0 < twins <= MAX_TWINS
            if change <= survey.tolerance and not may_be_repeated:
                return second
            first = second
        raise AcquisitionError(
            f"frames still change by {change:.1%} of full scale, noise explains "
            f"{survey.tolerance:.1%}: half-changed frames, flicker, or something moves"
        )

    def _frame_after_flash(
        self, codes: np.ndarray, frame: CapturedFrame, survey: Survey
    ) -> CapturedFrame:
        """A frame that looks the same before and after a flash, which looks different.

        Frames come in the order of the pictures shown, and only `codes` twice. If that fails,
        latency has grown, and from now on `patience` passes before each frame. In an exposure too
        short to see a flash, or if all is saturated, nothing can be compared.
        """
        light = survey.contrast * min(1.0, self._link.seconds / survey.seconds)
        is_bright = light > VISIBLE_FACTOR * survey.tolerance
        is_visible = is_bright and frame.cells.min() < SATURATED
        for _ in range(MAX_TRIALS):
            self._link.show(self._random_blocks())
            between = self._steady_frame(survey)
            self._link.show(codes)
            before = frame
            frame = self._steady_frame(survey)
            if not is_visible:
                return frame
            flash_begin = largest_change(between, before)
            flash_end = largest_change(between, frame)
            is_flash_seen = min(flash_begin, flash_end) > survey.tolerance
            is_same = largest_change(frame, before) <= survey.tolerance
            if is_flash_seen and is_same:
                return frame
            self._latency = max(self._latency, self._patience)
        raise AcquisitionError(
            f"the frame is stale: in {MAX_TRIALS} trials no flash of the display is seen"
        )

    def _random_blocks(self) -> np.ndarray:
        h, w = self.projector_grid
        size = (FLASH_BLOCKS, FLASH_BLOCKS)
        blocks = self._random.integers(0, 2, size).astype(np.float32)
        return cv2.resize(blocks, (w, h), interpolation=cv2.INTER_NEAREST)

    def _check_brightness(self, key: str, frame: CapturedFrame) -> None:
        """Refuse a frame that is not as bright as the first one of the same shot."""
        mean = frame.cells.mean(axis=(0, 1))
        before = self._brightness.setdefault(key, mean)
        drift = relative_drift(mean, before, MIN_BRIGHTNESS)
        if drift > self._max_drift:
            raise AcquisitionError(
                f"brightness deviates by {drift:.1%} from an earlier one of the same codes and "
                f"seconds, drift={self._max_drift:g}: camera, lamp or room light drifts"
            )


def _check_period(period: Any, display: Any) -> float | None:
    """The period in seconds; None for steady light, or if the display has none."""
    if period == "display":
        period = display.period
        if period is None:
            _log.warning(
                "the display has no known period: exposures are not checked for whole periods"
            )
    if period is None:
        return None
    return checks.number("period", period, above=0.0, most=1.0)


def _whole_periods(
    exposures: tuple[float, ...] | None, limits: tuple[float, float], period: float
) -> tuple[float, ...]:
    """Exposures that are whole periods: of those that the camera offers, else within its limits."""
    if exposures is None:
        least, most = limits
        multiples = period * np.array(PERIOD_COUNTS)
        is_possible = (multiples >= least) & (multiples <= most * (1 + 1e-9))
        exposures = tuple(multiples[is_possible].tolist())
    whole = []
    for seconds in exposures:
        nearest = max(round(seconds / period), 1) * period
        if abs(seconds - nearest) <= MAX_PERIOD_DEVIATION * seconds:
            whole.append(seconds)
    if not whole:
        raise InputError(f"period is {period:.4g} s; it must divide an exposure of the camera")
    return tuple(whole)


def _describe_instrument(instrument: Any) -> dict[str, Any]:
    """Camera or display as plain JSON."""
    if hasattr(instrument, "describe"):
        return instrument.describe()
    return {"kind": type(instrument).__name__}
