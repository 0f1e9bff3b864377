# SPDX-License-Identifier: BSD-3-Clause
"""One bounce in a right-angled corner of any size, by rows that are made when they are asked for.

Between two perpendicular walls of n x n patches form factors depend on three offsets only: n^3 numbers for
the N^2 = 4 n^4 entries of A. So A of 131072 pixels, 69 GB, comes from two tables of 67 MB.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.scenes.exchange.cube_tables import perpendicular
from ltcl.scenes.walls import spread_albedo


class CornerRows:
    """A = diag(albedo) F of `ltcl.scenes.dihedral`, row by row, never stored.

    Parameters
    ----------
    n : int
        Patches along each side of the two walls; N = 2 n^2 pixels on a grid (n, 2n).
    albedo : float or (2,) in [0, 1)
        Of both walls, or of the left and the right one: one colour channel.

    Attributes
    ----------
    shape : (N, N)
    grid : (n, 2n)
    first_bounce : (N,) float64
        The albedo of each pixel.

    Raises
    ------
    InputError
        If n or albedo is out of range, or albedo has another shape.
    MemoryLimitError
        If a table of n^3 numbers does not fit the memory of the host.

    Examples
    --------
    >>> import ltcl, numpy
    >>> rows = CornerRows(4, albedo=0.5)
    >>> numpy.allclose(rows.rows(3, 9), ltcl.scenes.dihedral(4, albedo=0.5).A[3:9])
    True
    """

    def __init__(self, n: int, albedo: Any = 0.7) -> None:
        n = checks.count("n", n)
        checks.fits_host(f"form factors of a corner of {n} x {2 * n} pixels", 4 * 8 * n**3)
        patches = spread_albedo(albedo, 2, n)
        if len(patches) != 1:
            raise InputError("albedo has 3 colours; rows are those of one channel: make three")
        self.n, self.grid, self.shape = n, (n, 2 * n), (2 * n * n, 2 * n * n)
        self.first_bounce = patches[0]
        # [d, p, q]: d apart along the seam, p and q the columns of the wall that sees and of the one that is
        # seen, both counted from the left.
        table = perpendicular(n)
        self._of_left = np.ascontiguousarray(table[:, ::-1], np.float32)
        self._of_right = np.ascontiguousarray(table[:, :, ::-1], np.float32)

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1 of A, (stop - start, N) float32."""
        if not 0 <= start <= stop <= self.shape[0]:
            raise InputError(f"rows {start} to {stop} are not among {self.shape[0]}")
        width = 2 * self.n
        parts = [np.zeros((0, self.shape[1]), np.float32)]
        for r in range(start // width, -(-stop // width)):
            first, last = max(start - r * width, 0), min(stop - r * width, width)
            parts.append(self._of_picture_row(r, first, last))
        found = np.concatenate(parts)
        found *= self.first_bounce[start:stop, None].astype(np.float32)
        return found

    def matmat(self, x: np.ndarray) -> np.ndarray:
        """A x, (N, k) float64, of the same float32 form factors as the rows.

        They depend on how far apart two pixels are along the seam, so that this is a convolution there and a
        matrix in the other direction: O(n^3) for each column, by a Fourier transform in float64.
        """
        n = self.n
        x = checks.shape("x", np.asarray(x, np.float64), (self.shape[0], *np.shape(x)[1:2]))
        waves = np.fft.rfft(x.reshape(n, 2 * n, -1), 2 * n, axis=0)
        of_left, of_right = self._spectra
        parts = waves.view(np.float64)  # real and imaginary side by side: the spectra are real
        seen = np.concatenate([of_left @ parts[:, n:], of_right @ parts[:, :n]], axis=1)
        found = np.fft.irfft(seen.view(np.complex128), 2 * n, axis=0)[:n].reshape(x.shape)
        return found * self.first_bounce.reshape(-1, *[1] * (x.ndim - 1))

    @cached_property
    def _spectra(self) -> tuple[np.ndarray, np.ndarray]:
        """Cosine transforms of both tables over the distance, (n + 1, n, n): they are even in it."""
        around = np.abs(np.arange(2 * self.n) - self.n)  # n, n - 1, ..., 0, ..., n - 1, of which n is none
        found = []
        for table in (self._of_left, self._of_right):
            even = np.concatenate([table, np.zeros_like(table[:1])])[np.roll(around, self.n)]
            found.append(np.ascontiguousarray(np.fft.rfft(even.astype(np.float64), axis=0).real))
        return found[0], found[1]

    def _of_picture_row(self, r: int, first: int, last: int) -> np.ndarray:
        """Form factors of pixels first .. last - 1 of row r of the picture, (last - first, N)."""
        n = self.n
        out = np.zeros((last - first, n, 2 * n), np.float32)
        apart = np.abs(np.arange(n) - r)
        split = max(min(last, n) - first, 0)
        out[:split, :, n:] = self._of_left[apart, first : first + split].transpose(1, 0, 2)
        out[split:, :, :n] = self._of_right[apart, max(first - n, 0) : max(last - n, 0)].transpose(1, 0, 2)
        return out.reshape(last - first, self.shape[1])
