# SPDX-License-Identifier: BSD-3-Clause
"""Orders of pixels and of wavelet coefficients in which neighbours in space are neighbours in memory.

A row of R, or of W R W^T, then has its large entries in runs, which `Tiles` hold with one place each.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from ltcl import checks


def hilbert(grid: Any) -> np.ndarray:
    """A curve through all pixels of a grid of any size, like Hilbert's: always on to a neighbour.

    Parameters
    ----------
    grid : (h, w)

    Returns
    -------
    (N,) int64
        The row-major index of the pixel at each place. All steps are to one of the four neighbours.

    Notes
    -----
    The generalised Hilbert curve of J. Cerveny: a rectangle is cut across its longer side, in two where it is
    long and in three where it is not, so that the curve enters and leaves parts at neighbouring corners. Here
    all rectangles of one depth are cut at once.

    Examples
    --------
    >>> hilbert((2, 2)).tolist(), hilbert((1, 3)).tolist()
    ([0, 2, 3, 1], [0, 1, 2])
    """
    h, w = checks.grid("grid", grid)
    # A curve between neighbouring corners has no diagonal step where the side between them is even.
    across_h = w >= h if w % 2 == h % 2 else w % 2 == 0
    along, across = ((0, w), (h, 0)) if across_h else ((h, 0), (0, w))
    parts = np.array([[0, 0, *along, *across]], np.int32)
    while not np.all(_thin(parts)):
        parts = _cut(parts)
    y, x = _walk(parts)
    return y.astype(np.int64) * w + x


def relatives(grid: Any, levels: int) -> np.ndarray:
    """An order of 2-D wavelet coefficients in which those of one place and size stand together.

    From coarse to fine; in each level along the curve of `hilbert`, the details of a place side by side.

    Parameters
    ----------
    grid : (h, w)
        Coefficients in the layout of Mallat: the approximation at the top left, details of a level beside,
        below and diagonally below it; of a length n the approximation has ceil(n / 2).
    levels : int
        Of the transform, 0 or more.

    Returns
    -------
    (N,) int64
        The row-major index of the coefficient at each place.

    Notes
    -----
    A row of W R W^T needs at 1 % error (diffuse dihedral, N = 4608, db2, 4 levels) 4.1 tiles of 8 in this
    order, 4.6 where each sub-band has a curve of its own, 4.6 where all finer details follow a place as a
    tree, 5.7 in the layout's own order. Of tiles of 16 it is 2.6, 3.5, 3.1 and 4.9.

    Examples
    --------
    >>> relatives((2, 4), 1).tolist()
    [0, 1, 2, 4, 6, 3, 5, 7]
    """
    h, w = checks.grid("grid", grid)
    checks.count("levels", levels, least=0)
    sizes = [(h, w)]
    for _ in range(levels):
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    y, x = np.divmod(hilbert(sizes[-1]), sizes[-1][1])
    details = [_details(fine, coarse, w) for coarse, fine in itertools.pairwise(reversed(sizes))]
    return np.concatenate([y * w + x, *details])


def _details(fine: tuple[int, int], coarse: tuple[int, int], w: int) -> np.ndarray:
    """The coefficients of one level: where sides are odd, the last places lack some of the three."""
    y, x = np.divmod(hilbert(coarse), coarse[1])
    down, right = np.array([[0], [1], [1]]), np.array([[1], [0], [1]])
    y, x = y + down * coarse[0], x + right * coarse[1]
    there = (y < fine[0]) & (x < fine[1])
    return (y * w + x).T[there.T]


def _length(sides: np.ndarray) -> np.ndarray:
    return np.abs(sides.sum(axis=1))


def _thin(parts: np.ndarray) -> np.ndarray:
    """Which are one pixel wide or long. Parts are (n, 6): corner, side along, side across, each (y, x)."""
    return (_length(parts[:, 2:4]) == 1) | (_length(parts[:, 4:6]) == 1)


def _cut(parts: np.ndarray) -> np.ndarray:
    """The parts of the next depth, in order."""
    thin = _thin(parts)
    long = ~thin & (2 * _length(parts[:, 2:4]) > 3 * _length(parts[:, 4:6]))
    square = ~thin & ~long
    counts = 1 + long + 2 * square
    ends = np.cumsum(counts)
    cut = np.empty((ends[-1], 6), parts.dtype)
    for which, pieces in (
        (thin, [parts[thin]]),
        (long, _in_two(parts[long])),
        (square, _in_three(parts[square])),
    ):
        for place, piece in enumerate(pieces):
            cut[(ends - counts)[which] + place] = piece
    return cut


def _in_two(parts: np.ndarray) -> list[np.ndarray]:
    corner, along, across = np.hsplit(parts, 3)
    half = _half(along)
    return [np.hstack([corner, half, across]), np.hstack([corner + half, along - half, across])]


def _in_three(parts: np.ndarray) -> list[np.ndarray]:
    """Up the near side, along the far one, and back down."""
    corner, along, across = np.hsplit(parts, 3)
    a, b = _half(along), _half(across)
    last = corner + along - np.sign(along) + b - np.sign(across)
    return [
        np.hstack([corner, b, a]),
        np.hstack([corner + b, along, across - b]),
        np.hstack([last, -b, a - along]),
    ]


def _half(sides: np.ndarray) -> np.ndarray:
    """About half of each side, and even where that is possible, which spares diagonal steps."""
    length = np.abs(sides)
    half = length // 2
    return np.sign(sides) * (half + ((half % 2 == 1) & (length > 2)))


def _walk(parts: np.ndarray) -> np.ndarray:
    """Pixels (y, x), (2, N), of thin parts, one part after the other."""
    along = np.where(_length(parts[:, 2:4])[:, None] > 1, parts[:, 2:4], parts[:, 4:6])
    count = _length(along)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.repeat(parts[:, :2], count, axis=0).T + place * np.repeat(np.sign(along), count, axis=0).T
