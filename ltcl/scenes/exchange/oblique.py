# SPDX-License-Identifier: BSD-3-Clause
"""Exact form factors between patches of two walls that stand to each other in any way.

    a_i F_ij = int_i int_j  cos(t_i) cos(t_j) / (pi r^2)  da_j da_i

How two patches of two given walls exchange light depends on the offset of their centres only. Walls
that share an edge direction repeat offsets along it, so each different one is computed once: n^3 of n^4
for walls that meet, n^2 for walls that face each other.

A pair farther apart than it is large takes Gauss-Legendre points on both patches: the kernel is smooth
there and every term positive. Nearer pairs, and those where the plane of one patch cuts the other,
take the integral over both outlines, see `contours`. Tests hold both to 1e-7 of the closed forms at right
angles, and closed rooms of slanted walls to rows that sum to 1. Both ways of a pair come from one number,
so reciprocity is exact.

Known limit: no occlusion, but what lies behind the plane of a patch counts as unseen by it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ltcl import checks
from ltcl.scenes.exchange import contours
from ltcl.scenes.walls import Wall

_TIERS = ((12.0, 3), (4.0, 4), (2.5, 5), (2.0, 6), (1.5, 8))
"""Distance of the centres in radii of both patches from which on so many points a side are enough."""

_TOUCH = 1e-12  # of the patches' size: heights above a plane that are rounding errors
_SLAB = 1 << 16  # pairs of quadrature points at a time, so that they stay in the cache


def exchange(first: Wall, second: Wall, n: int) -> np.ndarray:
    """a_i F_ij between the patches of two walls, (n, n, n, n) float64: rows, columns of both.

    Parameters
    ----------
    first, second : Wall
        They must not cut through each other.
    n : int
        Patches along each side of a wall.

    Examples
    --------
    >>> slope = Wall("slope", corner=(0, 0, 0), right=(0, 1, 0), down=(0.5, 0, 0.75**0.5))
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> from ltcl.scenes.exchange.cube_tables import perpendicular
    >>> upright = Wall("upright", corner=(0, 0, 1), right=(0, 1, 0), down=(0, 0, -1))
    >>> bool(np.isclose(exchange(upright, floor, 1).item(), perpendicular(1).item(), rtol=1e-9))
    True
    """
    one, other = (np.stack([wall.down, wall.right]).astype(np.float64) / n for wall in (first, second))
    start = np.subtract(second.corner, first.corner) + (other.sum(axis=0) - one.sum(axis=0)) / 2
    _, some, pair = np.unique(_offset_code(one, other, n), return_index=True, return_inverse=True)
    index = np.stack(np.unravel_index(some, (n, n, n, n)), axis=1).astype(np.float64)
    offset = start + index[:, 2:] @ other - index[:, :2] @ one
    return _of_offsets(one, other, offset)[pair].reshape(n, n, n, n)


def form_factors(walls: Sequence[Wall], n: int) -> np.ndarray:
    """Form factors of all patches of walls, (N, N) float64, N = n * n * len(walls), without occlusion.

    Parameters
    ----------
    walls : sequence of Wall
        None may cut through another.
    n : int
        Patches along each side of a wall.

    Raises
    ------
    MemoryLimitError
        If the matrix does not fit in the memory of the host.

    Examples
    --------
    >>> from ltcl.scenes.box import WALLS
    >>> bool(np.allclose(form_factors(WALLS, 2).sum(axis=1), 1))  # a closed room loses no light
    True
    """
    size = n * n * len(walls)
    checks.fits_host(f"a {size} x {size} matrix of form factors", 8 * size**2)
    matrix = np.zeros((n, len(walls), n, n, len(walls), n))
    for i, j in itertools.combinations(range(len(walls)), 2):
        fill(matrix, walls, n, i, j)
    return matrix.reshape(size, size)


def fill(matrix: np.ndarray, walls: Sequence[Wall], n: int, i: int, j: int) -> None:
    """Write the form factors between walls i and j, both ways, in a matrix (n, walls, n, n, walls, n)."""
    both = exchange(walls[i], walls[j], n) * n**2
    matrix[:, i, :, :, j, :] = both / walls[i].area
    matrix[:, j, :, :, i, :] = both.transpose(2, 3, 0, 1) / walls[j].area


def _offset_code(first: np.ndarray, second: np.ndarray, n: int) -> np.ndarray:
    """A number for each pair of patches, (n^4,), that tells different offsets apart.

    Where the walls share an edge, up to its sign, only the difference of the counts along it matters.
    """
    index = np.ogrid[:n, :n, :n, :n]
    free = {0, 1, 2, 3}
    parts = []
    for i, edge in enumerate(first):
        for j, other in enumerate(second, start=2):
            for sign in (1, -1):
                if {i, j} <= free and np.allclose(edge, sign * other, rtol=0, atol=_TOUCH * _size(edge)):
                    free -= {i, j}
                    parts.append(index[j] - sign * index[i])
    parts += [index[k] for k in sorted(free)]
    code = np.zeros((n, n, n, n), dtype=np.int64)
    for part in parts:
        code = code * (np.ptp(part) + 1) + (part - part.min())
    return code.ravel()


def _of_offsets(first: np.ndarray, second: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """a_i F_ij of patches with edges (down, right) and centres `offset` (P, 3) apart."""
    facing, cut = _sight(first, second, offset)
    radius = sum(max(_size(e[0] + e[1]), _size(e[0] - e[1])) / 2 for e in (first, second))
    distance = np.linalg.norm(offset, axis=1) / radius
    left = facing & ~cut
    result = np.zeros(len(offset))
    for least, points in _TIERS:
        some = np.flatnonzero(left & (distance >= least))
        result[some] = _quadrature(first, second, offset[some], points)
        left[some] = False
    apart = facing & cut & (distance >= _TIERS[-1][0])
    for some, points in ((apart, contours.APART), (left | (facing & cut & ~apart), contours.TOUCHING)):
        result[some] = _outlines(first, second, offset[some], cut[some], points)
    return result


def _sight(first: np.ndarray, second: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which pairs lie in front of each other at least in part, and which of these only in part."""
    touch = _TOUCH * max(_size(edge) for edge in (*first, *second))
    above = [_heights(first, second, offset), _heights(second, first, -offset)]
    facing = np.all([height.max(axis=1) > touch for height in above], axis=0)
    cut = np.any([height.min(axis=1) < -touch for height in above], axis=0)
    return facing, cut


