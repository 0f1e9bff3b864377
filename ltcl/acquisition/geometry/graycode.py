# SPDX-License-Identifier: BSD-3-Clause
"""Gray code with inverses: patterns, and the projector coordinates that their photographs give.

Neighbouring columns differ in one bit, so a pixel on the edge of a stripe has one undecided bit only, and
both ways to decide it are neighbours: its coordinate lies between the two. The patterns are those of
OpenCV's structured_light and in its order: column bits, highest first, each followed by its inverse; then
row bits; then white and black. With `high_frequency` every pattern but the finest is combined with the
finest by exclusive or (Gupta et al. 2011): all stripes become narrow, so that light between walls is even
in all of them. The price: a pixel on an edge of the finest stripes is undecided in every bit; its
neighbours then confirm it or not.

Fine stripes light half of everything evenly, so that a pixel shows `l_d + l_g / 2` when its own stripe is on
and `l_g / 2` when it is off (Nayar et al. 2006). With the direct light l_d and the indirect l_g known, a bit
is certain (Xu and Aliaga 2007) where direct light outweighs indirect light, for then the brighter of pattern
and inverse decides; or where one of the two shows more than l_g, so that it must be lit, and the other less
than l_d, so that it cannot be. Everything else is undecided, and so is what is not above the noise.
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
from ltcl.errors import InputError

_STRIP = 1 << 19  # values of all pictures of a strip of rows: 2 MiB of float32 stay in the cache
_FINE = 4  # bits of an axis whose stripes, 16 pixels and less, count as narrow enough to light evenly
_SIGMAS = 3.0  # standard deviations of a difference: 1 bit in 400 of noise alone passes
_DARK = 2.0  # thresholds, 8.5 standard deviations: max - min of 20 photographs of nothing is 3.7 on average
_FAINT = 0.1  # of the direct light: on an edge of narrow stripes uneven indirect light passes for a bit
_WINDOW = 5  # side of the neighbourhood that a coordinate must fit
_FAR = np.float32(1e9)  # beyond any coordinate


@dataclass(frozen=True)
class Edges:
    """Where stripes end between camera pixels, (H, W) each.

    Attributes
    ----------
    place : (H, W) int32
        The whole coordinate that the brighter pictures give, however faintly.
    right, below : (H, W) float32
        Where it differs by 1 between a pixel and its neighbour: the fraction in [0, 1] of the way at which
        it changes; NaN elsewhere.
    """

    place: np.ndarray
    right: np.ndarray
    below: np.ndarray


@dataclass(frozen=True)
class Axis:
    """One projector coordinate of every camera pixel, (H, W) float32 each.

    Attributes
    ----------
    value : (H, W)
        Projector pixels; pixel centres are at integers. It is the middle of the interval that is known.
    width : (H, W)
        Length of that interval in projector pixels: 1 where every bit is certain, 2 on an edge between two
        stripes, more where low bits are undecided, infinite where nothing is known.
    confidence : (H, W)
        In [0, 1]: the part of the direct light by which the weakest bit differs from its inverse.
    edges : Edges, optional
    """

    value: np.ndarray
    width: np.ndarray
    confidence: np.ndarray
    edges: Edges | None = None


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
        h, w = self.grid
        return (w - 1).bit_length(), (h - 1).bit_length()

    @property
    def count(self) -> int:
        """How many photographs there are."""
        return 2 * sum(self.bits) + 2

    def patterns(self) -> list[np.ndarray]:
        """Codes (h, w) in {0, 1}, float32."""
        columns, rows = self._lines()
        planes = [np.broadcast_to(bit, self.grid) for bit in columns]
        planes += [np.broadcast_to(bit[:, None], self.grid) for bit in rows]
        planes = [np.ascontiguousarray(plane, np.float32) for plane in planes]
        pairs = [pattern for plane in planes for pattern in (plane, 1.0 - plane)]
        return [*pairs, np.ones(self.grid, np.float32), np.zeros(self.grid, np.float32)]

    def _lines(self) -> list[list[np.ndarray]]:
        """Bits of all columns, and of all rows, highest first."""
        lines = []
        for n, count in zip(self.grid[::-1], self.bits, strict=True):
            code = np.arange(n) ^ (np.arange(n) >> 1)
            bits = [(code >> k) & 1 for k in range(count - 1, -1, -1)]
            lines.append([bit ^ bits[-1] for bit in bits[:-1]] + bits[-1:] if self.high_frequency else bits)
        return lines

    def decode(self, images: Sequence[Any], *, dark: float = 2e-3, edges: bool = False) -> tuple[Axis, Axis]:
        """x and y of every camera pixel.

        Parameters
        ----------
        images : sequence of (H, W) or (H, W, 3)
            The photographs of `patterns()`, in that order, linear or raw, in any unit.
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
        checks.number("dark", dark, least=0.0, below=1.0)
        step = 1.0 if pictures[0].dtype.kind in "ui" else 0.0  # of whole numbers
        least = max(dark * _brightest(pictures), step)
        H, W = pictures[0].shape
        axes = [_Decoder((H, W), n, self.high_frequency) for n in self.grid[::-1]]
        lines = [(k, bit) for bits in self._lines() for k, bit in enumerate(bits[::-1])]
        fine = [k < _FINE for k, _ in lines]
        # Bits in the order of the photographs; wide stripes light unevenly, narrow ones by their imbalance.
        order = [*range(self.bits[0])[::-1], *range(self.bits[0], len(lines))[::-1]]
        wide = np.array([not (fine[k] or self.high_frequency) for k in order], bool)
        uneven = np.array([abs(2 * lines[k][1].mean() - 1) for k in order]) * ~wide
        even = np.repeat([fine[k] for k in order], 2)

        def strip(rows: slice) -> None:
            # One row more: edges between this strip and the next.
            rows = slice(rows.start, min(rows.stop + edges, H))
            shown = [picture[rows] for picture in (pictures[:-2] or pictures[-2:])]
            stack = np.stack(shown, dtype=np.float32)
            stack -= pictures[-1][rows].astype(np.float32)
            pairs = stack if pictures[:-2] else stack[:0]
            pattern, inverse = pairs[0::2], pairs[1::2]
            # l_d = max - min, l_g = 2 min under fine stripes, which light half of the projector's pixels.
            lit = pairs[even] if len(pairs) else stack
            lowest = np.maximum(lit.min(axis=0), 0.0)
            direct, indirect = lit.max(axis=0) - lowest, 2.0 * lowest
            threshold = np.maximum(least, _SIGMAS * np.sqrt(2.0 * _variance(pattern, inverse)))
            seen = direct > (_DARK * threshold if self.high_frequency else least)
            if self.high_frequency:  # neighbours may confirm faint bits, but not those of noise in the dark
                threshold = np.maximum(threshold, _FAINT * direct)
            on, certain, difference = _decide(pattern, inverse, direct, indirect, threshold, wide, uneven)
            scale = np.where(direct > threshold, 1.0 / np.maximum(direct, threshold), 0.0)
            split = self.bits[0]
            for axis, own in zip(axes, (slice(split), slice(split, None)), strict=True):
                axis.fill(rows, on[own], certain[own], seen)
                if axis.bits:
                    weakest = difference[own].min(axis=0)
                    axis.confidence[rows] = np.minimum(weakest * scale, 1.0)
                    if edges:
                        axis.mark(rows, difference[own])

        in_strips(H, _STRIP // (W * self.count), strip)
        x, y = (axis.result(edges) for axis in axes)
        return x, y


def photographs(name: str, images: Sequence[Any], count: int) -> list[np.ndarray]:
    """Return `count` photographs of one size as (H, W) arrays; colour is averaged, bytes stay bytes.

    >>> photographs("photographs", [np.zeros((2, 3)), np.zeros((3, 2))], 2)
    Traceback (most recent call last):
    ltcl.errors.InputError: photographs[1] has shape (3, 2); it must be (2, 3), as photographs[0]
    """
    if len(images) != count:
        raise InputError(f"{name} are {len(images)}; they must be {count}, one for each pattern")
    pictures: list[np.ndarray] = []
    for number, image in enumerate(images):
        label = f"{name}[{number}]"
        array = checks.finite(label, checks.real(label, image))
        if array.ndim not in (2, 3) or array.shape[2:] not in ((), (1,), (3,)) or array.size == 0:
            raise InputError(f"{label} has shape {array.shape}; it must be (H, W) or (H, W, 3)")
        if array.ndim == 3:
            array = array.mean(axis=2, dtype=np.float32)
        if pictures and array.shape != pictures[0].shape:
            first = f"{pictures[0].shape}, as {name}[0]"
            raise InputError(f"{label} has shape {array.shape}; it must be {first}")
        pictures.append(array)
    return pictures


def in_strips(H: int, rows: int, work: Callable[[slice], None]) -> None:
    """Do `work` on slices of at most `rows` (at least one) of H rows, in parallel."""
    strips = [slice(top, min(top + max(rows, 1), H)) for top in range(0, H, max(rows, 1))]
    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(strips))) as pool:
        list(pool.map(work, strips))


