# SPDX-License-Identifier: BSD-3-Clause
"""Metering: exposures of a calibration and of its scan, by photographs of white and black.

White is exposed so that the brightest pixels reach 0.7 of the linear range. Each pattern of a scan
is photographed at that exposure, for the pixels that it lights, and at one up to 64 times as long,
if ambient light allows, for weak light; by an automatic rig also at the geometric mean: T p of
64 x 64 pixels then has a relative error of 0.40 % instead of 0.46 %.

Hot pixels, at the last code even under black, decide nothing.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from functools import reduce
from itertools import combinations
from typing import Any

import numpy as np

from ltcl.acquisition.agreement import ADVICE, sample
from ltcl.acquisition.rig import Shots, nearest
from ltcl.acquisition.scratch import row_strips
from ltcl.acquisition.session import CaptureSession, Photograph
from ltcl.errors import AcquisitionError

logger = logging.getLogger(__name__)

# Share of the linear range that the brightest pixels under white are to reach.
WHITE_LEVEL = 0.7
# Share that they may reach where the camera offers no exposure for that.
MAX_WHITE_LEVEL = 0.9
# Longest exposure relative to that of white: beyond, a photograph costs more time than its light
# is worth.
MAX_EXPOSURE_RATIO = 64.0
# Share of the linear range that ambient light takes at the longest exposure.
AMBIENT_LEVEL = 0.3
# Code, relative to full scale, that is as good as the last one.
SATURATED_CODE = 0.995
# Seconds of the first photograph.
FIRST_EXPOSURE = 1 / 60
# Codes of the brightest pixels under white; outside of them another probe follows.
MIN_WHITE_CODE = 0.3
MAX_WHITE_CODE = 0.95
# Quantile of the pixels that is to be bright.
BRIGHT_QUANTILE = 0.999
# Quantile of the pixels under black that ambient light must leave dark.
DARK_QUANTILE = 0.99
# Share of hot pixels above which the exposure is too long instead.
MAX_HOT_SHARE = 0.1
# Longer exposures are no brighter if codes rise by less than this power of the seconds, although
# they are below full scale: film, the flattest of the curves, rises by 0.2.
MIN_RISE_POWER = 0.05
# Ratio of exposures that tells, and least code that is not noise.
MIN_EXPOSURE_RATIO = 1.5
MIN_BRIGHT_CODE = 0.05
# Deviation of the brightest codes of photographs in which a camera is full.
MAX_FULL_SPREAD = 0.1
# Relative width of the codes of saturated pixels.
SATURATION_WIDTH = 0.02
# Codes, relative to those, of pixels that must rise, if there are so many.
HALF_FULL = (0.3, 0.7)
MIN_HALF_FULL = 8
# Largest number of exposures that are tried for white.
MAX_PROBES = 10


def offered_exposures(shots: Shots, seconds: Iterable[float]) -> tuple[float, ...]:
    """The exposures of a camera nearest to `seconds`: ascending, each once."""
    offered = {nearest(shots.exposures, exposure) for exposure in seconds}
    return tuple(sorted(offered))


def unsaturated_exposure(shots: Shots, seconds: float) -> float:
    """The exposure of a camera nearest to `seconds`, at which white has `WHITE_LEVEL`.

    If white were saturated there, the next shorter one, if there is any.
    """
    longest = seconds * MAX_WHITE_LEVEL / WHITE_LEVEL
    chosen = nearest(shots.exposures, seconds)
    if chosen <= longest or shots.exposures is None:
        return chosen
    return max((t for t in shots.exposures if t <= longest), default=chosen)


def bracket(shortest: float, longest: float, count: int) -> tuple[float, ...]:
    """`count` exposures, ascending, in steps of which every second is longer by the golden ratio.

    No period divides them: powers of one number do not determine a response
    (`radiometry.response`).

    >>> [round(t, 3) for t in bracket(0.01, 0.32, 4)]
    [0.01, 0.026, 0.123, 0.32]
    """
    golden_ratio = (1 + 5**0.5) / 2
    is_long_step = np.arange(count - 1) % 2
    steps = np.where(is_long_step, golden_ratio, 1.0)
    powers = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return tuple((shortest * (longest / shortest) ** powers).tolist())


def scan_exposures(shots: Shots, white: float, longest: float) -> tuple[float, ...]:
    """The exposures of each pattern of a scan, ascending; two if a person takes the photographs."""
    seconds = [white, longest]
    if not shots.keeps_photographs:
        seconds.append(math.sqrt(white * longest))
    return offered_exposures(shots, seconds)


def expected_exposures(shots: Shots, lit: float, ambient: float) -> tuple[float, ...]:
    """Exposures of a scan for guessed radiances of white and of ambient light."""
    white = WHITE_LEVEL / lit
    limit = AMBIENT_LEVEL / max(ambient, 1e-30)
    return scan_exposures(shots, white, min(MAX_EXPOSURE_RATIO * white, limit))


def hot_pixels(black: Sequence[Photograph]) -> np.ndarray:
    """Pixels (H, W) at the last code in all of some photographs that should be dark."""
    shape = black[0].stored.shape
    hot = np.empty(shape[:2], bool)
    for rows in row_strips(shape):
        dark = reduce(np.minimum, (photograph.read(rows) for photograph in black))
        brightest = dark.max(axis=-1) if dark.ndim == 3 else dark
        hot[rows] = brightest >= SATURATED_CODE
    if hot.mean() > MAX_HOT_SHARE:
        return np.zeros_like(hot)
    return hot


def fill_hot_pixels(image: np.ndarray, hot: np.ndarray) -> np.ndarray:
    """Replace each hot pixel of a photograph by the last good pixel before it."""
    if not hot.any():
        return image
    flat_hot = hot.ravel()
    places = np.flatnonzero(flat_hot)
    # Runs of hot pixels have one donor: the pixel before them, or at the start of the picture the
    # first good one.
    starts = np.diff(places, prepend=-1) > 1
    starts[0] = True
    donors = np.maximum.accumulate(np.where(starts, places - 1, -1))
    donors[donors < 0] = int(np.argmin(flat_hot))
    filled = image.copy()
    pixels = filled.reshape(hot.size, -1)
    pixels[places] = pixels[donors]
    return filled


def brightness(session: CaptureSession, photograph: Photograph, hot: np.ndarray) -> float:
    """The light that all but a thousandth of the pixels of a photograph do not exceed."""
    strips = _light_without_hot_pixels(session, photograph, hot)
    count = math.prod(photograph.stored.shape)
    return upper_quantile(strips, count, BRIGHT_QUANTILE, "higher")


def _light_without_hot_pixels(
    session: CaptureSession, photograph: Photograph, hot: np.ndarray
) -> Iterator[np.ndarray]:
    """Linear values (n, c) of a photograph strip by strip, hot pixels filled."""
    read = session.linear(photograph)
    shape = photograph.stored.shape
    channels = math.prod(shape[2:])
    has_hot = hot.any()
    previous = np.empty((0, channels), np.float32)
    for rows in row_strips(shape):
        light = read(rows).reshape(-1, channels)
        if has_hot:
            # The last pixel of the strip before may be the donor of the first ones.
            is_hot = np.append(np.zeros(len(previous), bool), hot[rows])
            light = fill_hot_pixels(np.concatenate([previous, light]), is_hot)[len(previous) :]
            previous = light[-1:].copy()
        yield light


def upper_quantile(
    strips: Iterable[np.ndarray], count: int, quantile: float, method: Any = "linear"
) -> float:
    """A quantile near 1 of `count` float32 values, which come in strips.

    >>> upper_quantile([np.float32([5, 1]), np.float32([4, 3, 2])], 5, 0.75)
    4.0
    """
    place = (count - 1) * quantile
    top_count = count - math.floor(place)
    largest = np.empty(0, np.float32)
    for strip in strips:
        values = strip.ravel()
        if len(largest) == top_count:
            values = values[values > largest.min()]
        largest = np.concatenate([largest, values])
        if len(largest) > top_count:
            largest = np.partition(largest, len(largest) - top_count)[len(largest) - top_count :]
    ends = np.sort(np.partition(largest, min(1, top_count - 1))[:2])
    return float(np.quantile(ends, place - math.floor(place), method=method))


def find_white_exposure(session: CaptureSession) -> float:
    """Seconds at which the brightest pixels under white have codes between 0.3 and 0.95."""
    shots = session.shots
    white = np.ones(shots.grid, np.float32)
    hot = np.zeros(1, bool)
    seconds = nearest(shots.exposures, FIRST_EXPOSURE)
    previous_level = 0.0
    for _ in range(MAX_PROBES):
        photograph = session.photograph(white, seconds)
        level = brightness(session, photograph, hot)
        if level > MAX_WHITE_CODE:
            hot = hot_pixels([session.photograph(np.zeros_like(white), seconds)])
            level = brightness(session, photograph, hot)
        if MIN_WHITE_CODE <= level <= MAX_WHITE_CODE:
            break
        if level == previous_level:
            _check_bits(shots, level)
        following = nearest(shots.exposures, seconds * exposure_factor(level))
        if following == seconds:
            _check_not_saturated(photograph)
            break
        seconds = following
        previous_level = level
    return seconds


def exposure_factor(level: float) -> float:
    """Factor for the exposure when the brightest pixels have this code."""
    if level >= SATURATED_CODE:
        return 1 / 4
    return WHITE_LEVEL / max(level, WHITE_LEVEL / 16)


def _check_bits(shots: Shots, level: float) -> None:
    """Refuse a camera with fewer bits than the rig says: it saturates below the last code."""
    if shots.levels is None:
        return
    last_code = shots.levels - 1
    code = round(level * last_code)
    bits = code.bit_length()
    is_last_of_fewer_bits = code + 1 == 1 << bits
    if bits > 8 and is_last_of_fewer_bits and level < SATURATED_CODE:
        raise AcquisitionError(
            f"white is saturated at code {code} of {last_code}; "
            f"bits of the rig (camera_bits of a folder) must be {bits}"
        )


def check_full_scale(
    shots: Shots,
    seconds: Sequence[float],
    images: Sequence[np.ndarray],
    names: Sequence[str] = (),
) -> None:
    """Refuse a camera that is full below its last code: longer exposures are no brighter.

    `images` (H, W[, c]) in [0, 1] are of one scene for so many seconds, and have `names`. If one
    shows something else instead, that is refused.
    """
    for c in range(shots.channels):
        planes = []
        levels = []
        for image in images:
            plane = sample(image)[:, c]
            planes.append(plane)
            levels.append(float(np.quantile(plane, BRIGHT_QUANTILE)))
        for a, b in combinations(np.argsort(seconds).tolist(), 2):
            ratio = seconds[b] / seconds[a]
            is_below_full = levels[a] > MIN_BRIGHT_CODE and levels[b] < SATURATED_CODE
            is_flat = levels[b] < levels[a] * ratio**MIN_RISE_POWER
            # Noise alone is flat, too, at short exposures; but a full camera gets no brighter.
            is_flat &= levels[b] >= (1.0 - MAX_FULL_SPREAD) * max(levels)
            if ratio >= MIN_EXPOSURE_RATIO and is_below_full and is_flat:
                if names and not _is_full(planes[a], planes[b], levels[a], ratio):
                    raise OtherLight(
                        f"{names[b]} of {seconds[b]:.3g} s and {names[a]} of {seconds[a]:.3g} s "
                        "show different patterns, or were exposed alike: the longer exposure is "
                        f"no brighter; {ADVICE}"
                    )
                raise AcquisitionError(_full_scale_error(shots, planes[b], levels[b]))


class OtherLight(AcquisitionError):
    """Two photographs of one pattern that show different light."""


def _is_full(short: np.ndarray, long: np.ndarray, level: float, ratio: float) -> bool:
    """True if pixels (n,) that are full in a short exposure stay so, and half-full ones rise."""
    top = short >= (1.0 - SATURATION_WIDTH) * level
    stays_full = np.median(long[top]) >= (1.0 - MAX_FULL_SPREAD) * level
    low, high = HALF_FULL
    half = (short > low * level) & (short < high * level)
    if np.count_nonzero(half) < MIN_HALF_FULL:
        return bool(stays_full)
    rise = np.median(long[half] / short[half])
    return bool(stays_full and rise >= ratio**MIN_RISE_POWER)


def _full_scale_error(shots: Shots, plane: np.ndarray, level: float) -> str:
    """Tell at which code a camera is full, as saturated pixels of a photograph show it."""
    code = float(np.median(plane[plane >= (1.0 - SATURATION_WIDTH) * level]))
    full = f"{code:.4g} of full scale"
    advice = f"{code:.4g}"
    if shots.levels is not None:
        last_code = shots.levels - 1
        advice = f"{round(code * last_code)}"
        full = f"code {advice} of {last_code}"
    return (
        f"the camera is full at {full}: longer exposures are no brighter; give white_level = "
        f"{advice} for the rig, or for its camera"
    )


def _check_not_saturated(photograph: Photograph) -> None:
    """Refuse white that saturates every pixel at the shortest exposure."""
    strips = row_strips(photograph.stored.shape)
    if min(photograph.read(rows).min() for rows in strips) >= SATURATED_CODE:
        seconds = photograph.seconds
        raise AcquisitionError(
            f"every pixel is saturated under white at the shortest exposure, {seconds:g} s; "
            "the camera must get less light: a smaller aperture, a darker projector or room"
        )


def longest_exposure(session: CaptureSession, white: float) -> float:
    """The longest useful exposure, which ambient light limits, by photographs of black."""
    shots = session.shots
    black = np.zeros(shots.grid, np.float32)
    seconds = nearest(shots.exposures, MAX_EXPOSURE_RATIO * white)
    while seconds > white:
        photograph = session.photograph(black, seconds)
        strips = _light_without_hot_pixels(session, photograph, session.hot)
        level = upper_quantile(strips, math.prod(photograph.stored.shape), DARK_QUANTILE)
        if level < 1.5 * AMBIENT_LEVEL:
            return seconds
        if level < MAX_WHITE_CODE:
            shorter = seconds * AMBIENT_LEVEL / level
        else:
            shorter = seconds / 8
        following = nearest(shots.exposures, shorter)
        if following >= seconds:
            return seconds
        name = shots.name(shots.number)
        logger.info("%s, of black, is too bright at %.3g s", name, seconds)
        seconds = following
    return white
