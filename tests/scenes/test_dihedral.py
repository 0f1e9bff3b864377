# SPDX-License-Identifier: BSD-3-Clause
"""The dihedral: bounces alternate between the walls, and both walls mirror each other."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError, MemoryLimitError
from ltcl.scenes import dihedral
from ltcl.scenes.cube_tables import perpendicular

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
