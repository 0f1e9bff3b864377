# SPDX-License-Identifier: BSD-3-Clause
"""Gray code with inverses: patterns, and what their photographs tell.

Neighbouring columns differ in one bit, so a pixel on the edge of a stripe has one undecided bit only, and
both ways to decide it are neighbours: its coordinate lies between the two. The patterns are those of
OpenCV's structured_light and in its order: column bits, highest first, each followed by its inverse; then
row bits; then white and black. With `high_frequency` every pattern but the finest is combined with the
finest by exclusive or (Gupta et al. 2011): all stripes become narrow, so that light between walls is even
in all of them. The price: a pixel on an edge of the finest stripes is undecided in every bit; its
neighbours then confirm it or not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry import classification, consistency
from ltcl.acquisition.geometry.decoded import Axis, Edges, photographs, side, strips
from ltcl.errors import InputError

STRIP = 1 << 19  # values of all pictures of a strip of rows: they stay in the cache
FINE = 4  # bits of an axis whose stripes are narrow enough to light everything evenly
DARK = 2.0  # thresholds of a difference: the range of many photographs of nothing is one
FAINT = 0.1  # of the direct light: on an edge of narrow stripes uneven indirect light passes for a bit


@dataclass(frozen=True)
class GrayCode:
    """Patterns for a projector grid, and the decoding of their photographs.

    Parameters
    ----------
    grid : (h, w)
        Any size; a side of 1 needs no patterns.
    high_frequency : bool
        Narrow stripes in every pattern, for strong light between walls.

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
    high_frequency: bool = False

    def __post_init__(self) -> None:
        checks.grid("grid", self.grid)
        checks.flag("high_frequency", self.high_frequency)

    @property
    def bits(self) -> tuple[int, int]:
        """Bits of a column and of a row."""
        return side(self.grid[1]), side(self.grid[0])

    @property
    def count(self) -> int:
        """How many photographs there are."""
        return 2 * sum(self.bits) + 2

    def patterns(self) -> list[np.ndarray]:
        """Codes (h, w) in {0, 1}, float32."""
        h, w = self.grid
        rows = [np.broadcast_to(bit, (h, w)) for bit in self._bits_of(w)]
        rows += [np.broadcast_to(bit[:, None], (h, w)) for bit in self._bits_of(h)]
        rows = [np.ascontiguousarray(row, np.float32) for row in rows]
        pairs = [pattern for row in rows for pattern in (row, 1.0 - row)]
        return [*pairs, np.ones((h, w), np.float32), np.zeros((h, w), np.float32)]

    def decode(
        self, images: Sequence[Any], *, sigmas: float = 3.0, dark: float = 2e-3, edges: bool = False
    ) -> tuple[Axis, Axis]:
        """x and y of every camera pixel.

        Parameters
        ----------
        images : sequence of (H, W) or (H, W, 3)
            The photographs of `patterns()`, in that order, linear or raw, in any unit.
        sigmas : float
            How far a bit must stand out of the noise, in standard deviations of the difference.
        dark : float
            Direct light that counts, as a part of the brightest.
        edges : bool
            Also find where stripes end between pixels.

        Raises
        ------
        InputError
            Another number of photographs, mixed sizes, NaN; or white shows nothing that black does not.
        """
        pictures = photographs("photographs", images, self.count)
        checks.number("sigmas", sigmas, least=0.0)
        checks.number("dark", dark, least=0.0, below=1.0)
        least = max(dark * _brightest(pictures), _step(pictures[0]))
        H, W = pictures[0].shape
        both = [
            _Plane(H, W, n, size, self.high_frequency)
            for n, size in zip(self.bits, self.grid[::-1], strict=True)
        ]
        light = self._light()

        def strip(rows: slice) -> None:
            # One row more: edges between this strip and the next.
            more = slice(rows.start, min(rows.stop + edges, H))
            self._strip(pictures, more, both, least, sigmas, edges, light)

        strips(H, STRIP // (W * self.count), strip)
        x, y = (plane.axis(edges) for plane in both)
        if self.high_frequency:
            x, y = consistency.confirmed(x, both[0].place), consistency.confirmed(y, both[1].place)
        return x, y

    def _strip(self, pictures, rows, both, least, sigmas, edges, light) -> None:
        stack = np.stack(
            [picture[rows] for picture in pictures[:-2]] or [pictures[-2][rows]], dtype=np.float32
        )
        stack -= pictures[-1][rows].astype(np.float32)
        pattern, inverse = (stack[0::2], stack[1::2]) if self.count > 2 else (stack[:0], stack[:0])
        variance = classification.noise(pattern, inverse)
        direct, indirect = classification.direct_global(
            stack[self._fine()] if self.count > 2 else _both(stack)
        )
        threshold = np.maximum(least, sigmas * np.sqrt(2.0 * variance))
        lit = direct > least
        if self.high_frequency:  # neighbours may confirm faint bits, but not those of noise in the dark
            lit = direct > DARK * threshold
            threshold = np.maximum(threshold, FAINT * direct)
        found = classification.classify(pattern, inverse, direct, indirect, threshold, *light)
        split = self.bits[0]
        for plane, part in ((both[0], slice(0, split)), (both[1], slice(split, None))):
            plane.fill(rows, found[part], lit)
            if edges and plane.bits:
                plane.mark(rows, found.difference[part])

    def _bits_of(self, n: int) -> list[np.ndarray]:
        place = np.arange(n)
        code = place ^ (place >> 1)
        bits = [(code >> k) & 1 for k in range(side(n) - 1, -1, -1)]
        return [bit ^ bits[-1] for bit in bits[:-1]] + bits[-1:] if self.high_frequency else bits

    def _fine(self) -> list[int]:
        """Photographs under narrow stripes."""
        columns, rows = self.bits
        fine = [k for n, start in ((columns, 0), (rows, columns)) for k in range(start + n)[start:][-FINE:]]
        return [photograph for k in fine for photograph in (2 * k, 2 * k + 1)]

    def _light(self) -> tuple[np.ndarray, np.ndarray]:
        """Which bits (B,) have stripes too wide for even light, and how far from even the others are."""
        lines = [(k < side(n) - FINE, bit) for n in self.grid[::-1] for k, bit in enumerate(self._bits_of(n))]
        wide = np.array([w and not self.high_frequency for w, _ in lines], bool)
        return wide, np.array([abs(2 * bit.mean() - 1) for _, bit in lines]) * ~wide


class _Plane:
    """One axis of the whole picture, filled a strip at a time."""

    def __init__(self, H: int, W: int, bits: int, size: int, narrow: bool) -> None:
        self.bits, self.size, self.narrow = bits, size, narrow
        self.value, self.width, self.confidence = (np.zeros((H, W), np.float32) for _ in range(3))
        self.place = np.zeros((H, W), np.int32)
        self.flips = _flips(bits, narrow and bits > 1)
        self.edges = Edges(self.place, *(np.full((H, W), np.nan, np.float32) for _ in range(2)))

    def axis(self, edges: bool) -> Axis:
        return Axis(self.value, self.width, self.confidence, self.edges if edges and self.bits else None)

    def fill(self, rows: slice, bits: classification.Bits, lit: np.ndarray) -> None:
        on, certain = bits.on, bits.certain
        narrow = self.narrow and self.bits > 1
        if narrow:
            # Exclusive or with the finest bit, a second time, gives Gray code back.
            on = np.concatenate([on[:-1] ^ on[-1], on[-1:]])
            certain = np.concatenate([certain[:-1] & certain[-1], certain[-1:]])
        code, undecided = _number(on), _number(~certain)
        low = _binary(code)
        other = _binary(code ^ undecided)
        edge = (undecided != 0) & (undecided & (undecided - 1) == 0) & (np.abs(low - other) == 1)
        edge &= not narrow  # there all bits flip: one that is faint tells nothing of where
        width = 1 + edge.astype(np.float32)
        value = np.where(edge, low + other, 2 * low) * np.float32(0.5)
        rough = (undecided != 0) & ~edge
        if rough.any():
            value[rough], width[rough] = _coarse(low[rough], undecided[rough], self.size)
        width[~lit | (value > self.size - 1)] = np.inf
        self.value[rows], self.width[rows], self.place[rows] = value, width, low
        self.confidence[rows] = bits.confidence if self.bits else lit

    def mark(self, rows: slice, difference: np.ndarray) -> None:
        """Where the difference of pattern and inverse passes zero between a pixel and the next.

        Albedo scales both pictures alike, and blur is even about an edge: neither moves the zero. At an edge
        of two neighbouring columns one bit flips, or with narrow stripes all, where the finest one does.
        """
        low, W = self.place[rows].ravel(), self.place.shape[1]
        size = low.size
        if self.narrow and self.bits > 1:
            difference = np.concatenate([difference, difference.sum(axis=0, keepdims=True)])
        for out, step in ((self.edges.right[rows], 1), (self.edges.below[rows], W)):
            site = np.flatnonzero(np.abs(low[step:] - low[:-step]) == 1)
            index = self.flips.take(np.maximum(low.take(site), low.take(site + step))) * size + site
            before, after = difference.take(index), difference.take(index + step)
            total = before + after
            total[total <= 0] = np.nan
            out.ravel()[site] = before / total
        self.edges.right[rows, -1] = np.nan  # no neighbour, but the first of the next row


def _flips(bits: int, narrow: bool) -> np.ndarray:
    """Which bit tells n - 1 and n apart, highest first; where narrow stripes flip all, their number."""
    n = np.arange(1 << bits)
    order = bits - np.frexp((n & -n).astype(np.float64))[1]
    return np.where(narrow & (order == bits - 1), bits, order)


def _number(bits: np.ndarray) -> np.ndarray:
    """Bits (B, ...), highest first, as whole numbers."""
    code = np.zeros(bits.shape[1:], np.int32)
    for start in range(0, len(bits), 8):
        part = bits[start : start + 8].view(np.uint8)
        byte = part[0].copy()
        for bit in part[1:]:
            byte <<= 1
            byte |= bit
        code <<= len(part)
        code |= byte
    return code


def _binary(code: np.ndarray) -> np.ndarray:
    """The place of a Gray code: b = g ^ g >> 1 ^ g >> 2 ..."""
    place = code.copy()
    for shift in (1, 2, 4, 8, 16):
        place ^= place >> shift
    return place


def _coarse(low: np.ndarray, undecided: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Middle and length of the interval that the bits above the first undecided one tell."""
    length = np.int32(1) << np.frexp(undecided.astype(np.float64))[1].astype(np.int32)
    first = low & ~(length - 1)
    last = np.minimum(first + length, size) - 1
    return (first + last) / 2.0, np.maximum(last - first + 1, 1)


def _both(stack: np.ndarray) -> np.ndarray:
    """White and black where a single projector pixel leaves nothing to tell apart."""
    return np.concatenate([stack, np.zeros_like(stack)])


def _step(picture: np.ndarray) -> float:
    """One step of a whole-numbered photograph."""
    return 1.0 if picture.dtype.kind in "ui" else 0.0


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
