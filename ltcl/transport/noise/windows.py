# SPDX-License-Identifier: BSD-3-Clause
"""Small windows of a grid of pixels, and the detail in them that no smooth light has."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
    detail : (k, p)
        Orthonormal pictures that are orthogonal to polynomials below a degree along each axis.
    grid : (h, w)
    side, order : int
        Pixels along a side, and that degree.
    """

    grid: tuple[int, int]
    side: int
    order: int
    pixels: np.ndarray
    detail: np.ndarray

    @classmethod
    def from_grid(
        cls,
        grid: tuple[int, int],
        side: int,
        order: int,
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
        windows = cls(
            grid=grid,
            side=side,
            order=order,
            pixels=pixels,
            detail=np.zeros((0, 0)),
        )
        return windows.with_order(order)

    @property
    def sides(self) -> tuple[int, int]:
        """Rows and columns of a window."""
        height, width = self.grid
        return min(self.side, height), min(self.side, width)

    def with_order(self, order: int) -> Self:
        """The same windows with detail of degree `order` or more."""
        rows, columns = self.sides
        detail = np.kron(_detail_along(rows, order), _detail_along(columns, order))
        return replace(self, order=order, detail=detail)

    def finest(self) -> Self:
        """The same windows with the highest third of all degrees."""
        return self.with_order(self.side - max(self.side // 3, 1))


def distances(camera: Windows, projector: Windows) -> np.ndarray:
    """Steps between each two windows, (camera windows, projector windows).

    0 or less if they share a pixel; infinite if the grids differ.
    """
    if camera.grid != projector.grid:
        return np.full((len(camera.pixels), len(projector.pixels)), np.inf)
    y, x = np.divmod(camera.pixels, camera.grid[1])
    v, u = np.divmod(projector.pixels, projector.grid[1])
    return np.maximum(_gaps(y, v), _gaps(x, u))


def _gaps(y: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Steps from the range of each row of y to that of each row of v; 0 or less if they meet."""
    above = y.min(axis=1)[:, None] - v.max(axis=1)
    below = v.min(axis=1) - y.max(axis=1)[:, None]
    return np.maximum(above, below)


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
