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
from dataclasses import dataclass, replace

import numpy as np

from ltcl.acquisition import agreement, anchor, exposure, radiometry
from ltcl.acquisition.agreement import Sensor
from ltcl.acquisition.anchor import Anchor
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling, Sharpness, decode
from ltcl.acquisition.radiometry import ProjectorResponse, Radiance, Response
from ltcl.acquisition.radiometry.camera import NO_LIGHT
from ltcl.acquisition.rig import Shots, nearest
from ltcl.acquisition.session import CaptureSession, Photograph, Request, acquisition_error
from ltcl.errors import AcquisitionError, InputError
from ltcl.store import ArrayLog

Progress = Callable[[str, int, int], None]

_QUIETEST = 1e-6  # of full scale: the read noise of a camera without any, so that weights are finite
_SPAN = 16.0  # ratio of the longest exposure for the response to that of white, and of that to the shortest
_LONGER = 4  # more of them at most, each twice as long, where a colour stays dark
_SATURATED = 0.05  # of the pixels: as many reach the last code in each colour
_RAMPS = 4  # at most
_REPEATS = 2  # at least: two photographs determine noise
_PROBES = 2  # of the exposure, mostly
_CAMERA_PIXELS = 9  # to one of the projector's, where a plan is made before the first photograph
_SIGNIFICANT = 3.0  # standard deviations of noise that white must be above
_UNEVEN = 0.1  # relative deviation of a projector's curve from pixel to pixel
_DIRECT = 0.5  # of what white shows at a pixel is its own light, at least, in most scenes


