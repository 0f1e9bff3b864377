# SPDX-License-Identifier: BSD-3-Clause
"""Exchange of light between two flat patches from their outlines alone, however near they are.

    a_i F_ij = 1 / (2 pi)  sum over the edges p of i, q of j:  (p . q)  int int ln r  ds dt,   0 < s, t < 1

(Stokes' theorem; p and q are edge vectors that run around the patches' fronts.) The integral along q has
a closed form. Seen from p it is smooth but for logarithms where p passes the ends of q, and where both
lines come closest; so p is cut there, and Gauss points crowd towards the ends of each piece. That
holds to 1e-9 for patches that touch along an edge, at a corner or nearly, at angles from 1 to 179 degrees.

The formula holds for what lies in front of the other patch's plane only; `clip` takes that part.
Far patches lose digits, as the sum cancels: a factor (distance / side)^2 to ^4. `oblique` uses quadrature
there.

Source: Sparrow, "A new and simpler formulation for radiative angle factors", J. Heat Transfer 85, 1963.
"""

from __future__ import annotations

import numpy as np
import scipy.special

TOUCHING, APART = 40, 16
"""Points on each piece of an edge: for patches that touch or nearly, and for others."""

_SLAB = 2048  # pairs of patches at a time, so that temporary arrays stay in the cache


