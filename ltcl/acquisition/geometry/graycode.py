# SPDX-License-Identifier: BSD-3-Clause
"""Gray code with inverses: patterns, and the projector coordinates that their photographs give.

Neighbouring columns differ in one bit, so a pixel on the edge of a stripe has one undecided bit
only, and its coordinate lies between two neighbours. The patterns are those of OpenCV's
structured_light, in its order: column bits, highest first, each followed by its inverse; then row
bits; then white and black.

Fine stripes light half of everything evenly, so that a pixel shows `l_d + l_g / 2` when its own
stripe is on and `l_g / 2` when it is off (Nayar et al. 2006). With the direct light l_d and the
indirect l_g known, a bit is certain (Xu and Aliaga 2007) where direct light outweighs indirect
light, for then the brighter of pattern and inverse decides; or where one of the two shows more than
l_g, so that it must be lit, and the other less than l_d, so that it cannot be; if it is above the
noise. Known limit: a pixel that gets more than twice as much light from elsewhere as from the
projector, as in a closed white room, has no coordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry.exposures import check_photographs
from ltcl.acquisition.radiometry.merge import in_strips
from ltcl.errors import InputError

STRIP = 1 << 19  # values of all pictures of a strip of rows: 2 MiB of float32 stay in the cache
FINE = (
    4  # bits of an axis whose stripes, 16 pixels and less, count as narrow enough to light evenly
)
SIGMAS = 3.0  # standard deviations of a difference: 1 bit in 400 of noise alone passes
DARK, STEPS = (
    2e-3,
    1.5,
)  # least difference that counts, of the brightest pixel and of the camera's codes
# Pixels and those next to them, to the right and below.
ADJACENT = (np.s_[..., :-1], np.s_[..., 1:]), (np.s_[..., :-1, :], np.s_[..., 1:, :])


@dataclass(frozen=True)
class Axis:
    """One projector coordinate of every camera pixel, arrays (H, W) float32.

    `value` and `width` are the middle and the length of the interval that is known, in projector
    pixels with centres at integers: 1 where every bit is certain, 2 on an edge between two stripes,
    infinite elsewhere. `place` is the whole coordinate that the brighter pictures give, however
    faintly. Where it differs by 1 from that of the next pixel, `right` and `below` are the fraction
    in [0, 1] of the distance at which it changes; NaN elsewhere.
    """

    value: np.ndarray
    width: np.ndarray
    place: np.ndarray
    right: np.ndarray
    below: np.ndarray


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

    def decode(
        self, images: Sequence[Any], *, levels: int | None = None, edges: bool = True
    ) -> tuple[Axis, Axis]:
        """x and y of every camera pixel, from photographs of `patterns()`, in that order.

        Arguments and errors are those of `decode` of the whole map; `edges`: also find where
        stripes end between pixels.
        """
        if len(images) != self.count:
            raise InputError(
                f"photographs are {len(images)}; they must be {self.count}, one a pattern"
            )
        pictures = check_photographs("photographs", images)
        pictures = [p.mean(axis=2, dtype=np.float32) if p.ndim == 3 else p for p in pictures]
        dark = (
            DARK
            if levels is None
            else max(DARK, STEPS / (checks.count("levels", levels, least=2) - 1))
        )
        step = 1.0 if pictures[0].dtype.kind == "u" else 0.0  # of whole numbers
        # What white shows more than black, at the brightest pixels but a thousandth.
        lit = pictures[-2].astype(np.float32) - pictures[-1].astype(np.float32)
        brightest = float(np.quantile(lit[:: max(lit.shape[0] // 512, 1)], 0.999))
        if brightest <= 0.0:
            bright, black = (f"photographs[{len(pictures) - k}]" for k in (2, 1))
            raise InputError(
                f"{bright} is of the white pattern and must be brighter than {black}, of the black one; "
                f"the difference is at most {brightest:.3g}"
            )
        least = max(dark * brightest, step)
        H, W = pictures[0].shape
        axes = [Axis(*np.full((5, H, W), np.nan, np.float32)) for _ in self.grid]
        fine = [k < FINE for bits in self.bits for k in reversed(range(bits))]

        def strip(rows: slice) -> None:
            # One row more: edges between this strip and the next.
            rows = slice(rows.start, min(rows.stop + edges, H))
            stack = np.stack(
                [picture[rows] for picture in pictures[:-2] or pictures], dtype=np.float32
            )
            stack -= pictures[-1][rows].astype(np.float32)
            pairs = stack if fine else stack[:0]  # a single projector pixel has none
            pattern, inverse = pairs[0::2], pairs[1::2]
            # l_d = max - min, l_g = 2 min under fine stripes, which light half of the projector's
            # pixels.
            lit = stack[np.repeat(fine, 2)] if fine else stack
            lowest = np.maximum(lit.min(axis=0), 0.0)
            direct, indirect = lit.max(axis=0) - lowest, 2.0 * lowest
            threshold = np.maximum(least, SIGMAS * np.sqrt(2.0 * _variance(pattern, inverse)))
            difference = pattern - inverse
            on = difference > 0
            np.abs(difference, out=difference)
            certain = (difference > threshold) & (direct > threshold)
            dim = direct <= indirect
            if dim.any():
                bright, faint = np.maximum(pattern, inverse), np.minimum(pattern, inverse)
                certain &= ~dim | ((bright > indirect) & (faint < direct))
            split = self.bits[0]
            for axis, size, own in zip(
                axes, self.grid[::-1], (np.s_[:split], np.s_[split:]), strict=True
            ):
                _decode_rows(axis, rows, on[own], certain[own], size)
                axis.width[rows][direct <= least] = np.inf
                if edges and size > 1:
                    _mark_edges(axis, rows, difference[own])

        in_strips(H, STRIP // (W * self.count), strip)
        return axes[0], axes[1]


def _variance(pattern: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Of one photograph, from B pairs (B, ...): a pattern and its inverse always sum to white.

    Drift and flicker count, too, and of raw photographs pixels on edges (0.5 % of a real board's
    lit pixels). One pair has no variance: 0.
    """
    if len(pattern) < 2:
        return np.zeros(pattern.shape[1:], np.float32)
    total = pattern + inverse
    total -= total.mean(axis=0)  # small numbers, for the squares
    return np.einsum("b...,b...->...", total, total) / (2.0 * (len(total) - 1))


