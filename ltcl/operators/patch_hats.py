# SPDX-License-Identifier: BSD-3-Clause
"""Sums of pixels under hat functions around the middles of patches, wall by wall."""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.device.kernels import Queued
from ltcl.errors import InputError
from ltcl.operators.bases import Basis
from ltcl.operators.csr import CSR
from ltcl.operators.epilogue import Epilogue

PATCH_HATS = "patch hats"
# Patches around a pixel.
CORNERS = 4
# Bytes on the host of a patch around a pixel, while the sparse matrix is made.
CORNER_BYTES = 64


class PatchHats(Basis):
    """Sums under one hat a patch, (P, N), where each patch covers detail x detail pixels.

    A hat is bilinear between the middles of neighbouring patches of a wall, and constant from the
    outer middles to the edges of the wall, over which it does not reach. The hats add up to 1 at
    each pixel, and each of them sums to detail^2. Not orthonormal.

    Parameters
    ----------
    device : Device
    grid : (h, w)
        Walls side by side, in pixels.
    walls : int
        Number of the walls, which divide w.
    detail : int
        Pixels along a patch; it divides the sides of a wall.

    Attributes
    ----------
    patches : (N, 4) of int
        The patches around each pixel, row-major on the grid of the patches.
    shares : (N, 4) float64
        Their hats at the pixel.
    matrix : (P, N) csr_array
        W on the host.

    Examples
    --------
    Two walls of one patch each, which share nothing:

    >>> import ltcl, numpy
    >>> from ltcl.operators import PatchHats
    >>> W = PatchHats(ltcl.open_device(), (2, 4), walls=2, detail=2)
    >>> (W @ numpy.arange(8.0)).tolist()
    [10.0, 18.0]
    """

    def __init__(self, device: Device, grid: tuple[int, int], walls: int, detail: int) -> None:
        h, w = checks.grid("grid", grid)
        walls = checks.count("walls", walls)
        detail = checks.count("detail", detail)
        if h % detail or w % (walls * detail):
            raise InputError(
                f"grid is {(h, w)}; its sides must be whole numbers of patches of {detail} x "
                f"{detail} pixels on {walls} wall(s)"
            )
        nbytes = CORNER_BYTES * CORNERS * h * w
        checks.fits_host(f"hats of patches on {h} x {w} pixels", nbytes)
        self.walls = walls
        self.detail = detail
        self.patches, self.shares = _corners((h, w), walls, detail)
        self.matrix = _matrix(self.patches, self.shares, h * w // detail**2)
        self._sums = CSR(device, self.matrix)
        super().__init__(device, (h, w), PATCH_HATS, self._sums.shape[0], self._sums)
        self.orthonormal = False
        self.isometric = False

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Name, grid, walls and detail."""
        return {
            **super().to_arrays(),
            "walls": np.array(self.walls),
            "detail": np.array(self.detail),
        }

    def columns_of(self, pixels: np.ndarray) -> scipy.sparse.csr_array:
        """The hats at some pixels, (P, n)."""
        return _matrix(self.patches[pixels], self.shares[pixels], self.shape[0])

    def diagonal_of(self, core: np.ndarray) -> np.ndarray:
        """The diagonal of W^T C W, (N,) float64, for C (P, P) on the host."""
        diagonal = np.zeros(len(self.patches))
        for i in range(CORNERS):
            for j in range(CORNERS):
                entries = core[self.patches[:, i], self.patches[:, j]]
                diagonal += self.shares[:, i] * self.shares[:, j] * entries
        return diagonal

    def _bind_transform(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        return self._sums._bind_product(x, out, epilogue, transpose)


def hats_matrix(grid: tuple[int, int], walls: int, detail: int) -> scipy.sparse.csr_array:
    """W of `PatchHats` on the host, (P, N).

    >>> float(hats_matrix((1, 4), walls=1, detail=1).toarray().trace())
    4.0
    """
    patches, shares = _corners(grid, walls, detail)
    return _matrix(patches, shares, len(patches) // detail**2)


def _matrix(patches: np.ndarray, shares: np.ndarray, count: int) -> scipy.sparse.csr_array:
    """So many hats, (count, n), of those at each of n pixels."""
    pixels = np.repeat(np.arange(len(patches)), CORNERS)
    entries = (shares.ravel(), (patches.ravel(), pixels))
    shape = (count, len(patches))
    matrix = scipy.sparse.csr_array(scipy.sparse.coo_array(entries, shape=shape))
    matrix.eliminate_zeros()
    return matrix


def _corners(grid: tuple[int, int], walls: int, detail: int) -> tuple[np.ndarray, np.ndarray]:
    """The patches around each pixel, and their hats there, both (N, 4)."""
    h, w = grid
    width = w // walls
    patch_columns = w // detail
    rows = _neighbours(h, detail)
    columns = _neighbours(width, detail)
    first = np.arange(walls)[:, None] * (width // detail)
    patches = np.empty((h, walls, width, CORNERS), np.int64)
    shares = np.empty((h, walls, width, CORNERS))
    corner = 0
    for row, row_share in rows:
        for column, column_share in columns:
            places = row[:, None, None] * patch_columns + (first + column)
            patches[..., corner] = places
            shares[..., corner] = row_share[:, None, None] * column_share
            corner += 1
    pixels = math.prod(grid)
    return patches.reshape(pixels, CORNERS), shares.reshape(pixels, CORNERS)


def _neighbours(pixels: int, detail: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The patch before and the patch after each pixel along a side of a wall, and their hats."""
    place = (np.arange(pixels) + 0.5) / detail - 0.5
    before = np.floor(place).astype(np.int64)
    share = place - before
    last = pixels // detail - 1
    return [
        (np.clip(before, 0, last), 1.0 - share),
        (np.clip(before + 1, 0, last), share),
    ]