def outline(corner: np.ndarray, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Edges of parallelograms, (P, 4, 2, 3): starts and edge vectors, around the front.

    Parameters
    ----------
    corner : ndarray, (P, 3)
        Top left corners.
    right, down : ndarray, (P, 3) or (3,)
        The edges from there.

    Examples
    --------
    >>> edges = outline(np.zeros((1, 3)), right=np.array([0, 1, 0]), down=np.array([1, 0, 0]))
    >>> edges.shape, edges[0, :, 1].sum(axis=0).tolist()
    ((1, 4, 2, 3), [0.0, 0.0, 0.0])
    """
    starts = np.stack([corner, corner + down, corner + down + right, corner + right], axis=1)
    edges = np.broadcast_to(np.stack([down, right, -down, -right], axis=-2), starts.shape)
    return np.stack([starts, edges], axis=2)


def clip(outlines: np.ndarray, height: np.ndarray) -> np.ndarray:
    """The part of convex outlines with height >= 0, (P, E + 1, 2, 3).

    Parameters
    ----------
    outlines : ndarray, (P, E, 2, 3)
        Starts and edge vectors.
    height : ndarray, (P, E)
        Signed distance of the starts from the plane that cuts.

    Returns
    -------
    ndarray
        The same edges, shortened, to nothing where they lie behind, and one more along the cut.

    Examples
    --------
    >>> square = outline(np.zeros((1, 3)), right=np.array([0, 1, 0]), down=np.array([1, 0, 0]))
    >>> clip(square, height=square[:, :, 0, 0] - 0.75)[0, :, 1].round(2).tolist()[0]
    [0.25, 0.0, 0.0]
    """
    after = np.roll(height, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.clip(np.nan_to_num(height / (height - after)), 0, 1)
    first = np.where(height < 0, cut, 0)
    last = np.where(after < 0, cut, 1)
    hidden = (height < 0) & (after < 0)
    first, last = np.where(hidden, 0, first), np.where(hidden, 0, last)
    starts = outlines[:, :, 0] + first[..., None] * outlines[:, :, 1]
    edges = (last - first)[..., None] * outlines[:, :, 1]
    # The outline leaves the front along one edge at most; what closes it starts there.
    leaving = np.argmax((height >= 0) & (after < 0), axis=1)
    here = np.arange(len(outlines))
    starts = np.concatenate([starts, (starts + edges)[here, leaving][:, None]], axis=1)
    edges = np.concatenate([edges, -edges.sum(axis=1, keepdims=True)], axis=1)
    return np.stack([starts, edges], axis=2)


def exchange(first: np.ndarray, second: np.ndarray, points: int = TOUCHING) -> np.ndarray:
    """a_i F_ij of pairs of patches, (P,), in the unit of the outlines squared.

    Parameters
    ----------
    first, second : ndarray, (P, E, 2, 3)
        Outlines, each wholly in front of the other's plane.
    points : int
        `TOUCHING` or `APART`.

    Examples
    --------
    >>> wall = outline(np.zeros((1, 3)), right=np.array([0, 0, 1]), down=np.array([0, 1, 0]))
    >>> floor = outline(np.zeros((1, 3)), right=np.array([0, 1, 0]), down=np.array([1, 0, 0]))
    >>> exchange(wall, floor).round(6)
    array([0.200044])
    """
    total = np.zeros(len(first))
    for start in range(0, len(first), _SLAB):
        slab = slice(start, start + _SLAB)
        total[slab] = _slab(first[slab], second[slab], points)
    # Patches that hardly see each other may come out a rounding error below zero.
    return np.maximum(total, 0) / (2 * np.pi)


def _slab(first: np.ndarray, second: np.ndarray, points: int) -> np.ndarray:
    total = np.zeros(len(first))
    for p in range(first.shape[1]):
        for q in range(second.shape[1]):
            product = np.einsum("pi,pi->p", first[:, p, 1], second[:, q, 1])
            some = np.flatnonzero(product)
            if len(some):
                total[some] += product[some] * _mean_log(first[some, p], second[some, q], points)
    return total


def _mean_log(p: np.ndarray, q: np.ndarray, points: int) -> np.ndarray:
    """Mean of ln r between points of two segments (P, 2, 3), (P,)."""
    (start, edge), (other, along) = np.moveaxis(p, 1, 0), np.moveaxis(q, 1, 0)
    length = np.linalg.norm(along, axis=1)
    unit = along / length[:, None]
    offset = start - other
    cuts = _cuts(edge, along, offset)
    node, weight = _crowded(points)
    s = cuts[:, :-1, None] + np.diff(cuts, axis=1)[..., None] * node  # (P, pieces, points)
    # Of a point of p: how far along q, and at which distance from its line.
    t0, t1 = np.einsum("pi,pi->p", offset, unit), np.einsum("pi,pi->p", edge, unit)
    across0, across1 = offset - t0[:, None] * unit, edge - t1[:, None] * unit
    t = t0[:, None, None] + t1[:, None, None] * s
    across = across0[:, None, None] + across1[:, None, None] * s[..., None]
    distance = np.sqrt(np.einsum("...i,...i->...", across, across))
    inner = _log_integral(t, distance) - _log_integral(t - length[:, None, None], distance)
    return np.einsum("pkm,m,pk->p", inner, weight, np.diff(cuts, axis=1)) / length


def _cuts(edge: np.ndarray, along: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Where segments p are cut, (P, 5) ascending from 0 to 1: beside the ends of q and nearest its line."""
    square = np.einsum("pi,pi->p", edge, edge)
    here = -np.einsum("pi,pi->p", edge, offset) / square
    there = here + np.einsum("pi,pi->p", edge, along) / square
    normal = np.cross(edge, along)
    spread = np.einsum("pi,pi->p", normal, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.einsum("pi,pi->p", np.cross(along, offset), normal) / spread
    inside = np.clip(np.nan_to_num(np.stack([here, there, nearest], axis=1)), 0, 1)
    ends = np.zeros((len(edge), 1)), np.ones((len(edge), 1))
    return np.concatenate([ends[0], np.sort(inside, axis=1), ends[1]], axis=1)


def _log_integral(t: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """int_0^t ln sqrt(u^2 + distance^2) du."""
    return scipy.special.xlogy(t, t**2 + distance**2) / 2 - t + distance * np.arctan2(t, distance)


def _crowded(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre on [0, 1] under s = u^3 (10 - 15 u + 6 u^2), which flattens logarithms at both ends."""
    node, weight = np.polynomial.legendre.leggauss(points)
    u = (node + 1) / 2
    return u**3 * (10 - 15 * u + 6 * u**2), weight / 2 * 30 * u**2 * (1 - u) ** 2
