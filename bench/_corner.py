# SPDX-License-Identifier: BSD-3-Clause
"""R of a right-angled corner of one albedo, dense, with a sixteenth of the work of one inverse.

The corner has two mirror symmetries, left to right and top to bottom. Light that is even or odd
under each of them stays so at every bounce: these are four symmetry classes that never mix. A
quarter of the corner, N / 4 pixels, determines all light of a class, and A there is the sum of its
four mirror images with the signs of the class.

Form factors depend on three offsets only, n^3 numbers for the N^2 = 4 n^4 entries of A: products
with A of 131072 pixels, 69 GB, need a table of 134 MB.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import scipy.linalg
import scipy.sparse.linalg

from ltcl import Transport
from ltcl.acquisition.scanning.sketch import like_nature
from ltcl.scenes import exchange
from ltcl.scenes.scene import transport_matrix

# Change of light from bounce to bounce, relative to direct light, after which others do not count.
LEAST_CHANGE = 1e-6
# Albedos of a textured corner.
COLOURS = (0.7, 0.5, 0.4)


class Bounce:
    """A = albedo F of `ltcl.scenes.dihedral(n, albedo)`, (N, N) with N = 2 n^2, never stored.

    `table` (n, n, n): form factors of patches d apart along the seam, in column p of the left wall,
    which receives the light, and column q of the right one, both counted from the left.
    """

    def __init__(self, n: int, albedo: float) -> None:
        self.n = n
        self.albedo = albedo
        self.grid = (n, 2 * n)
        self.shape = (2 * n * n, 2 * n * n)
        self.table = _form_factors(n)
        # Distances n, n - 1, ..., 0, ..., n - 1 along the seam: an even sequence, 0 at distance n.
        distances = np.abs(np.arange(2 * n) - n)
        padded = np.concatenate([self.table, np.zeros_like(self.table[:1])])
        even = padded[np.roll(distances, n)]
        # The Fourier transform of an even sequence is real: cosine transforms over d.
        self._spectrum = np.ascontiguousarray(np.fft.rfft(even, axis=0).real)

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1 of A, (stop - start, N) float32."""
        n = self.n
        row, column = np.divmod(np.arange(start, stop), 2 * n)
        distances = np.abs(row[:, None] - np.arange(n))
        is_left = column < n
        is_right = ~is_left
        out = np.zeros((stop - start, n, 2 * n), np.float32)
        left_columns = column[is_left, None]
        out[is_left, :, n:] = self.table[distances[is_left], left_columns]
        right_columns = column[is_right, None] - n
        mirrored = self.table.transpose(0, 2, 1)
        out[is_right, :, :n] = mirrored[distances[is_right], right_columns]
        return np.float32(self.albedo) * out.reshape(-1, self.shape[1])

    def matmat(self, x: np.ndarray) -> np.ndarray:
        """A x, (N, k): a convolution along the seam by Fourier transforms, a matrix across."""
        n = self.n
        light = np.asarray(x, np.float64).reshape(n, 2 * n, -1)
        waves = np.fft.rfft(light, 2 * n, axis=0)
        # The spectra are real: real and imaginary parts are columns beside each other.
        columns = waves.view(np.float64)
        on_left = self._spectrum @ columns[:, n:]
        on_right = self._spectrum.transpose(0, 2, 1) @ columns[:, :n]
        received = np.concatenate([on_left, on_right], axis=1)
        bounced = np.fft.irfft(received.view(np.complex128), 2 * n, axis=0)[:n]
        return self.albedo * bounced.reshape(np.shape(x))


