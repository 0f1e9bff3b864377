# SPDX-License-Identifier: BSD-3-Clause
"""All that is measured once of a set-up, before its transport is scanned.

    exposure        white is bright at; then `exposing`
    response        of the camera (`ramps`)
    geometry        which projector pixel a camera pixel sees, by patterns, unless it is given
    noise           of the camera, from the same photograph taken again and again
    black           offset of the camera, and light without the projector, at the exposures of the scan
    white           all that the projector can light, of which row sums of T are known
    projector       codes to light of each channel, and from these pictures how its colours mix

Photographs of one pattern that contradict each other are refused (`agreeing`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import agreeing, exposing
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.acquisition.geometry import measure as measure_geometry
from ltcl.acquisition.geometry.measure import exposure
from ltcl.acquisition.geometry.sharpness import Sharpness
from ltcl.acquisition.radiometry import (
    NoiseModel,
    ProjectorResponse,
    Radiance,
    Response,
    black,
    estimate,
    merge,
    mixing,
    projector,
)
from ltcl.acquisition.ramps import TOP, ramp, response_of
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.stuck import healed, stuck
from ltcl.acquisition.taking import Taking
from ltcl.errors import AcquisitionError, InputError

Tell = Callable[[str], None]
_QUIETEST = 1e-6  # of full scale: the read noise of a camera without any, so that weights are finite
_BURST = 6  # photographs that tell the noise
_CODES = 17  # of the projector's response
_AGAIN = 16  # photographs of white
_FEWER = tuple(1 << k for k in range(9, 15))  # codes of cameras whose files have 16 bits
_ENDING = 0.01  # of the pixels
_CLEAR = 3.0  # standard deviations without light that white must be
_OWN = 0.5  # of what white shows at a pixel, that its own light is at least, in most scenes


def measure(
    shots: Shots,
    *,
    geometry: str | Correspondence = "graycode",
    response: Response | None = None,
    exposures: Any = None,
    frames: int = 16,
    side: int = 1,
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
    side : int
        Of the blocks of the scan: the camera must tell these apart.
    tell : function of a str, optional
        Told what is measured next.

    Raises
    ------
    InputError
        A geometry of other pixels; one exposure only and no response.
    AcquisitionError
        The rig fails; nothing can be decoded; the projector does not shine; the camera is too coarse.

    Examples
    --------
    >>> from ltcl.acquisition import VirtualRig
    >>> rig = VirtualRig(np.eye(64) * 0.5, (8, 8), response="srgb", bits=12)
    >>> found = measure(Shots(rig), geometry="aligned")
    >>> bool(abs(found.white.value - 0.5).max() < 0.02), found.resampling.seen.all()
    (True, np.True_)
    """
    checks.count("frames", frames)
    run, tell = Taking(shots), tell or (lambda _: None)
    tell("exposure")
    seconds = exposure(_Whole(shots), shots.grid)
    _refuse_other(shots, geometry)
    _refuse_saturated(run, seconds)
    tell("response")
    response = response or response_of(run, seconds)
    tell("geometry")
    R, sharpness = _resampling(run, geometry, seconds, response)
    if sharpness is not None:
        sharpness.check(side)
    seconds, bad = _bright(run, response, seconds)
    deep = exposing.deepest(shots, seconds, response, bad)
    tell("noise")
    noise = _noise(run, response, seconds, deep, bad)
    tell("exposures")
    if exposures is None:
        chosen = exposing.for_scan(shots, seconds, deep, noise)
    else:
        chosen = tuple(exposing.offered(shots, [float(t)])[0] for t in sorted(exposures))
    tell("black")
    offset, ambient = _black(run, response, noise, chosen, frames)
    sensor = (response, noise, offset)
    tell("white")
    # The longest is for what is dim beside the brightest, and told by the scan at that exposure.
    times = exposing.offered(shots, [seconds / 2, seconds, chosen[-1]])
    white = run.merged(run.white, times, *sensor, _AGAIN) - ambient
    _refuse_long(chosen, _lit(white, R), noise)
    R = R.ascertained(white.value, white.valid)
    tell("projector")
    light, M = _projector(run, seconds, *sensor)
    _refuse_short(chosen, _lit(white, R), noise)
    return Calibration(chosen, response, noise, offset, ambient, white, light, M, R, sharpness)


def _refuse_saturated(run: Taking, seconds: float) -> None:
    """Refuse a scene that is white throughout where no shorter exposure is left."""
    if exposing.offered(run.shots, [seconds / 2])[0] < seconds:
        return
    (image,) = run.take([(run.white, seconds)])
    if image.min() >= TOP:
        raise AcquisitionError(
            f"every pixel is saturated under white at the shortest exposure, {seconds:g} s; there must be "
            "less light on the camera: a smaller aperture, a darker projector or room"
        )


def _lit(white: Radiance, R: Resampling) -> float:
    """What half of the camera's pixels that see the projector's show under white; 0 where none is lit."""
    seen = np.unique(R.weights.indices)
    pixels = white.value.shape[0] * white.value.shape[1]
    value, valid = (part.reshape(pixels, -1)[seen] for part in (white.value, white.valid))
    lit = value[valid & (value > 0)]
    return float(np.median(lit)) if lit.size else 0.0


