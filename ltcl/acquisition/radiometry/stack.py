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
_SEEN = 1 << 14  # pixels that the order of two photographs is told by
_OFFSET = 0.18  # codes without light that a camera may have: what is darkest may be without light
_LIT, _PART = 0.03, 0.02  # codes above those, that are light; part of the pixels, for fewer may be stuck
_CLIPPED = 0.98  # codes above tell nothing of an order
_RATIO = 1.2  # of seconds, below which two photographs may look alike
_CHANCE = 3e-5  # of refusing photographs in order: 4 standard deviations where pixels are many


@dataclass(frozen=True, repr=False, eq=False)
class Stack:
    """Photographs as given, (K) of (H, W) or (H, W, 3), in ascending order of their seconds.

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

    def codes(self, k: int, part: Any = slice(None)) -> np.ndarray:
        """Photograph k, or some of its pixels, in [0, 1]: float32, (pixels, channels)."""
        return normalised(self.images[k].reshape(self.pixels, self.channels)[part], self.levels)


def normalised(codes: np.ndarray, levels: int) -> np.ndarray:
    """Integer codes over the largest, `levels` - 1; floats as they are. float32."""
    if codes.dtype.kind == "f":
        return codes.astype(np.float32, copy=False)
    return codes.astype(np.float32) * np.float32(1.0 / (levels - 1))


def photographs(name: str, images: Any) -> tuple[np.ndarray, ...]:
    """A sequence of pictures of one shape and type, finite, not empty; others are refused by their number."""
    if len(images) == 0:
        raise InputError(f"{name} holds no photograph; there must be one at least")
    found = tuple(checks.real(f"{name}[{k}]", image) for k, image in enumerate(images))
    first = found[0]
    if first.ndim not in (2, 3) or first.shape[2:] not in ((), (3,)) or first.size == 0:
        raise InputError(f"{name}[0] has shape {first.shape}; it must be (H, W) or (H, W, 3), not empty")
    if first.dtype.kind != "f" and first.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{name}[0] holds {first.dtype}; photographs are uint8, uint16 or float")
    for k, image in enumerate(found):
        checks.shape(f"{name}[{k}]", image, first.shape)
        if image.dtype != first.dtype:
            raise InputError(f"{name}[{k}] holds {image.dtype}; it must be {first.dtype}, as {name}[0]")
        if image.dtype.kind == "f":
            checks.finite(f"{name}[{k}]", image)
    return found


def stack(images: Sequence[Any], seconds: Any, levels: int | None = None) -> Stack:
    """Photographs and their seconds as a checked `Stack`.

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3)
        uint8, uint16, or floats with 1 for the largest code.
    seconds : (K,)
        Exposure of each, in any order.
    levels : int, optional
        Codes the camera can write, 4096 of 12 bits; None takes 256 or 65536 by the type, and 0 (no rounding)
        of floats.

    Raises
    ------
    InputError
        No photographs; another shape or type than the first; NaN; seconds that are not as many positive
        numbers; levels that a photograph exceeds; a longer exposure that is not brighter.

    Examples
    --------
    >>> dim, bright = np.full((2, 3), 40, np.uint8), np.full((2, 3), 80, np.uint8)
    >>> stack([bright, dim], [0.2, 0.1]).seconds
    array([0.1, 0.2])
    """
    found = photographs("images", images)
    times = checks.finite("seconds", checks.real("seconds", seconds).astype(np.float64))
    if times.shape != (len(found),) or times.min() <= 0:
        raise InputError(
            f"seconds is {seconds!r}; it must be {len(found)} positive number(s), one for each photograph"
        )
    levels = levels_of(found, levels)
    order = np.argsort(times, kind="stable")
    made = Stack(tuple(found[k] for k in order), times[order], levels)
    _check_order(made, order)
    return made


def levels_of(images: tuple[np.ndarray, ...], levels: int | None) -> int:
    """Codes of the camera: as given, where photographs allow it, or by their type; 0 of floats."""
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


def _check_order(made: Stack, order: np.ndarray) -> None:
    """Refuse a photograph that is not brighter than one of fewer seconds."""
    part = slice(None, None, max(1, made.pixels // _SEEN))
    for k in range(len(made.images) - 1):
        ratio = made.seconds[k + 1] / made.seconds[k]
        if ratio == 1.0:
            continue
        short, long = (made.codes(j, part).astype(np.float64) for j in (k, k + 1))
        seen = np.maximum(short, long) < _CLIPPED
        rise = (long - short)[seen]
        above = (np.minimum(short, long) - _dark(short, seen))[seen]
        if _falls(rise, made.levels) or (ratio > _RATIO and _stays(rise, above, ratio, made.levels)):
            raise InputError(
                f"images[{order[k + 1]}] has {made.seconds[k + 1]:g} s and is not brighter than "
                f"images[{order[k]}] of {made.seconds[k]:g} s; brightness must rise with the seconds"
            )


def _falls(rise: np.ndarray, levels: int) -> bool:
    return len(rise) > 1 and rise.mean() < -_error(rise, levels)


def _dark(short: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Codes (channels,) that may be without light, where other channels have offsets of their own."""
    parts = [part[here] for part, here in zip(short.T, seen.T, strict=True)]
    darkest = np.array([np.quantile(part, 0.01) if part.size else 0.0 for part in parts])
    return np.where(darkest < _OFFSET, darkest, 0.0)


def _stays(rise: np.ndarray, above: np.ndarray, ratio: float, levels: int) -> bool:
    """Whether what is lit does not rise; beside it a picture may be as dark at any exposure."""
    if len(rise) < 2:
        return False
    noise = 4.0 * float(np.median(np.abs(rise)))  # about 4 standard deviations of one of them
    lit = above > max(_LIT, noise)
    if lit.sum() < max(2, _PART * len(lit)):
        return False
    rise, above = rise[lit], above[lit]
    # Codes rise more than the fourth root of light, or the noise may be all that hides it.
    least = above.mean() * (ratio**0.25 - 1.0)
    return bool(np.median(rise) < 0.1 * least and rise.mean() + _error(rise, levels) < least)


def _error(rise: np.ndarray, levels: int) -> float:
    """How far the mean of two pixels or more may be off; a few tell their own noise badly (Student's t)."""
    rounding = 1.0 / (6.0 * levels**2) if levels else 0.0
    scatter = math.sqrt((rise.var(ddof=1) + rounding) / len(rise))
    return -float(stdtrit(len(rise) - 1, _CHANCE)) * (scatter + 1.0 / max(levels, 1 << 12))
