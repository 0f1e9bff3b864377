# SPDX-License-Identifier: BSD-3-Clause
"""Form factors of patches that lie close together, touching ones too, at any angle.

    F_ij = 1 / a_i  int_i  P_j(p) da,    P_j(p) = 1 / (2 pi)  sum over edges of j of  angle n_i . normal

P_j(p) is the exact share of the light from a point p that meets patch j: each edge of j, seen from p, spans
an angle in a plane with a normal (Lambert; Baum, Rushmeier and Winget, SIGGRAPH 1989, eq. 7). What lies
behind the plane of patch i is cut off first. P_j is integrated over patch i by Gauss-Legendre quadrature;
between touching patches, where it has no smooth end at the seam, points crowd at the sides of patch i.

Measured: 2e-5 of an entry for touching patches at angles from 20 to 160 degrees, 1e-6 at 90.
Known limit: 1e-2 where the plane of one patch cuts the other; no occlusion.
"""

from __future__ import annotations

import numpy as np
import scipy.spatial

from ltcl.scenes.patches import Patches

_TOUCHING = 2.2  # sizes of a pair within which two patches may touch, at any shape
_POINTS = {True: 16, False: 4}  # quadrature points along a side, for touching patches and others
_AT_ONCE = 1 << 19  # points handled together: tens of megabytes


def squared_size(patches: Patches) -> np.ndarray:
    """(|right|^2 + |down|^2) / 4 of every patch, (N,); the size of a pair is the root of the sum of both."""
    return (np.square(patches.right).sum(axis=1) + np.square(patches.down).sum(axis=1)) / 4


def pairs(patches: Patches, sizes: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs i < j whose centres are within `sizes` of their size and that see each other, boxes aside."""
    squared = squared_size(patches)
    tree = scipy.spatial.KDTree(patches.centre)
    found = tree.query_pairs(sizes * np.sqrt(2 * squared.max()), output_type="ndarray")
    i, j = np.sort(found, axis=1).T if len(found) else np.zeros((2, 0), int)
    offset = patches.centre[j] - patches.centre[i]
    close = np.square(offset).sum(axis=1) < sizes**2 * (squared[i] + squared[j])
    i, j, offset = i[close], j[close], offset[close]
    facing = _above(patches, i, j, offset) & _above(patches, j, i, -offset)
    order = np.lexsort((j[facing], i[facing]))
    return i[facing][order], j[facing][order]


def form_factors(patches: Patches, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """F_ij of listed pairs, (P,) float64: shares of the light from patches i that meet patches j.

    Parameters
    ----------
    patches : Patches
    i, j : (P,) integers

    Examples
    --------
    >>> from ltcl.scenes.box import WALLS
    >>> from ltcl.scenes.patches import cut
    >>> round(float(form_factors(cut(WALLS[:2], 1), np.array([0]), np.array([1]))[0]), 5)
    0.20004
    """
    # From the smaller patch: the larger one is then handled exactly.
    swap = patches.area[i] > patches.area[j]
    i, j, area = np.where(swap, j, i), np.where(swap, i, j), patches.area
    squared = squared_size(patches)
    distance = np.square(patches.centre[j] - patches.centre[i]).sum(axis=1)
    touching = distance < _TOUCHING**2 * (squared[i] + squared[j])
    result = np.empty(len(i))
    for kind, points in _POINTS.items():
        where = np.flatnonzero(touching == kind)
        step = max(1, _AT_ONCE // points**2)
        for start in range(0, len(where), step):
            part = where[start : start + step]
            result[part] = _mean(patches, i[part], j[part], *_rule(points, graded=kind))
    return np.where(swap, result * area[i] / area[j], result)


def _above(patches: Patches, i: np.ndarray, j: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Whether any point of patches j is above the planes of patches i."""
    normal = patches.normal[i]
    rise = sum(np.abs((edge[j] * normal).sum(axis=1)) for edge in (patches.right, patches.down))
    return (offset * normal).sum(axis=1) + rise / 2 > 1e-6 * np.sqrt(squared_size(patches)[j])


def _rule(points: int, graded: bool) -> tuple[np.ndarray, np.ndarray]:
    """Places (-1/2 .. 1/2) along a side and their weights; graded ones crowd at both ends."""
    node, weight = np.polynomial.legendre.leggauss(points)
    t, w = (node + 1) / 2, weight / 2
    if graded:
        t, w = t**3 * (10 - 15 * t + 6 * t**2), w * 30 * t**2 * (1 - t) ** 2
    return t - 0.5, w


def _mean(
    patches: Patches, i: np.ndarray, j: np.ndarray, place: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """P_j averaged over the points of patches i, (P,)."""
    right, down = (edge[i][:, None, :] for edge in (patches.right, patches.down))
    u, v = (axis.ravel()[:, None] for axis in np.meshgrid(place, place))
    points = (patches.centre[i][:, None, :] + u * right + v * down).reshape(-1, 3)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    corners = patches.centre[j][:, None, :] + np.tensordot(
        signs, np.stack([patches.right[j], patches.down[j]]), 1
    ).transpose(1, 0, 2)  # (P, 4, 3)
    many = len(weight) ** 2
    seen = _seen(points, np.repeat(patches.normal[i], many, axis=0), np.repeat(corners, many, axis=0))
    return seen.reshape(len(i), many) @ np.outer(weight, weight).ravel()


def _seen(points: np.ndarray, normals: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Shares of the light from points (M, 3) that meet quadrilaterals (M, 4, 3)."""
    rays = corners - points[:, None, :]
    height = np.einsum("mkc,mc->mk", rays, normals)
    total = np.zeros(len(points))
    leaving, entering = np.zeros_like(points), np.zeros_like(points)
    for k in range(4):
        a, b, up_a, up_b = rays[:, k], rays[:, (k + 1) % 4], height[:, k], height[:, (k + 1) % 4]
        falls, rises = (up_a >= 0) & (up_b < 0), (up_a < 0) & (up_b >= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            horizon = a + (b - a) * (up_a / (up_a - up_b))[:, None]
        leaving[falls], entering[rises] = horizon[falls], horizon[rises]
        start = np.where(rises[:, None], horizon, a)
        end = np.where(falls[:, None], horizon, b)
        total += np.where((up_a >= 0) | (up_b >= 0), _edge(start, end, normals), 0.0)
    total += _edge(leaving, entering, normals)  # along the horizon, where the polygon was cut
    return np.maximum(total, 0.0) / (2 * np.pi)


def _edge(a: np.ndarray, b: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The angle between a and b, times the part of their plane's normal along `normals`."""
    normal = np.cross(a, b)
    length = np.sqrt((normal**2).sum(axis=1))
    angle = np.arctan2(length, (a * b).sum(axis=1))
    return angle * (normal * normals).sum(axis=1) / np.where(length > 0, length, 1.0)
