# SPDX-License-Identifier: BSD-3-Clause
"""Gray code with inverses: patterns, and the projector coordinates that their photographs give.

Neighbouring columns differ in one bit, so a pixel on the edge of a stripe has one undecided bit only, and
its coordinate lies between two neighbours. The patterns are those of OpenCV's structured_light, in its order:
column bits, highest first, each followed by its inverse; then row bits; then white and black.

Fine stripes light half of everything evenly, so that a pixel shows `l_d + l_g / 2` when its own stripe is on
and `l_g / 2` when it is off (Nayar et al. 2006). With the direct light l_d and the indirect l_g known, a bit
is certain (Xu and Aliaga 2007) where direct light outweighs indirect light, for then the brighter of pattern
and inverse decides; or where one of the two shows more than l_g, so that it must be lit, and the other less
than l_d, so that it cannot be; if it is above the noise. Known limit: a pixel that gets more than twice as
much light from elsewhere as from the projector, as in a closed white room, has no coordinate.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry.camera import photographs
from ltcl.errors import InputError

_STRIP = 1 << 19  # values of all pictures of a strip of rows: 2 MiB of float32 stay in the cache
FINE = 4  # bits of an axis whose stripes, 16 pixels and less, count as narrow enough to light evenly
_SIGMAS = 3.0  # standard deviations of a difference: 1 bit in 400 of noise alone passes
_WINDOW = 5  # side of the neighbourhood that a coordinate must fit
_FAR = np.float32(1e9)  # beyond any coordinate


@dataclass(frozen=True)
class Axis:
    """One projector coordinate of every camera pixel, arrays (H, W).

    `value` and `width`, float32, are the middle and the length of the interval that is known, in projector
    pixels with centres at integers: 1 where every bit is certain, 2 on an edge between two stripes, infinite
    elsewhere. `place`, int32, is the whole coordinate that the brighter pictures give, however faintly.
    Where it differs by 1 from that of the next pixel, `right` and `below` are the fraction in [0, 1] of the
    distance at which it changes; NaN elsewhere.
    """

    value: np.ndarray
    width: np.ndarray
    place: np.ndarray
    right: np.ndarray
    below: np.ndarray

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> Axis:
        """To be filled a strip of rows at a time."""
        value, width = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        right, below = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
        return cls(value, width, np.zeros(shape, np.int32), right, below)


@dataclass(frozen=True)
class GrayCode:
    """Patterns for a projector grid (h, w), and the decoding of their photographs.

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
        """Bits of a column and of a row; a side of 1 has none."""
        h, w = self.grid
        return (w - 1).bit_length(), (h - 1).bit_length()

    @property
    def count(self) -> int:
        """How many photographs there are."""
        return 2 * sum(self.bits) + 2

    def patterns(self) -> list[np.ndarray]:
        """Codes (h, w) in {0, 1}, float32."""
        patterns = []
        for axis, bits in zip((1, 0), self.bits, strict=True):
            place = np.arange(self.grid[axis])
            for k in reversed(range(bits)):
                bit = ((place ^ (place >> 1)) >> k) & 1
                plane = np.broadcast_to(bit if axis else bit[:, None], self.grid).astype(np.float32)
                patterns += [plane, 1.0 - plane]
        return [*patterns, np.ones(self.grid, np.float32), np.zeros(self.grid, np.float32)]

    def decode(self, images: Sequence[Any], *, dark: float = 2e-3, edges: bool = True) -> tuple[Axis, Axis]:
        """x and y of every camera pixel, from photographs (H, W) or (H, W, 3) of `patterns()`, in that order.

        They are linear or raw; `dark` is the least direct light, relative to the brightest; `edges`: also
        find where stripes end between pixels. Errors are those of `decode` of the whole map.
        """
        if len(images) != self.count:
            raise InputError(f"photographs are {len(images)}; they must be {self.count}, one a pattern")
        pictures = photographs("photographs", images)
        pictures = [p.mean(axis=2, dtype=np.float32) if p.ndim == 3 else p for p in pictures]
        checks.number("dark", dark, least=0.0, below=1.0)
        step = 1.0 if pictures[0].dtype.kind == "u" else 0.0  # of whole numbers
        least = max(dark * _brightest(pictures), step)
        H, W = pictures[0].shape
        axes = Axis.empty((H, W)), Axis.empty((H, W))
        fine = [k < FINE for bits in self.bits for k in reversed(range(bits))]

        def strip(rows: slice) -> None:
            # One row more: edges between this strip and the next.
            rows = slice(rows.start, min(rows.stop + edges, H))
            stack = np.stack([picture[rows] for picture in pictures[:-2] or pictures], dtype=np.float32)
            stack -= pictures[-1][rows].astype(np.float32)
            pairs = stack if fine else stack[:0]  # a single projector pixel has none
            pattern, inverse = pairs[0::2], pairs[1::2]
            # l_d = max - min, l_g = 2 min under fine stripes, which light half of the projector's pixels.
            lit = stack[np.repeat(fine, 2)] if fine else stack
            lowest = np.maximum(lit.min(axis=0), 0.0)
            direct, indirect = lit.max(axis=0) - lowest, 2.0 * lowest
            threshold = np.maximum(least, _SIGMAS * np.sqrt(2.0 * _variance(pattern, inverse)))
            difference = pattern - inverse
            on = difference > 0
            np.abs(difference, out=difference)
            certain = (difference > threshold) & (direct > threshold)
            dim = direct <= indirect
            for k in range(len(certain)) if dim.any() else ():
                bright, faint = np.maximum(pattern[k], inverse[k]), np.minimum(pattern[k], inverse[k])
                certain[k] &= ~dim | ((bright > indirect) & (faint < direct))
            split = self.bits[0]
            for axis, size, own in zip(axes, self.grid[::-1], (np.s_[:split], np.s_[split:]), strict=True):
                _decode_rows(axis, rows, on[own], certain[own], size)
                axis.width[rows][direct <= least] = np.inf
                if edges and size > 1:
                    _mark_edges(axis, rows, difference[own])

        in_strips(H, _STRIP // (W * self.count), strip)
        return axes


def in_strips(H: int, rows: int, work: Callable[[slice], None]) -> None:
    """Do `work` on slices of at most `rows` (at least one) of H rows, in parallel."""
    strips = [slice(top, min(top + max(rows, 1), H)) for top in range(0, H, max(rows, 1))]
    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(strips))) as pool:
        list(pool.map(work, strips))


