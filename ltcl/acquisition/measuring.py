# SPDX-License-Identifier: BSD-3-Clause
"""All that is measured once of a set-up, before its transport is scanned.

    exposure        white is bright at; then `exposing`
    response        of the camera, from ramps beside black at a bracket of exposures
    geometry        which projector pixel a camera pixel sees, by patterns, unless it is given
    noise           of the camera, from the same photograph taken again and again
    black           offset of the camera, and light without the projector, at the exposures of the scan
    white           all that the projector can light, of which row sums of T are known
    projector       codes to light of each channel, and from these pictures how its colours mix

Known limit: the unit of light is what the response reaches at the last code, for which nothing else stands.
A colour that the wall hardly reflects is photographed for longer, up to 16 times, so that its curve reaches
that code too: one that ends before has a unit of its own, and grey is no longer grey.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import exposing
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.acquisition.geometry import measure as measure_geometry
from ltcl.acquisition.geometry.measure import exposure
from ltcl.acquisition.radiometry import (
    NoiseModel,
    ProjectorResponse,
    Radiance,
    Response,
    black,
    bracket,
    calibrate,
    estimate,
    merge,
    mixing,
    projector,
)
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.stuck import healed, stuck
from ltcl.errors import AcquisitionError, InputError

Tell = Callable[[str], None]
_BRACKET, _SPAN = 8, 16.0  # exposures to find the response from, and how far from that of white
_LONGER, _STEP = 4, 2.0  # more of them at most, where a colour stays dark; times the one before
_DARKER = 0.99  # share of the pixels: the others must reach the last code in each colour
_RAMPS, _MANY = 4, 4096  # scenes of them where there are fewer pixels
_TOP = 0.995  # of the codes: the unit of a curve is what it reaches at the last one
_QUIETEST = 1e-6  # of full scale: the read noise of a camera without any, so that weights are finite
_BURST = 6  # photographs that tell the noise
_CODES = 17  # of the projector's response
_AGAIN = 16  # photographs of white
_OWN = 0.5  # of what white shows at a pixel, that its own light is at least, in most scenes


def measure(
    shots: Shots,
    *,
    geometry: str | Correspondence = "graycode",
    response: Response | None = None,
    exposures: Any = None,
    frames: int = 16,
    tell: Tell | None = None,
) -> Calibration:
    """Measure a set-up, with about 100 photographs, 200 in colour, beside those of the geometry.

    Parameters
    ----------
    shots : Shots
    geometry : "graycode", "aligned" (the camera is on the projector's grid) or Correspondence
    response : Response, optional
        Of the camera, where it is known; else it is found, which takes two exposures at least.
    exposures : sequence of float, optional
        Seconds of each photograph of the scan; left out, they are chosen.
    frames : int
        Photographs to average for black, at each of these.
    tell : function of a str, optional
        Told what is measured next.

    Raises
    ------
    InputError
        A geometry of other pixels; one exposure only and no response.
    AcquisitionError
        The rig fails; nothing can be decoded; the projector does not shine.

    Examples
    --------
    >>> from ltcl.acquisition import VirtualRig
    >>> rig = VirtualRig(np.eye(64) * 0.5, (8, 8), response="srgb", bits=12)
    >>> found = measure(Shots(rig), geometry="aligned")
    >>> bool(abs(found.white.value - 0.5).max() < 0.02), found.resampling.seen.all()
    (True, np.True_)
    """
    checks.count("frames", frames)
    run = _Run(shots, tell or (lambda _: None))
    run.tell("exposure")
    seconds = exposure(shots, shots.grid)
    _refuse_other(shots, geometry)
    _refuse_saturated(run, seconds)
    run.tell("response")
    response = response or _response(run, seconds)
    run.tell("geometry")
    R = _resampling(run, geometry, seconds, response)
    seconds, bad = _bright(run, response, seconds)
    deep = exposing.deepest(shots, seconds, response, bad)
    run.tell("noise")
    noise = _noise(run, response, seconds, deep, bad)
    run.tell("exposures")
    if exposures is None:
        chosen = exposing.for_scan(shots, seconds, deep, noise)
    else:
        chosen = tuple(exposing.offered(shots, [float(t)])[0] for t in sorted(exposures))
    run.tell("black")
    offset, ambient = _black(run, response, noise, chosen, frames)
    sensor = (response, noise, offset)
    run.tell("white")
    # The longest is for what is dim beside the brightest, and told by the scan at that exposure.
    times = exposing.offered(shots, [seconds / 2, seconds, chosen[-1]])
    white = run.merged(run.white, times, *sensor, _AGAIN) - ambient
    _refuse_long(chosen, white, noise)
    run.tell("projector")
    light, M = _projector(run, seconds, *sensor)
    return Calibration(chosen, response, noise, offset, ambient, white, light, M, R)


class _Run:
    """A rig, and photographs of it merged."""

    def __init__(self, shots: Shots, tell: Tell) -> None:
        self.shots, self.tell = shots, tell
        self.black = np.zeros(shots.grid, np.float32)
        self.white = np.ones(shots.grid, np.float32)

    def take(self, wanted: list[tuple[np.ndarray, float]]) -> list[np.ndarray]:
        """A photograph of each (codes, seconds), all of them told of before."""
        self.shots.prepare(wanted)
        return [self.shots.photograph(codes, t) for codes, t in wanted]

    def merged(
        self,
        codes: np.ndarray,
        seconds: tuple[float, ...],
        response: Response,
        noise: NoiseModel,
        offset: np.ndarray,
        again: int = 1,
    ) -> Radiance:
        """What the camera sees under `codes`, the ambient light still in it."""
        times = [t for t in seconds for _ in range(again)]
        images, last = self.take([(codes, t) for t in times]), self.shots.count
        with exposing.telling(f"photographs {last + 1 - len(images)} to {last}"):
            return merge(images, times, response, noise, levels=self.shots.levels, black=offset)


def _refuse_saturated(run: _Run, seconds: float) -> None:
    """Refuse a scene that is white throughout where no shorter exposure is left."""
    if exposing.offered(run.shots, [seconds / 2])[0] < seconds:
        return
    (image,) = run.take([(run.white, seconds)])
    if image.min() >= _TOP:
        raise AcquisitionError(
            f"every pixel is saturated under white at the shortest exposure, {seconds:g} s; there must be "
            "less light on the camera: a smaller aperture, a darker projector or room"
        )


def _refuse_long(exposures: tuple[float, ...], white: Radiance, noise: NoiseModel) -> None:
    """Refuse exposures of which the shortest saturates where a pixel is lit."""
    lit = white.value[white.valid & (white.value > 0)]
    most = noise.saturation / (_OWN * float(np.median(lit))) if lit.size else np.inf
    if exposures[0] > most:
        raise InputError(
            f"exposures is {exposures}, but half of what white shows saturates at {exposures[0]:g} s; the "
            f"shortest must be at most {0.7 * most:.2g} s"
        )


class _Linear:
    """A rig whose photographs are linear in light: a pixel that is half lit shows half of it."""

    def __init__(self, shots: Shots, response: Response) -> None:
        self._shots, self._response = shots, response
        self.exposures, self.levels, self.prepare = shots.exposures, shots.levels, shots.prepare

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        return self._response.linear(self._shots.photograph(codes, seconds))


def _refuse_other(shots: Shots, geometry: str | Correspondence) -> None:
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


def _resampling(run: _Run, geometry: str | Correspondence, seconds: float, response: Response) -> Resampling:
    if not isinstance(geometry, str):
        return Resampling.of(geometry)
    if geometry == "aligned":
        return Resampling.aligned(run.shots.grid)
    with exposing.telling("the geometry"):
        return Resampling.of(measure_geometry(_Linear(run.shots, response), run.shots.grid, seconds=seconds))


def _ramp(grid: tuple[int, int], shift: int = 0) -> np.ndarray:
    """Codes from 0 to 1 along the longer side, some pixels further: all brightnesses in one picture."""
    h, w = grid
    long = np.roll(np.linspace(0.0, 1.0, max(h, w), dtype=np.float32), shift)
    return np.ascontiguousarray(np.broadcast_to(long if w >= h else long[:, None], grid))


def _response(run: _Run, seconds: float) -> Response:
    span = bracket(seconds / _SPAN, seconds * _SPAN, _BRACKET)
    times, grid = exposing.offered(run.shots, span), run.shots.grid
    if len(times) == 1:
        raise InputError("rig.exposures has one exposure, which tells no response; give response=")
    ramps = [_ramp(grid, k * max(grid) // _RAMPS) for k in range(_RAMPS)]
    lit = [*ramps[: 1 if grid[0] * grid[1] >= _MANY else _RAMPS], run.black]
    first, taken = run.shots.count + 1, run.take([(codes, t) for t in times for codes in lit])
    bad = stuck(taken[len(lit) - 1])  # under black, for the shortest time
    beside = _beside(taken, len(lit), bad)
    longest = exposing.offered(run.shots, [times[-1] * _STEP**k for k in range(1, _LONGER + 1)])
    for longer in (t for t in longest if t > times[-1]):
        if _reached(beside[-1]):
            break
        more = run.take([(codes, longer) for codes in lit])
        beside, times = [*beside, *_beside(more, len(lit), bad)], (*times, longer)
    with exposing.telling(f"the response of the camera, photographs {first} to {run.shots.count}"):
        return calibrate(beside, times, levels=run.shots.levels, saturation=_TOP)


def _beside(images: list[np.ndarray], count: int, bad: np.ndarray) -> list[np.ndarray]:
    """Every `count` of them side by side, without the pixels that are stuck."""
    whole = [healed(image, bad) for image in images]
    return [np.hstack(whole[k : k + count]) for k in range(0, len(whole), count)]


def _reached(image: np.ndarray) -> bool:
    """Whether each colour has light at its last code; of one channel, no other's unit must be the same."""
    return image.ndim == 2 or bool(np.quantile(image, _DARKER, axis=(0, 1)).min() >= _TOP)


def _bright(run: _Run, response: Response, seconds: float) -> tuple[float, np.ndarray]:
    """The exposure at which white fills most of the range, and the pixels that are stuck."""
    image, dark = run.take([(run.white, seconds), (run.black, seconds)])
    bad = stuck(dark)
    level = float(np.quantile(response.linear(healed(image, bad)), 0.999))
    return exposing.offered(run.shots, [seconds * exposing.WHITE / max(level, 0.01)])[-1], bad


def _noise(run: _Run, response: Response, seconds: float, deep: float, bad: np.ndarray) -> NoiseModel:
    ramp = _ramp(run.shots.grid)
    scenes = ((ramp, seconds), (run.black, seconds), (run.black, deep))
    run.shots.prepare([shot for shot in scenes for _ in range(_BURST)])
    bursts = [[healed(image, bad) for image in run.take([shot] * _BURST)] for shot in scenes]
    with exposing.telling("the noise of the camera"):
        found = estimate(bursts, response=response, levels=run.shots.levels)
    return replace(found, read=max(found.read, _QUIETEST))


def _black(
    run: _Run, response: Response, noise: NoiseModel, exposures: tuple[float, ...], frames: int
) -> tuple[np.ndarray, Radiance]:
    times = [t for t in sorted(set(exposures)) for _ in range(frames)]
    images = run.take([(run.black, t) for t in times])
    if times[0] < times[-1]:
        with exposing.telling("black"):
            found = black.measure(images, times, response, noise, levels=run.shots.levels)
        return found.offset, found.ambient
    offset = np.zeros(run.shots.channels)  # one exposure does not tell it from ambient light, nor need it
    return offset, merge(images, times, response, noise, levels=run.shots.levels, black=offset)


def _projector(
    run: _Run, seconds: float, response: Response, noise: NoiseModel, offset: np.ndarray
) -> tuple[ProjectorResponse, np.ndarray | None]:
    """Response of each channel of the projector, and the mixing of colours."""
    times = exposing.offered(run.shots, [seconds, 4.0 * seconds])
    codes, colours = np.linspace(0.0, 1.0, _CODES), run.shots.channels
    shown = []
    for d in range(colours):
        unit = np.ones(1, np.float32) if colours == 1 else np.eye(3, dtype=np.float32)[d]
        fed = [np.float32(c) * run.white[..., None] * unit for c in codes]
        shown.append([part[..., 0] if colours == 1 else part for part in fed])
    run.shots.prepare((part, t) for parts in shown for part in parts for t in times)
    pictures = [[run.merged(part, times, response, noise, offset) for part in parts] for parts in shown]
    with exposing.telling("the projector"):
        if colours == 1:
            return projector.measure(codes, pictures[0]), None
        return projector.measure(codes, pictures), mixing([part[-1] for part in pictures], pictures[0][0])
