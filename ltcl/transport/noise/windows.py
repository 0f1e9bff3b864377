# SPDX-License-Identifier: BSD-3-Clause
"""Small windows of a grid of pixels, and the detail in them that no smooth light has."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np

# Windows that are drawn from those of a grid.
MAX_WINDOWS = 24


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Windows of p pixels each, with k components of detail.

    Attributes
    ----------
    pixels : (windows, p)
        Numbers of the pixels.
    weight : (windows, p)
        1 / texture of the pixels.
    detail : (k, p)
        Orthonormal pictures that are orthogonal to polynomials below a degree along each axis.
    gain : (windows, k)
        Standard deviation of the detail of weighted noise of 1.
    """

    pixels: np.ndarray
    weight: np.ndarray
    detail: np.ndarray
    gain: np.ndarray

    @classmethod
    def from_grid(
        cls,
        grid: tuple[int, int],
        side: int,
        order: int,
        texture: np.ndarray,
        overlap: bool = False,
    ) -> Self:
        """Windows of `side` pixels a side with detail of degree `order` or more.

        All of them if they may `overlap`, else at most 24 that do not.
        """
        sides = [min(side, pixels) for pixels in grid]
        corners = _corners(grid, sides, overlap)
        if len(corners) > MAX_WINDOWS and not overlap:
            random = np.random.default_rng(0)
            chosen = random.choice(len(corners), MAX_WINDOWS, replace=False)
            corners = corners[np.sort(chosen)]
        y = corners[:, [0]] + np.arange(sides[0])
        x = corners[:, [1]] + np.arange(sides[1])
        pixels = y[:, :, None] * grid[1] + x[:, None, :]
        pixels = pixels.reshape(len(corners), -1)
        detail = np.kron(_detail_along(sides[0], order), _detail_along(sides[1], order))
        weight = 1.0 / texture[pixels]
        gain = np.sqrt(weight**2 @ detail.T**2)
        return cls(pixels=pixels, weight=weight, detail=detail, gain=gain)


def _corners(grid: tuple[int, int], sides: list[int], overlap: bool) -> np.ndarray:
    """Row and column of the first pixel of each window, (windows, 2)."""
    starts = []
    for pixels, side in zip(grid, sides, strict=True):
        count = pixels - side + 1 if overlap else pixels // side
        starts.append(np.linspace(0, pixels - side, count).astype(int))
    return np.array(list(product(*starts)))


def _detail_along(side: int, order: int) -> np.ndarray:
    """Orthonormal polynomials of degree `order` or more on `side` points, at least one of them."""
    centred = np.arange(side) - (side - 1) / 2
    polynomials = np.linalg.qr(np.vander(centred, increasing=True))[0]
    return polynomials[:, min(order, side - 1) :].T
