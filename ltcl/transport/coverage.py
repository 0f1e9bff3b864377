# SPDX-License-Identifier: BSD-3-Clause
"""Light that T carries: norms of its columns, and camera pixels that no projector pixel lights.

A camera pixel is unlit if it has no direct light, an entry that is bright beside those of other
pixels, and if its light under white, T 1, is not above all of: 0, a thousandth of the median one,
and 5 standard deviations of its noise. These are of entries, or of an error that the whole row has
in common, such as that of a dark frame, which shows in pixels below 0. A border of the wall beyond
the projector's picture is seen so: no pattern changes it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators import as_operator
from ltcl.transport.first_bounce import ENTRIES

if TYPE_CHECKING:
    from ltcl.transport.transport import Transport

# Products that estimate the norms of columns that cannot be read, to a factor of 2.
NORM_PROBES = 16
# Times the median light of lit camera pixels: 10 stops below it, a picture is black.
UNLIT_SHARE = 1e-3
# Times that median: noise is estimated only if some pixel is below.
FAINT_SHARE = 0.05
# Standard deviations that noise does not exceed, even in a million pixels.
NOISE_SIGMAS = 5.0
# Pixels below 0, at least, whose median tells a standard deviation, and that to this median.
MIN_NEGATIVE_PIXELS = 8
STD_PER_MEDIAN = 1.483
# Times the median brightest entry of lit camera pixels: what is brighter is direct light.
DIRECT_SHARE = 0.2
# Times the median light of lit camera pixels: what is brighter is lit, whatever the noise.
LIT_SHARE = 0.5


def column_norms(T: Transport) -> np.ndarray:
    """Norms of the columns of T as they are coupled, (channels, N), or (1, 3 N) in one system."""
    rows = T.blocks
    if rows is None:
        rows = [T.matrices]
    squares_of_rows = []
    for row in rows:
        squares_of_rows.append([_squared_norms(matrix, T) for matrix in row])
    squares = np.sum(squares_of_rows, axis=0)
    if T.mixing is not None:
        squares = np.square(T.mixing).T @ squares
    return np.sqrt(squares.reshape(len(T.operators), -1))


def _squared_norms(matrix: Any, T: Transport) -> np.ndarray:
    """Squared norms of the columns, (N,) float64.

    With products alone they are estimated by random signs v, as E (A^T v)^2.
    """
    if isinstance(matrix, np.ndarray):
        return np.einsum("ij,ij->j", matrix, matrix, dtype=np.float64)
    if isinstance(matrix, scipy.sparse.csr_array):
        return _squared_norms_of_rows(matrix)
    if hasattr(matrix, "row_blocks"):
        squares = np.zeros(matrix.shape[1])
        for _, rows in matrix.row_blocks():
            squares += _squared_norms_of_rows(rows)
        return squares
    A = as_operator(matrix, T.device)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (A.shape[0], NORM_PROBES))
    return np.mean(np.square(A.T @ signs, dtype=np.float64), axis=1)


def _squared_norms_of_rows(rows: Any) -> np.ndarray:
    squares = rows.data.astype(np.float64) ** 2
    return np.bincount(rows.indices, squares, minlength=rows.shape[1])


def unlit_pixels(T: Transport) -> np.ndarray:
    """Camera pixels (M,) that no projector pixel lights."""
    white, brightest = _light_of_rows(T)
    lit_white = white[white > 0]
    if lit_white.size == 0:
        return np.zeros(len(white), bool)
    median = float(np.median(lit_white))
    least = UNLIT_SHARE * median
    if brightest is None:
        return abs(white) <= least
    is_faint = (white > least) & (white < FAINT_SHARE * median)
    if is_faint.any():
        least = np.maximum(least, NOISE_SIGMAS * _noise_without_light(T))
    below_zero = -white[white < 0]
    if len(below_zero) >= MIN_NEGATIVE_PIXELS:
        sigma = STD_PER_MEDIAN * np.median(below_zero)
        least = np.maximum(least, NOISE_SIGMAS * sigma)
    has_direct_light = brightest > DIRECT_SHARE * np.median(brightest[white > 0])
    return (white <= np.minimum(least, LIT_SHARE * median)) & ~has_direct_light


def _light_of_rows(T: Transport) -> tuple[np.ndarray, np.ndarray | None]:
    """The light of each camera pixel under white, and its brightest entry; None if not shown."""
    matrices = list(T.matrices)
    if T.blocks is not None:
        matrices = [block for row in T.blocks for block in row]
    pattern = np.ones(T.shape[1], np.float32)
    white = np.zeros(T.shape[0])
    for matrix in matrices:
        white += matrix @ pattern
    peaks = []
    for matrix in matrices:
        if hasattr(matrix, "row_blocks"):
            blocks = [_brightest(rows) for _, rows in matrix.row_blocks()]
            peaks.append(np.concatenate(blocks))
        elif isinstance(matrix, ENTRIES):
            peaks.append(_brightest(matrix))
        else:
            return white, None
    return white, np.max(peaks, axis=0)


def _brightest(rows: Any) -> np.ndarray:
    """The largest entry of each row, by absolute value."""
    largest = abs(rows).max(axis=1)
    if scipy.sparse.issparse(largest):
        return largest.toarray().ravel()
    return largest


def _noise_without_light(T: Transport) -> Any:
    """Standard deviation (M,) of T 1 where there is no light; 0 if T has no noise to estimate."""
    try:
        noise = T.noise
    except InputError:
        return 0.0
    projector_pixels = noise.columns.sum(axis=1)
    if T.blocks is not None:
        projector_pixels = 3 * projector_pixels
    variances = noise.rows.T @ (noise.floor**2 * projector_pixels)
    return np.sqrt(variances)
