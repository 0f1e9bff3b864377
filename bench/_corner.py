# SPDX-License-Identifier: BSD-3-Clause
"""R of a right-angled corner of one albedo, dense, with a sixteenth of the work of one inverse.

The corner has two mirrors, from left to right and from top to bottom. Light that is even or odd
under each of them stays so at every bounce: four kinds that never mix. A quarter of the corner, N /
4 pixels, tells all of such light, and A there is the sum of its four mirror images with the signs
of the kind.

Form factors depend on three offsets only, n^3 numbers for the N^2 = 4 n^4 entries of A: products
with A of 131072 pixels, 69 GB, take a table of 134 MB.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg

from ltcl.scenes import exchange
from ltcl.scenes.scene import transport_matrix


class Bounce:
    """A = albedo F of `ltcl.scenes.dihedral(n, albedo)`, (N, N) with N = 2 n^2, never stored.

    `table` (n, n, n): form factors of patches d apart along the seam, in column p of the left wall,
    which sees, and column q of the right one, both counted from the left.
    """

    def __init__(self, n: int, albedo: float) -> None:
        self.n, self.albedo, self.grid, self.shape = n, albedo, (n, 2 * n), (2 * n * n, 2 * n * n)
        left, right = np.array(
            [((0, 0, -1), (-1, 0, 0)), ((0, 0, -1), (0, 1, 0))], np.float64
        )  # down, right
        d, p, q = np.ogrid[:n, :n, :n]
        offsets = np.broadcast_arrays(p + 0.5 - n, q + 0.5, d)
        places = (np.stack([each[k] for each in offsets], axis=-1).reshape(-1, 3) for k in range(n))
        self.table = np.stack(
            [exchange.exchange(left, right, place).reshape(n, n) for place in places]
        )
        around = np.abs(np.arange(2 * n) - n)  # n, n - 1, ..., 0, ..., n - 1, of which n is none
        even = np.concatenate([self.table, np.zeros_like(self.table[:1])])[np.roll(around, n)]
        self._spectrum = np.ascontiguousarray(
            np.fft.rfft(even, axis=0).real
        )  # cosine transforms over d

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1 of A, (stop - start, N) float32."""
        n, (row, column) = self.n, np.divmod(np.arange(start, stop), 2 * self.n)
        apart, left, right = np.abs(row[:, None] - np.arange(n)), column < n, column >= n
        out = np.zeros((stop - start, n, 2 * n), np.float32)
        out[left, :, n:] = self.table[apart[left], column[left, None]]
        out[right, :, :n] = self.table.transpose(0, 2, 1)[apart[right], column[right, None] - n]
        return np.float32(self.albedo) * out.reshape(-1, self.shape[1])

    def matmat(self, x: np.ndarray) -> np.ndarray:
        """A x, (N, k): a convolution along the seam, by a Fourier transform, and a matrix across it."""
        n = self.n
        waves = np.fft.rfft(np.asarray(x, np.float64).reshape(n, 2 * n, -1), 2 * n, axis=0)
        parts = waves.view(np.float64)  # real and imaginary side by side: the spectra are real
        of_left, of_right = self._spectrum, self._spectrum.transpose(0, 2, 1)
        seen = np.concatenate([of_left @ parts[:, n:], of_right @ parts[:, :n]], axis=1)
        light = np.fft.irfft(seen.view(np.complex128), 2 * n, axis=0)[:n]
        return self.albedo * light.reshape(np.shape(x))


def interreflection(n: int, albedo: float, progress: Callable[[str], object]) -> np.ndarray:
    """R = (I - A)^-1 - I of `ltcl.scenes.dihedral(n, albedo)` for even n, (N, N) float32."""
    A, half, size = Bounce(n, albedo), n // 2, n * n // 2
    upper = A.rows(0, A.shape[0] // 2).reshape(half, 2 * n, n, 2 * n)[:, :n]
    down, right = slice(None, half - 1, -1), slice(None, n - 1, -1)
    quarters = [(v, h) for v in (slice(half), down) for h in (slice(n), right)]
    images = np.stack([upper[:, :, v, h].reshape(size, size) for v, h in quarters]) / albedo
    signs = scipy.linalg.hadamard(4)
    kinds = np.empty(images.shape)
    for number, kind in enumerate(kinds):
        progress(f"  bounces of light, kind {number + 1} of 4")
        form_factors = np.tensordot(signs[number], images, 1)
        kind[:] = transport_matrix(
            form_factors, np.full(size, albedo), np.ones(size)
        ) / albedo - np.eye(size)
    R = np.empty((n, 2 * n, n, 2 * n), np.float32)
    for image, of_kinds in enumerate(signs):
        block = np.tensordot(of_kinds / 4, kinds, 1).reshape(half, n, half, n)
        for seen in range(4):
            R[(*quarters[seen], *quarters[seen ^ image])] = block
    return R.reshape(A.shape)