def consistent(value: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Which of the valid coordinates (H, W) fit their neighbours'.

    On a surface coordinates run evenly, so a pixel is close to the median of its 5 x 5 neighbourhood, however
    steep the run: by symmetry the centre of a plane is its median. It may deviate by one projector pixel and
    twice the median absolute deviation of the neighbours, which is large at folds and borders, and has three
    valid neighbours (fewer only where the picture is that small).

    >>> x = np.add.outer(np.zeros(7), 3.0 * np.arange(7))
    >>> x[3, 3] = 40.0
    >>> good = consistent(x, np.ones((7, 7), bool))
    >>> bool(good[3, 3]), int(good.sum())
    (False, 48)
    """
    deviation, allowed, pixels = _deviation(value, valid, value)
    return valid & (pixels > min(3, value.size - 1)) & (deviation <= 1.0 + allowed)


def _deviation(value: np.ndarray, valid: np.ndarray, candidate: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of `candidate` from the median of the valid; twice their median absolute deviation; their number."""
    middle = _median(value, valid)
    # Invalid pixels count as half very near and half very far: they leave the median where it is.
    spread = _median(np.abs(value - middle), valid, low=0.0)
    size, border = (_WINDOW, _WINDOW), cv2.BORDER_CONSTANT
    count = cv2.boxFilter(valid.view(np.uint8), -1, size, normalize=False, borderType=border)
    return np.abs(candidate - middle), 2.0 * np.minimum(spread, _FAR / 4), count


def _median(value: np.ndarray, valid: np.ndarray, low: float = -float(_FAR)) -> np.ndarray:
    """Of the valid pixels of each neighbourhood, within one rank."""
    filled = np.full(value.shape, _FAR)
    filled[::2, 1::2] = filled[1::2, ::2] = low
    np.copyto(filled, value, "same_kind", where=valid)
    return cv2.medianBlur(filled, _WINDOW)


def _variance(pattern: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Of one photograph, from B pairs (B, ...): a pattern and its inverse always sum to white.

    What that sum varies by is noise of two photographs; drift and flicker count, too, and of raw photographs
    pixels on edges, whose two halves sum to something else (which costs 0.5 % of the lit pixels of a real
    board). One pair has no variance: 0.
    """
    if len(pattern) < 2:
        return np.zeros(pattern.shape[1:], np.float32)
    total = pattern + inverse
    total -= total.mean(axis=0)  # small numbers, for the squares
    return np.einsum("b...,b...->...", total, total) / (2.0 * (len(total) - 1))


def _decide(
    pattern: np.ndarray,
    inverse: np.ndarray,
    direct: np.ndarray,
    indirect: np.ndarray,
    threshold: np.ndarray,
    wide: np.ndarray,
    uneven: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """B bits of every pixel: on, certain, and by how much pattern and inverse differ; (B, ...) each.

    Under narrow stripes light from elsewhere is the same in both, but for the part `uneven` (B,) of it by
    which a pattern and its inverse differ; under `wide` (B,) ones it is not.
    """
    difference = pattern - inverse
    on = difference > 0
    np.abs(difference, out=difference)
    certain = difference > threshold
    for k in np.flatnonzero(uneven):
        certain[k] &= difference[k] > threshold + float(uneven[k]) * indirect
    certain &= direct > threshold
    bright = direct > indirect
    for k in np.flatnonzero(wide) if not bright.all() else ():
        lit, other = np.maximum(pattern[k], inverse[k]), np.minimum(pattern[k], inverse[k])
        certain[k] &= bright | ((lit > indirect) & (other < direct))
    return on, certain, difference


class _Decoder:
    """One axis of the whole picture, filled a strip at a time."""

    def __init__(self, shape: tuple[int, int], size: int, high_frequency: bool) -> None:
        self.bits, self.size = (size - 1).bit_length(), size
        self.narrow = high_frequency and self.bits > 1
        self.value, self.width = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self.confidence = np.zeros(shape, np.float32)
        self.place = np.zeros(shape, np.int32)
        self.right, self.below = (np.full(shape, np.nan, np.float32) for _ in range(2))
        # Which bit differs between n - 1 and n, highest first; all of narrow stripes where the finest does.
        n = np.arange(1 << self.bits)
        order = self.bits - np.frexp((n & -n).astype(np.float64))[1]
        self.flips = np.where(self.narrow & (order == self.bits - 1), self.bits, order)

    def fill(self, rows: slice, on: np.ndarray, certain: np.ndarray, seen: np.ndarray) -> None:
        """Coordinates of some rows, from the bits (B, rows, W)."""
        if self.narrow:
            # Exclusive or with the finest bit, a second time, gives Gray code back.
            on = np.concatenate([on[:-1] ^ on[-1], on[-1:]])
            certain = np.concatenate([certain[:-1] & certain[-1], certain[-1:]])
        code, undecided = _number(on), _number(~certain)
        low, other = _position(code), _position(code ^ undecided)
        edge = (undecided != 0) & (undecided & (undecided - 1) == 0) & (np.abs(low - other) == 1)
        edge &= not self.narrow  # there all bits flip: a faint one does not say where
        width = 1 + edge.astype(np.float32)
        value = np.where(edge, low + other, 2 * low) * np.float32(0.5)
        rough = (undecided != 0) & ~edge
        if rough.any():  # middle and length of the interval above the first undecided bit
            length = np.int32(1) << np.frexp(undecided[rough].astype(np.float64))[1].astype(np.int32)
            first = low[rough] & ~(length - 1)
            last = np.minimum(first + length, self.size) - 1
            value[rough], width[rough] = (first + last) / 2.0, np.maximum(last - first + 1, 1)
        width[~seen | (value > self.size - 1)] = np.inf
        self.value[rows], self.width[rows], self.place[rows] = value, width, low
        self.confidence[rows] = seen

    def mark(self, rows: slice, difference: np.ndarray) -> None:
        """Where the difference of pattern and inverse (B, rows, W) is zero between a pixel and the next.

        Albedo scales both pictures alike, and blur is even about an edge: neither moves the zero. At an edge
        of two neighbouring columns one bit flips, or with narrow stripes all, where the finest one does.
        """
        low, W = self.place[rows].ravel(), self.place.shape[1]
        if self.narrow:
            difference = np.concatenate([difference, difference.sum(axis=0, keepdims=True)])
        for fractions, step in ((self.right[rows], 1), (self.below[rows], W)):
            site = np.flatnonzero(np.abs(low[step:] - low[:-step]) == 1)
            if step == 1 < W:
                site = site[site % W != W - 1]  # the next pixel is the first of the next row
            index = self.flips.take(np.maximum(low.take(site), low.take(site + step))) * low.size + site
            before, after = difference.take(index), difference.take(index + step)
            total = before + after
            total[total <= 0] = np.nan
            fractions.ravel()[site] = before / total

    def result(self, edges: bool) -> Axis:
        """With faint coordinates of narrow stripes where five decided neighbours confirm them.

        On an edge of the finest of narrow stripes every bit is faint; the coordinate then deviates by one at
        most, and where that leads out of the range of the neighbours, stripes seem to end where none does.
        """
        marked = Edges(self.place, self.right, self.below) if edges and self.bits else None
        if not self.narrow:
            return Axis(self.value, self.width, self.confidence, marked)
        decided = self.width <= 2.0
        deviation, _, neighbours = _deviation(self.value, decided, self.place.astype(np.float32))
        near = ~decided & np.isfinite(self.width) & (neighbours >= 5) & (deviation <= 1.0)
        around = np.ones((_WINDOW, _WINDOW), np.uint8)
        near &= self.place >= np.floor(cv2.erode(np.where(decided, self.value, _FAR), around))
        near &= self.place <= np.ceil(cv2.dilate(np.where(decided, self.value, -_FAR), around))
        value = np.where(near, self.place, self.value).astype(np.float32)
        return Axis(value, np.where(near, np.float32(2.0), self.width), self.confidence, marked)


def _number(bits: np.ndarray) -> np.ndarray:
    """Bits (B, ...), highest first, as whole numbers; bytes at a time, which is four times as fast."""
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
