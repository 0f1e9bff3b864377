# SPDX-License-Identifier: BSD-3-Clause
"""`Movement`: where the light of a projector falls after it was bumped, and its fit to pictures.

A place u on the old projector's picture is now lit by the place G(u) of the new one,

    G(u) = u + sum_k theta_k m_k(u),    m = 1, s, t, s^2, s t, t^2

with s and t the place in halves of the longer side, from the middle: a homography close to the
identity, to second order, and as much of the parallax of a scene. Pixels of the pattern p are even
squares. A camera pixel at u sees its mean over a footprint at G(u), and q is that on the old
pixels, resampled as pictures are: bilinear interpolation of p would be biased by a tenth of a
pixel, since camera pixels that straddle two old pixels count little. With the old transport T and
pictures y on the old pixels, least squares find theta in

    y_k = (y_white / T q_white) T q_k

The factor is the gain of the lamp; that it may vary from place to place keeps light from beyond the
old picture, which T does not know, out of the map. First the whole pixels of a shift are found by
correlation; then theta by damped Gauss-Newton steps on all pictures, with bilinear interpolation
first, which varies more smoothly.

Known limits: where a scene has depth, a projector that is moved, and not turned, sees edges of
objects from another side; one map for the whole picture does not describe that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.acquisition.geometry.footprints import Footprints

# Terms of the map for each of its two coordinates.
TERMS = 6
# Rounds of the inverse of a map, each of which makes its error smaller by a tenth or more.
INVERSE_ROUNDS = 12
# Gauss-Newton steps, and the change in pixels below which they end.
MAX_STEPS = 30
LEAST_CHANGE = 1e-4
# Shift in pixels for derivatives: pictures are linear between pixels.
DERIVATIVE_STEP = 0.02
# Rounds in which pixels are trusted less that are left by more than this times as much as the
# median.
ROBUST_ROUNDS = 3
OUTLIER_RATIO = 3.0
# Damping of the first step, its change when a step succeeds or fails, and its end.
FIRST_DAMPING = 1e-3
DAMPING_FACTOR = 5.0
MAX_DAMPING = 1e6
# Pixels along the shorter side on which a shift is searched for.
SEARCHED_PIXELS = 64
# Share of the light under white that a model of the picture is off by.
MODEL_ERROR = 0.01
# Share of the light of a pixel under white that the old transport must know: what is masked there,
# or was dark and is lit now, tells nothing.
MIN_KNOWN_LIGHT = 0.1
# Share of an old pixel that must be lit to count.
MIN_LIT_SHARE = 0.99
# Least footprint of a camera pixel, so that pictures vary smoothly with the movement.
MIN_FOOTPRINT = 0.1
# Weights of a resampling up to which pictures are foretold on the camera's pixels. With more, a
# projector pixel is the mean of so many that bilinear interpolation is as good.
MAX_WEIGHTS = 1 << 23
# A place that is on no picture.
FAR = -1e6

# Products of the old transport: patterns (k, N) to pictures (k, N, channels).
Products = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Movement:
    """A smooth map G between the pixels of the projector before and after it was bumped.

    Attributes
    ----------
    grid : (h, w)
        Pixels of the projector.
    coefficients : (2, 6)
        theta of rows and of columns, in pixels.

    Examples
    --------
    >>> moved = Movement.shift((4, 6), 0.5, -1.0)
    >>> moved.forward(np.array([1.0]), np.array([2.0]))
    (array([1.5]), array([1.]))
    >>> moved.backward(np.array([1.5]), np.array([1.0]))
    (array([1.]), array([2.]))
    """

    grid: tuple[int, int]
    coefficients: np.ndarray

    @classmethod
    def shift(cls, grid: tuple[int, int], rows: float = 0.0, columns: float = 0.0) -> Movement:
        """A shift of G by rows and columns."""
        coefficients = np.zeros((2, TERMS))
        coefficients[:, 0] = rows, columns
        return cls(grid=grid, coefficients=coefficients)

    @property
    def is_identity(self) -> bool:
        """True if nothing has moved."""
        return not self.coefficients.any()

    @property
    def largest(self) -> float:
        """Largest distance in pixels between a pixel's place before and after."""
        row, column = np.indices(self.grid).reshape(2, -1)
        down, across = self._displacement(row, column)
        return float(np.hypot(down, across).max())

    def forward(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """G: the new place of old places."""
        down, across = self._displacement(row, column)
        return row + down, column + across

    def backward(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of G: the old place of new places."""
        old_row = np.asarray(row, np.float64)
        old_column = np.asarray(column, np.float64)
        for _ in range(INVERSE_ROUNDS):
            down, across = self._displacement(old_row, old_column)
            old_row = row - down
            old_column = column - across
        return old_row, old_column

    def _displacement(self, row: Any, column: Any) -> tuple[np.ndarray, np.ndarray]:
        height, width = self.grid
        half = max(max(self.grid) / 2.0, 1.0)
        t = (np.asarray(row) - (height - 1) / 2.0) / half
        s = (np.asarray(column) - (width - 1) / 2.0) / half
        terms = np.stack([np.ones_like(s), s, t, s * s, s * t, t * t])
        down, across = np.tensordot(self.coefficients, terms, 1)
        return down, across


def interpolation(
    row: np.ndarray,
    column: np.ndarray,
    grid: tuple[int, int],
    *,
    to_rim: bool = False,
    aperture: float = 1.0,
) -> scipy.sparse.csr_array:
    """Weights (n, N) of means of a picture of squares over an aperture at places (n,).

    An aperture of 1 x 1 pixels, the largest, makes it bilinear. Beyond the picture there is 0;
    `to_rim`: the pixels of its rim go on there.

    >>> interpolation(np.array([0.0]), np.array([0.25]), (1, 2)).toarray()
    array([[0.75, 0.25]])
    """
    height, width = grid
    if to_rim:
        row = np.clip(row, 0.0, height - 1.0)
        column = np.clip(column, 0.0, width - 1.0)
    top = np.floor(row).astype(np.int64)
    left = np.floor(column).astype(np.int64)
    down = np.clip((row - top - 0.5) / aperture + 0.5, 0.0, 1.0)
    across = np.clip((column - left - 0.5) / aperture + 0.5, 0.0, 1.0)
    numbers = []
    pixels = []
    weights = []
    for below in (0, 1):
        for right in (0, 1):
            r = top + below
            c = left + right
            weight = np.where(below, down, 1.0 - down) * np.where(right, across, 1.0 - across)
            is_there = (r >= 0) & (r < height) & (c >= 0) & (c < width) & (weight > 0)
            numbers.append(np.flatnonzero(is_there))
            pixels.append((r * width + c)[is_there])
            weights.append(weight[is_there])
    entries = np.concatenate(weights), (np.concatenate(numbers), np.concatenate(pixels))
    return scipy.sparse.csr_array(entries, shape=(len(row), height * width))


@dataclass(frozen=True, eq=False, kw_only=True)
class Views:
    """Pictures of patterns on the old pixels, to which a movement is fitted; white is the first.

    Attributes
    ----------
    grid : (h, w)
    patterns : (k, N)
    pictures, variance : (k, N, channels)
        Light less the ambient one; infinite variance where it is unknown.
    resampling, mapping : Resampling, Correspondence
        How the pictures came from the camera's pixels.
    """

    grid: tuple[int, int]
    patterns: np.ndarray
    pictures: np.ndarray
    variance: np.ndarray
    resampling: Resampling
    mapping: Correspondence

    @cached_property
    def footprint(self) -> float:
        """Width of a camera pixel in projector pixels, from `MIN_FOOTPRINT` to 1."""
        return float(np.clip(Footprints.from_map(self.mapping).width, MIN_FOOTPRINT, 1.0))

    def bilinear(self, movement: Movement) -> scipy.sparse.csr_array:
        """A (N, N) of q = A p under a movement, about."""
        row, column = np.indices(self.grid).reshape(2, -1)
        return interpolation(*movement.forward(row, column), self.grid)

    def resampled(self, movement: Movement) -> scipy.sparse.csr_array:
        """A (N, N) of q = A p under a movement; `bilinear` for a camera of very many pixels."""
        weights = self.resampling.weights
        if weights.nnz > MAX_WEIGHTS:
            return self.bilinear(movement)
        valid = self.mapping.valid.ravel()
        row = np.where(valid, self.mapping.y.ravel(), FAR)
        column = np.where(valid, self.mapping.x.ravel(), FAR)
        places = movement.forward(row.astype(np.float64), column.astype(np.float64))
        seen = interpolation(*places, self.grid, aperture=self.footprint)
        return scipy.sparse.csr_array(weights @ seen)

    @property
    def known(self) -> np.ndarray:
        """Pixels that are known in all pictures, and lit by white, (N, channels)."""
        is_known = np.isfinite(self.variance).all(axis=0)
        return is_known & (self.pictures[0] > 0)


@dataclass(frozen=True, eq=False, kw_only=True)
class MovementFit:
    """A movement, the gain of the lamp (channels,), and what both leave of the pictures.

    `misfit` is relative to the light of the pictures; `typical_misfit` is that of the median pixel,
    which a change of one place does not make larger.
    """

    movement: Movement
    gain: np.ndarray
    misfit: float
    typical_misfit: float


def search_shift(views: Views, largest: float) -> Movement:
    """The shift of whole pixels, up to `largest`, under which pictures are most like patterns."""
    step = max(min(views.grid) // SEARCHED_PIXELS, 1)
    known = views.known.all(axis=1)
    white = np.where(known, views.pictures[0].sum(axis=1), 1.0)
    patterns = []
    pictures = []
    for pattern, picture in zip(views.patterns[1:], views.pictures[1:], strict=True):
        relative = np.where(known, picture.sum(axis=1) / white, 0.0)
        patterns.append(_small(pattern, views.grid, step))
        pictures.append(_small(relative, views.grid, step))
    reach = int(np.ceil(largest / step))
    best = (-np.inf, 0, 0)
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            score = _likeness(patterns, pictures, down, across)
            best = max(best, (score, down, across))
    _, down, across = best
    return Movement.shift(views.grid, float(down * step), float(across * step))


def _small(picture: np.ndarray, grid: tuple[int, int], step: int) -> np.ndarray:
    """Means over squares of `step` pixels of a picture (N,), as far as they are whole."""
    height, width = grid[0] // step, grid[1] // step
    squares = picture.reshape(grid)[: height * step, : width * step]
    return squares.reshape(height, step, width, step).mean(axis=(1, 3))


def _likeness(
    patterns: Sequence[np.ndarray], pictures: Sequence[np.ndarray], down: int, across: int
) -> float:
    """Correlation of pictures with patterns that are read `down` and `across` further."""
    products = 0.0
    squares_of_patterns = 0.0
    squares_of_pictures = 0.0
    height, width = patterns[0].shape
    if abs(down) >= height or abs(across) >= width:
        return -np.inf
    to_rows = slice(max(-down, 0), height - max(down, 0))
    to_columns = slice(max(-across, 0), width - max(across, 0))
    from_rows = slice(max(down, 0), height + min(down, 0))
    from_columns = slice(max(across, 0), width + min(across, 0))
    for pattern, picture in zip(patterns, pictures, strict=True):
        p = pattern[from_rows, from_columns]
        y = picture[to_rows, to_columns]
        p = p - p.mean()
        y = y - y.mean()
        products += float((p * y).sum())
        squares_of_patterns += float((p * p).sum())
        squares_of_pictures += float((y * y).sum())
    return products / np.sqrt(max(squares_of_patterns * squares_of_pictures, 1e-30))


def fit_movement(views: Views, products: Products, first: Movement) -> MovementFit:
    """The movement that explains pictures best, from a first one on, and the gains."""
    movement = first
    for lighting in (views.bilinear, views.resampled):
        search = _Search(views, products, lighting)
        for _ in range(ROBUST_ROUNDS):
            movement = search.run(movement)
            search.trust_less_where_it_fails(movement)
    return search.with_gain(movement)


def no_movement(views: Views, products: Products) -> MovementFit:
    """The gains alone."""
    search = _Search(views, products, views.resampled)
    return search.with_gain(Movement.shift(views.grid))


class _Search:
    """Damped Gauss-Newton steps (Levenberg and Marquardt) of a movement."""

    def __init__(
        self, views: Views, products: Products, lighting: Callable[[Movement], Any]
    ) -> None:
        self.views = views
        self.lighting = lighting
        self.products = products
        known_light = products(views.patterns[:1])[0]
        self.known = views.known & (known_light > MIN_KNOWN_LIGHT * views.pictures[0])
        light = np.maximum(views.pictures[0], np.finfo(float).tiny)
        deviation = np.sqrt(views.variance[1:] + (MODEL_ERROR * light) ** 2)
        self.weight = np.where(self.known, 1.0 / deviation, 0.0)
        self._first_weight = self.weight

    def run(self, movement: Movement) -> Movement:
        """The movement of least squares."""
        damping = FIRST_DAMPING
        is_used = self._lit(movement)
        residual = self._residual(movement, is_used)
        for _ in range(MAX_STEPS):
            is_used = self._lit(movement)
            residual = self._residual(movement, is_used)
            J = self._derivatives(movement, is_used)
            normal = J.T @ J
            downhill = -(J.T @ residual)
            change = 0.0
            while damping < MAX_DAMPING:
                damped = normal + damping * np.diag(np.diagonal(normal) + 1e-12)
                step = np.linalg.lstsq(damped, downhill, rcond=None)[0].reshape(2, TERMS)
                tried = replace(movement, coefficients=movement.coefficients + step)
                tried_residual = self._residual(tried, is_used)
                if tried_residual @ tried_residual < residual @ residual:
                    movement = tried
                    damping /= DAMPING_FACTOR
                    change = np.abs(step).max()
                    break
                damping *= DAMPING_FACTOR
            if change < LEAST_CHANGE:
                break
        return movement

    def trust_less_where_it_fails(self, movement: Movement) -> None:
        """Weigh pixels less that are left as few others are (Cauchy): something changed there."""
        self.weight = self._first_weight
        is_used = self._lit(movement)
        residual = self._residual(movement, is_used).reshape(self.weight.shape)
        square = (residual**2).mean(axis=(0, 2))
        if not square.any():
            return
        typical = np.median(square[square > 0])
        trust = 1.0 / np.sqrt(1.0 + square / (OUTLIER_RATIO**2 * typical))
        self.weight = self._first_weight * trust[:, None]

    def with_gain(self, movement: Movement) -> MovementFit:
        """The gains of the lamp under a movement, and what both leave."""
        picture = self._predict(movement)
        is_known = self.known & self._lit(movement)[:, None]
        model = np.where(is_known, picture, 0.0)
        seen = np.where(is_known, self.views.pictures, 0.0)
        noise = np.where(is_known, self.views.variance, 0.0)
        squares = (model**2).sum(axis=(0, 1))
        gain = (model * seen).sum(axis=(0, 1)) / np.maximum(squares, np.finfo(float).tiny)
        left = ((seen - gain * model) ** 2 - noise).sum(axis=(0, 2))
        light = (seen**2).sum(axis=(0, 2))
        misfit = math.sqrt(max(left.sum(), 0.0) / max(light.sum(), np.finfo(float).tiny))
        typical = 0.0
        if light.any():
            typical = math.sqrt(max(np.median(left[light > 0] / light[light > 0]), 0.0))
        return MovementFit(movement=movement, gain=gain, misfit=misfit, typical_misfit=typical)

    def _predict(self, movement: Movement) -> np.ndarray:
        """T q of all patterns, (k, N, channels)."""
        lit = self.lighting(movement) @ self.views.patterns.T
        return self.products(lit.T)

    def _lit(self, movement: Movement) -> np.ndarray:
        """Old pixels (N,) that are lit by the new picture, and not beside it."""
        return self.lighting(movement).sum(axis=1) > MIN_LIT_SHARE

    def _residual(self, movement: Movement, is_used: np.ndarray) -> np.ndarray:
        """Weighted differences of predictions and pictures but white, which gives the gain."""
        picture = self._predict(movement)
        gain = self.views.pictures[0] / np.maximum(picture[0], np.finfo(float).tiny)
        gain = np.where(self.known & is_used[:, None], gain, 0.0)
        left = (gain * picture[1:] - self.views.pictures[1:]) * self.weight
        return np.where(is_used[:, None], left, 0.0).ravel()

    def _derivatives(self, movement: Movement, is_used: np.ndarray) -> np.ndarray:
        """Derivatives of the residual by all coefficients, (values, 12)."""
        columns = []
        for place in np.ndindex(2, TERMS):
            step = np.zeros((2, TERMS))
            step[place] = DERIVATIVE_STEP
            ahead = replace(movement, coefficients=movement.coefficients + step)
            behind = replace(movement, coefficients=movement.coefficients - step)
            difference = self._residual(ahead, is_used) - self._residual(behind, is_used)
            columns.append(difference / (2.0 * DERIVATIVE_STEP))
        return np.stack(columns, axis=1)
