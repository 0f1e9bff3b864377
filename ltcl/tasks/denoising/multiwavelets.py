# SPDX-License-Identifier: BSD-3-Clause
"""Orthonormal bases of T: Kronecker products of bases along the rows and columns of both pictures.

Multiwavelets of 1 to 4 vanishing moments (Alpert, A class of bases in L2 for the sparse
representation of integral operators, 1993) at a few random shifts, whose results are averaged
(cycle spinning: Coifman and Donoho, Translation-invariant de-noising, 1995). They do not cross the
folds between walls where these are known. The singular vectors of an estimate along rows and
columns (De Lathauwer, De Moor and Vandewalle, A multilinear singular value decomposition, 2000) are
a basis of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

Grid = tuple[int, int]
# Where the walls of a picture end, along its rows and along its columns, with 0 and the size.
WallEnds = list[list[int]]

# Trees of wavelets, whose results are averaged.
DEFAULT_SHIFTS = 4
# A scene seldom shows more folds along one axis.
MAX_FOLDS = 3
# Cosine between the light of neighbours, at most, if a fold lies between them.
MAX_FOLD_COSINE = 0.3


@dataclass(frozen=True, kw_only=True)
class SeparableBasis:
    """Orthonormal rows along the rows and columns of a picture, of the camera and the projector."""

    camera: tuple[np.ndarray, np.ndarray]
    projector: tuple[np.ndarray, np.ndarray]

    def forward(self, Z: np.ndarray) -> np.ndarray:
        """Coefficients of Z, both (M, N)."""
        return _transform(Z, (*self.camera, *self.projector))

    def backward(self, C: np.ndarray) -> np.ndarray:
        """Entries of the coefficients C, both (M, N)."""
        transposed = [A.T for A in (*self.camera, *self.projector)]
        return _transform(C, transposed)

    def forward_variance(self, variance: np.ndarray) -> np.ndarray:
        """Variances of coefficients from those of independent entries, both (M, N)."""
        squared = [A * A for A in (*self.camera, *self.projector)]
        return _transform(variance, squared)

    def forward_picture(self, picture: np.ndarray) -> np.ndarray:
        """Coefficients of one picture of the camera, both (M,)."""
        return _transform(picture, self.camera)

    def backward_picture(self, coefficients: np.ndarray) -> np.ndarray:
        """The picture of the camera, (M,), from its coefficients."""
        transposed = [A.T for A in self.camera]
        return _transform(coefficients, transposed)


def multiwavelets(
    grids: tuple[Grid, Grid],
    folds: tuple[WallEnds, WallEnds] | None = None,
    count: int = DEFAULT_SHIFTS,
) -> list[SeparableBasis]:
    """Bases at `count` random shifts, of each wall by itself; grids are of camera and projector."""
    random = np.random.default_rng(0)
    camera_grid, projector_grid = grids
    if folds is None:
        min_moments = 1
        camera_ends = [[0, size] for size in camera_grid]
        projector_ends = [[0, size] for size in projector_grid]
    else:
        min_moments = 2
        camera_ends, projector_ends = folds
    bases = []
    for number in range(count):
        moments = min_moments + number % (count // 2)
        camera = _wavelets_of_picture(camera_ends, moments, random)
        projector = _wavelets_of_picture(projector_ends, moments, random)
        if camera_ends == projector_ends:
            projector = camera
        bases.append(SeparableBasis(camera=camera, projector=projector))
    return bases


def singular_vectors(light: np.ndarray, grid: Grid) -> SeparableBasis:
    """Singular vectors of `light`, (N, N), along rows and columns, of each wall by itself."""
    light = np.maximum(light, 0.0)
    axes = []
    for axis, ends in enumerate(find_folds(light, grid)):
        slices = _slices_along(light, grid, axis).reshape(grid[axis], -1)
        walls = []
        for start, end in pairwise(ends):
            wall = slices[start:end]
            _, vectors = np.linalg.eigh(wall @ wall.T)
            walls.append(vectors.T)
        axes.append(block_diag(*walls))
    rows, columns = axes
    return SeparableBasis(camera=(rows, columns), projector=(rows, columns))


def find_folds(light: np.ndarray, grid: Grid) -> WallEnds:
    """Ends of walls: where neighbours in a picture of `grid` get their light from elsewhere.

    A row of `light` is the light of one pixel of that picture.
    """
    ends_of_axes = []
    for axis, size in enumerate(grid):
        slices = _slices_along(light, grid, axis)
        power = np.einsum("ijk,ijk->i", slices, slices)
        common = np.einsum("ijk,ijk->i", slices[1:], slices[:-1])
        norm = np.sqrt(power[1:] * power[:-1])
        is_dark = norm == 0.0
        cosine = (common + is_dark) / (norm + is_dark)
        ends = [0, size]
        for i in np.argsort(cosine)[:MAX_FOLDS]:
            if cosine[i] < MAX_FOLD_COSINE:
                ends.append(1 + int(i))
        ends_of_axes.append(sorted(ends))
    return ends_of_axes


def _slices_along(light: np.ndarray, grid: Grid, axis: int) -> np.ndarray:
    """The light of each row (axis 0) or each column (axis 1) of a picture, as first axis of 3."""
    return np.moveaxis(light.reshape(*grid, -1), axis, 0)


def _wavelets_of_picture(
    wall_ends: WallEnds, moments: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Multiwavelets along the rows and along the columns of a picture, at random shifts."""
    axes = []
    for ends in wall_ends:
        walls = []
        for start, end in pairwise(ends):
            walls.append(_multiwavelets_of_axis(end - start, moments, random.random()))
        axes.append(block_diag(*walls))
    rows, columns = axes
    return rows, columns


def _multiwavelets_of_axis(n: int, moments: int, shift: float) -> np.ndarray:
    """Orthonormal rows (n, n) on intervals of length 2^k that halve.

    The largest interval begins `shift` * n pixels outside.
    """
    outside = int(shift * n)
    length = 1 << (n + outside - 1).bit_length()
    details: list[np.ndarray] = []
    top = _scaling_functions(n, moments, -outside, length, details)
    return np.vstack([top, *details]).astype(np.float32)


def _scaling_functions(
    n: int, moments: int, start: int, length: int, details: list[np.ndarray]
) -> np.ndarray:
    """Orthonormal functions, (`moments` at most, n), that span the polynomials on an interval.

    The rest of the functions of both halves, with `moments` vanishing moments, joins `details`.
    """
    if start >= n or start + length <= 0:
        return np.zeros((0, n))
    if length == 1:
        return np.eye(n)[start : start + 1]
    half = length // 2
    left = _scaling_functions(n, moments, start, half, details)
    right = _scaling_functions(n, moments, start + half, half, details)
    children = np.vstack([left, right])
    x = (np.arange(n) - start) / length
    degrees = range(min(moments, len(children)))
    powers = np.stack([x**degree for degree in degrees], axis=1)
    Q, _ = np.linalg.qr(children @ powers, "complete")
    details.append(Q.T[moments:] @ children)
    return Q.T[:moments] @ children


def _transform(values: np.ndarray, axes: Sequence[np.ndarray]) -> np.ndarray:
    """`values` with a matrix applied along each axis of its pictures, in the shape of `values`."""
    shape = values.shape
    for A in axes:
        # The first axis becomes the last one.
        values = values.reshape(A.shape[1], -1).T @ A.T
    return values.reshape(shape)
