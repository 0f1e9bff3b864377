# SPDX-License-Identifier: BSD-3-Clause
"""Exact form factors between flat patches at any angle and distance, without occlusion.

    a_i F_ij = int_i int_j  cos(t_i) cos(t_j) / (pi r^2)  da_j da_i
             = 1 / (2 pi)  sum_p sum_q (p . q)  int_0^1 int_0^1  ln r  ds dt

(the second line by Stokes' theorem: edges p run around the front of patch i, q around that of j).
Pairs farther apart than they are large take Gauss-Legendre points on both patches: the kernel is
smooth there and every term positive. Nearer pairs, and those where the plane of one patch cuts the
other, take the integral
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
from typing import NamedTuple

import numpy as np
import scipy.special

from ltcl import checks
from ltcl.scenes.patches import Patches
from ltcl.scenes.walls import Wall

# Distance of the centres, in radii of both patches, from which on so many points a side are enough.
TIERS = ((20.0, 3), (7.0, 4), (4.0, 5), (3.0, 6), (2.0, 8))
NEAREST_TIER = TIERS[-1][0]

# Points on each piece of an edge: of pairs nearer than all tiers, and of others.
NEAR_EDGE_POINTS = 40
FAR_EDGE_POINTS = 16

# Heights above a plane up to this part of the patches' size are rounding errors.
FLAT_TOLERANCE = 1e-12

# Sizes of temporary arrays, so that they stay in the cache: pairs of patches; pairs of points.
PAIRS_AT_ONCE = 4096
POINT_PAIRS_AT_ONCE = 1 << 16
EDGE_POINTS_AT_ONCE = 1 << 18

# Places of (down, right) of a picture after quarter turns, and signs of both.
QUARTER_TURNS = (((0, 1), (1, 1)), ((1, 0), (1, -1)), ((0, 1), (-1, -1)), ((1, 0), (-1, 1)))

# Corners of a patch, around its front, in edges (down, right).
CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2


def form_factors(walls: Sequence[Wall], n: int) -> np.ndarray:
    """Form factors of all patches, (N, N) float64, N = n * n * len(walls), without occlusion.

    None of the walls may cut through another. MemoryLimitError if the host has no room for the
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
    """Write form factors of pairs of walls, both ways, in a matrix (n, walls, n, n, walls, n)."""
    n = len(matrix)
    known: dict[bytes, np.ndarray] = {}
    for i, j in pairs:
        congruence = _congruence(walls[i], walls[j])
        if congruence.key not in known:
            exchanged = exchange_of_walls(walls[i], walls[j], n)
            known[congruence.key] = congruence.to_common(exchanged)
        exchanged = congruence.from_common(known[congruence.key])
        matrix[:, i, :, :, j, :] = exchanged * (n**2 / walls[i].area)
        reverse = exchanged.transpose(2, 3, 0, 1)
        matrix[:, j, :, :, i, :] = reverse * (n**2 / walls[j].area)


class Congruence(NamedTuple):
    """The common form of congruent pairs of walls, and the turns of both pictures that lead to it.

    Mirror images have rows for columns.
    """

    key: bytes
    first_turn: int
    second_turn: int
    is_mirrored: bool

    @property
    def axes(self) -> tuple[int, int, int, int]:
        """Order of the axes of an exchange (n, n, n, n) in the common form."""
        return (1, 0, 3, 2) if self.is_mirrored else (0, 1, 2, 3)

    def to_common(self, exchanged: np.ndarray) -> np.ndarray:
        """Turn an exchange (n, n, n, n) to the common form."""
        turned = np.rot90(exchanged, -self.first_turn, axes=(0, 1))
        turned = np.rot90(turned, -self.second_turn, axes=(2, 3))
        return turned.transpose(self.axes)

    def from_common(self, exchanged: np.ndarray) -> np.ndarray:
        """Turn an exchange (n, n, n, n) back from the common form."""
        turned = exchanged.transpose(self.axes)
        turned = np.rot90(turned, self.first_turn, axes=(0, 1))
        return np.rot90(turned, self.second_turn, axes=(2, 3))


def _congruence(first: Wall, second: Wall) -> Congruence:
    """The congruence of a pair of walls.

    Its key is the lengths and angles of edges (down, right), normals, and the way from middle to
    middle, of all quarter turns of both pictures the first in order.
    """
    edges = np.array([first.down, first.right], np.float64)
    other_edges = np.array([second.down, second.right], np.float64)
    to_middles = (other_edges.sum(axis=0) - edges.sum(axis=0)) / 2
    offset = np.subtract(second.corner, first.corner) + to_middles
    vectors = np.array([*edges, first.normal, *other_edges, second.normal, offset])
    vectors[[0, 1, 3, 4, 6]] /= np.linalg.norm(edges[0])
    gram = (vectors @ vectors.T).round(9)
    congruences = []
    turns = itertools.product(range(4), range(4), (False, True))
    for turn, other_turn, is_mirrored in turns:
        order, sign = _turned_edges(turn, is_mirrored)
        other_order, other_sign = _turned_edges(other_turn, is_mirrored)
        places = [*order, 2, other_order[0] + 3, other_order[1] + 3, 5, 6]
        signs = np.array([*sign, 1, *other_sign, 1, 1])
        # Adding 0 turns -0 into 0.
        turned = gram[np.ix_(places, places)] * np.outer(signs, signs) + 0.0
        congruences.append(Congruence(turned.tobytes(), turn, other_turn, is_mirrored))
    return min(congruences)


