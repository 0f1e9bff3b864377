# SPDX-License-Identifier: BSD-3-Clause
"""All that is measured once of a set-up, before its transport is scanned, in this order.

    exposure     at which the brightest pixels under white reach 0.7 of the linear range
    response     of the camera, from ramps at a bracket of exposures
    geometry     which projector pixel a camera pixel sees, by Gray code
    black, white repeatedly: noise of the camera, its offset, ambient light, the row sums of T
    projector    uniform codes of all channels and each channel alone: their curves, and how colours
                 mix; few pixels and all others: does its light depend on the picture?
    anchor       a pattern that is photographed again during the scan: did anything move?

Known limit: the unit of light is what the response reaches at the last code, which has no absolute
value. A colour that the scene hardly reflects is photographed for longer, so that its curve
reaches that code too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ltcl.acquisition import anchor, consistency, radiometry
from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.anchor import Anchor
from ltcl.acquisition.calibration import Calibration, StoredMap
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling, Sharpness, decode
from ltcl.acquisition.geometry.photographs import PhotographFile
from ltcl.acquisition.metering import (
    MAX_EXPOSURE_RATIO,
    SATURATED_CODE,
    WHITE_LEVEL,
    OtherLight,
    bracket,
    brightness,
    check_full_scale,
    fill_hot_pixels,
    find_white_exposure,
    hot_pixels,
    longest_exposure,
    offered_exposures,
    scan_exposures,
    unsaturated_exposure,
)
from ltcl.acquisition.radiance import difference, planes
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Shots, nearest
from ltcl.acquisition.session import (
    CaptureSession,
    Photograph,
    ProgressFunction,
    Request,
    acquisition_error,
    ignore_progress,
)
from ltcl.store import ArrayLog

# Read noise, relative to full scale, of a camera without any, so that weights are finite.
MIN_READ_NOISE = 1e-6
# Ratio of the longest exposure for the response to that of white, and of that to the shortest.
RESPONSE_SPAN = 16.0
# More exposures for the response, each twice as long, while fewer than this share of the pixels
# reach the last code in each colour.
MAX_EXTRA_EXPOSURES = 4
SATURATED_SHARE = 0.05
# Ratio of the exposure of white to the shortest one, below which ramps, whose light bounces, show
# nothing as dark as black: the curve between them would be a guess, and be wrong by 0.1 % of full
# scale, so that clean photographs deviate from each other.
MIN_DARK_RATIO = 8.0
# Most ramps for the response.
MAX_RAMPS = 4
# Fewest photographs of black and of white: two determine noise.
MIN_REPEATS = 2
# Most of them before a scan of few patterns.
MAX_SPARING_REPEATS = 4
# Pixels of a photograph among which those are that determine the response, and their number.
MAX_RESPONSE_PIXELS = 1 << 15
RESPONSE_SAMPLES = 1 << 14
# Photographs that usually find the exposure of white.
EXPECTED_PROBES = 2
# Camera pixels for one of the projector's, in a plan before the first photograph.
EXPECTED_CAMERA_PIXELS = 9


class CaptureTimes(NamedTuple):
    """Exposures of black, of which the first is that of white, of white, and of the scan."""

    black: Sequence[float]
    white: Sequence[float]
    scan: Sequence[float]


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Numbers of photographs that are taken where they cost little, or much.

    Attributes
    ----------
    is_sparing : bool
        Whether they cost much: a person takes them, or the scan after them takes few.
    exposures : int
        Exposures for the response.
    many_pixels : int
        Camera pixels from which on `few_exposures` tell it, and `few_repeats` of black and white
        the noise.
    ramp_pixels : int
        Camera pixels in the ramps of each.
    codes : tuple of float
        Uniform codes of the projector. Monotone cubics through the many codes, none the inverse of
        another, deviate from sRGB, a power of 2.2 and film by at most 0.02 % of white (root mean
        square), through the few by 0.3 %.
    spares_witnesses : bool
        Leaves out the inverses of coarse stripes of Gray code, and long exposures of black and of
        white before a scan without any. A person takes them: they tell which photograph is wrong
        where some are exchanged or missing.
    """

    is_sparing: bool
    exposures: int
    ramp_pixels: int
    codes: tuple[float, ...]
    many_pixels: float = math.inf
    few_exposures: int = 0
    few_repeats: int = MAX_SPARING_REPEATS
    spares_witnesses: bool = False

    def response_exposures(self, camera_pixels: int) -> int:
        """Exposures for the response of a camera of so many pixels."""
        return self.few_exposures if camera_pixels >= self.many_pixels else self.exposures

    def ramps(
        self, grid: tuple[int, int], camera_pixels: int, lit: np.ndarray | None = None
    ) -> list[np.ndarray]:
        """Codes from 0 to 1 along the longer side of what is lit, each shifted further.

        `lit` (h, w) are the pixels that the projector lights; None: all.
        """
        if lit is None:
            lit = np.ones(grid, bool)
        rows, columns = _lit_box(lit)
        height = rows.stop - rows.start
        width = columns.stop - columns.start
        count = min(-(-self.ramp_pixels // camera_pixels), MAX_RAMPS)
        codes = np.linspace(0.0, 1.0, max(height, width), dtype=np.float32)
        ramps = []
        for k in range(count):
            shifted = np.roll(codes, k * len(codes) // count)
            if width < height:
                shifted = shifted[:, None]
            ramp = np.zeros(grid, np.float32)
            ramp[rows, columns] = shifted
            ramps.append(ramp)
        return ramps

    def repeats(self, frames: int, camera_pixels: int, seeing: float) -> int:
        """Photographs of black and of white.

        Few are shared by the camera pixels that see one projector pixel, `seeing` of them.
        """
        if not self.is_sparing:
            return max(MIN_REPEATS, frames)
        if camera_pixels >= self.many_pixels:
            frames = min(frames, self.few_repeats)
        return max(MIN_REPEATS, math.ceil(frames / max(seeing, 1.0)))

    def requests(
        self, grid: tuple[int, int], channels: int, repeats: int, times: CaptureTimes
    ) -> list[list[Request]]:
        """Blocks, black, white, uniform codes, colours, few pixels, blocks, the others.

        With one channel there are no colours. The second photograph of blocks shows that nothing
        moved in between.
        """
        white = np.ones(grid, np.float32)
        black = np.zeros(grid, np.float32)
        white_seconds = times.black[0]
        # Then long exposures are those of black alone, for the light of the room.
        has_short_scan = self.spares_witnesses and len(times.scan) == 1
        scan_range = sorted({times.scan[0], times.scan[-1]})
        blocks = [(anchor.pattern(grid), seconds) for seconds in scan_range]
        dark_requests = []
        for seconds in times.black:
            count = 1 if has_short_scan and seconds != white_seconds else repeats
            dark_requests += _repeated(black, seconds, count)
        bright_requests = []
        for seconds in times.white:
            is_single = self.is_sparing and seconds != white_seconds
            count = 1 if is_single else repeats
            bright_requests += _repeated(white, seconds, count)
        uniform_requests = []
        for code in self.codes:
            # Views: the codes of many pixels in all colours would fill the memory.
            uniform = np.broadcast_to(np.float32(code), grid)
            uniform_requests.append((uniform, white_seconds))
        groups = [blocks[:1], dark_requests, bright_requests, uniform_requests]
        if channels == 3:
            colours = []
            for colour in np.eye(3, dtype=np.float32):
                colours.append((np.broadcast_to(colour, (*grid, 3)), white_seconds))
            groups.append(colours)
        few = anchor.sparse_pattern(grid)
        others = 1.0 - few
        return [*groups, [(few, white_seconds)], blocks, [(others, white_seconds)]]


def _lit_box(lit: np.ndarray) -> tuple[slice, slice]:
    """The rows and the columns from the first lit pixel to the last."""
    rows = np.flatnonzero(lit.any(axis=1))
    columns = np.flatnonzero(lit.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _repeated(codes: np.ndarray, seconds: float, count: int) -> list[Request]:
    """`count` requests of the same codes at one exposure."""
    return [(codes, seconds)] * count


THOROUGH = Effort(
    is_sparing=False,
    exposures=8,
    ramp_pixels=1 << 14,
    codes=tuple((np.arange(16) + 0.3) / 16),
)
BY_HAND = Effort(
    is_sparing=True,
    exposures=5,
    ramp_pixels=1 << 10,
    codes=(0.07, 0.2, 0.38, 0.68, 0.9),
)


# An automatic rig before a scan of few patterns. The error of a response is 0.11 to 0.15 % by 8
# exposures of 1024 pixels of the camera, 0.07 to 0.09 % of 4096 and 0.06 % by 6 of 16384; 5 have
# 0.08 to 0.3 % (linear, film and sRGB cameras).
SPARING = replace(
    BY_HAND,
    exposures=THOROUGH.exposures,
    many_pixels=1 << 13,
    few_exposures=6,
    spares_witnesses=True,
)
# The same before a scan of direct light, which is off by more than that.
DIRECT = replace(
    SPARING, many_pixels=1 << 10, few_exposures=BY_HAND.exposures, few_repeats=MIN_REPEATS
)


def _effort(by_hand: bool, sparing: bool, direct: bool) -> Effort:
    if by_hand:
        return BY_HAND
    if direct:
        return DIRECT
    return SPARING if sparing else THOROUGH


def expected_photographs(
    grid: tuple[int, int],
    channels: int = 1,
    frames: int = 16,
    aligned: bool = False,
    by_hand: bool = False,
    sparing: bool = False,
    direct: bool = False,
) -> int:
    """Number of photographs that `measure` takes without a known response.

    Probes of the exposure may add some. `by_hand`: by a person, with at least three camera pixels
    to a side of one of the projector's; `sparing`: before a scan of few patterns; `direct`: of
    direct light.

    >>> expected_photographs((8, 16)), expected_photographs((8, 16), by_hand=True)
    (149, 39)
    """
    effort = _effort(by_hand, sparing, direct)
    if sparing:
        frames = min(frames, MAX_SPARING_REPEATS)
    seeing = 1 if aligned else EXPECTED_CAMERA_PIXELS
    camera_pixels = seeing * grid[0] * grid[1]
    ramps = effort.ramps(grid, camera_pixels)
    of_response = effort.response_exposures(camera_pixels) * len(ramps)
    # Black and white of the Gray code are photographed anyway.
    stripes = 0 if aligned else GrayCode(grid, effort.spares_witnesses).count - 2
    white_times = (1.0, 2.0, 3.0)
    scan_times = (2.0, 3.0)
    if sparing:
        scan_times = (2.0,)
        if effort.spares_witnesses:
            white_times = (1.0, 2.0)
    times = CaptureTimes(black=(2.0, 3.0), white=white_times, scan=scan_times)
    repeats = effort.repeats(frames, camera_pixels, seeing)
    groups = effort.requests(grid, channels, repeats, times)
    captures = sum(map(len, groups))
    return EXPECTED_PROBES + of_response + stripes + captures


def measure(
    shots: Shots,
    *,
    geometry: str | Correspondence = "graycode",
    response: Response | None = None,
    exposures: Sequence[float] | None = None,
    frames: int = 16,
    side: int = 1,
    sparing: bool = False,
    direct: bool = False,
    progress: ProgressFunction = ignore_progress,
    log: ArrayLog | None = None,
) -> Calibration:
    """Measure a set-up, with as many photographs as `expected_photographs` says.

    The camera must resolve blocks of `side`; `sparing`: with few photographs, before a scan of few
    patterns at one exposure, and `direct`: of direct light; `log` has photographs of an earlier
    run; the other arguments, and errors, are as in `ltcl.acquire`.

    >>> from ltcl.acquisition import VirtualRig
    >>> calibration = measure(
    ...     Shots(VirtualRig(np.eye(64) / 2, (8, 8), bits=12)), geometry="aligned"
    ... )
    >>> bool(abs(calibration.white.value - 0.5).max() < 0.02), calibration.resampling.seen.all()
    (True, np.True_)
    """
    effort = _effort(shots.keeps_photographs, sparing, direct)
    if sparing:
        frames = min(frames, MAX_SPARING_REPEATS)
    expected = expected_photographs(
        shots.grid,
        channels=shots.channels,
        frames=frames,
        aligned=geometry == "aligned",
        by_hand=shots.keeps_photographs,
        sparing=sparing,
        direct=direct,
    )

    def count(done: int) -> None:
        progress("calibration", done, max(done, expected))

    session = CaptureSession(shots, log, count)

    # 1. Exposure of white, and response of the camera.
    first_exposure = find_white_exposure(session)
    consistency.check_geometry(shots, geometry)
    white_exposure = _measure_response(session, effort, first_exposure, response)

    # 2. Geometry.
    with session.naming_photographs():
        view = _measure_geometry(session, effort, geometry, white_exposure)
    if view.sharpness is not None:
        with session.naming_photographs():
            view.sharpness.check(side)

    # 3. Black, white, uniform codes and blocks.
    times = _choose_times(session, effort, white_exposure, exposures, sparing)
    height, width = view.resampling.camera_grid
    repeats = effort.repeats(frames, height * width, view.camera_pixels)
    requests = effort.requests(shots.grid, shots.channels, repeats, times)
    before, dark, bright, *uniform, few, after, others = session.take(requests)

    # 4. Noise and offset of the camera; then photographs can be compared.
    _check_black_and_white(session, dark, bright, white_exposure)
    with session.naming_photographs():
        session.camera = _measure_camera(session, dark, bright)
    session.check_agreement()
    progress("calibration", shots.count, shots.count)

    # 5. Light: ambient, white, of the projector's channels, and of the blocks.
    projector, mixing = _measure_projector(session, effort, uniform, dark, bright)
    ambient = session.merge(dark)
    white = difference(session.merge(bright), ambient, session.file)
    consistency.check_light(times.scan, white, view.resampling, session.camera)
    blocks = session.merge([*before, *after])
    if view.light is not None:
        block_light = difference(blocks, ambient, session.file)
        consistency.check_map(
            session, view.resampling, view.stripes, view.light, block_light, white
        )
    consistency.check_superposition(session, few[0], others[0], dark, bright)
    resampling = view.resampling.ascertained_by(planes(white, "value"))
    return Calibration(
        exposures=tuple(times.scan),
        response=session.camera.response,
        noise=session.camera.noise,
        offset=session.camera.offset,
        ambient=ambient,
        white=white,
        projector=projector,
        mixing=mixing,
        resampling=resampling,
        sharpness=view.sharpness,
        anchor=Anchor.of(blocks, resampling),
        mapping=view.mapping,
        stripes=_stripes_of_scan(view, times),
    )


def _choose_times(
    session: CaptureSession,
    effort: Effort,
    white: float,
    exposures: Sequence[float] | None,
    sparing: bool,
) -> CaptureTimes:
    """Exposures of black, white and the scan, by that of white."""
    shots = session.shots
    longest = longest_exposure(session, white)
    white_times = [white / 2, white, longest]
    if exposures is not None:
        scan = offered_exposures(shots, exposures)
    elif sparing:
        # Half of the pixels are lit: no camera pixel is dark.
        scan = offered_exposures(shots, [white])
        if effort.spares_witnesses:
            white_times = [white / 2, white]
    else:
        scan = scan_exposures(shots, white, longest)
    return CaptureTimes(
        black=sorted({white, longest}),
        white=offered_exposures(shots, white_times),
        scan=scan,
    )


def _measure_response(
    session: CaptureSession, effort: Effort, seconds: float, response: Response | None
) -> float:
    """Find response and hot pixels of the camera, for the session.

    Returns the exposure at which white has `WHITE_LEVEL` of the linear range.
    """
    shots = session.shots
    white = np.ones(shots.grid, np.float32)
    if response is None:
        response, session.hot = _response_from_ramps(session, effort, seconds)
    else:
        session.hot = hot_pixels([session.photograph(np.zeros_like(white), seconds)])
    session.camera = CameraModel(response=response)
    level = brightness(session, session.photograph(white, seconds), session.hot)
    # The digest is of photographs at the exposure of white, which tell rigs apart, not of probes.
    shots.digest.clear()
    return unsaturated_exposure(shots, seconds * WHITE_LEVEL / max(level, 0.01))


def _response_from_ramps(
    session: CaptureSession, effort: Effort, white_exposure: float
) -> tuple[Response, np.ndarray]:
    """Response of the camera, and its hot pixels, from ramps at a bracket of exposures.

    Without an exposure much shorter than that of white, photographs of black are added.
    """
    shots = session.shots
    shortest = white_exposure / RESPONSE_SPAN
    longest = white_exposure * RESPONSE_SPAN
    height, width = shots.camera_grid or (0, 0)
    exposures = effort.response_exposures(height * width)
    times = [*offered_exposures(shots, bracket(shortest, longest, exposures))]
    ramps = effort.ramps(shots.grid, height * width, getattr(shots.rig, "lit", None))
    if times[0] * MIN_DARK_RATIO > white_exposure:
        ramps.append(np.zeros(shots.grid, np.float32))
    exposed = session.take([[(ramp, seconds) for ramp in ramps] for seconds in times])
    hot = hot_pixels(exposed[0])
    if shots.channels == 3:
        _expose_dark_colours(session, ramps, hot, times, exposed)
    images = [_side_by_side(group, hot) for group in exposed]
    names = [_name_group(session, group) for group in exposed]
    check_full_scale(shots, times, images, names)
    first = exposed[0][0].number
    subject = f"the response of the camera, photographs {first} to {shots.number}"
    with acquisition_error(subject, names):
        response = radiometry.calibrate(
            images,
            times,
            levels=shots.levels,
            saturation=SATURATED_CODE,
            samples=RESPONSE_SAMPLES,
        )
    return response, hot


def _name_group(session: CaptureSession, group: Sequence[Photograph]) -> str:
    """Name of the photographs of one exposure."""
    names = [session.name(photograph) for photograph in group]
    if len(names) == 1:
        return names[0]
    return f"{names[0]} to {names[-1]}"


def _expose_dark_colours(
    session: CaptureSession,
    ramps: Sequence[np.ndarray],
    hot: np.ndarray,
    times: list[float],
    exposed: list[list[Photograph]],
) -> None:
    """Add longer exposures of the ramps, until every colour reaches the last code."""
    longer = times[-1] * 2.0 ** np.arange(1, MAX_EXTRA_EXPOSURES + 1)
    for seconds in offered_exposures(session.shots, longer.tolist()):
        if seconds <= times[-1] or _are_saturated(ramps, exposed[-1], hot):
            return
        times.append(seconds)
        exposed += session.take([[(ramp, seconds) for ramp in ramps]])


def _are_saturated(
    ramps: Sequence[np.ndarray], photographs: Sequence[Photograph], hot: np.ndarray
) -> bool:
    """True if the photographs of ramps reach the last code in every colour."""
    lit = []
    for ramp, photograph in zip(ramps, photographs, strict=True):
        if ramp.any():
            lit.append(photograph)
    brightest = np.quantile(_side_by_side(lit, hot), 1.0 - SATURATED_SHARE, axis=(0, 1))
    return bool(brightest.min() >= SATURATED_CODE)


def _side_by_side(photographs: Sequence[Photograph], hot: np.ndarray) -> np.ndarray:
    """Photographs of one exposure as a single picture of some pixels, without hot ones."""
    parts = []
    for photograph in photographs:
        step = photograph.step_of(MAX_RESPONSE_PIXELS)
        parts.append(_without_hot_pixels(photograph, hot, step))
    return np.hstack(parts)


def _without_hot_pixels(photograph: Photograph, hot: np.ndarray, step: int) -> np.ndarray:
    """Pixels of a photograph at a distance `step`; hot ones are those before them."""
    return fill_hot_pixels(photograph.at_step(step), hot[::step, ::step])


def _stripes_of_scan(view: _View, times: CaptureTimes) -> list[Photograph]:
    """The photographs of the bits of Gray code, if those of the scan have their exposure."""
    if not view.stripes or list(times.scan) != [view.stripes[0].seconds]:
        return []
    layout = GrayCode(view.resampling.grid).layout_of(len(view.stripes))
    return [view.stripes[number] for number in layout.first.tolist()]


@dataclass(frozen=True, kw_only=True)
class _View:
    """The camera's view of the projector's pixels, and the photographs of Gray code behind it."""

    resampling: Resampling
    sharpness: Sharpness | None = None
    stripes: Sequence[Photograph] = ()
    light: PhotographFile | None = None
    mapping: StoredMap | None = None

    @property
    def camera_pixels(self) -> float:
        """Camera pixels for one of the projector's."""
        used = self.resampling.camera_pixels()
        return len(used) / max(np.count_nonzero(self.resampling.seen), 1)


def _measure_geometry(
    session: CaptureSession, effort: Effort, geometry: str | Correspondence, seconds: float
) -> _View:
    """Find the projector pixel of each camera pixel."""
    shots = session.shots
    black = np.zeros(shots.grid, np.float32)
    longest = nearest(shots.exposures, MAX_EXPOSURE_RATIO * seconds)
    session.prepare([(black, seconds), (black, longest)])
    if geometry == "aligned":
        return _View(resampling=Resampling.aligned(shots.grid))
    stripes: list[Photograph] = []
    light = None
    if isinstance(geometry, str):
        patterns = GrayCode(shots.grid, effort.spares_witnesses).patterns()
        [stripes] = session.take([[(codes, seconds) for codes in patterns]])
        # Linear in light: a pixel that is half lit shows half of it.
        light = PhotographFile(session.file)
        for photograph in stripes:
            light.append_rows(photograph.grid, session.linear(photograph))
        with acquisition_error("the geometry"):
            geometry = decode(light, shots.grid, levels=shots.levels)
    resampling = Resampling.of(geometry)
    return _View(
        resampling=resampling,
        sharpness=Sharpness.of(geometry, resampling, light or ()),
        stripes=stripes,
        light=light,
        mapping=StoredMap.of(geometry, session.file),
    )


def _check_black_and_white(
    session: CaptureSession,
    dark: Sequence[Photograph],
    bright: Sequence[Photograph],
    white_exposure: float,
) -> None:
    """Check that black does not change, and that white reaches the full scale of the camera."""
    of_white_exposure = [shot for shot in dark if shot.seconds == white_exposure]
    consistency.check_black(session, of_white_exposure)
    by_exposure = {photograph.seconds: photograph for photograph in bright}
    images = []
    names = []
    for photograph in by_exposure.values():
        images.append(photograph.sampled)
        names.append(session.name(photograph))
    try:
        check_full_scale(session.shots, list(by_exposure), images, names)
    except OtherLight:
        session.check_agreement()
        raise


def _measure_camera(
    session: CaptureSession, dark: Sequence[Photograph], bright: Sequence[Photograph]
) -> CameraModel:
    """Noise of the camera, and its linear value without light.

    That is 0 if a single exposure cannot tell it from ambient light.
    """
    response = session.camera.response
    levels = session.shots.levels
    bursts = _bursts(dark, session.hot) + _bursts(bright, session.hot)
    with acquisition_error("the noise of the camera"):
        noise = radiometry.estimate(bursts, response=response, levels=levels)
    noise = replace(noise, read=max(noise.read, MIN_READ_NOISE))
    times = [photograph.seconds for photograph in dark]
    if min(times) == max(times):
        offset = np.zeros(session.shots.channels)
        return CameraModel(response=response, noise=noise, offset=offset)
    images = [photograph.sampled for photograph in dark]
    with acquisition_error("black"):
        offset = radiometry.black_level(images, times, response, noise, levels=levels)
    return CameraModel(response=response, noise=noise, offset=offset)


def _bursts(photographs: Sequence[Photograph], hot: np.ndarray) -> list[list[np.ndarray]]:
    """Images of one pattern by exposure, if there is more than one."""
    by_exposure: dict[float, list[np.ndarray]] = {}
    for photograph in photographs:
        image = _without_hot_pixels(photograph, hot, photograph.step)
        by_exposure.setdefault(photograph.seconds, []).append(image)
    bursts = [by_exposure[seconds] for seconds in sorted(by_exposure)]
    return [images for images in bursts if len(images) > 1]


def _measure_projector(
    session: CaptureSession,
    effort: Effort,
    uniform: Sequence[Sequence[Photograph]],
    dark: Sequence[Photograph],
    bright: Sequence[Photograph],
) -> tuple[Response, np.ndarray | None]:
    """Response of the projector, and how its colours mix; None with one channel.

    `uniform` are photographs of uniform codes, then those of each colour if there are any; `dark`
    and `bright` those of black and of white.
    """
    ambient = session.merge_sampled(dark)
    lit = session.merge_sampled(bright)
    grey, *colours = uniform
    pictures = [session.merge_sampled([photograph]) for photograph in grey]
    codes = [0.0, *effort.codes, 1.0]
    if not colours:
        consistency.check_uniform(session, grey, pictures, [lit], ambient)
        with acquisition_error("the projector"):
            return radiometry.projector_response(codes, [[ambient, *pictures, lit]]), None
    [full_colours] = colours
    full = [session.merge_sampled([photograph]) for photograph in full_colours]
    consistency.check_uniform(session, grey, pictures, full, ambient, full_colours)
    consistency.check_colours(full, lit, ambient)
    with acquisition_error("the projector"):
        projector = radiometry.colour_response(codes, pictures, full, ambient)
        return projector, radiometry.mixing(full, ambient)
