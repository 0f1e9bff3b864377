# SPDX-License-Identifier: BSD-3-Clause
"""The trihedral: the cube's corner at 90 degrees, rhombs otherwise, light between a tube's and a plane's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError, MemoryLimitError
from ltcl.scenes import box, trihedral


def test_right_angles_give_the_corner_of_the_cube() -> None:
    scene, corner = trihedral(4), box(4, sides=3)
    np.testing.assert_allclose(scene.form_factors, corner.form_factors, rtol=1e-7, atol=1e-18)
    for wall, expected in zip(scene.walls, corner.walls, strict=True):
        assert wall.name == expected.name
        for name in ("corner", "right", "down"):
            assert getattr(wall, name) == pytest.approx(getattr(expected, name), abs=1e-15)


@pytest.mark.parametrize("angle", [5, 60, 100, 119])
def test_walls_are_alike_and_meet_in_edges_of_the_angle(angle: float) -> None:
    n = 3
    scene = trihedral(n, angle=angle)
    assert scene.area == pytest.approx(np.full(3 * n * n, np.sin(np.radians(angle)) / n**2))
    for wall in scene.walls:
        turn = np.dot(wall.right, wall.down)
        assert abs(turn) == pytest.approx(abs(np.cos(np.radians(angle))), abs=1e-12)
    F = scene.form_factors.reshape(n, 3, n, n, 3, n).sum(axis=(0, 2, 3, 5))
    assert F[~np.eye(3, dtype=bool)] == pytest.approx(np.full(6, F[0, 1]), rel=1e-7)
    (T,) = scene.matrices()
    assert pytest.approx(T.T, rel=1e-9, abs=1e-15) == T  # equal areas: T is symmetric


def test_the_narrower_the_more_light_stays() -> None:
    kept = [trihedral(3, angle=angle).form_factors.sum(axis=1).mean() for angle in (5, 30, 60, 90, 119.9)]
    assert (np.diff(kept) < 0).all()
    assert kept[-1] < 0.01


def test_viewer_sees_all_three_walls() -> None:
    for angle in (5, 45, 90, 119):
        scene = trihedral(8, angle=angle)
        assert all(scene.viewer.sees(wall) for wall in scene.walls)
        assert scene.view(np.ones(scene.grid), size=100).mean() > 0.2


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"angle": 0}, "angle is 0; it must be a finite number above 0 and below 120"),
        ({"angle": 120}, "angle is 120"),
        ({"angle": float("nan")}, "angle is nan"),
        ({"angle": "60"}, "angle is '60'"),
        ({"albedo": 1.0}, r"outside \[0, 1\)"),
        ({"n": 0}, "n is 0"),
    ],
)
def test_bad_trihedrals_are_refused(arguments: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        trihedral(**{"n": 2, **arguments})
    with pytest.raises(MemoryLimitError, match=r"trihedral of 50 degrees, .* needs"):
        trihedral(10**6, angle=50)
