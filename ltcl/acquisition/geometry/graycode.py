# SPDX-License-Identifier: BSD-3-Clause
"""Gray code with inverses: patterns, and the projector coordinates that their photographs give.

Neighbouring columns differ in one bit, so a pixel on the edge of a stripe has one undecided bit
only, and its coordinate lies between two neighbours. The patterns are those of OpenCV's
structured_light, in its order: column bits, highest first, each followed by its inverse; then row
bits; then white and black.

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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry.exposures import check_photographs
from ltcl.acquisition.radiometry.strips import in_strips
from ltcl.errors import InputError

# Values of all pictures of a strip of rows: 2 MiB of float32 stay in the cache.
STRIP_VALUES = 1 << 19

# Bits of an axis whose stripes, 16 pixels and less, count as narrow enough to light evenly.
FINE_BITS = 4

# Standard deviations of a difference that counts: 1 bit in 400 of noise alone passes.
MIN_DEVIATIONS = 3.0

# Least difference that counts, as a part of the brightest pixel.
MIN_CONTRAST = 2e-3

# Least difference that counts, in codes of the camera.
MIN_CODES = 1.5

# White less black of the brightest pixels but a thousandth.
BRIGHTEST_QUANTILE = 0.999

# Rows of a photograph that determine it.
MAX_SAMPLED_ROWS = 512

# Pixels and those next to them, to the right and below.
RIGHT_PAIR = (np.s_[..., :-1], np.s_[..., 1:])
BELOW_PAIR = (np.s_[..., :-1, :], np.s_[..., 1:, :])


@dataclass(frozen=True)
class Axis:
    """A projector coordinate of every camera pixel, arrays (H, W) float32.

    Attributes
    ----------
    value : ndarray
        Middle of the interval that is known, in projector pixels with centres at integers.
    width : ndarray
        Length of the interval: 1 if every bit is certain, 2 on an edge between two stripes, else
        infinite.
    place : ndarray
        The whole coordinate that the brighter pictures give, however faintly.
    right, below : ndarray
        If `place` differs by 1 from that of the next pixel: the fraction in [0, 1] of the distance
        at which it changes; else NaN.
    """

    value: np.ndarray
    width: np.ndarray
    place: np.ndarray
    right: np.ndarray
    below: np.ndarray

    @classmethod
    def unknown(cls, shape: tuple[int, ...]) -> Axis:
        """Coordinates that are NaN everywhere."""
        return cls(*(np.full(shape, np.nan, np.float32) for _ in range(5)))


@dataclass(frozen=True)
class GrayCode:
    """Gray code patterns for a projector grid, and the decoding of their photographs.

    Parameters
    ----------
    grid : (int, int)
        Height and width of the projector.

    Raises
    ------
    InputError
        The grid is not two positive integers.

    Examples
    --------
    >>> code = GrayCode((3, 5))
    >>> len(code.patterns()), code.patterns()[4][0].tolist()
    (12, [0.0, 1.0, 1.0, 0.0, 0.0])
    >>> x, y = code.decode(code.patterns())
    >>> x.value[0].tolist(), y.value[:, 0].tolist()
    ([0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 2.0])
    """

    grid: tuple[int, int]

    def __post_init__(self) -> None:
        checks.grid("grid", self.grid)

    @property
    def bits(self) -> tuple[int, int]:
        """Number of bits of a column and of a row; a side of 1 has none."""
        h, w = self.grid
        return (w - 1).bit_length(), (h - 1).bit_length()

    @property
    def count(self) -> int:
        """Number of patterns."""
        return 2 * sum(self.bits) + 2

    def patterns(self) -> list[np.ndarray]:
        """Patterns as codes (h, w) in {0, 1}, float32."""
        h, w = self.grid
        column_bits, row_bits = self.bits
        patterns = []
        for bit in _gray_bits(w, column_bits):
            patterns += self._with_inverse(bit[None, :])
        for bit in _gray_bits(h, row_bits):
            patterns += self._with_inverse(bit[:, None])
        patterns.append(np.ones(self.grid, np.float32))
        patterns.append(np.zeros(self.grid, np.float32))
        return patterns

    def decode(
        self, images: Sequence[Any], *, levels: int | None = None, edges: bool = True
    ) -> tuple[Axis, Axis]:
        """Decode photographs into the projector coordinates x and y of every camera pixel.

        Parameters
        ----------
        images : sequence of (H, W) or (H, W, 3) arrays
            Photographs of `patterns()`, in that order, as in `ltcl.acquisition.geometry.decode`.
        levels : int, optional
            Number of codes of the camera if images are floats.
        edges : bool
            Also find where stripes end between pixels.

        Returns
        -------
        x, y : Axis

        Raises
        ------
        InputError
            As in `ltcl.acquisition.geometry.decode`.
        """
        if len(images) != self.count:
            raise InputError(
                f"photographs are {len(images)}; they must be {self.count}, one a pattern"
            )
        pictures = [_as_grey(image) for image in check_photographs("photographs", images)]
        decoder = StripDecoder(self, pictures, _min_difference(pictures, levels), edges)
        H, W = pictures[0].shape
        in_strips(H, STRIP_VALUES // (W * self.count), decoder.decode)
        return decoder.x, decoder.y

    def _with_inverse(self, bit: np.ndarray) -> list[np.ndarray]:
        pattern = np.broadcast_to(bit, self.grid).astype(np.float32)
        return [pattern, 1.0 - pattern]


def _gray_bits(size: int, bits: int) -> list[np.ndarray]:
    """Bits of the Gray code of the numbers below `size`, highest first."""
    number = np.arange(size)
    gray = number ^ (number >> 1)
    return [(gray >> k) & 1 for k in reversed(range(bits))]


def _has_fine_stripes(code: GrayCode) -> np.ndarray:
    """True for patterns with fine stripes; the last two, white and black, are left out."""
    column_bits, row_bits = code.bits
    significance = np.concatenate([np.arange(column_bits)[::-1], np.arange(row_bits)[::-1]])
    return np.repeat(significance < FINE_BITS, 2)


def _as_grey(picture: np.ndarray) -> np.ndarray:
    if picture.ndim == 3:
        return picture.mean(axis=2, dtype=np.float32)
    return picture


def _min_difference(pictures: list[np.ndarray], levels: int | None) -> float:
    """Least difference of two photographs that counts; white as dark as black is refused."""
    contrast = MIN_CONTRAST
    if levels is not None:
        largest_code = checks.count("levels", levels, least=2) - 1
        contrast = max(contrast, MIN_CODES / largest_code)
    white = pictures[-2].astype(np.float32)
    black = pictures[-1].astype(np.float32)
    lit = white - black
    row_step = max(lit.shape[0] // MAX_SAMPLED_ROWS, 1)
    brightest = float(np.quantile(lit[::row_step], BRIGHTEST_QUANTILE))
    if brightest <= 0.0:
        white_name = f"photographs[{len(pictures) - 2}]"
        black_name = f"photographs[{len(pictures) - 1}]"
        raise InputError(
            f"{white_name} is of the white pattern and must be brighter than {black_name}, of the "
            f"black one; the difference is at most {brightest:.3g}"
        )
    code_step = 1.0 if pictures[0].dtype.kind == "u" else 0.0
    return max(contrast * brightest, code_step)


class StripDecoder:
    """Decodes photographs strip by strip of rows into the axes `x` and `y`."""

    def __init__(
        self, code: GrayCode, pictures: list[np.ndarray], min_difference: float, edges: bool
    ) -> None:
        self.code = code
        self.pictures = pictures
        self.min_difference = min_difference
        self.edges = edges
        self.x = Axis.unknown(pictures[0].shape)
        self.y = Axis.unknown(pictures[0].shape)
        self.is_fine_picture = _has_fine_stripes(code)

    def decode(self, rows: slice) -> None:
        """Decode some rows."""
        H = self.pictures[0].shape[0]
        if self.edges:  # one row more has the edges between this strip and the next
            rows = slice(rows.start, min(rows.stop + 1, H))
        stripes, direct, indirect = self._light(rows)
        pattern = stripes[0::2]
        inverse = stripes[1::2]
        noise = np.sqrt(2.0 * _variance(pattern, inverse))
        threshold = np.maximum(self.min_difference, MIN_DEVIATIONS * noise)
        difference = pattern - inverse
        is_on = difference > 0
        np.abs(difference, out=difference)

        is_certain = (difference > threshold) & (direct > threshold)
        is_dim = direct <= indirect
        if is_dim.any():
            bright = np.maximum(pattern, inverse)
            faint = np.minimum(pattern, inverse)
            is_certain &= ~is_dim | ((bright > indirect) & (faint < direct))

        h, w = self.code.grid
        column_bits = self.code.bits[0]
        is_unlit = direct <= self.min_difference
        for axis, size, bits in (
            (self.x, w, np.s_[:column_bits]),
            (self.y, h, np.s_[column_bits:]),
        ):
            _decode_rows(axis, rows, is_on[bits], is_certain[bits], size)
            axis.width[rows][is_unlit] = np.inf
            if self.edges and size > 1:
                _mark_edges(axis, rows, difference[bits])

    def _light(self, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stripes less black, (2 B, rows, W); direct and indirect light, (rows, W)."""
        black = self.pictures[-1][rows].astype(np.float32)
        has_stripes = len(self.is_fine_picture) > 0
        pictures = self.pictures
        if has_stripes:
            pictures = pictures[:-2]
        stack = np.stack([picture[rows] for picture in pictures], dtype=np.float32)
        stack -= black
        if has_stripes:
            stripes = stack
            fine = stack[self.is_fine_picture]
        else:  # a single projector pixel: white and black alone show its light
            stripes = stack[:0]
            fine = stack

        # l_d = max - min, l_g = 2 min under fine stripes, which light half of the projector's
        # pixels.
        lowest = np.maximum(fine.min(axis=0), 0.0)
        direct = fine.max(axis=0) - lowest
        return stripes, direct, 2.0 * lowest