def _turned_edges(turn: int, is_mirrored: bool) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Order and signs of (down, right) after quarter turns, mirrored or not."""
    order, sign = QUARTER_TURNS[turn]
    if is_mirrored:
        return order[::-1], sign[::-1]
    return order, sign


def exchange_of_walls(first: Wall, second: Wall, n: int) -> np.ndarray:
    """a_i F_ij between the patches of two walls, (n, n, n, n) float64: rows, columns of both.

    It depends on the offset of the patches alone, so each offset is computed once: about 2 n^3 for
    walls that share an edge, 4 n^2 for walls that face each other.
    """
    edges = np.stack([first.down, first.right]).astype(np.float64) / n
    others = np.stack([second.down, second.right]).astype(np.float64) / n
    steps, counts = _offset_steps(edges, others, n)
    ranges = [np.arange(count.min(), count.max() + 1) for count in counts]
    places = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1)
    to_middles = (others.sum(axis=0) - edges.sum(axis=0)) / 2
    start = np.subtract(second.corner, first.corner) + to_middles
    offsets = start + places @ np.array(steps)
    table = exchange(edges, others, offsets.reshape(-1, 3))
    table = table.reshape(offsets.shape[:-1])
    return table[tuple(count - count.min() for count in counts)]


def _offset_steps(
    edges: np.ndarray, others: np.ndarray, n: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Steps (3,) of the offset between patches of two walls, and how often each is taken.

    Counts are arrays that broadcast to (n, n, n, n). Along an edge that both walls share only the
    difference of their counts matters.
    """
    index = np.ogrid[:n, :n, :n, :n]
    steps = []
    counts = []
    free = {0, 1, 2, 3}  # axes of the exchange that no shared edge has taken
    for i, j, sign in itertools.product((0, 1), (2, 3), (1, -1)):
        tolerance = FLAT_TOLERANCE * np.linalg.norm(edges[i])
        is_shared = np.allclose(edges[i], sign * others[j - 2], rtol=0, atol=tolerance)
        if is_shared and {i, j} <= free:
            free -= {i, j}
            steps.append(others[j - 2])
            counts.append(index[j] - sign * index[i])
    for axis in sorted(free):
        step = others[axis - 2] if axis > 1 else -edges[axis]
        steps.append(step)
        counts.append(index[axis])
    return steps, counts


