# SPDX-License-Identifier: BSD-3-Clause
"""Photographs as a camera writes them: codes at several exposures, their noise, the level of black.

A code is what the camera wrote, over the largest it can write: in [0, 1], and not linear in light.

    variance = max(x, 0) / electrons + read^2 + (slope / (levels - 1))^2 / 12

is that of photons, reading and rounding; x is the linear sensor value above black, 1 at full scale;
`slope` is linear value per code. Photon transfer (`estimate`): the variance of a pixel among
repeated photographs against their mean is a straight line, fitted with weights 1 / variance^2 as
samples of a variance have them.

Known limit: noise below 0.4 codes is not seen in the variance of whole codes, so that `read` is
never below 0.2 codes, and in 8 bits electrons may come out 16 % too many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
from scipy.special import stdtrit

from ltcl import checks
from ltcl.errors import InputError

if TYPE_CHECKING:
    from ltcl.acquisition.radiometry.response import Response

BLACK = 0.05  # of full scale: photographs that reach no more at any exposure show no scene
NO_LIGHT = "is the lens cap on, the projector off or showing something else, or every exposure far too short?"
MOST = 1 << 20  # pixels of a photograph that determine a response or the level of black, at most
_COMPARED = 1 << 14  # pixels of two photographs whose order is checked
_CLIPPED = 0.98  # codes above, from 250 of 255 on, may be saturated: no order shows there
_OFFSET = (
    0.18  # codes that a camera may have without light: 0.125 of 14 bits raw, and a margin of noise
)
_LIT, _SHARE = (
    0.03,
    0.02,
)  # codes of light, 8 of 8 bits; least share of lit pixels: fewer may be hot ones
_CHANCE = 3e-5  # of refusing photographs in order: 4 standard deviations of a normal value
_BINS = (
    64  # of pixels of equal number: the noise of a variance among their mean is 8 times that of all
)
_ROUNDS = 5  # of reweighting: the line stands to 1e-5 after two (measured)
_MOST_CLIPPED = 0.002  # share of a bin's samples at either end: a variance is then low by 0.4 %
_MOST_ELECTRONS = 1e9  # more than any pixel holds, for codes without photon noise
_FAR = 5.0  # standard deviations of a bin's variance above the line
_HIDDEN = 0.2  # codes: noise that whole codes may hide


@dataclass(frozen=True)
class NoiseModel:
    """Noise of a linear sensor value in [0, 1].

    `electrons` at full scale; `read`: standard deviation without light; `black`: linear value
    without light; `saturation`: largest linear value that is valid; `levels`: codes of the camera,
    0 for no rounding.

    >>> round(float(NoiseModel(electrons=10000.0, read=0.003).variance(0.5)) ** 0.5, 5)
    0.00768
    """

    electrons: float = 10000.0
    read: float = 0.002
    black: float = 0.0
    saturation: float = 0.96
    levels: int = 0

    def __post_init__(self) -> None:
        checks.number("electrons", self.electrons, above=0.0)
        checks.number("read", self.read, least=0.0)
        checks.number("black", self.black)
        checks.number("saturation", self.saturation, above=self.black, most=1.0)
        checks.count("levels", self.levels, least=0)

    def variance(self, linear: Any, slope: Any = 1.0) -> np.ndarray:
        """Variance of linear values above black, where the response rises by `slope` a code."""
        rounding = np.square(slope) * (
            1.0 / (12.0 * (self.levels - 1) ** 2) if self.levels > 1 else 0.0
        )
        return np.maximum(linear, 0) * (1.0 / self.electrons) + self.read**2 + rounding


@dataclass(frozen=True, repr=False, eq=False)
class Stack:
    """Photographs (pixels, channels) of one `shape` and type, in ascending order of their seconds (K,).

    `levels`: codes that the camera can write, 256, 4096, ...; 0 of floats that were never rounded.
    """

    images: tuple[np.ndarray, ...]
    shape: tuple[int, ...]
    seconds: np.ndarray
    levels: int

    def codes(self, most: int) -> np.ndarray:
        """About `most` pixels, spread evenly, in [0, 1]: float32, (K, pixels, channels)."""
        step = max(1, len(self.images[0]) // most)
        return _normalised(np.stack([image[::step] for image in self.images]), self.levels)


def photographs(name: str, images: Any) -> tuple[np.ndarray, ...]:
    """A sequence of pictures of one shape and type, finite, not empty; others are refused by their number."""
    if len(images) == 0:
        raise InputError(f"{name} holds no photograph; there must be at least one")
    arrays = tuple(checks.real(f"{name}[{k}]", image) for k, image in enumerate(images))
    first = arrays[0]
    if first.ndim not in (2, 3) or first.shape[2:] not in ((), (3,)) or first.size == 0:
        raise InputError(
            f"{name}[0] has shape {first.shape}; it must be (H, W) or (H, W, 3), not empty"
        )
    if first.dtype.kind != "f" and first.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"{name}[0] holds {first.dtype}; photographs must be uint8, uint16 or float"
        )
    for k, image in enumerate(arrays):
        checks.shape(f"{name}[{k}]", image, first.shape)
        if image.dtype != first.dtype:
            raise InputError(
                f"{name}[{k}] holds {image.dtype}; it must be {first.dtype}, as {name}[0]"
            )
        if image.dtype.kind == "f":
            checks.finite(f"{name}[{k}]", image)
    return arrays


def stack(images: Sequence[Any], seconds: Any, levels: int | None = None) -> Stack:
    """Photographs and their seconds, checked; refused where one is not brighter than one of fewer seconds.

    The mean code must not fall, and that of lit pixels must rise at least as the fourth root of the
    seconds (codes of any camera rise more), by Student's t of the pixels' differences.
    """
    arrays = photographs("images", images)
    times = checks.finite("seconds", checks.real("seconds", seconds).astype(np.float64))
    if times.shape != (len(arrays),) or times.min() <= 0:
        raise InputError(
            f"seconds is {seconds!r}; it must be {len(arrays)} positive number(s), one an image"
        )
    order = np.argsort(times, kind="stable")
    shape = arrays[0].shape
    images = tuple(arrays[k].reshape(shape[0] * shape[1], -1) for k in order)
    bracket = Stack(images, shape, times[order], _levels(arrays, levels))
    rounding = 1.0 / max(bracket.levels, 1 << 12)  # an allowance of one code
    for k, (short, long) in enumerate(pairwise(bracket.codes(_COMPARED).astype(np.float64))):
        seen, ratio = (
            np.maximum(short, long) < _CLIPPED,
            bracket.seconds[k + 1] / bracket.seconds[k],
        )
        rise, light = (long - short)[seen], np.minimum(short, long)
        if ratio == 1.0 or rise.size < 2:
            continue
        # The darkest pixels of a channel may show its offset.
        darkest = np.quantile(np.where(seen, light, 1.0), 0.01, axis=0)
        light = (light - np.where(darkest < _OFFSET, darkest, 0.0))[seen]
        # About 4 standard deviations of the noise of one photograph: the median of |a - b| is 0.95
        # of one.
        lit = light > max(_LIT, 4.0 * float(np.median(np.abs(rise))))
        if lit.sum() >= max(2, _SHARE * lit.size):
            rise -= lit * light * (ratio**0.25 - 1.0)
        error = np.sqrt((rise.var(ddof=1) + rounding**2) / rise.size)
        if rise.mean() < stdtrit(rise.size - 1, _CHANCE) * error - rounding:
            short, long = (f"images[{order[j]}] of {bracket.seconds[j]:g} s" for j in (k, k + 1))
            raise InputError(
                f"{long} is not brighter than {short}; brightness must rise with the seconds"
            )
    return bracket


def _normalised(codes: np.ndarray, levels: int) -> np.ndarray:
    """Integer codes over the largest, `levels` - 1; floats as they are. float32."""
    scale = 1.0 if codes.dtype.kind == "f" else 1.0 / (levels - 1)
    return codes.astype(np.float32) * np.float32(scale)


def _levels(images: tuple[np.ndarray, ...], levels: int | None) -> int:
    """Codes of the camera: `levels`, where photographs allow it, or by their type; 0 of floats."""
    dtype = images[0].dtype
    natural = 0 if dtype.kind == "f" else np.iinfo(dtype).max + 1
    if levels is None or (levels == 0 and natural == 0):
        return natural
    checks.count("levels", levels, least=2, most=natural or 1 << 16)
    if (
        natural
        and levels < natural
        and (most := max(int(image.max()) for image in images)) >= levels
    ):
        raise InputError(f"levels is {levels}, but images hold {most}; levels must be above")
    return levels


def estimate(
    bursts: Sequence[Sequence[Any]], *, response: Response | None = None, levels: int | None = None
) -> NoiseModel:
    """The noise model of a camera from photographs that were repeated without any change.

    Each of the `bursts` holds 2 or more photographs, as `merge` takes them, of one scene and
    exposure; all together reach from dark to bright. `response` is 0 without light; None: linear
    codes. InputError for no bursts, a burst of one photograph, mixed shapes, and no pixel between
    black and saturation.

    >>> rng = np.random.default_rng(0)
    >>> light = np.linspace(0, 0.9, 10000).reshape(100, 100)
    >>> burst = [
    ...     rng.poisson(light * 5000) / 5000 + rng.normal(0, 0.004, light.shape) for _ in range(8)
    ... ]
    >>> round(estimate([burst]).electrons, -2), round(estimate([burst]).read, 3)
    (5000.0, 0.004)
    """
    pixels, brightest = [], 0.0
    checks.count("len(bursts)", len(bursts), least=1)
    for number, burst in enumerate(bursts):
        shots = photographs(f"bursts[{number}]", burst)
        if len(shots) < 2:
            raise InputError(f"bursts[{number}] holds one photograph; noise needs at least two")
        levels = _levels(shots, levels)
        codes = _normalised(np.stack(shots), levels)
        linear = (codes if response is None else response.linear(codes)).astype(np.float64)
        code = codes.mean(axis=0)
        brightest = max(brightest, float(code.max()))
        slope = np.ones_like(code) if response is None else response.derivative(code)
        clipped = (codes == 0).mean(axis=0), (linear > NoiseModel.saturation).mean(axis=0)
        freedom = np.full(code.shape, len(codes) - 1.0)
        moments = linear.mean(axis=0), linear.var(axis=0, ddof=1)
        pixels.append(
            np.stack([a.ravel() for a in (*moments, np.square(slope), *clipped, freedom)])
        )
    values = np.concatenate(pixels, axis=1)
    values = values[:, np.argsort(values[0], kind="stable")]
    starts = np.unique(np.linspace(0, values.shape[1], _BINS + 1).astype(int)[:-1])
    freedom = np.add.reduceat(values[-1], starts)
    light, variance, slopes, dark, full = (
        np.add.reduceat(values[:-1] * values[-1], starts, axis=1) / freedom
    )
    # Whole bins go, and all beyond: a pixel selected by its own noise would bias the variance.
    keep = (np.cumsum((dark > _MOST_CLIPPED)[::-1])[::-1] == 0) & (
        np.cumsum(full > _MOST_CLIPPED) == 0
    )
    if not keep.any():
        why = NO_LIGHT if brightest < BLACK else "other exposures are needed"
        raise InputError(f"bursts have no pixels between black and saturation; {why}")
    light, variance, freedom = light[keep], variance[keep], freedom[keep]
    rounding = (np.maximum(slopes, 1e-30) / (12.0 * (levels - 1) ** 2) if levels else 0.0 * slopes)[
        keep
    ]
    columns = np.stack([np.maximum(light, 0.0), np.ones_like(light)], axis=1)
    least = 1e-3 * variance.mean() + 1e-30
    expected, gain, floor = np.maximum(variance, least), 0.0, 0.0
    for _ in range(_ROUNDS):
        # Bins far above the line have edges of a scene that moved: by their own variance they
        # hardly count.
        far = variance > (1.0 + _FAR * np.sqrt(2.0 / freedom)) * expected
        scale = np.sqrt(freedom) / np.where(far, variance, expected)
        unrounded = np.maximum(variance - rounding, 0.0)
        (gain, floor), _ = scipy.optimize.nnls(columns * scale[:, None], unrounded * scale)
        expected = np.maximum(columns @ (gain, floor) + rounding, least)
    read = np.sqrt(max(floor, 12.0 * _HIDDEN**2 * float(rounding.min())))
    return NoiseModel(
        float(1.0 / max(gain, 1.0 / _MOST_ELECTRONS)), float(read), levels=levels or 0
    )


def black_level(
    images: Sequence[Any],
    seconds: Any,
    response: Response,
    noise: NoiseModel,
    *,
    levels: int | None = None,
) -> np.ndarray:
    """Linear value of a camera without light, (channels,) float64: the `black` of `merge`.

    Under a black projector pixel p has the linear value b + a_p t_k after t_k seconds: a level b of
    its channel and ambient light a_p. By least squares with weights w_k of the mean of each
    photograph

        b = sum_p (Y0 - Y1 S1 / S2) / sum_p (S0 - S1^2 / S2),  Sn = sum_k w_k t_k^n, Yn = sum_k w_k
        t_k^n y_pk

    `images` need two different exposures at least; `noise.black` is not used. InputError for what
    `merge` refuses, for one exposure only, and where every pixel is saturated in some photograph.

    >>> from ltcl.acquisition.radiometry import Response
    >>> shots = [0.01 + t * np.array([[0.0, 0.1, 0.2]]) for t in (0.5, 1.0, 2.0)]
    >>> black_level(shots, [0.5, 1.0, 2.0], Response.identity(), NoiseModel()).round(4)
    array([0.01])
    """
    bracket = stack(images, seconds, levels or noise.levels or None)
    t = bracket.seconds
    if t[0] == t[-1]:
        raise InputError(f"seconds is {seconds!r}; it must hold at least two different exposures")
    light = response.linear(bracket.codes(MOST))
    level = np.empty(light.shape[2])
    for c in range(len(level)):
        y = light[:, light[..., c].max(axis=0) <= noise.saturation, c].astype(np.float64)
        if y.shape[1] == 0:
            raise InputError(
                "images are saturated at every pixel; they need shorter exposures or less light"
            )
        w = 1.0 / noise.variance(y.mean(axis=1))
        S0, S1, S2 = (float(np.sum(w * t**n)) for n in range(3))
        level[c] = np.sum((w - w * t * (S1 / S2)) @ y) / (y.shape[1] * (S0 - S1**2 / S2))
    return level
