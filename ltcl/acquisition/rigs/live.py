# SPDX-License-Identifier: BSD-3-Clause
"""`LiveRig`: a camera on a cable photographs what a display shows.

Frames are compared by the means of square cells, about 64 along the shorter side. Before the first
photograph is measured:

    exposure    at most 1/15 s, halved until white saturates less than a hundredth of the cells
    noise       the largest change of a cell between frames of the same picture, black and white
    dimming     a strip of white, then all white: no cell may get darker, as by a fast automatic
    exposure latency     from a flash until all but a hundredth of the cells show it, to a tenth of
    the contrast drift       of the mean, right after a flash and at rest, by a slow automatic
    exposure or white balance

Then two frames in a row must be the same but for noise, none half-changed (torn). Where codes or
exposure changed and the frame did not, or both changed, it may be an old one: a flash, blocks at
random, is shown in between and must be seen to come and to go. Photographs of the same codes and
seconds must be as bright. Projectors show colours one after the other: an exposure of n + f
periods, 0 < f < 1, catches up to 3 f / (n + f) more or less of one. So exposures are offered only
within 2 % of a whole number of periods.
"""

from __future__ import annotations

import logging
import time
from typing import Any, NamedTuple

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition import rig
from ltcl.acquisition.rig import Closing, as_exposures, as_shot, require_members, shot_key, to_unit
from ltcl.errors import AcquisitionError, InputError

_log = logging.getLogger(__name__)
_ACROSS = 64  # cells
_USUAL, _TRIALS = 1 / 15, 6  # seconds of the longest exposure that is tried; exposures that are
_FRAMES, _FLASHES = 6, 4  # of the same picture; to white, and as many to black
_ARRIVED, _OUTLIERS = (
    0.1,
    0.01,
)  # difference from a flash, of white; share of cells that may differ more
_SAFETY = 1.5  # over the largest noise that was seen in some ten thousand differences
_STEP = 1 / 255  # a code of the coarsest camera: changes below are none
_VISIBLE = 4.0  # times the noise: what must be seen
_FLICKER, _BRIGHT = 0.1, 0.98  # of full scale: more noise than that; here a pixel may hold no more
_DIM = 0.1  # of full scale: brightness is compared relative to that at least
_MARGIN = 0.02  # seconds to wait beyond the slowest flash
_TRIES, _TWINS = (
    6,
    3,
)  # frames before refusal; frames without any difference that a camera may repeat
_FRACTION = 0.02  # of an exposure, which is no whole period
_PERIODS = sorted(
    count << k for count in (1, 3) for k in range(20)
)  # of an exposure: 1, 2, 3, 4, 6, 8, 12


class Frame(NamedTuple):
    """A frame as the camera gave it, and when it came or its shutter opened."""

    codes: np.ndarray  # (H, W) or (H, W, 3)
    cells: np.ndarray  # (a, b, channels) float32, of full scale
    waited: float  # seconds since the last change


class Survey(NamedTuple):
    """What the tests measured; of full scale where nothing else is said."""

    latency: float  # the most seconds from a change to its first frame
    seconds: float  # exposure of the tests
    tolerance: float  # change of a cell that noise explains
    contrast: float  # largest difference of a cell between white and black
    drift: float  # relative change of the brightness between identical frames


