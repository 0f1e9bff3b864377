# SPDX-License-Identifier: BSD-3-Clause
"""A camera and a display in time, and their tests before the first photograph.

Frames are compared by the means of square cells, about 64 along the shorter side: fine enough for a torn
strip or a single bright spot, coarse enough to average noise.

    latency     the display turns white, or black; the time until a frame shows it. Of several flashes the
                median and the longest.
    noise       the largest change of a cell between frames of the same picture, black and white
    dimming     a strip of white alone, then all white: with more light no cell may get darker. Where one
                does, an automatic exposure is at work, which may be too fast for the next test.
    drift       a frame right after a flash, and one a while later: a slow automatic exposure or white
                balance. The figure is the relative difference of the means, of the worst channel; 5 standard
                deviations of it, which the noise of few pixels explains, are no drift.

A cell is lit where white differs from black by at least a fifth of the largest difference, and by more than
noise does. A flash has arrived once all but a hundredth of the lit cells have changed by nine tenths, or as
far as noise allows, so a half-changed frame does not count.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from ltcl.acquisition.rig import check_photograph, to_unit
from ltcl.errors import AcquisitionError

_ACROSS = 64  # cells
_FRAMES = 6  # of the same picture
_LIT, _ARRIVED, _OUTLIERS = 0.2, 0.9, 0.01
_SAFETY = 1.5  # over the largest noise that was seen in some ten thousand differences
_SIGMAS = 5.0  # standard deviations between the means of two frames that noise explains
_STEP = 1 / 255  # a code of the coarsest camera: changes below are none
_VISIBLE = 4.0  # times the noise: the least of white
_FLICKER = 0.1  # of full scale: more noise than that
BRIGHT = 0.98
"""Of full scale: here a pixel may hold no more."""


class Frame(NamedTuple):
    """A frame as the camera gave it, its cells, and a time before which its exposure may have begun."""

    codes: np.ndarray  # (H, W) or (H, W, 3)
    cells: np.ndarray  # (a, b, channels) float32, of full scale
    time: float


@dataclass(frozen=True)
class Survey:
    """What the tests measured; of full scale where nothing else is said."""

    latency: float  # median of the seconds from a change to its first frame
    worst: float  # the longest of them
    seconds: float  # exposure of the tests
    tolerance: float  # change of a cell that noise explains
    contrast: float  # largest difference of a cell between white and black
    drift: float  # relative change of the brightness between identical frames
    noise: float  # difference of the brightness of two identical frames that noise explains


class Stage:
    """A camera that looks at a display, and when the last of them was changed."""

    def __init__(self, camera: Any, display: Any) -> None:
        self.camera, self.display = camera, display
        self.seconds: float | None = None  # of exposure, once set
        self._changed = -float("inf")
        self._kind: tuple[tuple[int, ...], np.dtype] | None = None

    def show(self, codes: Any) -> None:
        """Show codes, or one code everywhere."""
        self.display.show(codes if np.ndim(codes) else np.full(self.display.grid, codes, np.float32))
        self._changed = time.monotonic()

    def expose(self, seconds: float) -> None:
        """Set the exposure, where it is another."""
        if seconds != self.seconds:
            self.seconds = None
            self.camera.expose(seconds)
            self.seconds, self._changed = seconds, time.monotonic()

    def settle(self, seconds: float) -> None:
        """Wait until so many seconds after the last change, and drop the frames of a stream meanwhile."""
        while (left := seconds - self.since(time.monotonic())) > 0:
            if self.camera.stream:
                self.camera.frame()
            else:
                time.sleep(left)

    def since(self, moment: float) -> float:
        """Seconds from the last change to `moment`."""
        return moment - self._changed

    def frame(self) -> Frame:
        """The next frame. Its time is its arrival from a stream, else the shutter's release."""
        released = time.monotonic()
        codes = np.asarray(self.camera.frame())
        moment = time.monotonic() if self.camera.stream else released
        check_photograph("the frame", codes, self.camera.channels, self._kind)
        self._kind = codes.shape, codes.dtype
        return Frame(codes, cells(to_unit("the frame", codes, self.camera)), moment)

    def at_rest(self, codes: Any, patience: float) -> Frame:
        """A frame of codes that have been shown for so long."""
        self.show(codes)
        self.settle(patience + (self.seconds or 0.0))
        return self.frame()