def _variance(pattern: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Variance of one photograph, from B pairs (B, ...): pattern and inverse always sum to white.

    Drift and flicker count, and in raw photographs pixels on edges (0.5 % of a real board's lit
    pixels). One pair has no variance: 0.
    """
    if len(pattern) < 2:
        return np.zeros(pattern.shape[1:], np.float32)
    total = pattern + inverse
    total -= total.mean(axis=0)  # small numbers, for the squares
    return np.einsum("b...,b...->...", total, total) / (2.0 * (len(total) - 1))


def _decode_rows(
    axis: Axis, rows: slice, is_on: np.ndarray, is_certain: np.ndarray, size: int
) -> None:
    """Coordinates of some rows, from the bits (B, rows, W), highest first."""
    bits = len(is_on)
    number = np.arange(1 << bits)
    place_of_code = np.argsort(number ^ (number >> 1)).astype(np.float32)
    powers = np.exp2(np.arange(bits)[::-1], dtype=np.float32)
    code = np.tensordot(powers, is_on, 1).astype(np.int32)
    undecided = np.tensordot(powers, ~is_certain, 1).astype(np.int32)
    place = place_of_code.take(code)
    flipped_place = place_of_code.take(code ^ undecided)

    distance = np.abs(place - flipped_place)  # 1 if one bit is undecided, on an edge
    value = np.where(distance == 1, 0.5 * (place + flipped_place), place)
    is_unknown = (distance > 1) | (value > size - 1)
    axis.value[rows] = value
    axis.width[rows] = np.where(is_unknown, np.inf, distance + 1)
    axis.place[rows] = place


def _mark_edges(axis: Axis, rows: slice, difference: np.ndarray) -> None:
    """Mark the zeros of the difference of pattern and inverse (B, rows, W) between two pixels.

    Albedo scales both pictures alike, and blur is even about an edge: neither moves the zero. At an
    edge of two neighbouring columns n - 1 and n only the bit of the lowest one in n flips.
    """
    bits = len(difference)
    place = axis.place[rows].astype(np.int32)
    number = np.arange(1 << bits)
    _, lowest_one = np.frexp(number & -number)
    flipped_bit = bits - lowest_one  # highest bit first
    row_step = place.shape[1]
    for fractions, step, (pixels, neighbours) in (
        (axis.right[rows], 1, RIGHT_PAIR),
        (axis.below[rows], row_step, BELOW_PAIR),
    ):
        is_edge = np.zeros(place.shape, bool)
        is_edge[pixels] = np.abs(place[neighbours] - place[pixels]) == 1
        site = np.flatnonzero(is_edge)
        higher = np.maximum(place.take(site), place.take(site + step))
        index = flipped_bit.take(higher) * place.size + site
        before = difference.take(index)
        after = difference.take(index + step)
        total = before + after
        total[total <= 0] = np.nan
        fractions.ravel()[site] = before / total