class TexturedCorner(scipy.sparse.linalg.LinearOperator):
    """T = (I - diag(albedo) U A V)^-1 diag(albedo direct) of a corner with texture, never stored.

    Light bounces between n x 2 n cells by the form factors A of `Bounce`. V averages the pixels of
    each cell, `step` along both sides, and U interpolates between the middles of cells; for a step
    of 1 both are the identity, and T is exact. The first and the last `margin` columns of pixels
    are left out: neither lit nor seen. The albedo, one number or one a column of pixels, has
    texture like nature, and bricks.
    """

    def __init__(
        self,
        n: int,
        albedo: float | np.ndarray,
        *,
        step: int = 1,
        margin: int = 0,
        seed: int = 0,
    ):
        self.bounce = Bounce(n, 1.0)
        self.cells = (n, 2 * n)
        self.full_grid = (n * step, 2 * n * step)
        self.margin = margin
        self.grid = (n * step, 2 * n * step - 2 * margin)
        pixels = self.grid[0] * self.grid[1]
        super().__init__(np.float64, (pixels, pixels))
        texture = like_nature(self.full_grid, np.random.default_rng(seed))
        row, column = np.indices(self.full_grid)
        bricks = np.where((row // 7 + column // 11) % 2 == 0, 1.0, -1.0)
        variation = 0.5 * texture / np.abs(texture).max() + 0.5 * bricks
        self.albedo = albedo * (0.7 + 0.3 * variation)
        across = np.linspace(0.0, np.pi, self.full_grid[1])
        self.direct = self.albedo * (0.6 + 0.3 * np.cos(across))

    @property
    def first_bounce(self) -> np.ndarray:
        """What pixels send back of the light of their own, (N,)."""
        return self._inside(self.direct).ravel()

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        columns = [self._picture(column.reshape(self.grid)) for column in np.asarray(X).T]
        return np.stack(columns, axis=1)

    def _picture(self, light: np.ndarray) -> np.ndarray:
        """T p of a picture."""
        margins = ((0, 0), (self.margin, self.margin))
        direct = self.direct * np.pad(light.astype(np.float64), margins)
        total = direct
        change = np.inf
        while change > LEAST_CHANGE * np.abs(direct).max(initial=LEAST_CHANGE):
            received = self.bounce.matmat(self._cells(total).ravel()).reshape(self.cells)
            following = direct + self.albedo * self._between(received)
            change = np.abs(following - total).max()
            total = following
        return self._inside(total).ravel()

    def _inside(self, picture: np.ndarray) -> np.ndarray:
        return picture[:, self.margin : self.margin + self.grid[1]]

    def _cells(self, picture: np.ndarray) -> np.ndarray:
        """Means over cells."""
        height, width = self.cells
        return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)

    def _between(self, cells: np.ndarray) -> np.ndarray:
        """Light between the middles of cells."""
        height, width = self.full_grid
        return cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR)


def textured_transport(grid: tuple[int, int], step: int, device: Any) -> Transport:
    """The true transport of a corner in three colours, whose cells have `step` pixels a side."""
    height, width = grid
    cells = height // step
    margin = height - width // 2
    channels = []
    for seed, albedo in enumerate(COLOURS):
        channels.append(TexturedCorner(cells, albedo, step=step, margin=margin, seed=seed))
    direct = np.stack([channel.first_bounce for channel in channels])
    return Transport(channels, grid, first_bounce=direct, device=device)


def _form_factors(n: int) -> np.ndarray:
    """Table of `Bounce`, (n, n, n)."""
    # Axes of the walls: down, right.
    left_wall = np.array(((0, 0, -1), (-1, 0, 0)), np.float64)
    right_wall = np.array(((0, 0, -1), (0, 1, 0)), np.float64)
    d, p, q = np.ogrid[:n, :n, :n]
    offsets = np.broadcast_arrays(p + 0.5 - n, q + 0.5, d)
    layers = []
    for distance in range(n):
        places = np.stack([offset[distance] for offset in offsets], axis=-1)
        offset_factors = exchange.exchange(left_wall, right_wall, places.reshape(-1, 3))
        layers.append(offset_factors.reshape(n, n))
    return np.stack(layers)


def interreflection(n: int, albedo: float, progress: Callable[[str], object]) -> np.ndarray:
    """R = (I - A)^-1 - I of `ltcl.scenes.dihedral(n, albedo)` for even n, (N, N) float32."""
    A = Bounce(n, albedo)
    half = n // 2
    size = n * n // 2
    # 1. Form factors of the upper left quarter, and of its three mirror images, as it sees them.
    left_wall_rows = A.rows(0, A.shape[0] // 2)
    upper = left_wall_rows.reshape(half, 2 * n, n, 2 * n)[:, :n]
    quarters = _quarters(n)
    views = [upper[:, :, v, h].reshape(size, size) for v, h in quarters]
    images = np.stack(views) / albedo
    # 2. One inverse for each symmetry class.
    signs = scipy.linalg.hadamard(4)
    interreflections = np.empty(images.shape)
    for number, class_signs in enumerate(signs):
        progress(f"  bounces of light, symmetry {number + 1} of 4")
        form_factors = np.tensordot(class_signs, images, 1)
        T = transport_matrix(form_factors, np.full(size, albedo), np.ones(size))
        interreflections[number] = T / albedo - np.eye(size)
    # 3. Blocks of R: a quarter and its image see each other by the sum over all classes.
    R = np.empty((n, 2 * n, n, 2 * n), np.float32)
    for image, class_signs in enumerate(signs):
        block = np.tensordot(class_signs / 4, interreflections, 1)
        for receiver in range(4):
            R[(*quarters[receiver], *quarters[receiver ^ image])] = block.reshape(half, n, half, n)
    return R.reshape(A.shape)


def _quarters(n: int) -> list[tuple[slice, slice]]:
    """Rows and columns of the quarters of a corner, each in the order of the upper left one."""
    upper = slice(n // 2)
    lower = slice(None, n // 2 - 1, -1)
    left = slice(n)
    right = slice(None, n - 1, -1)
    return [(upper, left), (upper, right), (lower, left), (lower, right)]