def _refuse_long(exposures: tuple[float, ...], level: float, noise: NoiseModel) -> None:
    """Refuse exposures of which the shortest saturates where a pixel is lit."""
    if exposures[0] * _OWN * level > noise.saturation:
        raise InputError(
            f"exposures is {exposures}, but half of what white shows saturates at {exposures[0]:g} s; the "
            f"shortest must be at most {0.7 * noise.saturation / (_OWN * level):.2g} s"
        )


def _refuse_short(exposures: tuple[float, ...], level: float, noise: NoiseModel) -> None:
    """Refuse exposures of which the longest tells nothing."""
    least = _CLEAR * float(np.sqrt(noise.variance(0.0)))
    if 0 < exposures[-1] * level < least:
        raise InputError(
            f"exposures is {exposures}, but half of what white shows is lost in noise at {exposures[-1]:g} "
            f"s; the longest must be some {4 * least / level:.2g} s"
        )


class _Whole:
    """A rig whose photographs of white may not end at fewer bits than they have, at two exposures."""

    def __init__(self, shots: Shots) -> None:
        self._shots, self.exposures = shots, shots.exposures
        self._ends: dict[int, float] = {}

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        image, levels = self._shots.photograph(codes, seconds), self._shots.levels or 0
        last = round(float(image.max()) * (levels - 1))
        ends = last + 1 < levels and last + 1 in _FEWER and np.mean(image == image.max()) > _ENDING
        if ends and self._ends.setdefault(last, seconds) < seconds:
            bits = last.bit_length()
            raise AcquisitionError(
                f"photograph {self._shots.number}, of white, ends at code {last} of {levels - 1}, as one of "
                f"a shorter exposure does: the camera has {bits} bits; bits of the rig, or camera_bits of a "
                f"folder, must be {bits}"
            )
        return image


class _Linear:
    """A rig whose photographs are linear in light: a pixel that is half lit shows half of it."""

    def __init__(self, shots: Shots, response: Response) -> None:
        self._shots, self._response = shots, response
        self.exposures, self.levels, self.prepare = shots.exposures, shots.levels, shots.prepare
        self.sums = agreeing.Complements()
        self.taken: list[tuple[np.ndarray, np.ndarray]] = []

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        light = self._response.linear(self._shots.photograph(codes, seconds))
        self.sums.add(codes, light, self._shots.number)
        self.taken.append((codes, light))
        return light


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


def _resampling(
    run: Taking, geometry: str | Correspondence, seconds: float, response: Response
) -> tuple[Resampling, Sharpness | None]:
    if not isinstance(geometry, str):
        R = Resampling.of(geometry)
        return R, Sharpness.of(geometry, R)
    if geometry == "aligned":
        return Resampling.aligned(run.shots.grid), None
    linear = _Linear(run.shots, response)
    with exposing.telling("the geometry"):
        found = measure_geometry(linear, run.shots.grid, seconds=seconds)
    linear.sums.refuse()
    R = Resampling.of(found)
    return R, Sharpness.of(found, R, linear.taken)


def _bright(run: Taking, response: Response, seconds: float) -> tuple[float, np.ndarray]:
    """The exposure at which white fills most of the range, and the pixels that are stuck."""
    image, dark = run.take([(run.white, seconds), (run.black, seconds)])
    bad = stuck(dark)
    level = float(np.quantile(response.linear(healed(image, bad)), 0.999))
    return exposing.offered(run.shots, [seconds * exposing.WHITE / max(level, 0.01)])[-1], bad


def _noise(run: Taking, response: Response, seconds: float, deep: float, bad: np.ndarray) -> NoiseModel:
    scenes = ((ramp(run.shots.grid), seconds), (run.black, seconds), (run.black, deep))
    run.shots.prepare([shot for shot in scenes for _ in range(_BURST)])
    taken = [run.agreeing([shot] * _BURST, response) for shot in scenes]
    bursts = [[healed(image, bad) for image in images] for images in taken]
    with exposing.telling("the noise of the camera"):
        found = estimate(bursts, response=response, levels=run.shots.levels)
    return replace(found, read=max(found.read, _QUIETEST))


def _black(
    run: Taking, response: Response, noise: NoiseModel, exposures: tuple[float, ...], frames: int
) -> tuple[np.ndarray, Radiance]:
    times = [t for t in sorted(set(exposures)) for _ in range(frames)]
    images = run.take([(run.black, t) for t in times])
    if times[0] < times[-1]:
        with exposing.telling("black"):
            found = black.measure(images, times, response, noise, levels=run.shots.levels)
        run.refuse_unlike(images, times, response, noise, found.offset)
        return found.offset, found.ambient
    run.refuse_unlike(images, times, response, noise)
    offset = np.zeros(run.shots.channels)  # one exposure does not tell it from ambient light, nor need it
    return offset, merge(images, times, response, noise, levels=run.shots.levels, black=offset)


def _projector(
    run: Taking, seconds: float, response: Response, noise: NoiseModel, offset: np.ndarray
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
