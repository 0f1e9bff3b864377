# SPDX-License-Identifier: BSD-3-Clause
"""Exact form factors between equal square patches of parallel and of perpendicular walls.

    F_ij = 1 / a_i  int_i int_j  cos(t_i) cos(t_j) / (pi r^2)  da_j da_i

is the share of the light leaving patch i that meets patch j. On regular grids it depends on the
offset of the two patches only, so a table over all offsets is computed once and a matrix is
gathered from it. Lengths are counted in patch sides; F has no unit, and as all patches are equal
F_ij = F_ji.

Near pairs use the closed form. There F is a mixed second difference, along each of the two or
three offsets, of one primitive function of the offset. That primitive grows as d^2 log d while F
falls as d^-2, and as d^-4 along a seam, so rounding eats up to d^6 log d units in the last place of
the closed form: 1e-9 of an entry at 10 patches, 1e-4 at 60. From `NEAR` patches on the table therefore
uses Gauss-Legendre quadrature: the kernel is analytic there, five points a side are exact to about
1e-10, and a sum of positive terms cannot turn negative, so nothing is ever clipped.

Known limit: no occlusion; the patches must see each other fully, as those of a convex room do.

Source: Ehlert and Smith, "View factors for perpendicular and parallel rectangular plates",
J. Thermophysics and Heat Transfer 7(1), 1993; the same formulas are C-13 (parallel) and C-15
(perpendicular) in Howell, "A catalog of radiation heat transfer configuration factors".
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.special

from ltcl import checks

NEAR = 8
"""Patches from which on quadrature is more accurate than the closed form."""

_POINTS = 5


def parallel(n: int, gap: int) -> np.ndarray:
    """Form factors between patches of two parallel walls of n x n patches.

    Parameters
    ----------
    n : int
        Patches along each side of a wall.
    gap : int
        Distance of the walls in patch sides, at least 1.

    Returns
    -------
    ndarray, (n, n), float64
        Entry [x, y]: the patches lie x and y patches apart along the two sides.

    Raises
    ------
    InputError
        If n or gap is not a whole number of at least 1.

    Notes
    -----
    Ehlert and Smith 1993, eq. for parallel plates (Howell C-13).

    Examples
    --------
    >>> float(parallel(1, gap=1)[0, 0].round(6))  # opposite faces of a cube
    0.199825
    """
    n, gap = checks.count("n", n), checks.count("gap", gap)
    x, y = np.ogrid[:n, :n]
    table = _parallel_quadrature(x, y, gap)
    if gap < NEAR:
        near = min(n, NEAR)
        lattice = np.arange(-1, near + 1, dtype=np.float64)
        primitive = _parallel_primitive(lattice[:, None], lattice, gap)
        table[:near, :near] = np.diff(np.diff(primitive, 2, axis=0), 2, axis=1)
    return table


def perpendicular(n: int) -> np.ndarray:
    """Form factors between patches of two perpendicular walls of n x n patches that share an edge.

    Parameters
    ----------
    n : int
        Patches along each side of a wall.

    Returns
    -------
    ndarray, (n, n, n), float64
        Entry [d, p, q]: d patches apart along the shared edge, the first patch p and the second q
        patches away from that edge (0: touching it). Symmetric in p and q.

    Raises
    ------
    InputError
        If n is not a whole number of at least 1.

    Notes
    -----
    Ehlert and Smith 1993, eq. for perpendicular plates (Howell C-15).

    Examples
    --------
    >>> float(perpendicular(1)[0, 0, 0].round(6))  # neighbouring faces of a cube
    0.200044
    """
    n = checks.count("n", n)
    d, p, q = np.ogrid[:n, :n, :n]
    table = _perpendicular_quadrature(d, p, q)
    near = min(n, NEAR)
    along = np.arange(-1, near + 1, dtype=np.float64)
    edge = np.arange(near + 1, dtype=np.float64)
    primitive = _perpendicular_primitive(along[:, None, None], edge[:, None], edge)
    table[:near, :near, :near] = -np.diff(np.diff(np.diff(primitive, 2, axis=0), axis=1), axis=2)
    return table


def _parallel_primitive(x: np.ndarray, y: np.ndarray, gap: float) -> np.ndarray:
    """C-13: the function whose 4th mixed derivative, twice in x and in y, is gap^2 / (pi r^4)."""
    across_x, across_y = np.hypot(x, gap), np.hypot(y, gap)
    arcs = y * across_x * np.arctan2(y, across_x) + x * across_y * np.arctan2(x, across_y)
    return (arcs - gap**2 / 2 * np.log(x**2 + y**2 + gap**2)) / (2 * np.pi)


def _perpendicular_primitive(d: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """C-15: minus the function whose derivative, twice in d, once in p and q, is p q / (pi r^4)."""
    across = np.hypot(p, q)
    arc = d * across * np.arctan2(d, across)
    # xlogy is 0 at the seam, where patches touch and the logarithm alone would be infinite.
    log = scipy.special.xlogy(across**2 - d**2, across**2 + d**2) / 4
    return (arc - log) / (2 * np.pi)


def _parallel_quadrature(x: np.ndarray, y: np.ndarray, gap: float) -> np.ndarray:
    """F of patches x and y apart: the kernel averaged over both pairs of sides."""
    total = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for (dx, wx), (dy, wy) in itertools.product(_gauss_offset(), repeat=2):
        total += wx * wy / ((x + dx) ** 2 + (y + dy) ** 2 + gap**2) ** 2
    return total * (gap**2 / np.pi)


def _perpendicular_quadrature(d: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """F of patches d apart along the seam and p and q away from it."""
    total = np.zeros(np.broadcast_shapes(d.shape, p.shape, q.shape))
    for (dp, wp), (dq, wq) in itertools.product(_gauss_side(), repeat=2):
        cosines = (wp * wq / np.pi) * (p + dp) * (q + dq)
        across = (p + dp) ** 2 + (q + dq) ** 2
        for dd, wd in _gauss_offset():
            total += wd * cosines / ((d + dd) ** 2 + across) ** 2
    return total


def _gauss_side() -> list[tuple[float, float]]:
    """Gauss-Legendre nodes and weights on [0, 1]: a point on one side of a patch."""
    node, weight = np.polynomial.legendre.leggauss(_POINTS)
    return list(zip((node + 1) / 2, weight / 2, strict=True))


def _gauss_offset() -> list[tuple[float, float]]:
    """Nodes and weights for the difference of a point on each of two sides: density 1 - |t|, |t| < 1.

    The density has a kink at 0, so each half has its own rule.
    """
    half = [(t, w * (1 - t)) for t, w in _gauss_side()]
    return [(-t, w) for t, w in half] + half
