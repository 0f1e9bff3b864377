# SPDX-License-Identifier: BSD-3-Clause
"""All that is measured once of a set-up, before its transport is scanned, in this order.

    exposure     at which white is bright
    response     of the camera, from ramps at a bracket of exposures
    geometry     which projector pixel a camera pixel sees, by Gray code
    black, white repeatedly: noise of the camera, its offset, ambient light, the row sums of T
    projector    uniform codes: light of each channel, and how colours mix
    anchor       a pattern that is photographed again during the scan: did anything move?

Known limit: the unit of light is what the response reaches at the last code, for which nothing else stands.
A colour that the scene hardly reflects is photographed for longer, so that its curve reaches that code too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ltcl import checks
from ltcl.acquisition import anchor, exposure
from ltcl.acquisition.agreement import Sensor
from ltcl.acquisition.anchor import Anchor
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.exposure import acquisition_error
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling
from ltcl.acquisition.geometry import measure as measure_geometry
from ltcl.acquisition.geometry.sharpness import Sharpness
from ltcl.acquisition.radiometry import (
    NoiseModel,
    ProjectorResponse,
    Radiance,
    Response,
    black,
    calibrate,
    estimate,
    mixing,
    projector,
)
from ltcl.acquisition.radiometry.stack import NO_LIGHT
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.session import CaptureSession, Photograph, Request
from ltcl.errors import AcquisitionError, InputError

Progress = Callable[[str, int, int], None]

_NEARLY_SATURATED = 0.95  # of the linear range
_QUIETEST = 1e-6  # of full scale: the read noise of a camera without any, so that weights are finite
_BRACKET, _BRACKET_BY_HAND, _SPAN = 8, 5, 16.0  # exposures for the response; their largest ratio to white's
_LONGER = 4  # more of them at most, each twice as long, where a colour stays dark
_SATURATED = 0.05  # of the pixels: as many reach the last code in each colour
_RAMPS, _RAMP_PIXELS, _RAMP_PIXELS_BY_HAND = 4, 1 << 14, 1 << 10  # ramps at most, and camera pixels in them
# Uniform codes between black and white, none the inverse of another. Monotone cubics through them deviate by
# at most 0.02 % of white (root mean square) from sRGB, a power of 2.2 and film; those of a person by 0.3 %.
_CODES, _CODES_BY_HAND = tuple((np.arange(16) + 0.3) / 16), (0.07, 0.2, 0.38, 0.68, 0.9)
_REPEATS = 2  # at least: two photographs determine noise
_CAMERA_PIXELS = 9  # to one of the projector's, where a plan is made before the first photograph
_SIGNIFICANT = 3.0  # standard deviations of noise that white must be above
_DIRECT = 0.5  # of what white shows at a pixel is its own light, at least, in most scenes


def measure(
    shots: Shots,
    *,
    geometry: str | Correspondence = "graycode",
    response: Response | None = None,
    exposures: Sequence[float] | None = None,
    frames: int = 16,
    side: int = 1,
    progress: Progress = lambda step, done, total: None,
) -> Calibration:
    """Measure a set-up, with as many photographs as `photographs` says.

    `frames` of black and of white are averaged (a person's are shared by the camera pixels of a projector
    pixel); `side` is that of the blocks of the scan, which the camera must resolve; the others are as in
    `ltcl.acquire`. `progress` is called with "calibration", the photographs taken, and those expected.

    Raises
    ------
    InputError
        A geometry of other pixels; exposures at which nothing is seen; one exposure only and no response.
    AcquisitionError
        The rig fails; nothing can be decoded; the projector is off; the camera is too coarse; photographs
        contradict each other.

    Examples
    --------
    >>> from ltcl.acquisition import VirtualRig
    >>> rig = VirtualRig(np.eye(64) * 0.5, (8, 8), response="srgb", bits=12)
    >>> calibration = measure(Shots(rig), geometry="aligned")
    >>> bool(abs(calibration.white.value - 0.5).max() < 0.02), calibration.resampling.seen.all()
    (True, np.True_)
    """
    checks.count("frames", frames)
    by_hand = getattr(shots.rig, "keeps_photographs", False)
    expected = photographs(
        shots.grid,
        channels=shots.channels,
        frames=frames,
        aligned=geometry == "aligned",
        by_hand=by_hand,
    )
    session = CaptureSession(shots, lambda done: progress("calibration", done, max(done, expected)), by_hand)
    seconds = exposure.bright_white(session, shots.grid)
    _check_geometry(shots, geometry)
    if response is None:
        response, hot = _response(session, seconds)
    else:
        hot = exposure.hot_pixels(session.photograph(session.black, seconds))
    level = exposure.brightness(response.linear(session.photograph(session.white, seconds)), hot)
    seconds = exposure.nearest(shots.exposures, seconds * exposure.WHITE / max(level, 0.01))
    shots.digest.clear()  # of probes; photographs at this exposure tell rigs apart
    longest = exposure.nearest(shots.exposures, exposure.longest_exposure(seconds, 0.0))
    session.announce([(session.black, seconds), (session.black, longest)])
    with session.naming_photographs(Sensor(response)):
        R, sharpness = _resampling(session, geometry, seconds, response)
    if sharpness is not None:
        sharpness.check(side)
    longest = _longest(session, seconds, longest, response, hot)
    if exposures is None:
        times = exposure.for_scan(shots, seconds, longest)
    else:
        times = tuple(exposure.nearest(shots.exposures, float(t)) for t in sorted(exposures))
    per_pixel = len(np.unique(R.weights.indices)) / max(np.count_nonzero(R.seen), 1)
    repeats = _repeats(frames, per_pixel) if session.by_hand else max(_REPEATS, frames)
    dark = [(session.black, t) for t in sorted({seconds, longest}) for _ in range(repeats)]
    bright = [
        (session.white, t)
        for t in exposure.offered(shots, [seconds / 2, seconds, longest])
        for _ in range(1 if session.by_hand and t != seconds else repeats)
    ]
    uniform = _uniform(session, seconds)
    blocks = [(anchor.pattern(shots.grid), t) for t in sorted({times[0], times[-1]})]
    groups = [blocks[:1], dark, bright, *uniform, blocks]  # blocks before and after: nothing moved in between
    session.announce([request for group in groups for request in group])
    before, dark, bright, *uniform, blocks = map(session.take, groups)
    progress("calibration", session.count, session.count)
    with session.naming_photographs(Sensor(response)):
        _check_light(dark, bright, seconds)
        noise = _noise([dark, bright], response, hot, session.levels)
        sensor = Sensor(response, noise, _offset(session, dark, response, noise))
    session.record.check(sensor, shots.name)
    ambient, lit = session.merge(dark, sensor), session.merge(bright, sensor)
    white = lit - ambient
    light, M = _projector(session, uniform, ambient, lit, sensor)
    _check_exposures(times, white, R, noise)
    R = R.ascertained(white.value, white.valid)
    shown = session.merge([*before, *blocks], sensor)
    return Calibration(
        times,
        response,
        noise,
        sensor.offset,
        ambient,
        white,
        light,
        M,
        R,
        sharpness,
        Anchor.of(shown, white, ambient, R),
    )


def photographs(
    grid: tuple[int, int],
    *,
    channels: int = 1,
    frames: int = 16,
    aligned: bool = False,
    by_hand: bool = False,
) -> int:
    """How many photographs `measure` takes without a known response, give or take probes of the exposure.

    `by_hand`: a person takes them, as few as possible, with a camera that has at least three pixels to a side
    of one of the projector's. The others are as in `ltcl.acquire`.

    >>> photographs((8, 16)), photographs((8, 16), by_hand=True)
    (147, 37)
    """
    per_pixel = 1 if aligned else _CAMERA_PIXELS
    bracket = _BRACKET_BY_HAND if by_hand else _BRACKET
    ramps = bracket * _ramp_count(grid[0] * grid[1] * per_pixel, by_hand)
    stripes = 0 if aligned else GrayCode(grid).count - 2
    repeats = _repeats(frames, per_pixel) if by_hand else max(_REPEATS, frames)
    white = repeats + 2 if by_hand else 3 * repeats
    codes = len(_CODES_BY_HAND if by_hand else _CODES)
    uniform = codes if channels == 1 else 3 * codes + 3
    return 2 + ramps + stripes + 2 * repeats + white + uniform + 3


def _repeats(frames: int, camera_pixels: float) -> int:
    return max(_REPEATS, math.ceil(frames / max(camera_pixels, 1.0)))


def _check_geometry(shots: Shots, geometry: str | Correspondence) -> None:
    """Refuse a geometry of other pixels than those of the first photograph."""
    if geometry == "aligned" and shots.camera_grid != shots.grid:
        raise InputError(
            f"geometry is 'aligned', but photographs are {shots.camera_grid}; they must be {shots.grid}, "
            "the projector's pixels"
        )
    if isinstance(geometry, str):
        return
    if (geometry.grid, geometry.camera_grid) != (shots.grid, shots.camera_grid):
        raise InputError(
            f"geometry is from {geometry.camera_grid} to {geometry.grid}; the rig is from "
            f"{shots.camera_grid} to {shots.grid}"
        )


def _response(session: CaptureSession, seconds: float) -> tuple[Response, np.ndarray]:
    """The response of the camera, and hot pixels: those at the last code in the shortest exposure."""
    span = exposure.bracket(
        seconds / _SPAN, seconds * _SPAN, _BRACKET_BY_HAND if session.by_hand else _BRACKET
    )
    times = list(exposure.offered(session.shots, span))
    if len(times) == 1:
        raise InputError(exposure.ONE_EXPOSURE)
    H, W = session.shots.camera_grid or session.shots.grid
    ramps = _ramps(session.shots.grid, _ramp_count(H * W, session.by_hand))
    session.announce([(ramp, t) for t in times for ramp in ramps])
    exposed = [session.take([(ramp, t) for ramp in ramps]) for t in times]
    hot = exposure.hot_pixels(np.minimum.reduce([p.image for p in exposed[0]]))
    for t in exposure.offered(session.shots, [times[-1] * 2.0**k for k in range(1, _LONGER + 1)]):
        darkest = np.quantile(_side_by_side(exposed[-1], hot), 1.0 - _SATURATED, axis=(0, 1)).min()
        if t <= times[-1] or session.shots.channels == 1 or darkest >= exposure.LAST_CODE:
            break
        times.append(t)
        exposed.append(session.take([(ramp, t) for ramp in ramps]))
    first, last = exposed[0][0].number, exposed[-1][-1].number
    with acquisition_error(f"the response of the camera, photographs {first} to {last}"):
        response = calibrate(
            [_side_by_side(photographs, hot) for photographs in exposed],
            times,
            levels=session.levels,
            saturation=exposure.LAST_CODE,
        )
    return response, hot


def _ramp_count(camera_pixels: int, by_hand: bool) -> int:
    return min(-(-(_RAMP_PIXELS_BY_HAND if by_hand else _RAMP_PIXELS) // camera_pixels), _RAMPS)


def _ramps(grid: tuple[int, int], count: int) -> list[np.ndarray]:
    """Codes from 0 to 1 along the longer side, each one shifted further: a pixel has another code in each."""
    h, w = grid
    long = np.linspace(0.0, 1.0, max(h, w), dtype=np.float32)
    shifted = [np.roll(long, k * len(long) // count) for k in range(count)]
    return [np.ascontiguousarray(np.broadcast_to(r if w >= h else r[:, None], grid)) for r in shifted]


def _side_by_side(photographs: list[Photograph], hot: np.ndarray) -> np.ndarray:
    return np.hstack([exposure.fill_hot_pixels(photograph.image, hot) for photograph in photographs])


class _Linear:
    """A camera that is linear in light for `geometry.measure`: a pixel that is half lit shows half of it."""

    def __init__(self, session: CaptureSession, response: Response) -> None:
        self.prepare, self.levels = session.announce, session.levels
        self._session, self._response = session, response
        self.codes: list[np.ndarray] = []
        self.light: list[np.ndarray] = []

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        self.codes.append(codes)
        self.light.append(self._response.linear(self._session.photograph(codes, seconds)))
        return self.light[-1]


def _resampling(
    session: CaptureSession, geometry: str | Correspondence, seconds: float, response: Response
) -> tuple[Resampling, Sharpness | None]:
    if geometry == "aligned":
        return Resampling.aligned(session.shots.grid), None
    if isinstance(geometry, Correspondence):
        R = Resampling.of(geometry)
        return R, Sharpness.of(geometry, R)
    camera = _Linear(session, response)
    with acquisition_error("the geometry"):
        correspondence = measure_geometry(camera, session.shots.grid, seconds=seconds)
    R = Resampling.of(correspondence)
    return R, Sharpness.of(correspondence, R, list(zip(camera.codes, camera.light, strict=True)))


def _longest(
    session: CaptureSession, white: float, seconds: float, response: Response, hot: np.ndarray
) -> float:
    """The longest useful exposure, `seconds` at most: ambient light limits it, as black shows."""
    while seconds > white:
        image = exposure.fill_hot_pixels(session.photograph(session.black, seconds), hot)
        level = float(np.quantile(response.linear(image), 0.99))
        if level < 1.5 * exposure.AMBIENT:
            return seconds
        shorter = (
            exposure.longest_exposure(white, level / seconds) if level < _NEARLY_SATURATED else seconds / 8
        )
        seconds, longer = exposure.nearest(session.exposures, shorter), seconds
        if seconds >= longer:
            return longer
    return white


def _noise(
    patterns: list[list[Photograph]], response: Response, hot: np.ndarray, levels: int | None
) -> NoiseModel:
    """Of repeated photographs of a pattern at an exposure."""
    bursts = []
    for photographs in patterns:
        for seconds in sorted({p.seconds for p in photographs}):
            bursts.append(
                [exposure.fill_hot_pixels(p.image, hot) for p in photographs if p.seconds == seconds]
            )
    with acquisition_error("the noise of the camera"):
        noise = estimate([burst for burst in bursts if len(burst) > 1], response=response, levels=levels)
    return replace(noise, read=max(noise.read, _QUIETEST))


def _check_light(dark: list[Photograph], bright: list[Photograph], seconds: float) -> None:
    """Refuse white that is no brighter than black, summed over the pixels, by 3 deviations of noise."""
    excess, variance = 0.0, 0.0
    for sign, photographs in ((1.0, bright), (-1.0, dark)):
        images = np.stack([p.image for p in photographs if p.seconds == seconds])
        excess += sign * float(images.mean(axis=0).sum())
        variance += float(images.var(axis=0, ddof=1).sum()) / len(images)
    if excess <= _SIGNIFICANT * math.sqrt(variance):
        raise AcquisitionError(f"photographs are no brighter under white than under black; {NO_LIGHT}")


def _offset(
    session: CaptureSession, dark: list[Photograph], response: Response, noise: NoiseModel
) -> np.ndarray:
    """Linear value without light, (channels,); 0 where one exposure cannot tell it from ambient light."""
    times = [p.seconds for p in dark]
    if min(times) == max(times):
        return np.zeros(session.shots.channels)
    with acquisition_error("black"):
        return black.measure([p.image for p in dark], times, response, noise, levels=session.levels).offset


def _uniform(session: CaptureSession, seconds: float) -> list[list[Request]]:
    """Uniform codes; of colours, those of each channel, white of it included."""
    codes = _CODES_BY_HAND if session.by_hand else _CODES
    if session.shots.channels == 1:
        return [[(np.float32(code) * session.white, seconds) for code in codes]]
    lit = [session.white[..., None] * unit for unit in np.eye(3, dtype=np.float32)]
    return [[(np.float32(code) * channel, seconds) for code in (*codes, 1.0)] for channel in lit]


def _projector(
    session: CaptureSession, uniform: list[list[Photograph]], dark: Radiance, lit: Radiance, sensor: Sensor
) -> tuple[ProjectorResponse, np.ndarray | None]:
    """Response of each channel of the projector, and the mixing of colours."""
    codes = [0.0, *(_CODES_BY_HAND if session.by_hand else _CODES), 1.0]
    pictures = [[dark, *(session.merge([p], sensor) for p in channel)] for channel in uniform]
    with acquisition_error("the projector"):
        if len(pictures) == 1:
            return projector.measure(codes, [*pictures[0], lit]), None
        return projector.measure(codes, pictures), mixing([channel[-1] for channel in pictures], dark)


def _check_exposures(times: tuple[float, ...], white: Radiance, R: Resampling, noise: NoiseModel) -> None:
    """Refuse exposures of which the shortest saturates lit pixels, or the longest shows noise alone."""
    seen = np.unique(R.weights.indices)
    pixels = white.value.shape[0] * white.value.shape[1]
    value, valid = (part.reshape(pixels, -1)[seen] for part in (white.value, white.valid))
    lit = value[valid & (value > 0)]
    level = float(np.median(lit)) if lit.size else 0.0
    least = _SIGNIFICANT * float(np.sqrt(noise.variance(0.0)))
    for wrong, seconds, what, limit in (
        (times[0] * _DIRECT * level > noise.saturation, times[0], "saturates", f"below {times[0] / 2:.2g}"),
        (0 < times[-1] * level < least, times[-1], "is lost in noise", f"above {2 * times[-1]:.2g}"),
    ):
        if wrong:
            raise InputError(
                f"exposures is {times}; half of white {what} at {seconds:g} s, which must be {limit}"
            )
