# SPDX-License-Identifier: BSD-3-Clause
"""Light of one bounce between parts of the picture: what is negative, and what is ambient.

In a Lambertian scene I - S^-1 = A (eq. 4), and A takes no light away from anywhere. One view of
glossy surfaces is T = P S F Q (eq. 28, section 8.4); the matrix in the place of A then has negative
entries. They are summed between parts of the picture, 4 x 4 rectangles, over whose pixels the noise
of a measurement averages out; within a part, a biased first bounce makes negative entries, too.

Measured: 0 for diffuse boxes, 0.0004 for a path-traced diffuse corner; for a glossy corner 0.005,
0.013, 0.034 and 0.13 with shares of 0.05, 0.1, 0.2 and 0.4 of glossy reflection.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ltcl.errors import ConvergenceError
from ltcl.operators import IdentityPlus, Operator
from ltcl.solvers import solve

# Parts along each side of the picture for negative light; twice as many for ambient light.
PARTS_PER_SIDE = 4
AMBIENT_PARTS_PER_SIDE = 8
# Pixels of a picture whose parts tell ambient light from a bounce, at least.
MIN_AMBIENT_PIXELS = 64
# Solves for negative light: far below the smallest share that counts.
SOLVE_RTOL = 1e-3
# Solves for ambient light.
AMBIENT_SOLVE_RTOL = 1e-2


def negative_bounce(
    S: IdentityPlus, grid: tuple[int, int], allowed: np.ndarray | float = 0.0
) -> float:
    """Share of light that one bounce between parts of the picture takes away.

    In [0, 1], and 0 in a Lambertian scene; NaN if no method solves with S. A few products with 16
    right-hand sides. `allowed` is the mean light between parts, (parts, parts), up to which noise
    explains what is negative.

    Examples
    --------
    >>> from ltcl.scenes import dihedral
    >>> negative_bounce(dihedral(4).transport().interreflection, (4, 8)) < 1e-3
    True
    """

    def inverse(parts: np.ndarray) -> np.ndarray:
        return solve(S.as_it_stands(), parts, rtol=SOLVE_RTOL).x

    try:
        between = between_parts(inverse, grid, PARTS_PER_SIDE)
    except ConvergenceError:
        return float("nan")
    light = np.nansum(np.abs(between))
    if light == 0.0:
        return 0.0
    return float(np.nansum(np.maximum(-between - allowed, 0.0)) / light)


def between_parts(
    inverse: Callable[[np.ndarray], Any], grid: tuple[int, int], side: int, step: int = 1
) -> np.ndarray:
    """Mean light that each part of a picture gets from each `step`-th one in a bounce.

    It is NaN within a part. `inverse` is S^-1 of (N, k); the picture has `side` parts along each
    side.
    """
    # Indicators e of the parts.
    parts = picture_parts(grid, side)
    pixels = parts.sum(axis=0)
    sources = parts[:, ::step]
    # e^T A e
    light = parts.T @ (sources - inverse(sources))
    between = light / (pixels[:, None] * pixels[::step])
    np.fill_diagonal(between[::step], np.nan)
    return between


def picture_parts(grid: tuple[int, int], side: int) -> np.ndarray:
    """Indicators (N, parts) of rectangles, `side` along each side of a picture."""
    height, width = grid
    part_rows = np.arange(height) * min(side, height) // height
    part_columns = np.arange(width) * min(side, width) // width
    number = (part_rows[:, None] * (part_columns[-1] + 1) + part_columns).ravel()
    return (number[:, None] == np.arange(number[-1] + 1)).astype(np.float64)


def ambient(inverse: Callable[[np.ndarray], Any], grid: tuple[int, int], step: int = 1) -> float:
    """Least light of `between_parts` over its mean.

    A flat wall does not light itself, but ambient light that is left in T does.
    """
    between = between_parts(inverse, grid, AMBIENT_PARTS_PER_SIDE, step)
    least_axis = 1 if step == 1 else 0
    least = float(np.median(np.nanmin(between, axis=least_axis)))
    mean = float(np.nanmean(np.abs(between)))
    return max(least, 0.0) / max(mean, 1e-300)


def ambient_share(systems: Sequence[IdentityPlus], grid: tuple[int, int]) -> float:
    """`ambient` of the worst channel, from every 7th part alone; 0 if it is not known.

    Pictures of fewer than 64 pixels have too few parts, and a solve may not converge.
    """
    if grid[0] * grid[1] < MIN_AMBIENT_PIXELS:
        return 0.0
    shares = []
    try:
        for S in systems:
            undo = partial(_undo_coarsely, S.as_it_stands())
            shares.append(ambient(undo, grid, step=7))
    except ConvergenceError:
        return 0.0
    return max(shares)


def _undo_coarsely(S: Operator, light: np.ndarray) -> np.ndarray:
    return solve(S, light, rtol=AMBIENT_SOLVE_RTOL).x