def cells(image: np.ndarray) -> np.ndarray:
    """Means over square cells: (H, W) or (H, W, c) -> (a, b, c), float32.

    >>> cells(np.ones((480, 640), np.float32)).shape, cells(np.ones((3, 4, 3), np.float32)).shape
    ((68, 91, 1), (3, 4, 3))
    """
    h, w = image.shape[:2]
    side = max(1, min(h, w) // _ACROSS)
    small = image if side == 1 else cv2.resize(image, (w // side, h // side), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small.reshape(*small.shape[:2], -1), np.float32)


def change(a: Frame, b: Frame) -> float:
    """The largest difference of a cell between two frames, of full scale."""
    return float(np.abs(a.cells - b.cells).max())


def drift(now: np.ndarray, before: np.ndarray, least: float, noise: float) -> tuple[float, float]:
    """Relative difference of brightness, of the worst channel, and what noise does not explain of it.

    `now` and `before` are means (channels,) of two frames, differences relative to at least `least`.
    """
    difference, whole = np.abs(now - before), np.maximum(before, least)
    return float(np.max(difference / whole)), float(np.max((difference - noise) / whole))


def is_saturated(stage: Stage, seconds: float, patience: float) -> bool:
    """Whether white light fills a hundredth of the cells in this exposure."""
    stage.expose(seconds)
    return bool(np.mean(stage.at_rest(1.0, patience).cells > BRIGHT) > _OUTLIERS)


def survey(stage: Stage, seconds: float, *, flashes: int, patience: float, accepted: float) -> Survey:
    """Run the tests at an exposure; arguments and `accepted` drift as of `LiveRig`.

    AcquisitionError where the camera does not see the display, flickers, adapts, or misses a flash.
    """
    stage.expose(seconds)
    dark, black, dim = _measure_noise(stage, 0.0, patience)
    bright, white, lit = _measure_noise(stage, 1.0, patience)
    noise, explained = max(dark, bright), max(dim, lit)
    contrast = float((white.cells - black.cells).max())
    if contrast < _VISIBLE * max(noise, _STEP):
        raise AcquisitionError(
            f"the camera does not see the display: white is {contrast:.2%} of full scale above black, noise "
            f"{noise:.2%}, exposure {seconds:.4g} s; open the aperture, or point the camera at the picture"
        )
    tolerance = _SAFETY * (noise + _STEP)
    h, w = stage.display.grid
    strip = np.broadcast_to(np.arange(w) < max(1, w // 4), (h, w)).astype(np.float32)
    dimmed = float((stage.at_rest(strip, patience).cells - white.cells).max())
    if dimmed > tolerance:
        raise AcquisitionError(
            f"the camera adapts: a part of the picture is {dimmed:.1%} of full scale darker when the rest is "
            "lit as well; switch off the camera's automatic exposure and the projector's dynamic contrast"
        )
    stage.show(0.0)
    stage.settle(patience + seconds)
    latencies = []
    for number in range(flashes):
        before, after = (white, black) if number % 2 else (black, white)
        stage.show(float(after is white))
        latencies.append(_latency(stage, before, after, patience, tolerance))
    relative, beyond = _measure_drift(stage, max(latencies), patience, explained)
    if beyond > accepted:
        raise AcquisitionError(
            f"the camera drifts by {relative:.1%} between identical shots, {accepted:.1%} is accepted: "
            "switch off automatic exposure and white balance, and lamps that flicker"
        )
    latency = float(np.median(latencies))
    return Survey(latency, max(latencies), seconds, tolerance, contrast, relative, explained)


def _measure_noise(stage: Stage, code: float, patience: float) -> tuple[float, Frame, float]:
    """Of frames of the same picture the largest change, the last one, and what noise changes of means."""
    frames = [stage.at_rest(code, patience), *(stage.frame() for _ in range(_FRAMES - 1))]
    noise = max(change(a, b) for a, b in zip(frames[1:], frames, strict=False))
    if noise > _FLICKER:
        raise AcquisitionError(
            f"frames of the same picture differ by {noise:.1%} of full scale: something flickers or moves, "
            "or the exposure is no multiple of the display's period"
        )
    many = np.stack([frame.cells for frame in frames])
    a, b, _ = frames[0].cells.shape
    variance = float(many.var(axis=0, ddof=1).mean(axis=(0, 1)).max()) / (a * b)
    return noise, frames[-1], _SIGMAS * float(np.sqrt(2 * variance))


def _latency(stage: Stage, before: Frame, after: Frame, patience: float, tolerance: float) -> float:
    """Seconds until a flash shows that turns the frame `before` into `after`."""
    whole = after.cells - before.cells
    largest = np.abs(whole).max()
    lit = np.abs(whole) > max(_LIT * largest, min(2 * tolerance, largest / 2))
    while True:
        frame = stage.frame()
        waited = stage.since(frame.time)
        changed = (frame.cells - before.cells)[lit] / whole[lit] > _ARRIVED
        if np.mean(changed | (np.abs(frame.cells - after.cells)[lit] <= tolerance)) >= 1 - _OUTLIERS:
            return max(waited, 0.0)
        if waited > patience + (stage.seconds or 0.0):
            raise AcquisitionError(f"no frame shows a flash of the display within {waited:.2g} s")


def _measure_drift(stage: Stage, latency: float, patience: float, noise: float) -> tuple[float, float]:
    """Between frames right after a flash and some a while later; as `drift`."""
    stage.show(0.0)
    stage.settle(patience + (stage.seconds or 0.0))
    stage.show(1.0)
    means = []
    for wait in (latency, latency + patience):
        stage.settle(wait)
        if not means:
            stage.frame()  # it may have begun a little before
        means.append(np.mean([stage.frame().cells.mean(axis=(0, 1)) for _ in range(2)], axis=0))
    early, late = means
    return drift(early, late, _STEP, noise / np.sqrt(2.0))
