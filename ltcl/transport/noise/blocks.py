# SPDX-License-Identifier: BSD-3-Clause
"""Blocks of T between a window of the camera and one of the projector, and bounds on their noise.

Light is smooth where the scene has no edge, gloss lobe or first bounce, and noise is not. So
v = median(d^2) / 0.455 of detail d is an upper bound on the variance of entries. There are three
kinds of detail:

- `Windows.detail` along all four axes of a block, orthogonal to smooth light.
- Second differences along one axis of each picture, of T over its row sums: a texture of the wall
  that the camera sees does not matter, and an edge or a dead entry spoils few of them.
- The same, or none, of Z - Z^T, Z_ij = T_ij (d_j / d_i)^(1/2), d from T_ij d_j = T_ji d_i: in a
  reciprocal scene it has no light at all.

An entry of 0 may be noise: a path tracer leaves entries that no path met, a share exp(-L^2 / v) of
those of mean light L. Blocks with more zeros have dead or clipped entries, and tell nothing.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, Self

import numpy as np
import scipy.sparse

from ltcl.transport.noise.windows import Windows, distances

# Types of matrices whose entries are read.
ARRAYS = (np.ndarray, scipy.sparse.csr_array)
# Median of the squares of standard normal values.
MEDIAN_SQUARE = 0.4549
# Least variance, so that logarithms exist.
MIN_VARIANCE = 1e-60
# Part of the exponent L^2 / v that zeros may have, as both are estimates.
ZEROS_EXPONENT = 0.5
# Entries other than 0, at least: fewer may be anything.
MIN_ENTRIES = 16
# Pixels by which a blurred first bounce may reach beyond its own.
BLUR_REACH = 2
# Differences that count as one independent coefficient.
DIFFERENCES_PER_COEFFICIENT = 4
# Steps of the fit of d; smallest d, in medians.
BALANCE_STEPS = 40
MIN_BALANCE = 0.05
# Row sums count as at least this part of their median.
MIN_ROW_SUM = 0.05


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Bounds v on the variance of blocks, (camera windows, projector windows).

    Attributes
    ----------
    camera, projector : Windows
    entries : (camera windows, pixels, projector windows, pixels)
    variance : array
        v, NaN if it is unknown.
    scale, light : array
        The variance is floor^2 (scale + q light) in the model.
    mean_light : array
        Mean light of the entries.
    gauge : array, optional
        d_b / d_a, if v is that of Z - Z^T.
    is_near : array of bool
        True if the windows are so close that a blurred first bounce reaches the block.
    coefficients : int
        Number of details of a block.
    """

    camera: Windows
    projector: Windows
    entries: np.ndarray
    variance: np.ndarray
    scale: np.ndarray
    light: np.ndarray
    mean_light: np.ndarray
    is_near: np.ndarray
    coefficients: int
    gauge: np.ndarray | None = None

    @property
    def is_known(self) -> np.ndarray:
        """True where the variance is known."""
        return np.isfinite(self.variance)

    @property
    def is_smooth(self) -> bool:
        """True if v is of detail along all axes."""
        return self.coefficients == len(self.camera.detail) * len(self.projector.detail)

    def log_floors(self, q: float) -> np.ndarray:
        """Logarithm of floor^2 by each block."""
        variance = np.maximum(self.variance, MIN_VARIANCE)
        return np.log(variance / (self.scale + q * self.light))

    def with_factors(self, rows: np.ndarray, columns: np.ndarray) -> Self:
        """The blocks in a model with factors of rows (M,) and columns (N,)."""
        row_factors = rows[self.camera.pixels].mean(axis=1)
        column_factors = columns[self.projector.pixels].mean(axis=1)
        scale = row_factors[:, None] * column_factors
        light = scale * self.mean_light
        if self.gauge is not None:
            scale = _symmetric_mean(scale, self.gauge)
            light = _symmetric_mean(light, self.gauge)
        return replace(self, scale=scale, light=light)

    def are_enough(self, least: int) -> bool:
        """True if so many are known, a third as many of which hold no blurred first bounce."""
        known = np.count_nonzero(self.is_known)
        far = np.count_nonzero(self.is_known & ~self.is_near)
        return bool(known >= least and 3 * far >= least)


