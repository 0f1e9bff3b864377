# SPDX-License-Identifier: BSD-3-Clause
"""All that is measured once of a set-up, before its transport is scanned, in this order.

    exposure     at which the brightest pixels under white reach `_WHITE` of the linear range
    response     of the camera, from ramps at a bracket of exposures
    geometry     which projector pixel a camera pixel sees, by Gray code
    black, white repeatedly: noise of the camera, its offset, ambient light, the row sums of T
    projector    uniform codes: light of each channel, and how colours mix
    anchor       a pattern that is photographed again during the scan: did anything move?

Each pattern of a scan is photographed at the exposure of white, for the pixels that it lights, and
at one `_LONGER` times as long, if ambient light allows, for weak light; by an automatic rig also at
the geometric mean: T p of 64 x 64 pixels then has a relative error of 0.40 % instead of 0.46 %.

Known limit: the unit of light is what the response reaches at the last code, for which nothing else
stands. A colour that the scene hardly reflects is photographed for longer, so that its curve
reaches that code too.
"""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ltcl.acquisition import agreement, anchor, radiometry
from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.anchor import Anchor
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling, Sharpness, decode
from ltcl.acquisition.radiometry import Radiance, Response
from ltcl.acquisition.radiometry.exposures import NO_LIGHT
from ltcl.acquisition.rig import Shots, nearest
from ltcl.acquisition.session import CaptureSession, Photograph, Request, acquisition_error
from ltcl.errors import AcquisitionError, InputError
from ltcl.store import ArrayLog

logger = logging.getLogger(__name__)
Progress = Callable[[str, int, int], None]

_WHITE = 0.7  # of the linear range, for the brightest pixels under white
# times the exposure of white: beyond, a photograph costs more time than its light is worth
_LONGER = 64.0
_AMBIENT = 0.3  # of the linear range, which ambient light takes at the longest exposure
_LAST_CODE = 0.995  # of full scale: as good as the last code
_FIRST = 1 / 60  # seconds
_DIM, _BRIGHT = (
    0.3,
    0.95,
)  # codes of the brightest pixels under white, outside of which another probe follows
_BRIGHTEST = 0.999  # quantile of the pixels that is to be bright
_HOT = 0.1  # of the pixels: more at the last code under black, and the exposure is too long
_QUIETEST = (
    1e-6  # of full scale: the read noise of a camera without any, so that weights are finite
)
# ratio of the longest exposure for the response to that of white, and of that to the shortest
_SPAN = 16.0
_MORE = 4  # more of them at most, each twice as long, where a colour stays dark
_SATURATED = 0.05  # of the pixels: as many reach the last code in each colour
_RAMPS = 4  # at most
_REPEATS = 2  # at least: two photographs determine noise
_PROBES, _MOST_PROBES = 2, 10  # of the exposure: mostly, at most
_CAMERA_PIXELS = 9  # to one of the projector's, where a plan is made before the first photograph
_LAMP, _CERTAIN = (
    0.01,
    5.0,
)  # of full scale, of black: T p moves by less than 1 %; standard deviations
_PATTERN = 0.1  # of full scale: what is brighter may be another pattern, as `agreement` tells
_SIGNIFICANT = 3.0  # standard deviations of noise that white must be above
_UNEVEN = 0.1  # relative deviation of a projector's curve from pixel to pixel, which is allowed
_ALIKE = (
    0.9  # correlation of a picture of blocks with their pattern: 0.98 and more in the right map
)
_DIRECT = 0.5  # of what white shows at a pixel is its own light, at least, in most scenes


