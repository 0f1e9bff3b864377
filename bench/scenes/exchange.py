# SPDX-License-Identifier: BSD-3-Clause
"""Form factors of flat convex pieces, by Lambert's polygon formula, and what blocks hide of them.

    F(x, polygon) = 1 / (2 pi) sum_k angle_k n . (r_k x r_k+1) / |r_k x r_k+1|

at a point x with normal n, r_k from x to the corners. The mean over points of a piece is made
reciprocal: a_i F_ij = a_j F_ji.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from scenes.pieces import Pieces, Surface, axes_of
from scenes.tracing import Cuboid

# Distance of two centres, in radii of both pieces, up to which form factors take more points.
NEAR = 4.0
# Rays between two pieces, past blocks.
RAYS_OF_PAIR = 8
# Part of a block's size by which it is shrunk, so that it does not hide what touches it.
SHRINKAGE = 1e-6
# Height above a plane from which on a piece is before it.
LEAST_HEIGHT = 1e-9
# Pairs of pieces at once.
CHUNK_PAIRS = 1 << 18


class Geometry:
    """Corners, areas, normals and points of all pieces as arrays."""

    def __init__(self, pieces: Pieces, surfaces: Sequence[Surface]) -> None:
        count = max(map(len, pieces.corners))
        self.corners = np.empty((len(pieces), count, 3))
        for k, corners in enumerate(pieces.corners):
            self.corners[k, : len(corners)] = corners
            # Edges without length add nothing.
            self.corners[k, len(corners) :] = corners[-1]
        self.normal = np.array([surfaces[k].normal for k in pieces.surface])
        middle = self.corners.mean(axis=1, keepdims=True)
        edges = self.corners - middle
        following = np.roll(edges, -1, axis=1)
        # Areas of the triangles from the middle to each edge, (P, k).
        triangles = 0.5 * np.linalg.norm(np.cross(edges, following), axis=2)
        self.area = triangles.sum(axis=1)
        shares = triangles / self.area[:, None]
        self.centre = middle[:, 0] + (shares[:, :, None] * (edges + following) / 3).sum(axis=1)
        self.radius = np.linalg.norm(self.corners - self.centre[:, None], axis=2).max(axis=1)
        # Three points in each triangle, of equal weight.
        points = []
        for a, b, c in ((4, 1, 1), (1, 4, 1), (1, 1, 4)):
            points.append(middle + (b * edges + c * following) / (a + b + c))
        self.points = np.concatenate(points, axis=1)
        self.weights = np.tile(shares / 3, (1, 3))


def lambert(points: np.ndarray, normals: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Form factors of points (..., 3) to polygons (..., k, 3), both broadcast."""
    r = corners - points[..., None, :]
    following = np.roll(r, -1, axis=-2)
    across = np.cross(r, following)
    sine = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(sine, (r * following).sum(axis=-1))
    height = (across * normals[..., None, :]).sum(axis=-1)
    turns = np.divide(angle * height, sine, out=np.zeros_like(sine), where=sine > 1e-30)
    return np.abs(turns.sum(axis=-1)) / (2.0 * math.pi)


def form_factors(shape: Geometry, blocks: Sequence[Cuboid]) -> np.ndarray:
    """F (P, P): part of the light that leaves a piece and arrives at another."""
    pieces = len(shape.area)
    exchange = np.zeros((pieces, pieces))
    chunk = max(CHUNK_PAIRS // pieces, 1)
    for start in range(0, pieces, chunk):
        rows = slice(start, start + chunk)
        between = shape.centre - shape.centre[rows, None]
        height = (between * shape.normal[rows, None]).sum(axis=2)
        height_back = -(between * shape.normal).sum(axis=2)
        i, j = np.nonzero((height > LEAST_HEIGHT) & (height_back > LEAST_HEIGHT))
        distance = np.linalg.norm(between[i, j], axis=1)
        i += start
        values = lambert(shape.centre[i], shape.normal[i], shape.corners[j])
        near = np.flatnonzero(distance < NEAR * (shape.radius[i] + shape.radius[j]))
        for part in np.array_split(near, len(near) // 4096 + 1):
            a = i[part]
            b = j[part]
            at_points = lambert(
                shape.points[a], shape.normal[a][:, None], shape.corners[b][:, None]
            )
            values[part] = (shape.weights[a] * at_points).sum(axis=1)
        exchange[i, j] = values * shape.area[i]
    exchange = 0.5 * (exchange + exchange.T)
    if blocks:
        hide(exchange, shape, blocks)
    return exchange / shape.area[:, None]


def hide(exchange: np.ndarray, shape: Geometry, blocks: Sequence[Cuboid]) -> None:
    """Multiply the exchange of pieces by the part of rays between them that meets no block."""
    random = np.random.default_rng(3)
    chosen = [_random_points(shape, random) for _ in range(2 * RAYS_OF_PAIR)]
    first, second = np.nonzero(np.triu(exchange))
    may_meet = np.zeros(len(first), bool)
    for block in blocks:
        may_meet |= _passes_near(shape, first, second, block)
    first = first[may_meet]
    second = second[may_meet]
    for part in np.array_split(np.arange(len(first)), len(first) // CHUNK_PAIRS + 1):
        i = first[part]
        j = second[part]
        clear = np.zeros(len(part))
        for starts, ends in zip(chosen[::2], chosen[1::2], strict=True):
            clear += ~meets(starts[i], ends[j] - starts[i], blocks)
        exchange[i, j] *= clear / RAYS_OF_PAIR
        exchange[j, i] = exchange[i, j]


def _passes_near(
    shape: Geometry, first: np.ndarray, second: np.ndarray, block: Cuboid
) -> np.ndarray:
    """True where rays between two pieces may meet the sphere around a block."""
    start = shape.centre[first]
    way = shape.centre[second] - start
    to_block = np.array(block.middle) - start
    length2 = (way**2).sum(axis=1)
    along = np.clip((to_block * way).sum(axis=1) / length2, 0.0, 1.0)
    distance = np.linalg.norm(to_block - along[:, None] * way, axis=1)
    reach = np.linalg.norm(block.half) + np.maximum(shape.radius[first], shape.radius[second])
    return distance < reach


def _random_points(shape: Geometry, random: np.random.Generator) -> np.ndarray:
    """A point on each piece, (P, 3)."""
    mix = random.dirichlet(np.ones(shape.points.shape[1]), len(shape.area)) * shape.weights
    mix /= mix.sum(axis=1, keepdims=True)
    return (mix[:, :, None] * shape.points).sum(axis=1)


def meets(start: np.ndarray, way: np.ndarray, blocks: Sequence[Cuboid]) -> np.ndarray:
    """True where rays (n, 3) meet a block on their way."""
    hit = np.zeros(way.shape[:-1], bool)
    for block in blocks:
        axes = axes_of(block)
        half = np.array(block.half) * (1.0 - SHRINKAGE)
        begin = (start - np.array(block.middle)) @ axes.T
        along = way @ axes.T
        with np.errstate(divide="ignore", invalid="ignore"):
            one = (-half - begin) / along
            other = (half - begin) / along
        enter = np.nanmax(np.minimum(one, other), axis=-1)
        leave = np.nanmin(np.maximum(one, other), axis=-1)
        hit |= (enter < leave) & (leave > 0.0) & (enter < 1.0)
    return hit
