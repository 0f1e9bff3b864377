# SPDX-License-Identifier: BSD-3-Clause
"""Exact form factors between flat patches at any angle and distance, without occlusion.

    a_i F_ij = int_i int_j  cos(t_i) cos(t_j) / (pi r^2)  da_j da_i
             = 1 / (2 pi)  sum over the edges p of i, q of j:  (p . q)  int int ln r  ds dt,   0 <
             s, t < 1

(the second line by Stokes' theorem; p and q run around the fronts). Pairs farther apart than they
are large take Gauss-Legendre points on both patches: the kernel is smooth there and every term
positive. Nearer pairs, and those where the plane of one patch cuts the other, take the integral
over both outlines, of what lies in front: along q it has a closed form, and along p it is smooth
but for logarithms where p passes the ends of q and where both lines come closest, so p is cut there
and Gauss points crowd towards the ends of each piece. Far patches would lose digits so, a factor
(distance / side)^2 to ^4, as the sum cancels.

Tests hold all of it to 1e-9 of the closed forms at right angles, for patches that touch along an
edge, at a corner or nearly as well, and closed rooms of slanted walls to rows that sum to 1.

Source: Sparrow, "A new and simpler formulation for radiative angle factors", J. Heat Transfer 85,
1963.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
import scipy.special

from ltcl import checks
from ltcl.scenes.patches import Patches
from ltcl.scenes.walls import Wall

_TIERS = ((20.0, 3), (7.0, 4), (4.0, 5), (3.0, 6), (2.0, 8))
"""Distance of the centres in radii of both patches from which on so many points a side are enough."""

_TOUCHING, _APART = 40, 16  # points on each piece of an edge: nearer than all tiers, and farther
_FLAT = 1e-12  # of the patches' size: heights above a plane that are rounding errors
_SLAB = 4096  # pairs of patches at a time, so that temporary arrays stay in the cache
# where (down, right) of a picture lie after quarter turns, and mirrored: order and signs
_TURNS = {
    (turn, mirror): (order[::step], sign[::step])
    for turn, (order, sign) in enumerate(
        (((0, 1), (1, 1)), ((1, 0), (1, -1)), ((0, 1), (-1, -1)), ((1, 0), (-1, 1)))
    )
    for mirror, step in ((False, 1), (True, -1))
}
_AROUND = (
    np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
)  # corners of a patch, in edges (down, right)


def form_factors(walls: Sequence[Wall], n: int) -> np.ndarray:
    """Form factors of all patches of walls, (N, N) float64, N = n * n * len(walls), without occlusion.

    None of the walls may cut through another. MemoryLimitError: the host has no room for the
    matrix.

    >>> from ltcl.scenes.builders import WALLS
    >>> bool(np.allclose(form_factors(WALLS, 2).sum(axis=1), 1))  # a closed room loses no light
    True
    """
    size = n * n * len(walls)
    checks.fits_host(f"a {size} x {size} matrix of form factors", 8 * size**2)
    matrix = np.zeros((n, len(walls), n, n, len(walls), n))
    fill(matrix, walls, itertools.combinations(range(len(walls)), 2))
    return matrix.reshape(size, size)


def fill(matrix: np.ndarray, walls: Sequence[Wall], pairs: Iterable[tuple[int, int]]) -> None:
    """Write the form factors between pairs of walls, both ways, in a matrix (n, walls, n, n, walls, n)."""
    n = len(matrix)
    known: dict[bytes, np.ndarray] = {}
    for i, j in pairs:
        key, turn, other_turn, mirror = _congruent(walls[i], walls[j])
        axes = (1, 0, 3, 2) if mirror else (0, 1, 2, 3)
        if key not in known:
            both = np.rot90(of_walls(walls[i], walls[j], n), -turn, axes=(0, 1))
            known[key] = np.rot90(both, -other_turn, axes=(2, 3)).transpose(axes)
        both = np.rot90(
            np.rot90(known[key].transpose(axes), turn, axes=(0, 1)), other_turn, axes=(2, 3)
        )
        matrix[:, i, :, :, j, :] = both * (n**2 / walls[i].area)
        matrix[:, j, :, :, i, :] = both.transpose(2, 3, 0, 1) * (n**2 / walls[j].area)


def _congruent(first: Wall, second: Wall) -> tuple[bytes, int, int, bool]:
    """What congruent pairs of walls have in common, and the turns of their pictures that make it so.

    That is the lengths and angles of edges (down, right), normals, and the way from middle to
    middle, of all quarter turns of both pictures the first in order. Mirror images have rows for
    columns.
    """
    edges = [np.array([wall.down, wall.right], np.float64) for wall in (first, second)]
    offset = (
        np.subtract(second.corner, first.corner) + (edges[1].sum(axis=0) - edges[0].sum(axis=0)) / 2
    )
    vectors = np.array([*edges[0], first.normal, *edges[1], second.normal, offset])
    vectors[[0, 1, 3, 4, 6]] /= np.linalg.norm(edges[0][0])
    gram = (vectors @ vectors.T).round(9)
    keys = []
    for turn, other_turn, mirror in itertools.product(range(4), range(4), (False, True)):
        (order, sign), (other_order, other_sign) = _TURNS[turn, mirror], _TURNS[other_turn, mirror]
        places = [*order, 2, *(3 + k for k in other_order), 5, 6]
        signs = np.array([*sign, 1, *other_sign, 1, 1])
        turned = gram[np.ix_(places, places)] * np.outer(signs, signs) + 0.0  # no -0
        keys.append((turned.tobytes(), turn, other_turn, mirror))
    return min(keys)


def of_walls(first: Wall, second: Wall, n: int) -> np.ndarray:
    """a_i F_ij between the patches of two walls, (n, n, n, n) float64: rows, columns of both.

    It depends on the offset of the patches alone, so each offset is computed once: about 2 n^3 for
    walls that share an edge, 4 n^2 for walls that face each other.
    """
    edges, others = (
        np.stack([wall.down, wall.right]).astype(np.float64) / n for wall in (first, second)
    )
    index = np.ogrid[:n, :n, :n, :n]
    steps, counts, free = [], [], {0, 1, 2, 3}
    for i, j, sign in itertools.product((0, 1), (2, 3), (1, -1)):
        tolerance = _FLAT * np.linalg.norm(edges[i])
        alike = np.allclose(edges[i], sign * others[j - 2], rtol=0, atol=tolerance)
        if (
            alike and {i, j} <= free
        ):  # only the difference of the counts along a shared edge matters
            free -= {i, j}
            steps.append(others[j - 2])
            counts.append(index[j] - sign * index[i])
    steps += [others[k - 2] if k > 1 else -edges[k] for k in sorted(free)]
    counts += [index[k] for k in sorted(free)]
    ranges = np.meshgrid(
        *(np.arange(count.min(), count.max() + 1) for count in counts), indexing="ij"
    )
    start = np.subtract(second.corner, first.corner) + (others.sum(axis=0) - edges.sum(axis=0)) / 2
    offsets = start + np.stack(ranges, axis=-1) @ np.array(steps)
    table = exchange(edges, others, offsets.reshape(-1, 3)).reshape(offsets.shape[:-1])
    return table[tuple(count - count.min() for count in counts)]


def of_pairs(patches: Patches, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """F_ij of listed pairs of patches, (P,) float64: shares of the light from patches i that meet patches j.

    For pairs a few sizes apart at most: to 1e-6 of an entry up to 10 sizes.

    >>> from ltcl.scenes import box, cut
    >>> patches = cut(box(1, sides=2).walls, 1)
    >>> round(float(of_pairs(patches, np.array([0]), np.array([1]))[0]), 5)
    0.20004
    """
    edges = np.stack([patches.down, patches.right], axis=1)
    return exchange(edges[i], edges[j], patches.centre[j] - patches.centre[i]) / patches.area[i]


def exchange(first: np.ndarray, second: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """a_i F_ij of pairs of patches whose centres are `offset` (P, 3) apart, (P,).

    The edges (down, right) are those of all pairs, (2, 3), or of each, (P, 2, 3): these take
    outlines only.
    """
    result = np.empty(len(offset))
    for start in range(0, len(offset), _SLAB):
        slab = slice(start, start + _SLAB)
        pair = [edges if edges.ndim == 2 else edges[slab] for edges in (first, second)]
        result[slab] = _slab(pair[0], pair[1], offset[slab])
    return result


def _slab(first: np.ndarray, second: np.ndarray, offset: np.ndarray) -> np.ndarray:
    radius = sum(
        np.linalg.norm(e @ ((1, 1), (1, -1)), axis=-2).max(axis=-1) / 2
        for e in (first.swapaxes(-1, -2), second.swapaxes(-1, -2))
    )
    over, under = _heights(first, second, offset), _heights(second, first, -offset)
    level = _FLAT * np.asarray(radius)[..., None]
    over, under = (np.where(np.abs(height) < level, 0.0, height) for height in (over, under))
    left = (over.max(axis=1) > 0) & (under.max(axis=1) > 0)
    whole = (over.min(axis=1) >= 0) & (under.min(axis=1) >= 0)
    distance = np.linalg.norm(offset, axis=1) / radius
    result = np.zeros(len(offset))
    for least, points in _TIERS if first.ndim == 2 else ():
        some = np.flatnonzero(left & whole & (distance >= least))
        if len(some):
            result[some] = _quadrature(first, second, offset[some], points)
            left[some] = False
    if not left.any():
        return result
    first, second = (np.broadcast_to(edges, (len(offset), 2, 3)) for edges in (first, second))
    unit = np.broadcast_to(radius, len(offset))  # logarithms of a closed outline cancel best near 1
    for near, clipped in itertools.product((True, False), repeat=2):
        some = np.flatnonzero(left & ((distance < _TIERS[-1][0]) == near) & (whole != clipped))
        if len(some):
            scale = unit[some, None, None, None]
            outline = _outline(first[some], np.zeros((1, 3))) / scale
            opposite = _outline(second[some], offset[some]) / scale
            if clipped:
                outline, opposite = _clip(outline, under[some]), _clip(opposite, over[some])
            result[some] = (
                _stokes(outline, opposite, _TOUCHING if near else _APART) * unit[some] ** 2
            )
    return result


def _quadrature(
    first: np.ndarray, second: np.ndarray, offset: np.ndarray, points: int
) -> np.ndarray:
    """By points x points Gauss-Legendre points on each patch."""
    node, weight = np.polynomial.legendre.leggauss(points)
    place = np.stack(np.meshgrid(node, node, indexing="ij"), axis=-1).reshape(-1, 2) / 2
    weights = np.outer(weight, weight).ravel() / 4  # (Q,)
    here, there = place @ first, place @ second  # (Q, 3)
    between = (there[None, :] - here[:, None]).reshape(-1, 3)
    normal, other = _normal(first), _normal(second)
    areas = [np.linalg.norm(np.cross(*edges)) for edges in (first, second)]
    # The height of a point over the first plane is that of its patch's centre and its own from
    # there.
    moments = np.stack([weights, weights * (there @ normal)], axis=1)
    result = np.empty(len(offset))
    step = max(1, (1 << 16) // len(between))
    for start in range(0, len(offset), step):
        apart = offset[start : start + step]
        r2 = (2 * apart) @ between.T
        r2 += np.einsum("ki,ki->k", between, between)
        r2 += np.einsum("pi,pi->p", apart, apart)[:, None]
        np.square(r2, out=r2)
        np.reciprocal(r2, out=r2)
        inner = (r2.reshape(-1, len(weights)) @ moments).reshape(len(apart), -1, 2)
        meet = (apart @ normal)[:, None] * inner[..., 0] + inner[..., 1]
        leave = weights * ((apart @ other)[:, None] - here @ other)
        result[start : start + step] = -np.einsum("pk,pk->p", leave, meet)
    return result * (np.prod(areas) / np.pi)


def _stokes(first: np.ndarray, second: np.ndarray, points: int) -> np.ndarray:
    """a_i F_ij of pairs of outlines (P, E, 2, 3), each wholly in front of the other's plane."""
    product = np.einsum("pai,pbi->pab", first[:, :, 1], second[:, :, 1])
    pair, a, b = np.nonzero(product)
    terms = product[pair, a, b]
    step = max(1, (1 << 18) // points)
    for start in range(0, len(pair), step):
        some = slice(start, start + step)
        terms[some] *= _mean_log(first[pair[some], a[some]], second[pair[some], b[some]], points)
    # Patches that hardly see each other may come out a rounding error below zero.
    return np.maximum(np.bincount(pair, terms, len(first)), 0) / (2 * np.pi)


def _mean_log(p: np.ndarray, q: np.ndarray, points: int) -> np.ndarray:
    """Mean of ln r between points of two segments (P, 2, 3), (P,)."""
    (start, edge), (other, along) = np.moveaxis(p, 1, 0), np.moveaxis(q, 1, 0)
    length, offset = np.linalg.norm(along, axis=1), start - other
    unit = along / length[:, None]
    cuts = _cuts(edge, along, offset)
    pair, piece = np.nonzero(np.diff(cuts, axis=1))
    low, wide = cuts[pair, piece], np.diff(cuts, axis=1)[pair, piece]
    node, weight = np.polynomial.legendre.leggauss(points)
    u = (node + 1) / 2
    # s = u^3 (10 - 15 u + 6 u^2) flattens logarithms at both ends.
    s = low[:, None] + wide[:, None] * (u**3 * (10 - 15 * u + 6 * u**2))  # (pieces, points)
    # Of a point of p: how far along q, and at which distance from its line.
    t0, t1 = np.einsum("pi,pi->p", offset, unit), np.einsum("pi,pi->p", edge, unit)
    across0, across1 = offset - t0[:, None] * unit, edge - t1[:, None] * unit
    t = t0[pair, None] + t1[pair, None] * s
    across = across0[pair, None] + across1[pair, None] * s[..., None]
    distance = np.sqrt(np.einsum("...i,...i->...", across, across))
    inner = _log_integral(t, distance) - _log_integral(t - length[pair, None], distance)
    means = wide * (inner @ (weight * 15 * u**2 * (1 - u) ** 2))
    return np.bincount(pair, means, len(p)) / length


def _cuts(edge: np.ndarray, along: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Where segments p are cut, (P, 5) ascending from 0 to 1: beside the ends of q and nearest its line."""
    square = np.einsum("pi,pi->p", edge, edge)
    here = -np.einsum("pi,pi->p", edge, offset) / square
    there = here + np.einsum("pi,pi->p", edge, along) / square
    normal = np.cross(edge, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.einsum("pi,pi->p", np.cross(along, offset), normal) / np.einsum(
            "pi,pi->p", normal, normal
        )
    inside = np.clip(np.nan_to_num(np.stack([here, there, nearest], axis=1)), 0, 1)
    return np.pad(np.sort(inside, axis=1), ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1)))


def _log_integral(t: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """int_0^t ln sqrt(u^2 + distance^2) du."""
    return scipy.special.xlogy(t, t**2 + distance**2) / 2 - t + distance * np.arctan2(t, distance)


def _outline(edges: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Starts and edge vectors around the fronts of patches (P, 2, 3), (P, 4, 2, 3)."""
    starts = centre[:, None] + _AROUND @ edges
    return np.stack([starts, np.roll(starts, -1, axis=1) - starts], axis=2)


def _clip(outlines: np.ndarray, height: np.ndarray) -> np.ndarray:
    """The part in front of a plane of outlines (P, E, 2, 3) whose starts are `height` (P, E) above it.

    (P, E + 1, 2, 3): the same edges, shortened, to nothing where they lie behind, and one more
    along the cut.
    """
    after = np.roll(height, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.clip(np.nan_to_num(height / (height - after)), 0, 1)
    hidden = (height < 0) & (after < 0)
    first, last = (
        np.where((height < 0) & ~hidden, cut, 0),
        np.where(hidden, 0, np.where(after < 0, cut, 1)),
    )
    starts = outlines[:, :, 0] + first[..., None] * outlines[:, :, 1]
    edges = (last - first)[..., None] * outlines[:, :, 1]
    # The outline leaves the front along one edge at most; what closes it starts there.
    leaving, here = np.argmax((height >= 0) & (after < 0), axis=1), np.arange(len(outlines))
    starts = np.concatenate([starts, (starts + edges)[here, leaving][:, None]], axis=1)
    edges = np.concatenate([edges, -edges.sum(axis=1, keepdims=True)], axis=1)
    return np.stack([starts, edges], axis=2)


def _heights(plane: np.ndarray, patch: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Signed distances of a patch's corners, around, from another's plane, (P, 4)."""
    return ((offset[:, None] + _AROUND @ patch) * _normal(plane)[..., None, :]).sum(axis=-1)


def _normal(edges: np.ndarray) -> np.ndarray:
    normal = np.cross(edges[..., 0, :], edges[..., 1, :])
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)