@dataclass(frozen=True)
class _Effort:
    """Numbers of photographs: exposures for the response, camera pixels in the ramps of each, uniform codes.

    Monotone cubics through the codes, none the inverse of another, deviate from sRGB, a power of
    2.2 and film by at most 0.02 % of white (root mean square), or 0.3 % by hand.
    """

    bracket: int
    ramp_pixels: int
    codes: tuple[float, ...]

    def ramps(self, grid: tuple[int, int], camera_pixels: int) -> list[np.ndarray]:
        """Codes from 0 to 1 along the longer side, each shifted further."""
        count = min(-(-self.ramp_pixels // camera_pixels), _RAMPS)
        codes = np.linspace(0.0, 1.0, max(grid), dtype=np.float32)
        shifted = [np.roll(codes, k * len(codes) // count) for k in range(count)]
        return [
            np.broadcast_to(r if grid[1] >= grid[0] else r[:, None], grid).copy() for r in shifted
        ]

    def repeats(self, frames: int, camera_pixels: float) -> int:
        """Of black and white; a person's are shared by the camera pixels of a projector pixel."""
        return max(
            _REPEATS, math.ceil(frames / max(camera_pixels, 1.0)) if self is _BY_HAND else frames
        )

    def requests(
        self, grid: tuple[int, int], channels: int, repeats: int, times: Sequence[Sequence[float]]
    ) -> list[list[Request]]:
        """Blocks, black, white, uniform codes of each channel, and blocks again: nothing moved in between.

        `times` are those of black, of which the first is the exposure of white, of white, and of
        the scan.
        """
        (dark, bright, scan), white = times, np.ones(grid, np.float32)
        blocks = [(anchor.pattern(grid), t) for t in sorted({scan[0], scan[-1]})]
        single = {t for t in bright if self is _BY_HAND and t != dark[0]}
        lit = (
            [white]
            if channels == 1
            else [white[..., None] * c for c in np.eye(3, dtype=np.float32)]
        )
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


def expected_photographs(
    grid: tuple[int, int],
    channels: int = 1,
    frames: int = 16,
    aligned: bool = False,
    by_hand: bool = False,
) -> int:
    """How many photographs `measure` takes without a known response, give or take probes of the exposure.

    `by_hand`: by a person, with at least three camera pixels to a side of one of the projector's.

    >>> expected_photographs((8, 16)), expected_photographs((8, 16), by_hand=True)
    (147, 37)
    """
    effort, camera_pixels = _BY_HAND if by_hand else _AUTOMATIC, 1 if aligned else _CAMERA_PIXELS
    ramps = effort.bracket * len(effort.ramps(grid, camera_pixels * grid[0] * grid[1]))
    stripes = 0 if aligned else GrayCode(grid).count - 2  # without black and white
    repeats, times = (
        effort.repeats(frames, camera_pixels),
        ((2.0, 3.0), (1.0, 2.0, 3.0), (2.0, 3.0)),
    )
    return (
        _PROBES + ramps + stripes + sum(map(len, effort.requests(grid, channels, repeats, times)))
    )


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
    """Measure a set-up, with as many photographs as `expected_photographs` says.

    The camera must resolve blocks of `side`; `log` has photographs of an earlier run; the others,
    and errors, are as in `ltcl.acquire`.

    >>> from ltcl.acquisition import VirtualRig
    >>> calibration = measure(
    ...     Shots(VirtualRig(np.eye(64) / 2, (8, 8), bits=12)), geometry="aligned"
    ... )
    >>> bool(abs(calibration.white.value - 0.5).max() < 0.02), calibration.resampling.seen.all()
    (True, np.True_)
    """
    by_hand, aligned = getattr(shots.rig, "keeps_photographs", False), geometry == "aligned"
    options = {"channels": shots.channels, "frames": frames, "aligned": aligned, "by_hand": by_hand}
    expected, effort = (
        expected_photographs(shots.grid, **options),
        _BY_HAND if by_hand else _AUTOMATIC,
    )
    session = CaptureSession(
        shots, log, lambda done: progress("calibration", done, max(done, expected))
    )

    seconds = _bright_white(session)
    _check_geometry(shots, geometry)
    seconds = _response(session, effort, seconds, response)
    with session.naming_photographs():
        R, sharpness, stripes = _resampling(session, geometry, seconds)
    if sharpness is not None:
        sharpness.check(side)
    longest = _longest(session, seconds)
    scan = _for_scan(shots, seconds, longest) if exposures is None else _offered(shots, exposures)

    repeats = effort.repeats(
        frames, len(np.unique(R.weights.indices)) / max(np.count_nonzero(R.seen), 1)
    )
    bright = _offered(shots, [seconds / 2, seconds, longest])
    times = sorted({seconds, longest}), bright, scan
    before, dark, bright, *uniform, after = session.take(
        effort.requests(shots.grid, shots.channels, repeats, times)
    )
    _check_black(session, [photograph for photograph in dark if photograph.seconds == seconds])
    with session.naming_photographs():
        session.sensor = _sensor(session, dark, bright)
    session.record.check(session.sensor, shots.name)
    progress("calibration", shots.count, shots.count)

    ambient, lit = session.merge(dark), session.merge(bright)
    white = lit - ambient
    _check_light(scan, white, R, session.sensor)
    pictures = [[session.merge([photograph]) for photograph in each] for each in uniform]
    if shots.channels == 1:
        pictures[0].append(lit)
    for channel in zip(uniform, pictures, strict=True):
        _check_uniform(session, *channel, ambient)
    with acquisition_error("the projector"):
        channels = [[ambient, *each] for each in pictures]
        projector = radiometry.projector_response([0.0, *effort.codes, 1.0], channels)
        M = (
            None
            if shots.channels == 1
            else radiometry.mixing([each[-1] for each in pictures], ambient)
        )
    blocks = session.merge([*before, *after])
    _check_map(session, R, stripes, (blocks - ambient).value, white.value)
    R = R.ascertained(white.value, white.valid)
    return Calibration(
        scan, *session.sensor, ambient, white, projector, M, R, sharpness, Anchor.of(blocks, R)
    )


def _offered(shots: Shots, seconds: Iterable[float]) -> tuple[float, ...]:
    """The exposures of a camera nearest to `seconds`: ascending, each once."""
    return tuple(sorted({nearest(shots.exposures, t) for t in seconds}))


def bracket(shortest: float, longest: float, count: int) -> tuple[float, ...]:
    """`count` exposures, ascending, in steps of which every second is longer by the golden ratio.

    No period divides them: powers of one number do not determine a response
    (`radiometry.response`).

    >>> [round(t, 3) for t in bracket(0.01, 0.32, 4)]
    [0.01, 0.026, 0.123, 0.32]
    """
    steps = np.where(np.arange(count - 1) % 2, (1 + 5**0.5) / 2, 1.0)
    powers = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return tuple((shortest * (longest / shortest) ** powers).tolist())


def _hot_pixels(black: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels at the last code in a photograph (H, W[, 3]) that should be dark."""
    hot = (black.max(axis=-1) if black.ndim == 3 else black) >= _LAST_CODE
    return hot if hot.mean() <= _HOT else np.zeros_like(hot)


def _fill_hot_pixels(image: np.ndarray, hot: np.ndarray) -> np.ndarray:
    """The photograph with the good pixel before each hot one in its place, so that these decide nothing."""
    if not hot.any():
        return image
    good = np.flatnonzero(~hot)
    donor = good[np.maximum(np.searchsorted(good, np.arange(hot.size), "right") - 1, 0)]
    return image.reshape(hot.size, -1)[donor].reshape(image.shape)


def _brightness(image: np.ndarray, hot: np.ndarray) -> float:
    """What all but a thousandth of the pixels of a photograph reach at most."""
    return float(np.quantile(_fill_hot_pixels(image, hot), _BRIGHTEST, method="higher"))


def _bright_white(session: CaptureSession) -> float:
    """Seconds at which the brightest pixels under white have codes between 0.3 and 0.95 of full scale."""
    shots, hot = session.shots, np.zeros(1, bool)
    white = np.ones(shots.grid, np.float32)
    seconds, before = nearest(shots.exposures, _FIRST), 0.0
    for _ in range(_MOST_PROBES):
        image = session.photograph(white, seconds)
        level = _brightness(image, hot)
        if level > _BRIGHT:
            hot = _hot_pixels(session.photograph(0 * white, seconds))
            level = _brightness(image, hot)
        if _DIM <= level <= _BRIGHT:
            break
        last = (shots.levels or 1) - 1
        code = round(level * last)
        bits = code.bit_length()
        if level == before and bits > 8 and code + 1 == 1 << bits and level < _LAST_CODE:
            text = f"white is saturated at code {code} of {last}; bits of the rig"
            raise AcquisitionError(f"{text} (camera_bits of a folder) must be {bits}")
        change = 1 / 4 if level >= _LAST_CODE else _WHITE / max(level, _WHITE / 16)
        following = nearest(shots.exposures, seconds * change)
        if following == seconds:
            if image.min() < _LAST_CODE:
                break
            text = f"every pixel is saturated under white at the shortest exposure, {seconds:g} s; the camera"
            raise AcquisitionError(
                f"{text} must get less light: a smaller aperture, a darker projector or room"
            )
        seconds, before = following, level
    return seconds


def _for_scan(shots: Shots, white: float, longest: float) -> tuple[float, ...]:
    """The exposures of each pattern of a scan, ascending; two where a person takes the photographs."""
    by_hand = getattr(shots.rig, "keeps_photographs", False)
    between = [] if by_hand else [math.sqrt(white * longest)]
    return _offered(shots, [white, *between, longest])


def expected_exposures(shots: Shots, lit: float, ambient: float) -> tuple[float, ...]:
    """Those of a scan, from guesses of the radiance of white and of ambient light."""
    white = _WHITE / lit
    return _for_scan(shots, white, min(_LONGER * white, _AMBIENT / max(ambient, 1e-30)))


def _check_geometry(shots: Shots, geometry: str | Correspondence) -> None:
    """Refuse a geometry of other pixels than those of the first photograph."""
    grid, camera = shots.grid, shots.grid if geometry == "aligned" else shots.camera_grid
    if isinstance(geometry, Correspondence):
        grid, camera = geometry.grid, geometry.camera_grid
    if (grid, camera) != (shots.grid, shots.camera_grid):
        text = f"from photographs of {camera} to a projector of {grid}; the rig has photographs of"
        name = repr(geometry) if isinstance(geometry, str) else "a Correspondence"
        raise InputError(
            f"geometry is {name}, {text} {shots.camera_grid} and a projector of {shots.grid}"
        )


def _response(
    session: CaptureSession, effort: _Effort, seconds: float, response: Response | None
) -> float:
    """Response of the camera and hot pixels, for the session; the exposure at which white has `_WHITE`."""
    shots, full = session.shots, np.ones(session.shots.grid, np.float32)
    if response is None:
        response, session.hot = _ramps(session, effort, seconds)
    else:
        session.hot = _hot_pixels(session.photograph(0 * full, seconds))
    session.sensor = CameraModel(response)
    level = _brightness(session.photograph(full, seconds), session.hot)
    shots.digest.clear()  # of probes; photographs at the exposure of white tell rigs apart
    return nearest(shots.exposures, seconds * _WHITE / max(level, 0.01))


def _ramps(session: CaptureSession, effort: _Effort, seconds: float) -> tuple[Response, np.ndarray]:
    shots, span = session.shots, bracket(seconds / _SPAN, seconds * _SPAN, effort.bracket)
    times = [*_offered(shots, span)]
    H, W = shots.camera_grid or shots.grid
    ramps = effort.ramps(shots.grid, H * W)
    exposed = session.take([[(ramp, t) for ramp in ramps] for t in times])
    hot = _hot_pixels(np.minimum.reduce([p.image for p in exposed[0]]))

    def side_by_side(photographs: list[Photograph]) -> np.ndarray:
        return np.hstack([_fill_hot_pixels(photograph.image, hot) for photograph in photographs])

    for t in _offered(shots, [times[-1] * 2.0**k for k in range(1, _MORE + 1)]):
        darkest = np.quantile(side_by_side(exposed[-1]), 1.0 - _SATURATED, axis=(0, 1)).min()
        if t <= times[-1] or shots.channels == 1 or darkest >= _LAST_CODE:
            break
        times.append(t)
        exposed += session.take([[(ramp, t) for ramp in ramps]])
    images, numbers = (
        [side_by_side(group) for group in exposed],
        (exposed[0][0].number, shots.number),
    )
    with acquisition_error("the response of the camera, photographs {} to {}".format(*numbers)):
        return radiometry.calibrate(images, times, levels=shots.levels, saturation=_LAST_CODE), hot


def _resampling(
    session: CaptureSession, geometry: str | Correspondence, seconds: float
) -> tuple[Resampling, Sharpness | None, list[Photograph]]:
    black = np.zeros(session.shots.grid, np.float32)
    session.prepare(
        [(black, seconds), (black, nearest(session.shots.exposures, _LONGER * seconds))]
    )
    if geometry == "aligned":
        return Resampling.aligned(session.shots.grid), None, []
    stripes, light = [], []
    if isinstance(geometry, str):
        patterns = GrayCode(session.shots.grid).patterns()
        stripes = session.take([[(codes, seconds) for codes in patterns]])[0]
        # Linear in light: a pixel that is half lit shows half of it.
        light = [session.sensor.response.linear(photograph.image) for photograph in stripes]
        with acquisition_error("the geometry"):
            geometry = decode(light, session.shots.grid, levels=session.shots.levels)
    R = Resampling.of(geometry)
    return R, Sharpness.of(geometry, R, light), stripes


def _check_map(
    session: CaptureSession,
    R: Resampling,
    stripes: list[Photograph],
    blocks: np.ndarray,
    white: np.ndarray,
) -> None:
    """Refuse Gray code of which a pattern was exchanged with its inverse: its map is mirrored in part.

    The picture of blocks tells: it is more like their pattern in the map that exchanging them back
    gives.
    """
    grid, levels, codes = R.grid, session.shots.levels, anchor.pattern(R.grid).ravel()

    def likeness(R: Resampling) -> float:
        lit, full = (R.apply(x).reshape(len(codes), -1).sum(axis=1) for x in (blocks, white))
        seen = R.seen.ravel() & (full > 0)
        with np.errstate(invalid="ignore", divide="ignore"):  # of no pixels, or all alike
            return float(np.corrcoef(lit[seen] / full[seen], codes[seen])[0, 1])

    if not stripes or (own := likeness(R)) > _ALIKE:
        return
    light = [session.sensor.response.linear(photograph.image) for photograph in stripes]
    for k in range(0, len(stripes) - 2, 2):
        exchanged = [*light[:k], light[k + 1], light[k], *light[k + 2 :]]
        with contextlib.suppress(InputError):
            if likeness(Resampling.of(decode(exchanged, grid, levels=levels))) > max(own, _ALIKE):
                names = " and ".join(session.shots.name(each.number) for each in stripes[k : k + 2])
                text = f"{names} are exchanged, a pattern and its inverse; {agreement.ADVICE}"
                raise AcquisitionError(text)


def _longest(session: CaptureSession, white: float) -> float:
    """The longest useful exposure: ambient light limits it, as black shows."""
    seconds = nearest(session.shots.exposures, _LONGER * white)
    while seconds > white:
        light = session.photograph(np.zeros(session.shots.grid, np.float32), seconds)
        level = float(np.quantile(_fill_hot_pixels(light, session.hot), 0.99))
        if level < 1.5 * _AMBIENT:
            return seconds
        shorter = seconds * _AMBIENT / level if level < _BRIGHT else seconds / 8
        seconds, longer = nearest(session.shots.exposures, shorter), seconds
        if seconds >= longer:
            return longer
        logger.info(
            "%s, of black, is too bright at %.3g s",
            session.shots.name(session.shots.number),
            longer,
        )
    return white


def _check_black(session: CaptureSession, photographs: list[Photograph]) -> None:
    """Refuse black photographs of one exposure of which one is brighter: by its level, all others deviate."""
    light = np.stack([session.sensor.response.linear(p.image).ravel() for p in photographs])
    level = light.mean(axis=1)
    noise = float(np.std(light - light.mean(axis=0) - level[:, None])) / math.sqrt(light.shape[1])
    excess = level - level.min()
    bright = (excess > _LAMP + _CERTAIN * noise) & (excess < _PATTERN)
    if bright.any():
        name = session.shots.name(photographs[int(np.argmax(bright))].number)
        raise AcquisitionError(
            f"{name}, of black, is too bright: another light was on; {agreement.ADVICE}"
        )


def _sensor(
    session: CaptureSession, dark: list[Photograph], bright: list[Photograph]
) -> CameraModel:
    """Noise, and the linear value without light: 0 where one exposure cannot tell it from ambient light."""
    response, levels = session.sensor.response, session.shots.levels
    groups = [(each, t) for each in (dark, bright) for t in sorted({p.seconds for p in each})]
    bursts = [
        [_fill_hot_pixels(p.image, session.hot) for p in each if p.seconds == t]
        for each, t in groups
    ]
    with acquisition_error("the noise of the camera"):
        bursts = [images for images in bursts if len(images) > 1]
        noise = radiometry.estimate(bursts, response=response, levels=levels)
    noise = replace(noise, read=max(noise.read, _QUIETEST))
    times = [p.seconds for p in dark]
    if min(times) == max(times):
        return CameraModel(response, noise, np.zeros(session.shots.channels))
    with acquisition_error("black"):
        offset = radiometry.black_level(
            [p.image for p in dark], times, response, noise, levels=levels
        )
    return CameraModel(response, noise, offset)


def _check_uniform(
    session: CaptureSession, shots: list[Photograph], pictures: list[Radiance], ambient: Radiance
) -> None:
    """Refuse photographs of uniform codes that do not show black and a rising part g of white, the last."""
    *pictures, white = pictures
    known, named = white.valid & ambient.valid, session.shots.name
    pixels = agreement.spread(np.flatnonzero(known.reshape(*known.shape[:2], -1).all(axis=2)))
    black, dark_variance, bright, variance = (
        agreement.sample(x, pixels).astype(np.float64)
        for x in (ambient.value, ambient.variance, white.value, white.variance)
    )
    W, below, last = bright - black, 0.0, None
    of_colour = f", which {named(shots[-1].number)} is" if len(shots) > len(pictures) else ""
    for photograph, picture in zip(shots, pictures, strict=False):
        y, v, valid = (
            agreement.sample(x, pixels) for x in (picture.value, picture.variance, picture.valid)
        )
        total = max(float(np.sum(W[valid] ** 2)), 1e-30)
        g = float(np.sum(((y - black) * W)[valid])) / total
        noise = float(np.sqrt(np.sum(W[valid] ** 2 * (v + dark_variance)[valid]))) / total
        expected = black + g * W, dark_variance + g**2 * variance + (_UNEVEN * g * W) ** 2
        image, name = [agreement.sample(photograph.image, pixels)], named(photograph.number)
        if (
            agreement.find_deviation(image, [photograph.seconds], session.sensor, expected)
            is not None
        ):
            text = f"{name}, of a uniform code, does not show a part of white{of_colour}: another light was on"
            raise AcquisitionError(f"{text}, or it is another pattern; {agreement.ADVICE}")
        if last is not None and g < below - _SIGNIFICANT * noise - _UNEVEN * below:
            text = f"{last} or {name} deviates: it shows {g / below:.2g} times the light of a darker code"
            raise AcquisitionError(f"{text}; {agreement.ADVICE}")
        below, last = g, name


def _check_light(
    scan: tuple[float, ...], white: Radiance, R: Resampling, sensor: CameraModel
) -> None:
    """Refuse a projector without light; exposures that saturate lit pixels, or show noise alone."""
    if white.value.sum() <= _SIGNIFICANT * math.sqrt(white.variance[white.valid].sum()):
        raise AcquisitionError(
            f"photographs are no brighter under white than under black; {NO_LIGHT}"
        )
    light = R.apply(np.where(white.valid, white.value, 0.0))[R.seen]
    level = float(np.median(light[light > 0])) if (light > 0).any() else 0.0
    reason = ""
    if scan[0] * _DIRECT * level > sensor.noise.saturation:
        reason = f"saturates at {scan[0]:g} s, which must be below {scan[0] / 2:.2g}"
    elif 0 < scan[-1] * level < _SIGNIFICANT * float(np.sqrt(sensor.noise.variance(0.0))):
        reason = f"is lost in noise at {scan[-1]:g} s, which must be above {2 * scan[-1]:.2g}"
    if reason:
        raise InputError(f"exposures is {scan}; half of white {reason}")
