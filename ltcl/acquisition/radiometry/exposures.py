# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of one scene at several exposures, checked.

A code is what the camera wrote, over the largest it can write: in [0, 1], and not linear in light.
Photographs are refused if one is not brighter than one of fewer seconds: the list of exposures is
then probably in another order than the files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import stdtrit

from ltcl import checks
from ltcl.errors import InputError

# Photographs that reach no more of full scale at any exposure show no scene.
MIN_BRIGHTNESS = 0.05

NO_LIGHT = (
    "is the lens cap on, the projector off or showing something else, "
    "or every exposure far too short?"
)

# Pixels of a photograph that determine a response or the level of black.
MAX_PIXELS = 1 << 20


@dataclass(frozen=True)
class OrderTest:
    """Limits of the test that brightness rises with the seconds; codes are in [0, 1].

    Attributes
    ----------
    max_pixels : int
        Pixels of two photographs that are compared.
    clipped_code : float
        Codes above, from 250 of 255 on, may be saturated and show no order.
    max_offset : float
        Codes that a camera may have without light: 0.125 of 14 bits raw, and a margin of noise.
    darkest_share : float
        Quantile of the codes of a channel that may be its offset.
    lit_code : float
        Code of a lit pixel, 8 of 8 bits.
    min_lit_share : float
        Share of lit pixels that counts: fewer may be hot pixels.
    noise_factor : float
        Median difference of two photographs, times this, is 4 standard deviations of the noise of
        one photograph: the median of |a - b| is 0.95 of one.
    min_rise_power : float
        Codes of any camera rise more than this power of the seconds.
    chance : float
        Probability of refusing photographs in order: 4 standard deviations of a normal value.
    """

    max_pixels: int = 1 << 14
    clipped_code: float = 0.98
    max_offset: float = 0.18
    darkest_share: float = 0.01
    lit_code: float = 0.03
    min_lit_share: float = 0.02
    noise_factor: float = 4.0
    min_rise_power: float = 0.25
    chance: float = 3e-5


ORDER_TEST = OrderTest()