class BlockReader:
    """Entries X of T (M, N) between two sets of windows, and the kinds of blocks from them."""

    def __init__(self, T: Any, camera: Windows, projector: Windows) -> None:
        self.camera = camera
        self.projector = projector
        shape = (*camera.pixels.shape, *projector.pixels.shape)
        X = read_entries(T, camera.pixels.ravel(), projector.pixels.ravel())
        self.X = X.reshape(shape)
        self.light = np.maximum(self.X.mean(axis=(1, 3)), 0.0)
        self.zeros = np.mean(self.X == 0.0, axis=(1, 3))
        self.distance = distances(camera, projector)
        self.variance = detail_variance(self.X, camera, projector)
        self.has_unexplained_zeros = has_unexplained_zeros(self.zeros, self.light, self.variance)
        entries = camera.pixels.shape[1] * projector.pixels.shape[1]
        self.has_unexplained_zeros |= (1.0 - self.zeros) * entries < min(MIN_ENTRIES, entries)

    def kinds(self) -> Iterator[Blocks]:
        """Blocks by each kind of detail."""
        yield self.smooth()
        yield self.flattened()
        if self.camera.grid == self.projector.grid:
            yield self.reciprocal(has_differences=True)
            yield self.reciprocal(has_differences=False)

    def smooth(self) -> Blocks:
        """Blocks by detail along all axes."""
        coefficients = len(self.camera.detail) * len(self.projector.detail)
        return self._blocks(self.X, self.variance, ~self.has_unexplained_zeros, coefficients)

    def flattened(self) -> Blocks:
        """Blocks by differences of T over its row sums."""
        sums = np.einsum("apbq,ab->ap", self.X, self.distance > 0)
        texture = np.maximum(sums / max(np.median(sums), MIN_VARIANCE), MIN_ROW_SUM)
        weight = 1.0 / texture[:, :, None, None]
        return self._blocks_by_differences(self.X, weight)

    def reciprocal(self, has_differences: bool) -> Blocks:
        """Blocks by differences of Z - Z^T, or by Z - Z^T itself."""
        d = self._balance
        root = np.sqrt(d / d[:, :, None, None])
        Z = self.X * root
        E = (Z - Z.transpose(2, 3, 0, 1)) / 2**0.5
        # Dead pixels have no d.
        E[np.isnan(E)] = 0.0
        E[(self.X == 0.0) | (self.X == 0.0).transpose(2, 3, 0, 1)] = 0.0
        if has_differences:
            blocks = self._blocks_by_differences(E, np.ones((1, 1, 1, 1)))
        else:
            values = E.transpose(0, 2, 1, 3).reshape(*self.light.shape, -1)
            blocks = self._blocks_by_values(E, values)
        middle = np.ones(len(d))
        # A window of dead pixels has no difference, and needs no gauge.
        has_light = np.isfinite(d).any(axis=1)
        middle[has_light] = np.nanmedian(d[has_light], axis=1)
        gauge = middle / middle[:, None]
        return replace(
            blocks,
            gauge=gauge,
            scale=_symmetric_mean(np.ones(gauge.shape), gauge),
            light=_symmetric_mean(self.light, gauge),
        )

    @cached_property
    def _balance(self) -> np.ndarray:
        """d (windows, pixels) of T_ij d_j = T_ji d_i, from sums; NaN of pixels without light."""
        n = self.camera.pixels.size
        X = self.X * (self.distance > 0)[:, None, :, None]
        X = X.reshape(n, n)
        sums = X.sum(axis=0)
        has_light = (sums > 0.0) & (X.sum(axis=1) > 0.0)
        d = np.ones(n)
        for _ in range(BALANCE_STEPS):
            # d_i = sum of T_ij d_j over that of T_ji; the mean with the last d ends oscillations.
            following = np.divide(X @ d, sums, out=np.ones(n), where=has_light)
            following = np.maximum(following / np.median(following), MIN_BALANCE)
            d = np.sqrt(d * following)
        is_dead = ~has_light | (d <= MIN_BALANCE * 1.01)
        return np.where(is_dead, np.nan, d).reshape(self.camera.pixels.shape)

    def _blocks_by_differences(self, X: np.ndarray, weight: np.ndarray) -> Blocks:
        differences = _second_differences(np.where(X == 0.0, np.nan, X), weight, self)
        if differences.shape[2] == 0:
            # Windows of less than 3 pixels a side have none.
            differences = np.full((*self.light.shape, 1), np.nan)
        return self._blocks_by_values(X, differences)

    def _blocks_by_values(self, X: np.ndarray, values: np.ndarray) -> Blocks:
        """Blocks of entries X by values (a, b, k); 0 and NaN say nothing."""
        values = np.where(values == 0.0, np.nan, values)
        coefficients = values.shape[2] // DIFFERENCES_PER_COEFFICIENT
        is_known = np.isfinite(values).mean(axis=2) > 0.5
        # Zeros that are noise must not be left out, as the others are then brighter.
        is_known &= (self.zeros == 0.0) | self.has_unexplained_zeros
        with warnings.catch_warnings():
            # A block without a difference has the median NaN.
            warnings.simplefilter("ignore", RuntimeWarning)
            variance = np.nanmedian(values**2, axis=2) / MEDIAN_SQUARE
        return self._blocks(X, variance, is_known, max(coefficients, 1))

    def _blocks(
        self, X: np.ndarray, variance: np.ndarray, is_known: np.ndarray, coefficients: int
    ) -> Blocks:
        # A block with direct light is not smooth.
        is_known &= self.distance > 0
        return Blocks(
            camera=self.camera,
            projector=self.projector,
            entries=X,
            variance=np.where(is_known, variance, np.nan),
            scale=np.ones(self.light.shape),
            light=self.light,
            mean_light=self.light,
            is_near=self.distance <= BLUR_REACH,
            coefficients=coefficients,
        )