class LiveRig(Closing):
    """A camera and a display; `survey` is what their tests measured, None before the first photograph.

    A camera is `OpenCVCamera`, `GPhoto2Camera`, or any with `channels`, 1 or 3; `stream`, whether
    frames come by themselves and may wait in a queue; `expose(seconds)`; and `frame()`, uint8,
    uint16 or float, (H, W) or (H, W, 3). Optional: `exposures`, seconds, ascending (else any within
    `limits`, else 1e-4 to 30); `bits` of uint16 (else 16); `describe()`, a dict of plain JSON;
    `close()`. A display is `Display`, or any with `grid`, `period` and `show(codes)`.

    `period` is that of the projector's pictures, whose multiples are offered as `exposures`:
    seconds, as the "display" says, or None for steady light (LCD, LCoS). `drift` is the largest
    relative difference of brightness between identical shots. Within `patience` seconds everything
    is at rest.
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
        self.exposures = as_exposures("camera.exposures", getattr(camera, "exposures", None))
        if period == "display" and (period := display.period) is None:
            _log.warning(
                "the display has no known period: exposures are not checked for whole periods"
            )
        self._period = (
            None if period is None else checks.number("period", period, above=0.0, most=1.0)
        )
        if self._period is not None:
            least, most = getattr(camera, "limits", (rig.SHORTEST, rig.LONGEST))
            times = [n * self._period for n in _PERIODS]
            offered = self.exposures or [t for t in times if least <= t <= most * (1 + 1e-9)]
            nearest = [max(round(t / self._period), 1) * self._period for t in offered]
            pairs = zip(offered, nearest, strict=True)
            self.exposures = tuple(t for t, whole in pairs if abs(t - whole) <= _FRACTION * t)
            if not self.exposures:
                raise InputError(
                    f"period is {self._period:.4g} s; it must divide an exposure of the camera"
                )
        self._drift = checks.number("drift", drift, above=0.0, below=1.0)
        self._patience = checks.number("patience", patience, above=0.0, most=60.0)
        self._camera, self._display = camera, display
        self.survey: Survey | None = None
        self._seconds = 0.0  # of exposure, once set
        self._changed = -float("inf")
        self._first: tuple[tuple[int, ...], np.dtype] | None = None
        self._count = 0
        self._brightness: dict[str, np.ndarray] = {}
        self._shown: np.ndarray | None = None
        self._last: Frame | None = None
        self._latency = 0.0
        self._random = np.random.default_rng(0)

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """The camera's frame under `codes`, (h, w) or (h, w, 3) in [0, 1].

        AcquisitionError where the camera is gone, adapts, drifts, or shows old or half-changed
        frames.
        """
        codes, seconds = as_shot(self, codes, seconds)
        try:
            self.survey = self.survey or self._measure()
            self._latency = max(self._latency, self.survey.latency)
            frame = self._fresh(codes, seconds, self.survey)
            mean = frame.cells.mean(axis=(0, 1))
            before = self._brightness.setdefault(shot_key(codes, seconds), mean)
            if (drift := _drift(mean, before, _DIM)) > self._drift:
                text = f"brightness deviates by {drift:.1%} from an earlier one of the same codes and seconds"
                raise AcquisitionError(
                    f"{text}, drift={self._drift:g}: camera, lamp or room light drifts"
                )
        except AcquisitionError as error:
            raise AcquisitionError(f"photograph {self._count + 1}: {error}") from error
        self._count += 1
        return frame.codes

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Remember a photograph of an earlier session: one of the same shot must be as bright."""
        key = shot_key(*as_shot(self, codes, seconds))
        self._brightness.setdefault(key, _cells(to_unit("image", image, self)).mean(axis=(0, 1)))
        self._count += 1

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        ends = (self._camera, self._display)
        camera, display = (
            getattr(e, "describe", lambda e=e: {"kind": type(e).__name__})() for e in ends
        )
        facts = {"kind": "live", "projector_grid": self.projector_grid, "channels": self.channels}
        facts |= {
            "camera": camera,
            "display": display,
            "period": self._period,
            "exposures": self.exposures,
        }
        return facts | {"survey": self.survey and self.survey._asdict()}

    def close(self) -> None:
        """Close camera and display, where they can be closed."""
        for end in (self._camera, self._display):
            getattr(end, "close", lambda: None)()

    def _fresh(self, codes: np.ndarray, seconds: float, survey: Survey) -> Frame:
        """A frame of `codes`, exposed for `seconds`."""
        shown, last = self._shown, self._last
        self._shown = self._last = None  # after an error nothing is known of the frames to come
        moved = shown is None or not np.array_equal(shown, codes)
        timed = self._seconds != seconds
        self._expose(seconds)
        if moved:
            self._show(codes)
        frame = self._steady(survey)
        seen = last is not None and _change(frame, last) > survey.tolerance
        if (moved and timed) or ((moved or timed) and not seen):
            frame = self._after_flash(codes, frame, survey)
        self._shown, self._last = codes.copy(), frame
        return frame

    def _steady(self, survey: Survey) -> Frame:
        """The second of two frames in a row that are the same but for noise."""
        wait = self._latency + _MARGIN
        if self._camera.stream:  # a frame comes at the end of its exposure, which may be longer now
            wait += max(0.0, self._seconds - survey.seconds)
        self._settle(wait)
        first, twins, changed = self._frame(), 0, 0.0
        for _ in range(_TRIES + _TWINS):
            second = self._frame()
            twins = twins + 1 if np.array_equal(first.codes, second.codes) else 0
            changed = _change(first, second)
            if (
                changed <= survey.tolerance and not 0 < twins <= _TWINS
            ):  # the same frame once more, perhaps
                return second
            first = second
        text = (
            f"frames still change by {changed:.1%} of full scale, {survey.tolerance:.1%} is noise"
        )
        raise AcquisitionError(f"{text}: half-changed frames, flicker, or something moves")

    def _after_flash(self, codes: np.ndarray, frame: Frame, survey: Survey) -> Frame:
        """A frame that looks the same before and after a flash, which looks different.

        Frames come in the order of what was shown, and only `codes` twice. Where that fails,
        latency has grown, and from now on `patience` passes before each frame. In an exposure too
        short to see a flash, or where all is saturated, nothing can be compared.
        """
        h, w = self.projector_grid
        light = survey.contrast * min(1.0, self._seconds / survey.seconds)
        is_visible = light > _VISIBLE * survey.tolerance and frame.cells.min() < _BRIGHT
        for _ in range(_TRIES):
            blocks = self._random.integers(0, 2, (4, 4)).astype(np.float32)
            self._show(cv2.resize(blocks, (w, h), interpolation=cv2.INTER_NEAREST))
            between = self._steady(survey)
            self._show(codes)
            before, frame = frame, self._steady(survey)
            is_seen = min(_change(between, before), _change(between, frame)) > survey.tolerance
            if not is_visible or (is_seen and _change(frame, before) <= survey.tolerance):
                return frame
            self._latency = max(self._latency, self._patience)
        raise AcquisitionError(
            f"the frame is stale: in {_TRIES} trials no flash of the display is seen"
        )

    def _show(self, codes: Any) -> None:
        """Show codes, or one code everywhere."""
        self._display.show(
            codes if np.ndim(codes) else np.full(self.projector_grid, codes, np.float32)
        )
        self._changed = time.monotonic()

    def _expose(self, seconds: float) -> None:
        if seconds != self._seconds:
            self._seconds = 0.0
            self._camera.expose(seconds)
            self._seconds, self._changed = seconds, time.monotonic()

    def _settle(self, seconds: float) -> None:
        """Wait until so many seconds after the last change, and drop the frames of a stream meanwhile."""
        while (left := self._changed + seconds - time.monotonic()) > 0:
            if self._camera.stream:
                self._camera.frame()
            else:
                time.sleep(left)

    def _frame(self) -> Frame:
        released = time.monotonic()
        codes = np.asarray(self._camera.frame())
        moment = time.monotonic() if self._camera.stream else released
        scaled = to_unit("the frame", codes, self._camera, self._first)
        self._first = codes.shape, codes.dtype
        return Frame(codes, _cells(scaled), moment - self._changed)

    def _still(self, codes: Any, count: int = 1) -> np.ndarray:
        """Cells of frames of codes at rest: (count, a, b, channels)."""
        self._show(codes)
        self._settle(self._patience + self._seconds)
        return np.stack([self._frame().cells for _ in range(count)])

    def _measure(self) -> Survey:
        """Run the tests, in an exposure in which white is not saturated."""
        halved = [_USUAL / 2**k for k in range(_TRIALS)]
        offered, seconds = self.exposures or halved, _USUAL
        for most in halved:
            seconds = max((s for s in offered if s <= most), default=min(offered))
            self._expose(seconds)
            if np.mean(self._still(1.0) > _BRIGHT) <= _OUTLIERS:
                break
        else:
            raise AcquisitionError(
                f"white is saturated at {seconds:.4g} s; reduce aperture or gain"
            )
        dark, lit = self._still(0.0, _FRAMES), self._still(1.0, _FRAMES)
        noise = max(float(np.abs(np.diff(frames, axis=0)).max()) for frames in (dark, lit))
        if noise > _FLICKER:
            text = f"frames of the same picture differ by {noise:.1%} of full scale"
            raise AcquisitionError(
                f"{text}: something flickers or moves, or the display's period is wrong"
            )
        black, white = dark[-1], lit[-1]
        contrast = float((white - black).max())
        if contrast < _VISIBLE * max(noise, _STEP):
            text = f"white is {contrast:.2%} of full scale above black, noise {noise:.2%}, at {seconds:.4g} s"
            raise AcquisitionError(
                f"the camera does not see the display: {text}; open the aperture, or aim"
            )
        tolerance = _SAFETY * (noise + _STEP)
        h, w = self.projector_grid
        strip = np.broadcast_to(np.arange(w) < max(1, w // 4), (h, w)).astype(np.float32)
        dimmed = float((self._still(strip)[0] - white).max())
        if dimmed > tolerance:
            text = f"the camera adapts: a strip is {dimmed:.1%} of full scale darker when the rest is lit"
            raise AcquisitionError(f"{text}; switch off automatic exposure and dynamic contrast")
        self._still(0.0)
        accuracy = max(tolerance, _ARRIVED * contrast)
        flashes = [(1.0, white), (0.0, black)] * _FLASHES
        latency = max(self._wait_for(code, cells, accuracy) for code, cells in flashes)
        self._wait_for(1.0, white, accuracy)
        mean = self._frame().cells.mean(axis=(0, 1))  # the frame before may have begun too early
        if (drift := _drift(mean, lit.mean(axis=(0, 1, 2)), _STEP)) > self._drift:
            text = (
                f"the camera drifts by {drift:.1%} between identical shots, drift={self._drift:g}"
            )
            raise AcquisitionError(
                f"{text}: switch off automatic exposure, white balance, flickering lamps"
            )
        return Survey(latency, seconds, tolerance, contrast, drift)

    def _wait_for(self, code: float, after: np.ndarray, tolerance: float) -> float:
        """Seconds until a flash of a code shows, as the cells `after`."""
        self._show(code)
        while True:
            frame = self._frame()
            if np.mean(np.abs(frame.cells - after) > tolerance) <= _OUTLIERS:
                return max(frame.waited, 0.0)
            if frame.waited > self._patience + self._seconds:
                raise AcquisitionError(
                    f"no flash of the display is seen within {frame.waited:.2g} s"
                )


def _cells(image: np.ndarray) -> np.ndarray:
    """Means over square cells: (H, W) or (H, W, c) -> (a, b, c), float32."""
    h, w = image.shape[:2]
    side = max(1, min(h, w) // _ACROSS)
    small = (
        image
        if side == 1
        else cv2.resize(image, (w // side, h // side), interpolation=cv2.INTER_AREA)
    )
    return np.ascontiguousarray(small.reshape(*small.shape[:2], -1), np.float32)


def _change(a: Frame, b: Frame) -> float:
    """The largest difference of a cell, of full scale."""
    return float(np.abs(a.cells - b.cells).max())


def _drift(now: np.ndarray, before: np.ndarray, least: float) -> float:
    """Difference of two means, (channels,), relative to at least `least`, of the worst one."""
    return float(np.max(np.abs(now - before) / np.maximum(before, least)))
