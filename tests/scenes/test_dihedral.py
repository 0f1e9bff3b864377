# SPDX-License-Identifier: BSD-3-Clause
"""The dihedral: bounces alternate between the walls, and both walls mirror each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError, MemoryLimitError
from ltcl.scenes import dihedral
from ltcl.scenes.exchange.cube_tables import perpendicular

N = 6


def test_form_factors_are_those_of_the_table_around_the_seam() -> None:
    table, F = perpendicular(N), dihedral(N).form_factors.reshape(N, 2 * N, N, 2 * N)
    for row, column, other_row, other_column in [(0, 5, 0, 6), (0, 0, 5, 11), (3, 4, 1, 8)]:
        expected = table[abs(row - other_row), N - 1 - column, other_column - N]
        assert F[row, column, other_row, other_column] == pytest.approx(expected, rel=1e-12)


def test_bounces_alternate_between_the_walls() -> None:
    A = dihedral(N, albedo=0.9).A
    assert isinstance(A, np.ndarray)
    light = np.zeros((N, 2 * N))
    light[2, 1] = 1
    for bounce in range(1, 5):
        light = (A @ light.ravel()).reshape(N, 2 * N)
        dark = light[:, :N] if bounce % 2 else light[:, N:]
        assert not dark.any()


def test_spectrum_is_symmetric_as_the_walls_take_turns() -> None:
    A = dihedral(N, albedo=0.9).A
    eigenvalues = np.linalg.eigvalsh(A)
    assert eigenvalues == pytest.approx(-eigenvalues[::-1], abs=1e-12)


def test_picture_is_mirrored_at_the_seam_and_upside_down() -> None:
    F = dihedral(N).form_factors.reshape(N, 2 * N, N, 2 * N)
    assert pytest.approx(F[:, ::-1, :, ::-1], rel=1e-9, abs=1e-18) == F
    assert pytest.approx(F[::-1, :, ::-1, :], rel=1e-9, abs=1e-18) == F


def test_viewer_sees_the_unfolded_picture() -> None:
    scene = dihedral(8)
    ramp = np.broadcast_to(np.arange(16.0), (8, 16))
    image = scene.view(ramp, size=200)
    middle = image[len(image) // 2, 10:-10]
    assert (np.diff(middle) > -1e-5).all()


def test_albedo_per_wall_and_colour() -> None:
    assert dihedral(1, albedo=(0.2, 0.4)).albedo.tolist() == [[0.2, 0.4]]
    assert dihedral(1, albedo=(0.1, 0.2, 0.3)).albedo.tolist() == [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]


def test_bad_dihedrals_are_refused() -> None:
    with pytest.raises(InputError, match="n is -3"):
        dihedral(-3)
    with pytest.raises(InputError, match="albedo has shape"):
        dihedral(2, albedo=[0.1] * 4)
    with pytest.raises(MemoryLimitError, match=r"dihedral, .* needs"):
        dihedral(10**6)


def test_a_right_angle_is_the_default() -> None:
    scene, same = dihedral(N), dihedral(N, angle=90)
    assert scene.walls == same.walls
    assert (scene.form_factors == same.form_factors).all()


def test_angles_around_the_right_one_meet_the_table() -> None:
    """89.9999 and 90.0001 degrees take other formulas than 90, and give its light at their mean."""
    around = [dihedral(N, angle=90 + step).form_factors for step in (-1e-4, 1e-4)]
    np.testing.assert_allclose(sum(around) / 2, dihedral(N).form_factors, rtol=1e-7)


def test_the_narrower_the_more_light_stays() -> None:
    kept = [dihedral(3, angle=angle).form_factors.sum(axis=1).mean() for angle in (1, 30, 60, 90, 135, 179)]
    assert (np.diff(kept) < 0).all()
    assert kept[0] > 0.97
    assert kept[-1] < 1e-3


@pytest.mark.parametrize("angle", [2, 50, 130, 178])
def test_walls_at_any_angle_mirror_each_other(angle: float) -> None:
    scene = dihedral(4, angle=angle)
    left, right = scene.walls
    assert -np.dot(left.right, right.right) == pytest.approx(np.cos(np.radians(angle)), abs=1e-12)
    F = scene.form_factors.reshape(4, 8, 4, 8)
    assert pytest.approx(F[:, ::-1, :, ::-1], rel=1e-6, abs=1e-18) == F
    image = scene.view(np.ones(scene.grid), size=120)
    assert image == pytest.approx(image[:, ::-1], abs=0.15)  # the seam's pixels may fall to either side
    assert all(scene.viewer.sees(wall) for wall in scene.walls)


@pytest.mark.parametrize("angle", [0, 180, -20, float("nan"), "90", None, [90]])
def test_angles_that_make_no_dihedral_are_refused(angle: Any) -> None:
    with pytest.raises(InputError, match=r"angle is .*; it must be a finite number above 0 and below 180"):
        dihedral(2, angle=angle)