def detail_variance(
    X: np.ndarray, camera: Windows | None = None, projector: Windows | None = None
) -> np.ndarray:
    """Median square of the detail of blocks X (a, p, b, q), over that of normal values, (a, b).

    Without windows of the camera, or of the projector, it is detail along the others alone.
    """
    d = X
    if projector is not None:
        d = np.einsum("apbq,jq->apbj", d, projector.detail, optimize=True)
    if camera is not None:
        d = np.einsum("ip,apbj->aibj", camera.detail, d, optimize=True)
    return np.median(d**2, axis=(1, 3)) / MEDIAN_SQUARE


def _second_differences(X: np.ndarray, weight: np.ndarray, reader: BlockReader) -> np.ndarray:
    """Differences of weighted X along one axis of each picture, over their gain, (a, b, k)."""
    shape = (len(X), *reader.camera.sides, X.shape[2], *reader.projector.sides)
    values = (X * weight).reshape(shape)
    weights = np.broadcast_to(weight, X.shape).reshape(shape)
    kinds = [np.zeros((shape[0], shape[3], 0))]
    for axis, other in product((1, 2), (4, 5)):
        if min(shape[axis], shape[other]) < 3:
            continue
        d = np.diff(np.diff(values, 2, axis=axis), 2, axis=other)
        gain2 = _sum_of_squares(_sum_of_squares(weights**2, axis), other)
        d = np.moveaxis(d / np.sqrt(gain2), 3, 1)
        kinds.append(d.reshape(shape[0], shape[3], -1))
    return np.concatenate(kinds, axis=2)


def _sum_of_squares(squares: np.ndarray, axis: int) -> np.ndarray:
    """Squared gain of second differences of values with these squared weights."""
    x = np.moveaxis(squares, axis, 0)
    return np.moveaxis(x[:-2] + 4.0 * x[1:-1] + x[2:], 0, axis)


def _symmetric_mean(x: np.ndarray, gauge: np.ndarray) -> np.ndarray:
    """Mean of x and its transpose, both as factors of the variance of Z."""
    scaled = x * gauge
    return (scaled + scaled.T) / 2


def has_unexplained_zeros(zeros: np.ndarray, light: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """True if noise of a `variance` leaves fewer entries of mean `light` at 0 than `zeros`."""
    exponent = np.full(light.shape, np.inf)
    np.divide(light**2, variance, out=exponent, where=variance > 0.0)
    explained = np.exp(-ZEROS_EXPONENT * exponent)
    return (zeros == 1.0) | (zeros > explained)


def read_entries(T: Any, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """T[rows][:, columns], float64."""
    if not isinstance(T, ARRAYS):
        # A store reads rows in ascending order.
        ascending, order = np.unique(rows, return_inverse=True)
        return np.asarray(T.between(ascending, columns), np.float64)[order]
    # The smaller selection first.
    if len(rows) < len(columns):
        entries: Any = T[rows][:, columns]
    else:
        entries = T[:, columns][rows]
    if scipy.sparse.issparse(entries):
        entries = entries.toarray()
    return np.asarray(entries, np.float64)
