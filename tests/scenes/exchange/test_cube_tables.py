# SPDX-License-Identifier: BSD-3-Clause
"""Tables of form factors against adaptive quadrature, older closed forms and their own coarser selves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import dblquad

from ltcl.errors import InputError
from ltcl.scenes.exchange.cube_tables import NEAR, parallel, perpendicular


def point_to_rectangle(point: np.ndarray, normal: np.ndarray, corners: np.ndarray) -> float:
    """Lambert's formula: the share of light from a point that meets a polygon above its horizon."""
    arms = (corners - point) / np.linalg.norm(corners - point, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(arms, np.roll(arms, -1, axis=0), strict=True):
        across = np.cross(a, b)
        length = np.linalg.norm(across)
        if length:
            total += np.arctan2(length, a @ b) * (across @ normal) / length
    return abs(total) / (2 * np.pi)


def quadrature(place: Callable[[float, float], Any], normal: Any, corners: Any) -> float:
    """Form factor from the unit patch `place` to the rectangle `corners`, to 1e-7."""
    normal, corners = np.array(normal, float), np.array(corners, float)

    def integrand(v: float, u: float) -> float:
        return point_to_rectangle(np.array(place(u, v), float), normal, corners)

    return dblquad(integrand, 0, 1, 0, 1, epsabs=1e-12, epsrel=1e-7)[0]


# The far ones lie beyond NEAR, where the table changes its method.
@pytest.mark.parametrize("offset", [(0, 0, 0), (1, 0, 0), (0, 0, 1), (7, 7, 7), (8, 0, 0), (3, 9, 0)])
def test_perpendicular_patches_meet_quadrature(offset: tuple[int, int, int]) -> None:
    d, p, q = offset
    wall = [(d, 0, q), (d + 1, 0, q), (d + 1, 0, q + 1), (d, 0, q + 1)]
    expected = quadrature(lambda u, v: (u, p + v, 0), (0, 0, 1), wall)
    assert perpendicular(10)[offset] == pytest.approx(expected, rel=1e-6, abs=1e-11)


@pytest.mark.parametrize("gap", [1, 3, NEAR, 12])
@pytest.mark.parametrize("offset", [(0, 0), (1, 0), (2, 5), (9, 1)])
def test_parallel_patches_meet_quadrature(offset: tuple[int, int], gap: int) -> None:
    x, y = offset
    wall = [(x, y, gap), (x + 1, y, gap), (x + 1, y + 1, gap), (x, y + 1, gap)]
    expected = quadrature(lambda u, v: (u, v, 0), (0, 0, 1), wall)
    assert parallel(10, gap)[offset] == pytest.approx(expected, rel=1e-6, abs=1e-11)


def opposite_faces() -> float:
    """Howell C-11 for a cube: X = Y = 1."""
    inner = np.log(np.sqrt(4 / 3)) - 2 * np.arctan(1) + 2 * np.sqrt(2) * np.arctan(1 / np.sqrt(2))
    return 2 / np.pi * inner


def adjacent_faces() -> float:
    """Howell C-14 for a cube: H = W = 1."""
    inner = 2 * np.arctan(1) - np.sqrt(2) * np.arctan(1 / np.sqrt(2))
    return (inner + np.log(4 / 3 * (3 / 4) * (3 / 4)) / 4) / np.pi


def whole_walls(table: np.ndarray, n: int) -> float:
    """Form factor of the whole walls, from all pairs of patches."""
    times = np.full(n, 2) * (n - np.arange(n))  # how many pairs lie d apart: n - d on each side
    times[0] = n
    weights = np.multiply.outer(times, times) if table.ndim == 2 else times[:, None, None]
    return float((table * weights).sum() / n**2)


@pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 20])
def test_tables_add_up_to_whole_walls(n: int) -> None:
    assert whole_walls(parallel(n, gap=n), n) == pytest.approx(opposite_faces(), rel=1e-10)
    assert whole_walls(perpendicular(n), n) == pytest.approx(adjacent_faces(), rel=1e-10)


def test_fine_patches_add_up_to_coarse_ones() -> None:
    """The far half of the fine table (quadrature) fills the near half of the coarse one (closed form)."""
    fine, coarse = perpendicular(2 * NEAR), perpendicular(NEAR)
    for d, p, q in [(6, 0, 0), (7, 7, 7), (5, 1, 7), (0, 6, 0)]:
        shifts = np.abs(2 * d + np.array([-1, 0, 0, 1]))
        pairs = fine[shifts][:, 2 * p : 2 * p + 2, 2 * q : 2 * q + 2]
        assert pairs.sum() / 4 == pytest.approx(coarse[d, p, q], rel=1e-8)


def test_far_entries_keep_their_sign_and_slope() -> None:
    """Along the seam F falls as d^-4; the closed form alone would be noise of either sign there."""
    table = perpendicular(60)
    assert (table > 0).all()
    far = table[[40, 50, 59], 0, 0] * np.array([40.0, 50.0, 59.0]) ** 4
    assert far == pytest.approx(np.full(3, 0.25 / np.pi), rel=5e-3)  # p q / (pi d^4) at p = q = 1/2


def test_perpendicular_table_is_reciprocal() -> None:
    table = perpendicular(12)
    assert table == pytest.approx(table.transpose(0, 2, 1), rel=1e-9)


@pytest.mark.parametrize("bad", [0, -1, 1.5, True, "3"])
def test_sizes_must_be_whole(bad: Any) -> None:
    with pytest.raises(InputError, match="n is "):
        perpendicular(bad)
    with pytest.raises(InputError, match="n is "):
        parallel(bad, gap=1)
    with pytest.raises(InputError, match="gap is "):
        parallel(2, gap=bad)
