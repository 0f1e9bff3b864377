# SPDX-License-Identifier: BSD-3-Clause
"""Bits of Gray code from photographs, each with the noise of its pixel.

A photograph k of a pattern shows g_k times the light of other photographs: projectors rescale fine
patterns, lamps flicker, and colours of a wheel fall into other frames. The gain g_k is the median,
over lit pixels where the pattern (or its inverse) is on, of

    (p_b + q_b) / s,    s = sum_b d_b^2 (p_b + q_b) / sum_b d_b^2,    d_b = p_b - q_b

with p_b and q_b the photographs of pattern b and its inverse, less black. With gains undone, the
differences of p_b + q_b from s are the noise of the pixel, with the same weights: on the edges of
stripes, where d_b is small, raw photographs that are not linear in light do not add up. At least
half the median of all pixels counts.

Without inverses, q_b = g_b w - p_b with w the photograph of white. Fine stripes are on and off at
half of the pixels each, so that g_b is the sum of the quartiles of p_b / w; coarse ones get the
median of these. The noise is the distance of p_b from the nearer one of the levels that fine
stripes show. That is less sure: a single photograph decides each bit.

With inverses of the fine bits alone, gains, noise and light are those of these pairs, and a coarse
bit has q_b = s - p_b. Its difference 2 p_b - s has about twice the variance of that of a pair.

Fine stripes light half of everything evenly, so that a pixel shows `l_d + l_g / 2` when its own
stripe is on and `l_g / 2` when it is off (Nayar et al. 2006). With the direct light l_d and the
indirect light l_g known, a bit is certain (Xu and Aliaga 2007) if it is above the noise, and

    direct light outweighs indirect light: the brighter of pattern and inverse decides; or
    one of the two shows more than l_g, so that it must be lit, and the other shows less than l_d,
    so that it cannot be.

Known limit: a pixel that gets more than twice as much light from elsewhere as from the projector,
as in a closed white room, has no coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ltcl.acquisition.geometry.axis import (
    CERTAIN,
    EDGE_AFTER,
    EDGE_BEFORE,
    FAINT,
    FRACTION_STEPS,
    NO_EDGE,
    SHIFTS,
    UNKNOWN,
    Axis,
)
from ltcl.acquisition.geometry.photographs import Photographs

# Bits of an axis whose stripes, 16 pixels and less, count as narrow enough to light evenly.
FINE_BITS = 4

# Standard deviations of a difference that counts. Noise alone passes all bits of a pixel once in
# 10^5 with 4 bits; a bit that is wrong is found by the neighbours of the pixel.
MIN_DEVIATIONS = 2.0

# Least threshold, relative to direct light, of a pixel that is faint because of noise: others with
# undecided bits lie on the border of two surfaces.
MIN_FAINT_NOISE = 0.05

# Standard deviations of a difference that the direct light of a faint pixel exceeds: 32 fine
# photographs of noise alone differ by up to 3.
MIN_FAINT_DEVIATIONS = 3.0

# Least light of a faint pixel, as a part of the brightest within its 7 x 7 pixels: lens
# blur shifts the stripes that darker ones show.
MIN_FAINT_SHARE = 0.3
NEAR_WINDOW = 7

# Noise of a pixel, by few photographs, that counts at least, as a part of the median.
MIN_NOISE_SHARE = 0.5

# Part of the photographs that are free to deviate from their mean, at least.
MIN_FREEDOM = 0.1

# Pixels that determine a gain, and those that are read for it.
MIN_GAIN_PIXELS = 200
MAX_GAIN_PIXELS = 1 << 16

# Contrast d / (p + q) of a pixel that lies within a stripe.
STRIPE_CONTRAST = 0.5

# Light of the brightest pixels but a thousandth.
BRIGHTEST_QUANTILE = 0.999

# Light of the brightest pixels from which on a pixel tells a gain.
GAIN_LIGHT = 0.2

# Gains of a photograph; beyond, it is another pattern.
MAX_GAIN = 2.0

# Variances of a single photograph in 2 p - w - b, a bit without an inverse.
SINGLE_VARIANCES = 6.0

# Deviation of 2 p - s, relative to that of p - q, by at least six pairs in s.
COARSE_DEVIATION = 1.5

# Instead of a division by zero.
TINY = np.float32(1e-20)

# Pixels and those next to them, to the right and below.
RIGHT_PAIR = (np.s_[..., :-1], np.s_[..., 1:])
BELOW_PAIR = (np.s_[..., :-1, :], np.s_[..., 1:, :])


@dataclass(frozen=True)
class BitLayout:
    """Places of the bits among photographs of Gray code.

    Parameters
    ----------
    bits : (int, int)
        Number of bits of a column and of a row.
    inverses : int
        Finest bits of each axis that are followed by their inverses.

    Examples
    --------
    >>> layout = BitLayout((2, 1), 1)
    >>> layout.count, layout.first.tolist(), layout.has_inverse.tolist()
    (7, [0, 1, 3], [False, True, True])
    """

    bits: tuple[int, int]
    inverses: int

    @property
    def has_inverse(self) -> np.ndarray:
        """True for bits that are followed by their inverses, (B,)."""
        return significance(self.bits) < self.inverses

    @property
    def first(self) -> np.ndarray:
        """Number of the photograph of each bit, (B,)."""
        photographs = 1 + self.has_inverse.astype(int)
        return np.cumsum(photographs) - photographs

    @property
    def count(self) -> int:
        """Number of photographs, with white and black at the end."""
        return len(self.has_inverse) + int(self.has_inverse.sum()) + 2

    def pairs_of_axis(self, axis: int) -> np.ndarray:
        """Numbers of the photographs of rows (axis 0) or columns that inverses follow."""
        column_bits, _ = self.bits
        is_of_axis = np.arange(len(self.first)) < column_bits
        if axis == 0:
            is_of_axis = ~is_of_axis
        return self.first[is_of_axis & self.has_inverse]


class StripDecoder:
    """Decodes photographs strip by strip of rows into the axes `x` and `y`.

    Parameters
    ----------
    grid : (int, int)
        Height and width of the projector.
    layout : BitLayout
        Places of the patterns and their inverses; white and black come last.
    pictures : Photographs
    min_difference : float
        Least difference of two photographs that counts.
    edges : bool
        Also find where stripes end between pixels.
    """

    def __init__(
        self,
        grid: tuple[int, int],
        layout: BitLayout,
        pictures: Photographs,
        min_difference: float,
        edges: bool,
    ) -> None:
        self.grid = grid
        self.bits = layout.bits
        self.layout = layout
        self.pictures = pictures
        self.min_difference = min_difference
        self.edges = edges
        self.has_inverse = layout.has_inverse
        self.has_inverses = bool(self.has_inverse.any()) or not len(self.has_inverse)
        self.x = Axis.unknown(pictures.shape)
        self.y = Axis.unknown(pictures.shape)
        self.gains = np.ones((2, len(self.has_inverse)), np.float32)
        self.min_noise = 0.0
        if len(self.has_inverse):
            self._measure_gains()

    def decode(self, rows: slice) -> None:
        """Decode some rows."""
        H = self.pictures.shape[0]
        count = rows.stop - rows.start
        if self.edges:  # one row more has the edges between this strip and the next
            rows = slice(rows.start, min(rows.stop + 1, H))
        pattern, inverse = self._read_pairs(rows)
        difference = pattern - inverse
        lowest, highest = self._fine_light(pattern, inverse, rows)
        white, noise = self._statistics(pattern, inverse, lowest, highest)
        np.maximum(noise, self.min_noise, out=noise)
        threshold = np.maximum(self.min_difference, MIN_DEVIATIONS * noise)
        is_on = difference > 0
        np.abs(difference, out=difference)
        if self.has_inverses:
            difference[~self.has_inverse] /= COARSE_DEVIATION

        np.maximum(lowest, 0.0, out=lowest)
        direct = highest - lowest
        indirect = 2.0 * lowest
        is_dim = direct <= indirect
        is_certain = difference > threshold
        if is_dim.any():
            bright = np.maximum(pattern, inverse)
            faint = np.minimum(pattern, inverse)
            is_certain &= ~is_dim | ((bright > indirect) & (faint < direct))
        is_lit = direct > threshold
        is_noisy = ~is_dim & (threshold > MIN_FAINT_NOISE * direct)
        is_noisy &= (direct > MIN_FAINT_DEVIATIONS * noise) & (white > threshold)
        brightest = cv2.dilate(white, np.ones((NEAR_WINDOW, NEAR_WINDOW)))
        is_noisy &= white > MIN_FAINT_SHARE * brightest

        h, w = self.grid
        column_bits = self.bits[0]
        for axis, size, bits in (
            (self.x, w, np.s_[:column_bits]),
            (self.y, h, np.s_[column_bits:]),
        ):
            strip = axis.rows(slice(rows.start, rows.start + count))
            place, state = _decode_bits(is_on[bits], is_certain[bits], size)
            is_unknown = ~is_lit | (~is_noisy & (state == FAINT))
            strip.place[:] = place[:count]
            strip.state[:] = np.where(is_unknown, UNKNOWN, state)[:count]
            if self.edges and size > 1:
                _mark_edges(strip, place, difference[bits])

    def _read_pairs(self, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Patterns and inverses less black, at the same gain, (B, rows, W) each."""
        black = self.pictures.read(-1, rows)
        pattern_gains, inverse_gains = self.gains
        first = self.layout.first
        if not self.has_inverses:
            pattern = self._read_stack(first, rows, black, np.ones(len(first)))
            white = self.pictures.read(-2, rows) - black
            return pattern, pattern_gains[:, None, None] * white - pattern
        paired = self.has_inverse
        pattern = self._read_stack(first, rows, black, pattern_gains)
        if paired.all():
            return pattern, self._read_stack(first + 1, rows, black, inverse_gains)
        inverse = np.empty_like(pattern)
        inverse[paired] = self._read_stack(first[paired] + 1, rows, black, inverse_gains[paired])
        total, _ = self._pair_statistics(pattern[paired], inverse[paired])
        inverse[~paired] = total - pattern[~paired]
        return pattern, inverse

    def _read_stack(
        self, numbers: np.ndarray, rows: slice, black: np.ndarray, gains: np.ndarray
    ) -> np.ndarray:
        """Photographs less black, over their gains."""
        stack = np.empty((len(numbers), *black.shape), np.float32)
        for i, number in enumerate(numbers.tolist()):
            np.subtract(self.pictures.read(number, rows), black, out=stack[i])
            stack[i] /= gains[i]
        return stack

    def _fine_light(
        self, pattern: np.ndarray, inverse: np.ndarray, rows: slice
    ) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest light under fine stripes, (rows, W): l_g / 2 and l_d + l_g / 2."""
        if len(pattern) == 0:  # a single projector pixel: white and black alone show its light
            white = self.pictures.read(-2, rows) - self.pictures.read(-1, rows)
            return np.zeros_like(white), white
        is_fine = _has_fine_stripes(self.bits)
        pattern = pattern[is_fine]
        inverse = inverse[is_fine]
        lowest = np.minimum(pattern.min(axis=0), inverse.min(axis=0))
        highest = np.maximum(pattern.max(axis=0), inverse.max(axis=0))
        return lowest, highest

    def _statistics(
        self, pattern: np.ndarray, inverse: np.ndarray, lowest: np.ndarray, highest: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean s of the sums of pattern and inverse, and standard deviation of their differences.

        (rows, W); one pair has no variance: 0.
        """
        if self.has_inverse.all():
            return self._pair_statistics(pattern, inverse)
        if self.has_inverses:
            return self._pair_statistics(pattern[self.has_inverse], inverse[self.has_inverse])
        weight = _weights(pattern - inverse)
        total = pattern + inverse
        mean = np.einsum("b...,b...->...", weight, total)
        deviation = np.minimum(highest - pattern, pattern - lowest)
        np.maximum(deviation, 0.0, out=deviation)
        deviation *= deviation
        variance = SINGLE_VARIANCES * np.einsum("b...,b...->...", weight, deviation)
        return mean, np.sqrt(variance)

    def _pair_statistics(
        self, pattern: np.ndarray, inverse: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same of patterns that all have inverses."""
        weight = _weights(pattern - inverse)
        total = pattern + inverse
        mean = np.einsum("b...,b...->...", weight, total)
        deviation = total - mean
        freedom = 1.0 - np.einsum("b...,b...->...", weight, weight)
        scale = 1.0 / np.maximum(freedom, MIN_FREEDOM)
        deviation *= deviation
        variance = scale * np.einsum("b...,b...->...", weight, deviation)
        return mean, np.sqrt(variance)

    def _measure_gains(self) -> None:
        """Measure the gains of all photographs, and the least noise, at some of the rows."""
        H, W = self.pictures.shape
        rows = slice(0, H, -(-H * W // MAX_GAIN_PIXELS))
        pattern, inverse = self._read_pairs(rows)
        light = self._fine_light(pattern, inverse, rows)
        total, _ = self._statistics(pattern, inverse, *light)
        brightest = float(np.quantile(total, BRIGHTEST_QUANTILE))
        is_lit = total > max(GAIN_LIGHT * brightest, self.min_difference)
        if np.count_nonzero(is_lit) < MIN_GAIN_PIXELS:
            return
        total = total[is_lit]
        if self.has_inverses:
            for bit in np.flatnonzero(self.has_inverse).tolist():
                p = pattern[bit][is_lit] / total
                q = inverse[bit][is_lit] / total
                self.gains[:, bit] = _pair_gains(p, q)
        else:
            self.gains[0] = _single_gains(pattern[:, is_lit] / total, self.bits)
        pattern, inverse = self._read_pairs(rows)
        light = self._fine_light(pattern, inverse, rows)
        _, noise = self._statistics(pattern, inverse, *light)
        self.min_noise = MIN_NOISE_SHARE * float(np.median(noise[is_lit]))


def _pair_gains(pattern: np.ndarray, inverse: np.ndarray) -> tuple[float, float]:
    """Gains of a pattern and of its inverse, by their light (n,) relative to other bits."""
    light = pattern + inverse
    contrast = pattern - inverse
    gain_of_both = float(np.median(light))
    return (
        _gain(light, contrast > STRIPE_CONTRAST, gain_of_both),
        _gain(light, contrast < -STRIPE_CONTRAST, gain_of_both),
    )


def _gain(light: np.ndarray, is_on: np.ndarray, default: float) -> float:
    """Median of the relative light of pixels where a pattern is on, if there are enough."""
    gain = default
    if np.count_nonzero(is_on) >= MIN_GAIN_PIXELS:
        gain = float(np.median(light[is_on]))
    return min(max(gain, 1.0 / MAX_GAIN), MAX_GAIN)


def _single_gains(pattern: np.ndarray, bits: tuple[int, int]) -> np.ndarray:
    """Sums of the levels on and off of patterns (B, n), whose light is relative to white.

    Coarse stripes may be on, or off, at all pixels; they get the median of the fine ones.
    """
    is_fine = _has_fine_stripes(bits)
    gains = np.quantile(pattern, [0.25, 0.75], axis=1).sum(axis=0)
    gains[~is_fine] = np.median(gains[is_fine])
    return gains


def significance(bits: tuple[int, int]) -> np.ndarray:
    """Power of two of each bit, (B,): those of columns, highest first, then those of rows."""
    column_bits, row_bits = bits
    return np.concatenate([np.arange(column_bits)[::-1], np.arange(row_bits)[::-1]])


def _has_fine_stripes(bits: tuple[int, int]) -> np.ndarray:
    """True for bits whose stripes are fine, (B,)."""
    return significance(bits) < FINE_BITS


def _weights(difference: np.ndarray) -> np.ndarray:
    """Squares of the differences of patterns and inverses (B, ...), relative to their sum."""
    difference *= difference
    difference += TINY
    difference /= difference.sum(axis=0)
    return difference


def _decode_bits(
    is_on: np.ndarray, is_certain: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Whole coordinates and their states, from bits (B, rows, W), highest first."""
    bits = len(is_on)
    number = np.arange(1 << bits)
    place_of_code = np.argsort(number ^ (number >> 1)).astype(np.int32)
    powers = np.exp2(np.arange(bits)[::-1], dtype=np.float32)
    code = np.tensordot(powers, is_on, 1).astype(np.int32)
    undecided = np.tensordot(powers, ~is_certain, 1).astype(np.int32)
    place = place_of_code.take(code)
    # 1 or -1 if one bit is undecided, on an edge.
    step = place_of_code.take(code ^ undecided) - place

    state = np.full(place.shape, FAINT)
    state[step == 0] = CERTAIN
    state[step == -1] = EDGE_BEFORE
    state[step == 1] = EDGE_AFTER
    state[place + SHIFTS.take(state) > size - 1] = UNKNOWN
    return place, state


def _mark_edges(axis: Axis, place: np.ndarray, difference: np.ndarray) -> None:
    """Mark the zeros of the difference of pattern and inverse (B, rows, W) between two pixels.

    Albedo scales both pictures alike, and blur is even about an edge: neither moves the zero. At an
    edge of two neighbouring columns n - 1 and n only the bit of the lowest one in n flips. `place`
    and `difference` may have one row more than the axis.
    """
    bits = len(difference)
    rows = len(axis.place)
    number = np.arange(1 << bits)
    _, lowest_one = np.frexp(number & -number)
    flipped_bit = bits - lowest_one  # highest bit first
    row_step = place.shape[1]
    for steps, step, (pixels, neighbours) in (
        (axis.right_steps, 1, RIGHT_PAIR),
        (axis.below_steps, row_step, BELOW_PAIR),
    ):
        is_edge = np.zeros(place.shape, bool)
        is_edge[pixels] = np.abs(place[neighbours] - place[pixels]) == 1
        site = np.flatnonzero(is_edge[:rows])
        higher = np.maximum(place.take(site), place.take(site + step))
        index = flipped_bit.take(higher) * place.size + site
        before = difference.take(index)
        total = before + difference.take(index + step)
        fraction = before / np.where(total > 0, total, 1.0)
        counts = np.rint(FRACTION_STEPS * fraction)
        steps.ravel()[site] = np.where(total > 0, counts, NO_EDGE)