def form_factors_of_pairs(patches: Patches, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """F_ij of listed pairs, (P,) float64: share of the light from patch i that meets patch j.

    It is meant for pairs a few sizes apart: entries are right to 1e-6 up to 10 sizes.

    >>> from ltcl.scenes import box, cut
    >>> patches = cut(box(1, sides=2).walls, 1)
    >>> round(float(form_factors_of_pairs(patches, np.array([0]), np.array([1]))[0]), 5)
    0.20004
    """
    edges = np.stack([patches.down, patches.right], axis=1)
    offset = patches.centre[j] - patches.centre[i]
    return exchange(edges[i], edges[j], offset) / patches.area[i]


def exchange(first: np.ndarray, second: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """a_i F_ij of pairs of patches whose centres are `offset` (P, 3) apart, (P,).

    The edges (down, right) are those of all pairs, (2, 3), or of each, (P, 2, 3): these take
    outlines only.
    """
    result = np.empty(len(offset))
    for start in range(0, len(offset), PAIRS_AT_ONCE):
        slab = slice(start, start + PAIRS_AT_ONCE)
        if first.ndim == 2:
            result[slab] = _exchange_of_slab(first, second, offset[slab])
        else:
            result[slab] = _exchange_of_slab(first[slab], second[slab], offset[slab])
    return result


def _exchange_of_slab(first: np.ndarray, second: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """`exchange` of a few pairs, each by the method for its distance."""
    radius = _radius(first) + _radius(second)
    level = FLAT_TOLERANCE * np.asarray(radius)[..., None]
    # Heights of the second patch above the plane of the first, and the other way round.
    over = _flatten(_heights(first, second, offset), level)
    under = _flatten(_heights(second, first, -offset), level)
    is_left = (over.max(axis=1) > 0) & (under.max(axis=1) > 0)
    is_whole = (over.min(axis=1) >= 0) & (under.min(axis=1) >= 0)
    distance = np.linalg.norm(offset, axis=1) / radius
    result = np.zeros(len(offset))
    if first.ndim == 2:
        for least_distance, points in TIERS:
            is_far = distance >= least_distance
            pairs = np.flatnonzero(is_left & is_whole & is_far)
            if len(pairs):
                result[pairs] = _quadrature(first, second, offset[pairs], points)
                is_left[pairs] = False
    if not is_left.any():
        return result

    first = np.broadcast_to(first, (len(offset), 2, 3))
    second = np.broadcast_to(second, (len(offset), 2, 3))
    # Logarithms of a closed outline cancel best near 1, so radii are the unit.
    unit = np.broadcast_to(radius, len(offset))
    is_near = distance < NEAREST_TIER
    for near, clipped in itertools.product((True, False), repeat=2):
        is_kind = (is_near == near) & (is_whole != clipped)
        pairs = np.flatnonzero(is_left & is_kind)
        if not len(pairs):
            continue
        scale = unit[pairs, None, None, None]
        outline = _outline(first[pairs], np.zeros((1, 3))) / scale
        opposite = _outline(second[pairs], offset[pairs]) / scale
        if clipped:
            outline = _clip(outline, under[pairs])
            opposite = _clip(opposite, over[pairs])
        points = NEAR_EDGE_POINTS if near else FAR_EDGE_POINTS
        result[pairs] = _stokes(outline, opposite, points) * unit[pairs] ** 2
    return result


def _radius(edges: np.ndarray) -> np.ndarray:
    """Half of the longer diagonal of patches with edges (..., 2, 3)."""
    diagonals = edges.swapaxes(-1, -2) @ ((1, 1), (1, -1))
    return np.linalg.norm(diagonals, axis=-2).max(axis=-1) / 2


def _flatten(height: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Heights without those that are rounding errors."""
    return np.where(np.abs(height) < level, 0.0, height)


def _quadrature(
    first: np.ndarray, second: np.ndarray, offset: np.ndarray, points: int
) -> np.ndarray:
    """The exchange by points x points Gauss-Legendre points on each patch."""
    node, weight = np.polynomial.legendre.leggauss(points)
    nodes = np.meshgrid(node, node, indexing="ij")
    place = np.stack(nodes, axis=-1).reshape(-1, 2) / 2
    weights = np.outer(weight, weight).ravel() / 4  # (Q,)
    # Points on both patches, from their centres, (Q, 3).
    first_points = place @ first
    second_points = place @ second
    between = (second_points[None, :] - first_points[:, None]).reshape(-1, 3)
    first_normal = _normal(first)
    second_normal = _normal(second)
    first_area = np.linalg.norm(np.cross(*first))
    second_area = np.linalg.norm(np.cross(*second))
    # The height of a point above the first plane is that of its patch's centre, and its own from
    # there.
    moments = np.stack([weights, weights * (second_points @ first_normal)], axis=1)
    result = np.empty(len(offset))
    step = max(1, POINT_PAIRS_AT_ONCE // len(between))
    for start in range(0, len(offset), step):
        apart = offset[start : start + step]
        # 1 / r^4, computed in place.
        r = (2 * apart) @ between.T
        r += np.einsum("ki,ki->k", between, between)
        r += np.einsum("pi,pi->p", apart, apart)[:, None]
        np.square(r, out=r)
        np.reciprocal(r, out=r)
        inner = r.reshape(-1, len(weights)) @ moments
        inner = inner.reshape(len(apart), -1, 2)
        elevation = (apart @ first_normal)[:, None]
        arriving = elevation * inner[..., 0] + inner[..., 1]
        height = (apart @ second_normal)[:, None] - first_points @ second_normal
        exchanged = np.einsum("pk,pk->p", weights * height, arriving)
        result[start : start + step] = -exchanged
    return result * (first_area * second_area / np.pi)


def _stokes(first: np.ndarray, second: np.ndarray, points: int) -> np.ndarray:
    """a_i F_ij of pairs of outlines (P, E, 2, 3), each wholly in front of the other's plane."""
    product = np.einsum("pai,pbi->pab", first[:, :, 1], second[:, :, 1])
    pair, a, b = np.nonzero(product)
    terms = product[pair, a, b]
    step = max(1, EDGE_POINTS_AT_ONCE // points)
    for start in range(0, len(pair), step):
        chunk = slice(start, start + step)
        edges = first[pair[chunk], a[chunk]]
        other_edges = second[pair[chunk], b[chunk]]
        terms[chunk] *= _mean_log(edges, other_edges, points)
    # Patches that hardly see each other may come out a rounding error below zero.
    total = np.bincount(pair, terms, len(first))
    return np.maximum(total, 0) / (2 * np.pi)


def _mean_log(p: np.ndarray, q: np.ndarray, points: int) -> np.ndarray:
    """Mean of ln r between points of two segments (P, 2, 3), (P,)."""
    p_start, p_edge = np.moveaxis(p, 1, 0)
    q_start, q_edge = np.moveaxis(q, 1, 0)
    length = np.linalg.norm(q_edge, axis=1)
    unit = q_edge / length[:, None]
    offset = p_start - q_start
    cuts = _cuts(p_edge, q_edge, offset)
    widths = np.diff(cuts, axis=1)
    pair, piece = np.nonzero(widths)
    low = cuts[pair, piece]
    width = widths[pair, piece]
    node, weight = np.polynomial.legendre.leggauss(points)
    u = (node + 1) / 2
    # s = u^3 (10 - 15 u + 6 u^2) flattens logarithms at both ends.
    flat = u**3 * (10 - 15 * u + 6 * u**2)
    s = low[:, None] + width[:, None] * flat  # (pieces, points)
    # Place of a point of p along q, and its distance from the line of q: both are linear in s.
    t_start = np.einsum("pi,pi->p", offset, unit)
    t_slope = np.einsum("pi,pi->p", p_edge, unit)
    across_start = offset - t_start[:, None] * unit
    across_slope = p_edge - t_slope[:, None] * unit
    t = t_start[pair, None] + t_slope[pair, None] * s
    across = across_start[pair, None] + across_slope[pair, None] * s[..., None]
    distance = np.sqrt(np.einsum("...i,...i->...", across, across))
    t_end = t - length[pair, None]
    inner = _log_integral(t, distance) - _log_integral(t_end, distance)
    means = width * (inner @ (weight * 15 * u**2 * (1 - u) ** 2))
    return np.bincount(pair, means, len(p)) / length


def _cuts(edge: np.ndarray, along: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Places (P, 5), ascending from 0 to 1, where segments p are cut.

    They are at the ends of q and nearest to its line.
    """
    square = np.einsum("pi,pi->p", edge, edge)
    at_start = -np.einsum("pi,pi->p", edge, offset) / square
    at_end = at_start + np.einsum("pi,pi->p", edge, along) / square
    normal = np.cross(edge, along)
    distance = np.einsum("pi,pi->p", np.cross(along, offset), normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = distance / np.einsum("pi,pi->p", normal, normal)
    places = np.nan_to_num(np.stack([at_start, at_end, nearest], axis=1))
    inside = np.sort(np.clip(places, 0, 1), axis=1)
    return np.pad(inside, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1)))


def _log_integral(t: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """int_0^t ln sqrt(u^2 + distance^2) du."""
    logarithm = scipy.special.xlogy(t, t**2 + distance**2) / 2
    return logarithm - t + distance * np.arctan2(t, distance)


def _outline(edges: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Starts and edge vectors around the fronts of patches (P, 2, 3), (P, 4, 2, 3)."""
    starts = centre[:, None] + CORNERS @ edges
    return np.stack([starts, np.roll(starts, -1, axis=1) - starts], axis=2)


def _clip(outlines: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Part in front of a plane of outlines (P, E, 2, 3) that start `height` (P, E) above it.

    The result (P, E + 1, 2, 3) has the same edges, shortened, to nothing where they lie behind, and
    one more along the cut.
    """
    next_height = np.roll(height, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.clip(np.nan_to_num(height / (height - next_height)), 0, 1)
    starts_behind = height < 0
    ends_behind = next_height < 0
    is_hidden = starts_behind & ends_behind
    first = np.where(starts_behind & ~is_hidden, cut, 0)
    last = np.where(is_hidden, 0, np.where(ends_behind, cut, 1))
    starts = outlines[:, :, 0] + first[..., None] * outlines[:, :, 1]
    edges = (last - first)[..., None] * outlines[:, :, 1]
    # The outline leaves the front along one edge at most; the edge that closes it starts there.
    leaving = np.argmax(~starts_behind & ends_behind, axis=1)
    row = np.arange(len(outlines))
    closing_start = (starts + edges)[row, leaving][:, None]
    closing_edge = -edges.sum(axis=1, keepdims=True)
    starts = np.concatenate([starts, closing_start], axis=1)
    edges = np.concatenate([edges, closing_edge], axis=1)
    return np.stack([starts, edges], axis=2)


def _heights(plane: np.ndarray, patch: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Signed distances of a patch's corners, around, from another's plane, (P, 4)."""
    corners = offset[:, None] + CORNERS @ patch
    return (corners * _normal(plane)[..., None, :]).sum(axis=-1)


def _normal(edges: np.ndarray) -> np.ndarray:
    normal = np.cross(edges[..., 0, :], edges[..., 1, :])
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)