@dataclass(frozen=True, repr=False, eq=False, kw_only=True)
class ExposureStack:
    """Photographs of one shape and type, in ascending order of their seconds.

    Attributes
    ----------
    images : tuple of (pixels, channels) arrays
        Codes as the camera wrote them.
    shape : tuple of int
        Shape of a photograph, (H, W) or (H, W, 3).
    seconds : (K,) float64
        Exposures, ascending.
    levels : int
        Number of codes that the camera can write, 256, 4096, ...; 0 for floats that were never
        rounded.
    """

    images: tuple[np.ndarray, ...]
    shape: tuple[int, ...]
    seconds: np.ndarray
    levels: int

    def codes(self, max_pixels: int) -> np.ndarray:
        """About `max_pixels` pixels, spread evenly, in [0, 1]: float32, (K, pixels, channels)."""
        step = max(1, len(self.images[0]) // max_pixels)
        sampled = [image[::step] for image in self.images]
        return normalise_codes(np.stack(sampled), self.levels)

    def check_different_exposures(self, seconds: Any) -> None:
        """Refuse a stack of one exposure only; `seconds` is the argument that the message names."""
        if self.seconds[0] == self.seconds[-1]:
            raise InputError(
                f"seconds is {seconds!r}; it must hold at least two different exposures"
            )


def exposure_stack(images: Sequence[Any], seconds: Any, levels: int | None = None) -> ExposureStack:
    """Check photographs and their seconds, and put them in order.

    A photograph must not be darker than one of fewer seconds: the mean code must not fall, and that
    of lit pixels must rise at least as the fourth root of the seconds, by Student's t of the
    differences of pixels.
    """
    arrays = check_photographs("images", images)
    times = checks.real("seconds", seconds).astype(np.float64)
    checks.finite("seconds", times)
    if times.shape != (len(arrays),) or times.min() <= 0:
        raise InputError(
            f"seconds is {seconds!r}; "
            f"it must be {len(arrays)} positive number(s), one for each image"
        )
    order = np.argsort(times, kind="stable")
    shape = arrays[0].shape
    pixels = shape[0] * shape[1]
    ordered = [arrays[k].reshape(pixels, -1) for k in order]
    stack = ExposureStack(
        images=tuple(ordered),
        shape=shape,
        seconds=times[order],
        levels=code_levels(arrays, levels),
    )
    _check_order(stack, order)
    return stack


def check_photographs(name: str, images: Any) -> tuple[np.ndarray, ...]:
    """Photographs as arrays of one shape and type; another, an empty one and NaN are refused."""
    if len(images) == 0:
        raise InputError(f"{name} holds no photograph; there must be at least one")
    arrays = [checks.real(f"{name}[{k}]", image) for k, image in enumerate(images)]
    shape = arrays[0].shape
    dtype = arrays[0].dtype
    is_picture = len(shape) in (2, 3) and shape[2:] in ((), (3,))
    if not is_picture or arrays[0].size == 0:
        raise InputError(f"{name}[0] has shape {shape}; it must be (H, W) or (H, W, 3), not empty")
    if dtype.kind != "f" and dtype not in (np.uint8, np.uint16):
        raise InputError(f"{name}[0] holds {dtype}; photographs must be uint8, uint16 or float")
    for k, image in enumerate(arrays):
        checks.shape(f"{name}[{k}]", image, shape)
        if image.dtype != dtype:
            raise InputError(f"{name}[{k}] holds {image.dtype}; it must be {dtype}, as {name}[0]")
        if dtype.kind == "f":
            checks.finite(f"{name}[{k}]", image)
    return tuple(arrays)


def normalise_codes(codes: np.ndarray, levels: int) -> np.ndarray:
    """Integer codes over the largest, `levels` - 1; floats as they are. float32."""
    scaled = codes.astype(np.float32)
    if codes.dtype.kind == "f":
        return scaled
    return scaled * np.float32(1.0 / (levels - 1))


def code_levels(images: tuple[np.ndarray, ...], levels: int | None) -> int:
    """Number of codes of the camera: `levels` if the photographs allow it.

    Without `levels` it is that of the type, 0 for floats.
    """
    dtype = images[0].dtype
    is_float = dtype.kind == "f"
    levels_of_type = 0 if is_float else int(np.iinfo(dtype).max) + 1
    if levels is None or (levels == 0 and is_float):
        return levels_of_type
    max_levels = 1 << 16 if is_float else levels_of_type
    checks.count("levels", levels, least=2, most=max_levels)
    if not is_float and levels < levels_of_type:
        largest = max(int(image.max()) for image in images)
        if largest >= levels:
            raise InputError(f"levels is {levels}, but images hold {largest}; levels must be above")
    return levels


def _check_order(stack: ExposureStack, order: np.ndarray) -> None:
    """Refuse a photograph that is not brighter than the one before; `order` has their numbers."""
    codes = stack.codes(ORDER_TEST.max_pixels).astype(np.float64)
    # An allowance of one code.
    rounding = 1.0 / max(stack.levels, 1 << 12)
    for k, (short, long) in enumerate(pairwise(codes)):
        ratio = stack.seconds[k + 1] / stack.seconds[k]
        if _is_brighter(short, long, ratio, rounding):
            continue
        short_name = f"images[{order[k]}] of {stack.seconds[k]:g} s"
        long_name = f"images[{order[k + 1]}] of {stack.seconds[k + 1]:g} s"
        raise InputError(
            f"{long_name} is not brighter than {short_name}; brightness must rise with the seconds"
        )


def _is_brighter(short: np.ndarray, long: np.ndarray, ratio: float, rounding: float) -> bool:
    """True if codes (pixels, channels) may have `ratio` times the exposure of others."""
    is_clear = np.maximum(short, long) < ORDER_TEST.clipped_code
    rise = (long - short)[is_clear]
    if ratio == 1.0 or rise.size < 2:
        return True

    # The darkest pixels of a channel may show its offset.
    light = np.minimum(short, long)
    clear_light = np.where(is_clear, light, 1.0)
    darkest = np.quantile(clear_light, ORDER_TEST.darkest_share, axis=0)
    offset = np.where(darkest < ORDER_TEST.max_offset, darkest, 0.0)
    light = (light - offset)[is_clear]

    # What lit pixels must rise by at least is subtracted from their differences.
    noise = ORDER_TEST.noise_factor * float(np.median(np.abs(rise)))
    is_lit = light > max(ORDER_TEST.lit_code, noise)
    if is_lit.sum() >= max(2, ORDER_TEST.min_lit_share * is_lit.size):
        rise -= is_lit * light * (ratio**ORDER_TEST.min_rise_power - 1.0)

    error = np.sqrt((rise.var(ddof=1) + rounding**2) / rise.size)
    threshold = stdtrit(rise.size - 1, ORDER_TEST.chance) * error - rounding
    return bool(rise.mean() >= threshold)
