# SPDX-License-Identifier: BSD-3-Clause
"""Direct light: each camera pixel's answer to its own projector pixel and to those around it.

Under a pattern p of which every small region is lit by a share s, a camera pixel i sees

    y = sum_k D_ik p_k + s g_i + noise,    w = sum_k D_ik + g_i + noise    under white

with k over the pixel and its eight neighbours. Light that bounces comes from everywhere, and so
does not change as the pattern is shifted: it is the constant g_i (Nayar et al. 2006, Fast
separation of direct and global components). D_i and g_i are found by least squares, regularised by

    D_ik ~ N(0, (a_k w_i)^2),    g_i ~ N(0, (a w_i)^2)

as a neighbour's part, by a blurred edge or a map that is off by a part of a pixel, is small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

# Rows and columns from a pixel to those in its row of D, in the order of their numbers; and the
# place of the pixel itself.
OFFSETS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 0), (0, 1), (1, -1), (1, 0), (1, 1))
OWN = 4
# Standard deviations of D and g before anything is known, relative to white: of the pixel itself
# and of light that bounces, and of each neighbour.
OWN_SHARE = 1.0
NEIGHBOUR_SHARE = 0.1
# Part of the light under white by which pictures differ from the model, before it is measured, and
# at least.
FIRST_MISFIT = 0.01
LEAST_MISFIT = 1e-5
# Standard deviations by which white must be above 0 for a pixel to have light.
CLEAR_SIGMAS = 5.0
# Most that a pixel counts in the surprise of a picture.
MAX_SURPRISE = 1e4
# Variance, relative to the square of white, of a picture that is not known.
UNKNOWN_NOISE = 1e9
# Numbers of the equations of pixels at once.
CHUNK_NUMBERS = 1 << 20


@dataclass(frozen=True, eq=False, kw_only=True)
class DirectLight:
    """Direct and indirect light of N pixels in one channel, in the units of their pictures.

    Attributes
    ----------
    direct, variance : (N, 9)
        D at the pixels of `OFFSETS`, and its variance; 0 beyond the rim of the grid.
    indirect : (N,)
        g, all other light under white.
    surprise : (frames,)
        Mean square over pixels of what each picture, white first, differs by from what all others
        foretell, in units of the variance that is expected; about 1.
    """

    direct: np.ndarray
    variance: np.ndarray
    indirect: np.ndarray
    surprise: np.ndarray

    @property
    def is_there(self) -> np.ndarray:
        """Mask (N, 9) of the pixels of `OFFSETS` that exist, at pixels with light."""
        return self.variance > 0


def sparse_rows(
    grid: tuple[int, int], values: np.ndarray, mask: np.ndarray
) -> scipy.sparse.csr_array:
    """`values` (N, 9) at the pixels of `OFFSETS` as a matrix (N, N), those of a mask alone."""
    pixels = len(values)
    row, offset = np.nonzero(mask)
    column = neighbour_numbers(grid)[row, offset]
    entries = (values[row, offset], (row, column))
    return scipy.sparse.csr_array(entries, shape=(pixels, pixels))


def neighbour_numbers(grid: tuple[int, int]) -> np.ndarray:
    """Numbers (N, 9) of the pixels at `OFFSETS` from each pixel of a grid; -1 beyond its rim.

    >>> neighbour_numbers((1, 3))[:, 3:6].tolist()
    [[-1, 0, 1], [0, 1, 2], [1, 2, -1]]
    """
    height, width = grid
    numbers = np.full((height + 2, width + 2), -1)
    numbers[1:-1, 1:-1] = np.arange(height * width).reshape(grid)
    shifted = []
    for down, across in OFFSETS:
        rows = slice(1 + down, 1 + down + height)
        columns = slice(1 + across, 1 + across + width)
        shifted.append(numbers[rows, columns].ravel())
    return np.stack(shifted, axis=1)


def separate(
    grid: tuple[int, int],
    patterns: Sequence[np.ndarray],
    pictures: np.ndarray,
    variances: np.ndarray,
    progress: Callable[[int], None],
) -> DirectLight:
    """Direct and indirect light of one channel.

    `patterns` (h, w) are of 0 and 1, white first; `pictures` and `variances` (frames, N) are of
    them. `progress` is called with the number of pixels that were solved since its last call.
    """
    pixels = pictures.shape[1]
    frames = len(patterns)
    unknowns = len(OFFSETS) + 1
    numbers = neighbour_numbers(grid)
    lit = _lit_beside(patterns)
    shares = np.array([pattern.mean() for pattern in patterns])
    solution = _Solution(pixels, frames)
    misfit = FIRST_MISFIT
    chunk = max(CHUNK_NUMBERS // (frames * unknowns), 1)
    # The first round measures the misfit at some pixels.
    step = max(pixels // chunk, 1)
    sparse_pixels = np.arange(0, pixels, step)
    system = _System(numbers, lit, shares, pictures, variances)
    for _ in range(2):
        misfit = system.solve(sparse_pixels, misfit).misfit
    for start in range(0, pixels, chunk):
        rows = np.arange(start, min(start + chunk, pixels))
        solution.put(rows, system.solve(rows, misfit))
        progress(len(rows))
    return solution.light()


def _lit_beside(patterns: Sequence[np.ndarray]) -> np.ndarray:
    """Patterns (frames, N + 1), with a pixel at the end that is never lit."""
    flat = np.stack([pattern.ravel() for pattern in patterns])
    return np.pad(flat, ((0, 0), (0, 1)))


@dataclass(frozen=True, eq=False, kw_only=True)
class _SolvedPixels:
    """The findings for some pixels: D and g (n, 10), variances, surprise (n, frames), misfit."""

    values: np.ndarray
    variance: np.ndarray
    surprise: np.ndarray
    misfit: float


class _System:
    """The equations of all pixels, which are solved for some of them at a time."""

    def __init__(
        self,
        numbers: np.ndarray,
        lit: np.ndarray,
        shares: np.ndarray,
        pictures: np.ndarray,
        variances: np.ndarray,
    ) -> None:
        self.numbers = numbers
        self.lit = lit
        self.shares = shares
        self.pictures = pictures
        self.variances = variances

    def solve(self, rows: np.ndarray, misfit: float) -> _SolvedPixels:
        """Solve the equations of some pixels, whose pictures differ by `misfit` from the model."""
        white = self.pictures[0, rows].astype(np.float64)
        is_lit = white > CLEAR_SIGMAS * np.sqrt(self.variances[0, rows])
        unit = np.where(is_lit, white, 1.0)[:, None]
        beside = self.numbers[rows]
        # (n, frames, 10): what each unknown adds to each picture.
        A = np.empty((len(rows), len(self.shares), len(OFFSETS) + 1))
        A[:, :, :-1] = self.lit[:, beside].transpose(1, 0, 2)
        A[:, :, -1] = self.shares
        y = self.pictures[:, rows].T / unit
        noise = self.variances[:, rows].T / unit**2 + misfit**2
        weighted = A / noise[:, :, None]
        deviation = np.full(len(OFFSETS) + 1, NEIGHBOUR_SHARE)
        deviation[[OWN, -1]] = OWN_SHARE
        precision = weighted.transpose(0, 2, 1) @ A + np.diag(1.0 / deviation**2)
        covariance = np.linalg.inv(precision)
        values = (covariance @ (weighted.transpose(0, 2, 1) @ y[:, :, None]))[:, :, 0]
        residual = y - (A @ values[:, :, None])[:, :, 0]
        # Part of each picture that the fit takes up: the diagonal of the hat matrix.
        taken = ((A @ covariance) * weighted).sum(axis=2)
        surprise = residual**2 / (noise * np.maximum(1.0 - taken, 1e-9))
        is_known = (noise < UNKNOWN_NOISE) & is_lit[:, None]
        surprise = np.where(is_known, np.minimum(surprise, MAX_SURPRISE), 0.0)
        freedom = np.where(is_known, 1.0 - taken, 0.0).sum()
        camera_noise = np.where(is_known, (1.0 - taken) * (noise - misfit**2), 0.0).sum()
        squares = np.where(is_known, residual**2, 0.0).sum()
        excess = max(squares - camera_noise, 0.0) / max(freedom, 1.0)
        is_there = np.ones(values.shape, bool)
        is_there[:, :-1] = beside >= 0
        is_there &= is_lit[:, None]
        return _SolvedPixels(
            values=np.where(is_there, values * unit, 0.0),
            variance=np.where(is_there, np.diagonal(covariance, axis1=1, axis2=2) * unit**2, 0.0),
            surprise=surprise,
            misfit=max(excess**0.5, LEAST_MISFIT),
        )


class _Solution:
    """Collects the solutions of all pixels."""

    def __init__(self, pixels: int, frames: int) -> None:
        self.values = np.zeros((pixels, len(OFFSETS) + 1), np.float32)
        self.variance = np.zeros((pixels, len(OFFSETS)), np.float32)
        self.surprise = np.zeros(frames)

    def put(self, rows: np.ndarray, solved: _SolvedPixels) -> None:
        """Take the solution of some pixels."""
        self.values[rows] = solved.values
        self.variance[rows] = solved.variance[:, :-1]
        self.surprise += solved.surprise.sum(axis=0)

    def light(self) -> DirectLight:
        """The solution of all pixels."""
        return DirectLight(
            direct=self.values[:, :-1],
            variance=self.variance,
            indirect=self.values[:, -1],
            surprise=self.surprise / max(len(self.values), 1),
        )