def _decode_rows(axis: Axis, rows: slice, on: np.ndarray, certain: np.ndarray, size: int) -> None:
    """Coordinates of some rows, from the bits (B, rows, W), highest first."""
    n = np.arange(1 << len(on))
    places = np.argsort(n ^ (n >> 1)).astype(np.float32)  # of codes
    powers = np.exp2(np.arange(len(on))[::-1], dtype=np.float32)
    code, flips = (np.tensordot(powers, bits, 1).astype(np.int32) for bits in (on, ~certain))
    low, other = places.take(code), places.take(code ^ flips)
    distance = np.abs(low - other)  # 1 where one bit is undecided, on an edge
    value = np.where(distance == 1, 0.5 * (low + other), low)
    width = np.where((distance > 1) | (value > size - 1), np.inf, distance + 1)
    axis.value[rows], axis.width[rows], axis.place[rows] = value, width, low


def _mark_edges(axis: Axis, rows: slice, difference: np.ndarray) -> None:
    """Where the difference of pattern and inverse (B, rows, W) is zero between a pixel and the next.

    Albedo scales both pictures alike, and blur is even about an edge: neither moves the zero. At an
    edge of two neighbouring columns n - 1 and n only the bit of the lowest one in n flips.
    """
    low, n = axis.place[rows].astype(np.int32), np.arange(1 << len(difference))
    flips = len(difference) - np.frexp(n & -n)[1]  # highest bit first
    sides = zip((axis.right[rows], axis.below[rows]), (1, low.shape[1]), ADJACENT, strict=True)
    for fractions, step, (here, there) in sides:
        changes = np.zeros(low.shape, bool)
        changes[here] = np.abs(low[there] - low[here]) == 1
        site = np.flatnonzero(changes)
        index = flips.take(np.maximum(low.take(site), low.take(site + step))) * low.size + site
        before, after = difference.take(index), difference.take(index + step)
        total = before + after
        total[total <= 0] = np.nan
        fractions.ravel()[site] = before / total