def consistent(value: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Which of the valid coordinates (H, W) fit their neighbours'.

    The centre of a plane is the median of its 5 x 5 neighbourhood. A pixel may deviate from that by one
    projector pixel and twice the median absolute deviation of the neighbours, which is large at folds and
    borders, and must have three valid neighbours (fewer only where the picture is that small).
    """
    deviation = np.abs(value - _median(value, valid, -_FAR))
    # Invalid pixels count as half very near and half very far: they leave the median where it is.
    spread = np.minimum(_median(deviation, valid, np.float32(0.0)), _FAR / 4)
    size, border = (_WINDOW, _WINDOW), cv2.BORDER_CONSTANT
    count = cv2.boxFilter(valid.view(np.uint8), -1, size, normalize=False, borderType=border)
    return valid & (count > min(3, value.size - 1)) & (deviation <= 1.0 + 2.0 * spread)


def _median(value: np.ndarray, valid: np.ndarray, low: np.float32) -> np.ndarray:
    """Of the valid pixels of each neighbourhood, within one rank; invalid ones are `low` and far in turn."""
    filled = np.full(value.shape, _FAR)
    filled[::2, 1::2] = filled[1::2, ::2] = low
    np.copyto(filled, value, "same_kind", where=valid)
    return cv2.medianBlur(filled, _WINDOW)


def _variance(pattern: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Of one photograph, from B pairs (B, ...): a pattern and its inverse always sum to white.

    Drift and flicker count, too, and of raw photographs pixels on edges (0.5 % of a real board's lit pixels).
    One pair has no variance: 0.
    """
    if len(pattern) < 2:
        return np.zeros(pattern.shape[1:], np.float32)
    total = pattern + inverse
    total -= total.mean(axis=0)  # small numbers, for the squares
    return np.einsum("b...,b...->...", total, total) / (2.0 * (len(total) - 1))


def _decode_rows(axis: Axis, rows: slice, on: np.ndarray, certain: np.ndarray, size: int) -> None:
    """Coordinates of some rows, from the bits (B, rows, W)."""
    code, undecided = _number(on), _number(~certain)
    low, other = _position(code), _position(code ^ undecided)
    edge = (undecided != 0) & (undecided & (undecided - 1) == 0) & (np.abs(low - other) == 1)
    value = np.where(edge, low + other, 2 * low) * np.float32(0.5)
    width = np.where(edge, np.float32(2.0), np.float32(1.0))
    width[(undecided != 0) & ~edge | (value > size - 1)] = np.inf
    axis.value[rows], axis.width[rows], axis.place[rows] = value, width, low


def _mark_edges(axis: Axis, rows: slice, difference: np.ndarray) -> None:
    """Where the difference of pattern and inverse (B, rows, W) is zero between a pixel and the next.

    Albedo scales both pictures alike, and blur is even about an edge: neither moves the zero. At an edge of
    two neighbouring columns n - 1 and n only the bit of the lowest one in n flips.
    """
    low, W = axis.place[rows].ravel(), axis.place.shape[1]
    n = np.arange(1 << len(difference))
    flips = len(difference) - np.frexp((n & -n).astype(np.float64))[1]  # highest bit first
    for fractions, step in ((axis.right[rows], 1), (axis.below[rows], W)):
        site = np.flatnonzero(np.abs(low[step:] - low[:-step]) == 1)
        if step == 1 < W:
            site = site[site % W != W - 1]  # the next pixel is the first of the next row
        index = flips.take(np.maximum(low.take(site), low.take(site + step))) * low.size + site
        before, after = difference.take(index), difference.take(index + step)
        total = before + after
        total[total <= 0] = np.nan
        fractions.ravel()[site] = before / total


def _number(bits: np.ndarray) -> np.ndarray:
    """Bits (B, ...), highest first, as whole numbers; bytes at a time, which is four times as fast."""
    code = np.zeros(bits.shape[1:], np.int32)
    for start in range(0, len(bits), 8):
        group = bits[start : start + 8].view(np.uint8)
        byte = group[0].copy()
        for bit in group[1:]:
            byte <<= 1
            byte |= bit
        code <<= len(group)
        code |= byte
    return code


def _position(code: np.ndarray) -> np.ndarray:
    """The place of a Gray code: b = g ^ g >> 1 ^ g >> 2 ..."""
    place = code.copy()
    for shift in (1, 2, 4, 8, 16):
        place ^= place >> shift
    return place


def _brightest(pictures: list[np.ndarray]) -> float:
    """What white shows more than black, at the brightest pixels but a thousandth."""
    lit = pictures[-2].astype(np.float32) - pictures[-1].astype(np.float32)
    brightest = float(np.quantile(lit[:: max(lit.shape[0] // 512, 1)], 0.999))
    if brightest <= 0.0:
        raise InputError(
            f"photographs[{len(pictures) - 2}] is of the white pattern and must be brighter than "
            f"photographs[{len(pictures) - 1}], of the black one; the difference is at most {brightest:.3g}"
        )
    return brightest
