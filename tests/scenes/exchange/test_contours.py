# SPDX-License-Identifier: BSD-3-Clause
"""Outlines of patches: exchange against closed forms, and clipping."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.scenes.exchange.contours import clip, exchange, outline
from ltcl.scenes.exchange.cube_tables import parallel, perpendicular

X, Y, Z = np.eye(3)


def places(*offsets: np.ndarray) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*offsets), axis=-1).reshape(-1, 3).astype(np.float64)


def test_patches_at_a_right_angle_meet_the_closed_form() -> None:
    """Touching along an edge, at a corner, and apart."""
    d, p, q = np.mgrid[:3, :3, :3].reshape(3, -1)
    wall = outline(places(0 * d, d, p), right=Z, down=Y)
    floor = outline(places(q, 0 * d, 0 * d), right=Y, down=X)
    np.testing.assert_allclose(exchange(wall, floor), perpendicular(3)[d, p, q], rtol=1e-9)


@pytest.mark.parametrize("gap", [1, 2])
def test_parallel_patches_meet_the_closed_form(gap: int) -> None:
    x, y = np.mgrid[:3, :3].reshape(2, -1)
    floor = outline(places(x, y, 0 * x), right=Y, down=X)
    ceiling = outline(places(0 * x, 0 * x, 0 * x + gap), right=X, down=Y)
    np.testing.assert_allclose(exchange(floor, ceiling), parallel(3, gap)[x, y], rtol=1e-9)


def disks(radius: float, other: float, gap: float) -> float:
    """F between coaxial disks, Howell C-41."""
    a, b = radius / gap, other / gap
    x = 1 + (1 + b**2) / a**2
    return (x - np.sqrt(x**2 - 4 * (b / a) ** 2)) / 2


def test_outlines_may_have_any_number_of_edges() -> None:
    """Polygons of 48 edges that stand for disks; their outline is short of the circle by 3e-3 of the area."""
    turn = 2 * np.pi * np.arange(48) / 48
    # Of a regular polygon with the disk's area.
    radius = np.sqrt(np.pi / (24 * np.sin(2 * np.pi / 48)))
    corner = radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    floor = np.stack([corner, np.roll(corner, -1, axis=0) - corner], axis=1)[None]
    mirrored = corner[::-1] + 1.5 * Z
    ceiling = np.stack([mirrored, np.roll(mirrored, -1, axis=0) - mirrored], axis=1)[None]
    assert exchange(floor, ceiling)[0] / np.pi == pytest.approx(disks(1, 1, 1.5), rel=1e-3)


@pytest.mark.parametrize("height", [0.0, 0.25, 0.9])
def test_a_wall_that_stands_across_sees_the_floor_in_front_of_it_only(height: float) -> None:
    """The floor's part beyond the wall's plane is cut off, and a shorter floor is left."""
    wall = outline(np.array([[0.25, 0, height]]), right=Z, down=Y)  # looks along +x
    floor = outline(np.array([[0.0, 0, 0]]), right=Y, down=X)
    in_front = outline(np.array([[0.25, 0, 0]]), right=Y, down=0.75 * X)
    cut = clip(floor, floor[:, :, 0, 0] - 0.25)
    assert cut.shape == (1, 5, 2, 3)
    np.testing.assert_allclose(exchange(wall, cut), exchange(wall, in_front), rtol=1e-9)


def test_clipping_keeps_all_nothing_or_a_corner() -> None:
    square = outline(np.zeros((1, 3)), right=Y, down=X)
    heights = square[:, :, 0, 0] + square[:, :, 0, 1]

    def area(outlines: np.ndarray) -> float:
        starts, edges = outlines[0, :, 0], outlines[0, :, 1]
        np.testing.assert_allclose(edges.sum(axis=0), 0, atol=1e-15)
        return float(np.cross(starts, edges)[:, 2].sum() / 2)

    assert area(clip(square, heights + 1)) == pytest.approx(1)
    assert area(clip(square, heights - 3)) == pytest.approx(0)
    assert area(clip(square, heights - 1)) == pytest.approx(0.5)
    assert area(clip(square, heights - 1.5)) == pytest.approx(0.125)
    assert area(clip(square, 0.5 - heights)) == pytest.approx(0.125)