@dataclass(frozen=True)
class _Effort:
    """Numbers of photographs: exposures for the response, camera pixels in the ramps of each, uniform codes.

    Of uniform codes none is the inverse of another. Monotone cubics through them deviate from sRGB, a power
    of 2.2 and film by at most 0.02 % of white (root mean square), or 0.3 % by hand.
    """

    bracket: int
    ramp_pixels: int
    codes: tuple[float, ...]

    def ramps(self, grid: tuple[int, int], camera_pixels: int) -> list[np.ndarray]:
        """Codes from 0 to 1 along the longer side, each shifted further: a pixel has another code in each."""
        count = min(-(-self.ramp_pixels // camera_pixels), _RAMPS)
        codes = np.linspace(0.0, 1.0, max(grid), dtype=np.float32)
        shifted = [np.roll(codes, k * len(codes) // count) for k in range(count)]
        return [np.broadcast_to(r if grid[1] >= grid[0] else r[:, None], grid).copy() for r in shifted]

    def repeats(self, frames: int, camera_pixels: float) -> int:
        """Of black and white; a person's are shared by the camera pixels of a projector pixel."""
        return max(_REPEATS, math.ceil(frames / max(camera_pixels, 1.0)) if self is _BY_HAND else frames)

    def requests(
        self, white: np.ndarray, channels: int, repeats: int, times: Sequence[Sequence[float]]
    ) -> list[list[Request]]:
        """Blocks, black, white, uniform codes of each channel, and blocks again: nothing moved in between.

        `times` are those of black, of which the first is the exposure of white, of white, and of the scan.
        """
        dark, bright, scan = times
        blocks = [(anchor.pattern((len(white), white.shape[1])), t) for t in sorted({scan[0], scan[-1]})]
        single = {t for t in bright if self is _BY_HAND and t != dark[0]}
        lit = [white] if channels == 1 else [white[..., None] * c for c in np.eye(3, dtype=np.float32)]
        codes = self.codes if channels == 1 else (*self.codes, 1.0)
        return [
            blocks[:1],
            [(0 * white, t) for t in dark for _ in range(repeats)],
            [(white, t) for t in bright for _ in range(1 if t in single else repeats)],
            *([(np.float32(code) * channel, dark[0]) for code in codes] for channel in lit),
            blocks,
        ]


_AUTOMATIC = _Effort(8, 1 << 14, tuple((np.arange(16) + 0.3) / 16))
_BY_HAND = _Effort(5, 1 << 10, (0.07, 0.2, 0.38, 0.68, 0.9))


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
    effort, camera_pixels = _BY_HAND if by_hand else _AUTOMATIC, 1 if aligned else _CAMERA_PIXELS
    ramps = effort.bracket * len(effort.ramps(grid, camera_pixels * grid[0] * grid[1]))
    stripes = 0 if aligned else GrayCode(grid).count - 2  # without black and white
    repeats, times = effort.repeats(frames, camera_pixels), ((2.0, 3.0), (1.0, 2.0, 3.0), (2.0, 3.0))
    requests = effort.requests(np.ones(grid, np.float32), channels, repeats, times)
    return _PROBES + ramps + stripes + sum(map(len, requests))


def measure(
    shots: Shots,
    *,
    geometry: str | Correspondence = "graycode",
    response: Response | None = None,
    exposures: Sequence[float] | None = None,
    frames: int = 16,
    side: int = 1,
    progress: Progress = lambda step, done, total: None,
    log: ArrayLog | None = None,
) -> Calibration:
    """Measure a set-up, with as many photographs as `photographs` says.

    The camera must resolve blocks of `side`; `log` has photographs of an earlier run; the others are as in
    `ltcl.acquire`. InputError: a geometry of other pixels; exposures at which nothing is seen.
    AcquisitionError: the rig fails, or the photographs cannot be used.

    >>> from ltcl.acquisition import VirtualRig
    >>> calibration = measure(Shots(VirtualRig(np.eye(64) / 2, (8, 8), bits=12)), geometry="aligned")
    >>> bool(abs(calibration.white.value - 0.5).max() < 0.02), calibration.resampling.seen.all()
    (True, np.True_)
    """
    by_hand, full = getattr(shots.rig, "keeps_photographs", False), np.ones(shots.grid, np.float32)
    effort, aligned = _BY_HAND if by_hand else _AUTOMATIC, geometry == "aligned"
    options = {"channels": shots.channels, "frames": frames, "aligned": aligned, "by_hand": by_hand}
    expected = photographs(shots.grid, **options)
    session = CaptureSession(shots, log, lambda done: progress("calibration", done, max(done, expected)))

    seconds = exposure.bright_white(session)
    _check_geometry(shots, geometry)
    seconds = _response(session, effort, seconds, response)
    with session.naming_photographs():
        R, sharpness = _resampling(session, geometry, seconds)
    if sharpness is not None:
        sharpness.check(side)
    longest = _longest(session, seconds)
    scan = exposure.for_scan(shots, seconds, longest)
    if exposures is not None:
        scan = tuple(nearest(shots.exposures, float(t)) for t in sorted(exposures))

    repeats = effort.repeats(frames, len(np.unique(R.weights.indices)) / max(np.count_nonzero(R.seen), 1))
    bright = exposure.offered(shots.exposures, [seconds / 2, seconds, longest])
    times = sorted({seconds, longest}), bright, scan
    requests = effort.requests(full, shots.channels, repeats, times)
    before, dark, bright, *uniform, after = session.take(requests)
    with session.naming_photographs():
        session.sensor = _sensor(session, dark, bright, seconds)
    session.record.check(session.sensor, shots.name)
    progress("calibration", session.count, session.count)

    ambient, lit = session.merge(dark), session.merge(bright)
    white = lit - ambient
    _check_exposures(scan, white, R, session.sensor)
    pictures = [[session.merge([photograph]) for photograph in each] for each in uniform]
    for shown, each in zip(uniform, pictures, strict=True):
        full_code = lit if shots.channels == 1 else each[-1]
        _check_uniform(session, shown, each[: len(effort.codes)], full_code, ambient)
    light, M = _projector(effort, pictures, ambient, lit)
    R = R.ascertained(white.value, white.valid)
    blocks = Anchor.of(session.merge([*before, *after]), R)
    return Calibration(scan, *session.sensor, ambient, white, light, M, R, sharpness, blocks)


def _check_geometry(shots: Shots, geometry: str | Correspondence) -> None:
    """Refuse a geometry of other pixels than those of the first photograph."""
    grid, camera = shots.grid, shots.grid if geometry == "aligned" else shots.camera_grid
    if isinstance(geometry, Correspondence):
        grid, camera = geometry.grid, geometry.camera_grid
    if (grid, camera) != (shots.grid, shots.camera_grid):
        name = repr(geometry) if isinstance(geometry, str) else "a Correspondence"
        raise InputError(
            f"geometry is {name}, from photographs of {camera} to a projector of {grid}; the rig has "
            f"photographs of {shots.camera_grid} and a projector of {shots.grid}"
        )


def _response(session: CaptureSession, effort: _Effort, seconds: float, response: Response | None) -> float:
    """Response of the camera and hot pixels, for the session; the exposure at which white has `WHITE`."""
    shots, full = session.shots, np.ones(session.shots.grid, np.float32)
    if response is None:
        response, session.hot = _ramps(session, effort, seconds)
    else:
        session.hot = exposure.hot_pixels(session.photograph(0 * full, seconds))
    session.sensor = Sensor(response)
    level = exposure.brightness(session.photograph(full, seconds), session.hot)
    shots.digest.clear()  # of probes; photographs at the exposure of white tell rigs apart
    return nearest(shots.exposures, seconds * exposure.WHITE / max(level, 0.01))


def _ramps(session: CaptureSession, effort: _Effort, seconds: float) -> tuple[Response, np.ndarray]:
    shots, span = session.shots, exposure.bracket(seconds / _SPAN, seconds * _SPAN, effort.bracket)
    times = [*exposure.offered(shots.exposures, span)]
    H, W = shots.camera_grid or shots.grid
    ramps = effort.ramps(shots.grid, H * W)
    exposed = session.take([[(ramp, t) for ramp in ramps] for t in times])
    hot = exposure.hot_pixels(np.minimum.reduce([p.image for p in exposed[0]]))

    def side_by_side(photographs: list[Photograph]) -> np.ndarray:
        return np.hstack([exposure.fill_hot_pixels(photograph.image, hot) for photograph in photographs])

    for t in exposure.offered(shots.exposures, [times[-1] * 2.0**k for k in range(1, _LONGER + 1)]):
        darkest = np.quantile(side_by_side(exposed[-1]), 1.0 - _SATURATED, axis=(0, 1)).min()
        if t <= times[-1] or shots.channels == 1 or darkest >= exposure.LAST_CODE:
            break
        times.append(t)
        exposed += session.take([[(ramp, t) for ramp in ramps]])
    images, last = [side_by_side(group) for group in exposed], exposure.LAST_CODE
    numbers = f"photographs {exposed[0][0].number} to {exposed[-1][-1].number}"
    with acquisition_error(f"the response of the camera, {numbers}"):
        return radiometry.calibrate(images, times, levels=shots.levels, saturation=last), hot


def _resampling(
    session: CaptureSession, geometry: str | Correspondence, seconds: float
) -> tuple[Resampling, Sharpness | None]:
    black, longest = np.zeros(session.shots.grid, np.float32), exposure.longest_exposure(seconds, 0.0)
    session.prepare([(black, seconds), (black, nearest(session.shots.exposures, longest))])
    if geometry == "aligned":
        return Resampling.aligned(session.shots.grid), None
    light: list[np.ndarray] = []
    if isinstance(geometry, str):
        patterns = GrayCode(session.shots.grid).patterns()
        photographs = session.take([[(codes, seconds) for codes in patterns]])[0]
        # Linear in light: a pixel that is half lit shows half of it.
        light = [session.sensor.response.linear(photograph.image) for photograph in photographs]
        with acquisition_error("the geometry"):
            geometry = decode(light, session.shots.grid, levels=session.shots.levels)
    R = Resampling.of(geometry)
    return R, Sharpness.of(geometry, R, light)


def _longest(session: CaptureSession, white: float) -> float:
    """The longest useful exposure: ambient light limits it, as black shows."""
    seconds = nearest(session.shots.exposures, exposure.longest_exposure(white, 0.0))
    while seconds > white:
        light = session.photograph(np.zeros(session.shots.grid, np.float32), seconds)
        level = float(np.quantile(exposure.fill_hot_pixels(light, session.hot), 0.99))
        if level < 1.5 * exposure.AMBIENT:
            return seconds
        usable = level < exposure.BRIGHT
        shorter = exposure.longest_exposure(white, level / seconds) if usable else seconds / 8
        seconds, longer = nearest(session.shots.exposures, shorter), seconds
        if seconds >= longer:
            return longer
    return white


def _sensor(
    session: CaptureSession, dark: list[Photograph], bright: list[Photograph], seconds: float
) -> Sensor:
    """Noise, and the linear value without light: 0 where one exposure cannot tell it from ambient light."""
    excess, variance, bursts = 0.0, 0.0, []
    for sign, photographs in ((-1.0, dark), (1.0, bright)):
        for t in sorted({p.seconds for p in photographs}):
            images = [exposure.fill_hot_pixels(p.image, session.hot) for p in photographs if p.seconds == t]
            bursts.append(images)
            if t == seconds:
                excess += sign * float(np.mean(images, axis=0).sum())
                variance += float(np.var(images, axis=0, ddof=1).sum()) / len(images)
    if excess <= _SIGNIFICANT * math.sqrt(variance):
        raise AcquisitionError(f"photographs are no brighter under white than under black; {NO_LIGHT}")
    response, levels = session.sensor.response, session.shots.levels
    with acquisition_error("the noise of the camera"):
        bursts = [images for images in bursts if len(images) > 1]
        noise = radiometry.estimate(bursts, response=response, levels=levels)
    noise = replace(noise, read=max(noise.read, _QUIETEST))
    times = [p.seconds for p in dark]
    if min(times) == max(times):
        return Sensor(response, noise, np.zeros(session.shots.channels))
    with acquisition_error("black"):
        offset = radiometry.black_level([p.image for p in dark], times, response, noise, levels=levels)
    return Sensor(response, noise, offset)


def _check_uniform(
    session: CaptureSession,
    photographs: list[Photograph],
    pictures: list[Radiance],
    white: Radiance,
    ambient: Radiance,
) -> None:
    """Refuse photographs of uniform codes, which rise, that are not black and a rising part g of white.

    Projectors whose curve varies over the picture deviate, too: 10 % of the light of a code are allowed.
    """
    known = white.valid & ambient.valid
    pixels = agreement.spread(np.flatnonzero(known.reshape(*known.shape[:2], -1).all(axis=2)))
    black, dark_variance, bright, variance = (
        agreement.sample(x, pixels).astype(np.float64)
        for x in (ambient.value, ambient.variance, white.value, white.variance)
    )
    W, below, last = bright - black, 0.0, None
    single = len(photographs) > len(pictures)
    of_colour = f", which {session.shots.name(photographs[-1].number)} is" if single else ""
    for photograph, picture in zip(photographs, pictures, strict=False):
        y, v, valid = (agreement.sample(x, pixels) for x in (picture.value, picture.variance, picture.valid))
        total = max(float(np.sum(W[valid] ** 2)), 1e-30)
        g = float(np.sum(((y - black) * W)[valid])) / total
        noise = float(np.sqrt(np.sum((W**2 * (v + dark_variance))[valid]))) / total
        expected = black + g * W, dark_variance + g**2 * variance + (_UNEVEN * g * W) ** 2
        image = [agreement.sample(photograph.image, pixels)]
        deviation = agreement.find_deviation(image, [photograph.seconds], session.sensor, expected)
        name = session.shots.name(photograph.number)
        if deviation is not None:
            raise AcquisitionError(
                f"{name}, of a uniform code, does not show a part of white{of_colour}: another light was on, "
                f"or it is another pattern; {agreement.ADVICE}"
            )
        if last is not None and g < below - _SIGNIFICANT * noise - _UNEVEN * below:
            raise AcquisitionError(
                f"{last} or {name} deviates: it shows {g / below:.2g} times the light of a darker code; "
                f"{agreement.ADVICE}"
            )
        below, last = g, name


def _projector(
    effort: _Effort, pictures: list[list[Radiance]], ambient: Radiance, white: Radiance
) -> tuple[ProjectorResponse, np.ndarray | None]:
    """Response of each channel of the projector, and the mixing of colours."""
    codes = [0.0, *effort.codes, 1.0]
    with acquisition_error("the projector"):
        if len(pictures) == 1:
            return radiometry.projector_response(codes, [[ambient, *pictures[0], white]]), None
        responses = radiometry.projector_response(codes, [[ambient, *channel] for channel in pictures])
        return responses, radiometry.mixing([channel[-1] for channel in pictures], ambient)


def _check_exposures(scan: tuple[float, ...], white: Radiance, R: Resampling, sensor: Sensor) -> None:
    """Refuse exposures of which the shortest saturates lit pixels, or the longest shows noise alone."""
    light = R.apply(np.where(white.valid, white.value, 0.0))[R.seen]
    level = float(np.median(light[light > 0])) if (light > 0).any() else 0.0
    reason = ""
    if scan[0] * _DIRECT * level > sensor.noise.saturation:
        reason = f"saturates at {scan[0]:g} s, which must be below {scan[0] / 2:.2g}"
    elif 0 < scan[-1] * level < _SIGNIFICANT * float(np.sqrt(sensor.noise.variance(0.0))):
        reason = f"is lost in noise at {scan[-1]:g} s, which must be above {2 * scan[-1]:.2g}"
    if reason:
        raise InputError(f"exposures is {scan}; half of white {reason}")
