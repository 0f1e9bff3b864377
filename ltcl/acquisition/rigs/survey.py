# SPDX-License-Identifier: BSD-3-Clause
"""Tests of a camera and a display before the first photograph: latency, noise, and whether the camera adapts.

    latency     the display turns white, or black; the time until a frame shows it. Of several flashes the
                median and the longest.
    noise       the largest change of a cell between frames of the same picture, black and white
    dims?       a strip of white alone, then all white: with more light no cell may get darker. Where one
                does, an automatic exposure is at work, which may be too fast for the next test.
    drifts?     a frame right after a flash, and one a while later: a slow automatic exposure or white
                balance. The figure is the relative difference of the means, of the worst channel; 5 standard
                deviations of it, which the noise of few pixels explains, are no drift.

A cell is lit where white differs from black by at least a fifth of the largest difference, and by more than
noise does. A flash has arrived once all but a hundredth of the lit cells have come nine tenths of the way, or
as near to its end as noise lets them, so a half-changed frame does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl.acquisition.rigs.stage import Frame, Stage, change
from ltcl.errors import AcquisitionError

_FRAMES = 6  # of the same picture
_LIT, _ARRIVED, _OUTLIERS = 0.2, 0.9, 0.01
_SAFETY = 1.5  # over the largest noise that was seen in some ten thousand differences
_CLEAR = 5.0  # standard deviations between the means of two frames that noise explains
_STEP = 1 / 255  # a code of the coarsest camera: changes below are none
_VISIBLE = 4.0  # times the noise: the least of white
_SHAKY = 0.1  # of full scale: more noise than that is flicker
BRIGHT = 0.98
"""Of full scale: here a pixel may hold no more."""


@dataclass(frozen=True)
class Survey:
    """What the tests found.

    Attributes
    ----------
    latency : float
        Median of the seconds from a change to its first frame.
    worst : float
        The longest of them.
    seconds : float
        Exposure of the tests.
    tolerance : float
        Change of a cell, of full scale, that noise explains.
    contrast : float
        Largest difference of a cell between white and black, of full scale.
    drift : float
        Relative change of the brightness between identical frames.
    noise : float
        Difference of the brightness of two identical frames, of full scale, that noise explains.
    """

    latency: float
    worst: float
    seconds: float
    tolerance: float
    contrast: float
    drift: float
    noise: float


def survey(stage: Stage, seconds: float, *, flashes: int, patience: float, drift: float) -> Survey:
    """Run the tests.

    Parameters
    ----------
    stage : Stage
    seconds : float
        Of exposure.
    flashes : int
        To time, half of them to white.
    patience : float
        Seconds within which everything comes to rest.
    drift : float
        Relative change of the brightness that is still accepted.

    Raises
    ------
    AcquisitionError
        The camera does not see the display, flickers, adapts, or a flash does not arrive.
    """
    stage.expose(seconds)
    dark, black, dim = _at_rest(stage, 0.0, patience)
    bright, white, lit = _at_rest(stage, 1.0, patience)
    noise, explained = max(dark, bright), max(dim, lit)
    contrast = float((white.cells - black.cells).max())
    if contrast < _VISIBLE * noise or contrast < _VISIBLE * _STEP:
        raise AcquisitionError(
            f"the camera does not see the display: white is {contrast:.2%} of full scale above black, noise "
            f"is {noise:.2%}, exposure {seconds:.4g} s; open the aperture, or point the camera at the picture"
        )
    tolerance = _SAFETY * (noise + _STEP)
    _refuse_dimming(stage, white, tolerance, patience)
    latencies = _latencies(stage, (black, white), flashes, patience, tolerance)
    found, beyond = _drift(stage, max(latencies), patience, explained)
    if beyond > drift:
        raise AcquisitionError(
            f"the camera drifts by {found:.1%} between identical shots, {drift:.1%} is accepted: switch off "
            "automatic exposure and white balance, and lamps that flicker"
        )
    return Survey(float(np.median(latencies)), max(latencies), seconds, tolerance, contrast, found, explained)


def saturated(stage: Stage, seconds: float, patience: float) -> bool:
    """Whether white light fills a hundredth of the cells in this exposure."""
    stage.expose(seconds)
    _show(stage, 1.0)
    stage.settle(patience + seconds)
    return bool(np.mean(stage.frame().cells > BRIGHT) > _OUTLIERS)


def _show(stage: Stage, code: float) -> None:
    stage.show(np.full(stage.display.grid, code, np.float32))


def drifted(now: np.ndarray, before: np.ndarray, least: float, noise: float) -> tuple[float, float]:
    """Relative difference of brightness, of the worst channel, and what noise does not explain of it.

    Parameters
    ----------
    now, before : (channels,)
        Means of two frames.
    least : float
        Brightness that differences are relative to at least.
    noise : float
        Difference that noise explains.

    Examples
    --------
    >>> drifted(np.array([0.44]), np.array([0.4]), 0.1, 0.02)  # doctest: +ELLIPSIS
    (0.0999..., 0.0499...)
    """
    off, whole = np.abs(now - before), np.maximum(before, least)
    return float(np.max(off / whole)), float(np.max((off - noise) / whole))


def _at_rest(stage: Stage, code: float, patience: float) -> tuple[float, Frame, float]:
    """Of frames of the same picture the largest change, the last one, and what noise changes of means."""
    _show(stage, code)
    stage.settle(patience + (stage.seconds or 0.0))
    frames = [stage.frame() for _ in range(_FRAMES)]
    noise = max(change(a, b) for a, b in zip(frames[1:], frames, strict=False))
    if noise > _SHAKY:
        raise AcquisitionError(
            f"frames of the same picture differ by {noise:.1%} of full scale: something flickers or moves, "
            "or the exposure is no multiple of the display's period"
        )
    many = np.stack([frame.cells for frame in frames])
    a, b, _ = frames[0].cells.shape
    variance = float(many.var(axis=0, ddof=1).mean(axis=(0, 1)).max()) / (a * b)
    return noise, frames[-1], _CLEAR * float(np.sqrt(2 * variance))


def _refuse_dimming(stage: Stage, white: Frame, tolerance: float, patience: float) -> None:
    h, w = stage.display.grid
    strip = np.zeros((h, w), np.float32)
    strip[:, : max(1, w // 4)] = 1.0
    stage.show(strip)
    stage.settle(patience + (stage.seconds or 0.0))
    dimmed = float((stage.frame().cells - white.cells).max())
    if dimmed > tolerance:
        raise AcquisitionError(
            f"the camera adapts: a part of the picture is {dimmed:.1%} of full scale darker when the rest is "
            "lit as well; switch off the camera's automatic exposure and the projector's dynamic contrast"
        )


def _latencies(
    stage: Stage, levels: tuple[Frame, Frame], flashes: int, patience: float, tolerance: float
) -> list[float]:
    """Of flashes to white and to black in turn; `levels` are frames of black and white at rest."""
    found: list[float] = []
    _show(stage, 0.0)
    stage.settle(patience + (stage.seconds or 0.0))
    for number in range(flashes):
        now = 1 - number % 2
        _show(stage, float(now))
        found.append(_arrival(stage, levels[1 - now], levels[now], patience, tolerance))
    return found


def _arrival(stage: Stage, before: Frame, after: Frame, patience: float, tolerance: float) -> float:
    way = after.cells - before.cells
    most = np.abs(way).max()
    lit = np.abs(way) > max(_LIT * most, min(2 * tolerance, most / 2))
    while True:
        frame = stage.frame()
        waited = stage.since(frame.time)
        gone = (frame.cells - before.cells)[lit] / way[lit]
        there = (gone > _ARRIVED) | (np.abs(frame.cells - after.cells)[lit] <= tolerance)
        if np.mean(there) >= 1 - _OUTLIERS:
            return max(waited, 0.0)
        if waited > patience + (stage.seconds or 0.0):
            raise AcquisitionError(f"no frame shows a flash of the display within {waited:.2g} s")


def _drift(stage: Stage, wait: float, patience: float, noise: float) -> tuple[float, float]:
    """Between frames right after a flash and some a while later; as `drifted`."""
    _show(stage, 0.0)
    stage.settle(patience + (stage.seconds or 0.0))
    _show(stage, 1.0)
    stage.settle(wait)
    stage.frame()  # it may have begun a little before
    early = np.mean([stage.frame().cells.mean(axis=(0, 1)) for _ in range(2)], axis=0)
    stage.settle(wait + patience)
    late = np.mean([stage.frame().cells.mean(axis=(0, 1)) for _ in range(2)], axis=0)
    return drifted(early, late, _STEP, noise / np.sqrt(2.0))