def _heights(plane: np.ndarray, patch: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Signed distances of a patch's corners from another's plane, (P, 4), around as `contours.outline`."""
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    normal = _normal(plane)
    return (offset @ normal)[:, None] + signs @ patch @ normal


def _outlines(
    first: np.ndarray, second: np.ndarray, offset: np.ndarray, cut: np.ndarray, points: int
) -> np.ndarray:
    """By the integral over both outlines, each clipped by the other's plane where that cuts it."""
    # Counted in patch sides, as the logarithms of a closed outline cancel best near 1.
    unit = _size(first[0])
    first, second, offset = first / unit, second / unit, offset / unit
    centre = np.zeros_like(offset)
    one = contours.outline(centre - first.sum(axis=0) / 2, first[1], first[0])
    other = contours.outline(offset - second.sum(axis=0) / 2, second[1], second[0])
    result = np.empty(len(offset))
    result[~cut] = contours.exchange(one[~cut], other[~cut], points)
    if cut.any():
        over, under = _heights(second, first, -offset[cut]), _heights(first, second, offset[cut])
        clipped = contours.clip(one[cut], over), contours.clip(other[cut], under)
        result[cut] = contours.exchange(*clipped, points)
    return result * unit**2


def _quadrature(first: np.ndarray, second: np.ndarray, offset: np.ndarray, points: int) -> np.ndarray:
    """By points x points Gauss-Legendre points on each patch."""
    node, weight = np.polynomial.legendre.leggauss(points)
    place = np.stack(np.meshgrid(node, node, indexing="ij"), axis=-1).reshape(-1, 2) / 2
    weights = np.outer(weight, weight).ravel() / 4  # (Q,)
    here, there = place @ first, place @ second  # (Q, 3)
    between = (there[None, :] - here[:, None]).reshape(-1, 3)
    square = np.einsum("ki,ki->k", between, between)
    normal, other = _normal(first), _normal(second)
    # The height of a point over the first plane is that of its patch's centre and its own from there.
    moments = np.stack([weights, weights * (there @ normal)], axis=1)
    result = np.empty(len(offset))
    step = max(1, _SLAB // len(square))
    for start in range(0, len(offset), step):
        apart = offset[start : start + step]
        r2 = (2 * apart) @ between.T
        r2 += square
        r2 += np.einsum("pi,pi->p", apart, apart)[:, None]
        np.square(r2, out=r2)
        np.reciprocal(r2, out=r2)
        inner = (r2.reshape(-1, len(weights)) @ moments).reshape(len(apart), -1, 2)
        meet = (apart @ normal)[:, None] * inner[..., 0] + inner[..., 1]
        leave = weights * ((apart @ other)[:, None] - here @ other)
        result[start : start + step] = -np.einsum("pk,pk->p", leave, meet)
    return result * _area(first) * _area(second) / np.pi


def _normal(edges: np.ndarray) -> np.ndarray:
    normal = np.cross(edges[0], edges[1])
    return normal / np.linalg.norm(normal)


def _area(edges: np.ndarray) -> float:
    return _size(np.cross(edges[0], edges[1]))


def _size(vector: np.ndarray) -> float:
    return float(np.linalg.norm(vector))
