# SPDX-License-Identifier: BSD-3-Clause
"""Boxes, dihedrals, trihedrals: what theory says about them, and rooms with a block against sampling."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import MemoryLimitError
from ltcl.scenes import Block, Scene, box, dihedral, trihedral
from tests.scenes.closed_forms import perpendicular, sampled

N = 4
TABLE = Block(corner=(0.3, 0.35, 0), size=(0.35, 0.3, 0.5), albedo=0.6)
LAMP = Block(corner=(0.31, 0.27, 0.2), size=(0.33, 0.41, 0.37), albedo=(0.9, 0.5, 0.2))


def spectrum(scene: Scene) -> np.ndarray:
    """Eigenvalues of A, ascending; A is symmetric where areas and albedos are equal."""
    A = scene.A
    assert isinstance(A, np.ndarray)
    assert (A == A.T).all()
    return np.linalg.eigvalsh(A)


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_closed_box_of_uniform_albedo_reaches_the_bound_of_equation_14(albedo: float) -> None:
    scene = box(N, albedo=albedo)
    assert max(abs(spectrum(scene))) == pytest.approx(albedo, rel=1e-9)
    (T,) = scene.matrices()
    R = T / albedo - np.eye(len(T))
    assert max(abs(np.linalg.eigvalsh((R + R.T) / 2))) == pytest.approx(albedo / (1 - albedo), rel=1e-9)
    assert T.sum(axis=1) == pytest.approx(albedo / (1 - albedo), rel=1e-9)  # uniform light glows uniformly


def test_bounces_of_a_dihedral_alternate() -> None:
    n, scene = 6, dihedral(6, albedo=0.9)
    table, F = perpendicular(n), scene.form_factors.reshape(n, 2 * n, n, 2 * n)
    for row, column, other_row, other_column in [(0, 5, 0, 6), (0, 0, 5, 11), (3, 4, 1, 8)]:
        expected = table[abs(row - other_row), n - 1 - column, other_column - n]
        assert F[row, column, other_row, other_column] == pytest.approx(expected, rel=1e-8)
    light = np.zeros((n, 2 * n))
    light[2, 1] = 1
    for bounce in range(1, 5):
        light = (scene.A @ light.ravel()).reshape(n, 2 * n)
        assert not (light[:, :n] if bounce % 2 else light[:, n:]).any()
    eigenvalues = spectrum(scene)
    assert eigenvalues == pytest.approx(-eigenvalues[::-1], abs=1e-12)


@pytest.mark.parametrize(
    ("make", "angles"), [(dihedral, (1, 30, 60, 90, 135, 179)), (trihedral, (5, 30, 60, 90, 119.9))]
)
def test_the_narrower_the_more_light_stays(make: Any, angles: tuple[float, ...]) -> None:
    scenes = [make(3, angle=angle) for angle in angles]
    sums = [scene.form_factors.sum(axis=1).mean() for scene in scenes]
    assert (np.diff(sums) < 0).all()
    assert sums[-1] < 0.01
    for angle, scene in zip(angles, scenes, strict=True):
        assert all(scene.viewer.sees(wall) for wall in scene.walls)
        walls = len(scene.walls)
        F = scene.form_factors.reshape(3, walls, 3, 3, walls, 3).sum(axis=(0, 2, 3, 5))
        np.testing.assert_allclose(F[~np.eye(walls, dtype=bool)], F[0, 1], rtol=1e-7)  # walls are alike
        turn = scene.walls[0].right @ np.array(scene.walls[1].right)
        assert -turn == pytest.approx(np.cos(np.radians(angle)), abs=1e-12)


def test_too_large_scenes_are_refused_before_anything_is_allocated(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MemoryLimitError, match=r"dihedral.* needs .* TiB"):
        dihedral(10**5)
    monkeypatch.setattr(checks, "host_memory", lambda: 4 * 8 * 96**2 - 1)
    with pytest.raises(MemoryLimitError, match="96 x 96"):
        box(4)
    assert box(4, sides=5).grid == (4, 20)


def sums(scene: Scene) -> np.ndarray:
    """Row sums of the form factors by wall, (walls, n, n)."""
    n = scene.grid[0]
    return scene.form_factors.sum(axis=1).reshape(n, -1, n).swapaxes(0, 1)


def test_a_closed_room_with_a_block_loses_no_light_and_is_reciprocal(device: Device) -> None:
    scene = box(7, occluder=LAMP, device=device)
    rows = sums(scene)
    assert len(rows) == 12
    assert rows.max() <= 1 + 1e-12
    assert rows[:6].min() > 0.99
    assert np.abs(rows[:6] - 1).mean() < 3e-3
    assert rows[6:].min() > 0.999  # its faces: exact before rows of the room were scaled
    exchange = scene.area[:, None] * scene.form_factors
    np.testing.assert_allclose(exchange, exchange.T, rtol=1e-13)


@pytest.mark.parametrize("block", [TABLE, LAMP])
def test_exchange_past_a_block_agrees_with_sampling(device: Device, block: Block) -> None:
    scene = box(N, occluder=block, device=device)
    walls = scene.walls
    F = scene.form_factors.reshape(N, len(walls), N, N, len(walls), N)
    for i, j in ((0, 4), (1, 5), (2, 3), (0, 5), (2, 4), (1, 6), (3, 10), (2, 6)):
        mean, error = sampled(walls[i], walls[j], 100_000, block)
        assert F[:, i, :, :, j].sum() * walls[i].area / N**2 == pytest.approx(
            mean, abs=5 * error + 5e-3 * mean
        )
