# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of one scene at several exposures, checked, with the shortest first.

A code is what the camera wrote, over the largest it can write: in [0, 1], and not linear in light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

from ltcl import checks
from ltcl.errors import InputError

BLACK = 0.05  # of full scale: photographs that reach no more at any exposure show no scene
NO_LIGHT = "is the lens cap on, the projector off or showing something else, or every exposure far too short?"
_COMPARED = (
    1 << 14
)  # pixels that decide the order of two photographs: 4 standard errors are 3 % of a deviation
_CLIPPED = 0.98  # codes above, from 250 of 255 on, may be saturated: no order shows there
_OFFSET = 0.18  # codes that a camera may have without light: 0.125 of 14 bits raw, and a margin of noise
_LIT, _SHARE = (
    0.03,
    0.02,
)  # codes above the darkest that are light, 8 of 8 bits; share of the pixels: hot ones
_CHANCE = 3e-5  # of refusing photographs in order: 4 standard deviations of a normal value


@dataclass(frozen=True, repr=False, eq=False)
class Stack:
    """Photographs, (K) of (H, W) or (H, W, 3), in ascending order of their seconds.

    Attributes
    ----------
    images : tuple of arrays
        All of one shape and type: uint8, uint16 or float.
    seconds : (K,)
        float64.
    levels : int
        Codes that the camera can write: 256, 4096, ...; 0 of floats that were never rounded.
    """

    images: tuple[np.ndarray, ...]
    seconds: np.ndarray
    levels: int

    @property
    def channels(self) -> int:
        """1 or 3."""
        return self.images[0].shape[2] if self.images[0].ndim == 3 else 1

    @property
    def pixels(self) -> int:
        """Height times width."""
        return self.images[0].shape[0] * self.images[0].shape[1]

    def codes(self, k: int, pixels: Any = slice(None)) -> np.ndarray:
        """Photograph k, or some of its pixels, in [0, 1]: float32, (pixels, channels)."""
        return normalised(self.images[k].reshape(self.pixels, self.channels)[pixels], self.levels)


def normalised(codes: np.ndarray, levels: int) -> np.ndarray:
    """Integer codes over the largest, `levels` - 1; floats as they are. float32."""
    if codes.dtype.kind == "f":
        return codes.astype(np.float32, copy=False)
    return codes.astype(np.float32) * np.float32(1.0 / (levels - 1))


def photographs(name: str, images: Any) -> tuple[np.ndarray, ...]:
    """A sequence of pictures of one shape and type, finite, not empty; others are refused by their number."""
    if len(images) == 0:
        raise InputError(f"{name} holds no photograph; there must be one at least")
    arrays = tuple(checks.real(f"{name}[{k}]", image) for k, image in enumerate(images))
    first = arrays[0]
    if first.ndim not in (2, 3) or first.shape[2:] not in ((), (3,)) or first.size == 0:
        raise InputError(f"{name}[0] has shape {first.shape}; it must be (H, W) or (H, W, 3), not empty")
    if first.dtype.kind != "f" and first.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{name}[0] holds {first.dtype}; photographs are uint8, uint16 or float")
    for k, image in enumerate(arrays):
        checks.shape(f"{name}[{k}]", image, first.shape)
        if image.dtype != first.dtype:
            raise InputError(f"{name}[{k}] holds {image.dtype}; it must be {first.dtype}, as {name}[0]")
        if image.dtype.kind == "f":
            checks.finite(f"{name}[{k}]", image)
    return arrays


def stack(images: Sequence[Any], seconds: Any, levels: int | None = None) -> Stack:
    """Photographs (uint8, uint16, or floats with 1 for the largest code) and their seconds, checked.

    >>> dim, bright = np.full((2, 3), 40, np.uint8), np.full((2, 3), 80, np.uint8)
    >>> stack([bright, dim], [0.2, 0.1]).seconds
    array([0.1, 0.2])
    """
    arrays = photographs("images", images)
    times = checks.finite("seconds", checks.real("seconds", seconds).astype(np.float64))
    if times.shape != (len(arrays),) or times.min() <= 0:
        raise InputError(
            f"seconds is {seconds!r}; it must be {len(arrays)} positive number(s), one for each photograph"
        )
    order = np.argsort(times, kind="stable")
    bracket = Stack(tuple(arrays[k] for k in order), times[order], levels_of(arrays, levels))
    _check_order(bracket, order)
    return bracket


def levels_of(images: tuple[np.ndarray, ...], levels: int | None) -> int:
    """Codes of the camera: `levels`, where photographs allow it, or by their type; 0 of floats."""
    dtype = images[0].dtype
    natural = 0 if dtype.kind == "f" else np.iinfo(dtype).max + 1
    if levels is None:
        return natural
    if levels == 0 and natural == 0:
        return 0
    checks.count("levels", levels, least=2, most=natural or 1 << 16)
    if natural:
        most = max(int(image.max()) for image in images)
        if most >= levels:
            raise InputError(f"levels is {levels}, but images hold {most}; levels must be above")
    return levels


def _check_order(bracket: Stack, order: np.ndarray) -> None:
    """Refuse a photograph that is not brighter than one of fewer seconds.

    The mean over all pixels must not fall, and that over lit ones must rise by as much as the fourth root of
    the seconds, at least: codes of any camera rise more. A dark picture may be as dark at any exposure.
    """
    compared = slice(None, None, max(1, bracket.pixels // _COMPARED))
    for k in range(len(bracket.images) - 1):
        ratio = bracket.seconds[k + 1] / bracket.seconds[k]
        if ratio == 1.0:
            continue
        short, long = (bracket.codes(j, compared).astype(np.float64) for j in (k, k + 1))
        seen = np.maximum(short, long) < _CLIPPED
        # What is darkest of a channel may be its offset.
        channels = [channel[some] for channel, some in zip(short.T, seen.T, strict=True)]
        darkest = np.array([np.quantile(codes, 0.01) if codes.size else 0.0 for codes in channels])
        light = (np.minimum(short, long) - np.where(darkest < _OFFSET, darkest, 0.0))[seen]
        rise = (long - short)[seen]
        # About 4 standard deviations of the noise of one photograph: the median of |a - b| is 0.95 of one.
        lit = light > max(_LIT, 4.0 * float(np.median(np.abs(rise)))) if rise.size else rise > 0
        due = light[lit].mean() * (ratio**0.25 - 1.0) if lit.sum() >= max(2, _SHARE * lit.size) else 0.0
        if _below(rise, 0.0, bracket.levels) or (due > 0 and _below(rise[lit], due, bracket.levels)):
            raise InputError(
                f"images[{order[k + 1]}] has {bracket.seconds[k + 1]:g} s and is not brighter than "
                f"images[{order[k]}] of {bracket.seconds[k]:g} s; brightness must rise with the seconds"
            )


def _below(rise: np.ndarray, due: float, levels: int) -> bool:
    """Whether the mean of some pixels is below `due` by more than rounding and its error (Student's t)."""
    if rise.size < 2:
        return False
    rounding = 1.0 / (6.0 * levels**2) if levels else 0.0
    error = math.sqrt((rise.var(ddof=1) + rounding) / rise.size) + 1.0 / max(levels, 1 << 12)
    return bool(rise.mean() - stdtrit(rise.size - 1, _CHANCE) * error < due)
