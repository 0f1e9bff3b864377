# SPDX-License-Identifier: BSD-3-Clause
"""A scene: eq. 4, what it hands on, views and samples, light from a point, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltcl.scenes import Block, Scene, box, dihedral
from ltcl.scenes.scene import transport

COLOURS = [(0.8, 0.1, 0.1), (0.1, 0.7, 0.2), (0.5, 0.5, 0.5)]


@pytest.fixture(scope="module")
def corner() -> Scene:
    """Three coloured walls, 5 x 5 patches each."""
    return box(5, sides=3, albedo=COLOURS)


def test_transport_solves_equation_4_and_hands_everything_on(corner: Scene) -> None:
    assert isinstance(corner.A, tuple)
    for T, A, albedo in zip(corner.matrices(), corner.A, corner.albedo, strict=True):
        assert (albedo[:, None] * corner.form_factors == A).all()
        assert pytest.approx(np.diag(albedo), abs=1e-14) == T - A @ T
    T = corner.transport(first_bounce=corner.first_bounce)
    assert (T.grid, T.channels, T.shape) == (corner.grid, 3, (75, 75))
    assert T.first_bounce == pytest.approx(corner.albedo)
    assert all((a == b).all() for a, b in zip(T.matrices, corner.matrices(), strict=True))
    scene = dihedral(4, albedo=[0.9, 0.6])
    assert scene.transport("exact").first_bounce == pytest.approx(scene.first_bounce, rel=1e-12)
    pattern = np.random.default_rng(2).random(scene.grid).astype(np.float32)
    expected = scene.picture(scene.matrices()[0] @ pattern.ravel().astype(np.float64))
    assert scene.transport() @ pattern == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("size", [1, 2, 7, 512, 513, 1030])  # around the block size
def test_transport_of_unequal_patches(size: int) -> None:
    """Reciprocal form factors with row sums below one, albedos, some 0, and areas."""
    rng = np.random.default_rng(5)
    area, shared = rng.uniform(0.5, 2.0, size), rng.random((size, size))
    F = (np.triu(shared, 1) + np.triu(shared, 1).T) / area[:, None]
    F *= 0.95 / max(F.sum(axis=1).max(), 1e-300)
    albedo = rng.uniform(0, 0.99, size)
    albedo[:: max(1, size // 3)] = 0
    before = F.copy()
    T = transport(F, albedo, area)
    np.testing.assert_allclose(T - albedo[:, None] * (F @ T), np.diag(albedo), rtol=0, atol=1e-13)
    np.testing.assert_allclose(area[:, None] * T, (area[:, None] * T).T, rtol=0, atol=1e-13)
    assert not T[albedo == 0].any()
    assert not T[:, albedo == 0].any()
    assert (before == F).all()


def test_view_shows_each_wall_where_it_stands(corner: Scene) -> None:
    """Left wall left, right wall right, floor below, the seam of the two in the middle column."""
    image = corner.view(corner.picture(corner.first_bounce), size=101)
    assert (max(image.shape), image.dtype) == (101, np.float32)
    shown = [
        image[int(y * image.shape[0]), int(x * image.shape[1])]
        for y, x in [(0.3, 0.3), (0.3, 0.7), (0.75, 0.5)]
    ]
    np.testing.assert_allclose(shown, COLOURS, atol=1e-5)
    assert not image[0, 0].any()


def test_a_lamp_follows_cosine_inverse_square_and_the_shadow_of_a_block() -> None:
    """A thin plate at half the lamp's height: its shadow on the floor is twice as large, and straight."""
    plate = Block(corner=(0.4, 0.4, 0.5), size=(0.2, 0.2, 1e-6))
    lamp, n, room = (0.5, 0.5, 1.0), 20, box(20, sides=3)
    shaded = replace(room, blocks=(plate,))
    floor, dim = (scene.irradiance(lamp)[:, 2 * n :] for scene in (room, shaded))
    x = np.abs((np.arange(n) + 0.5) / n - 0.5)
    expected = (x[:, None] ** 2 + x**2 + 1) ** -1.5
    np.testing.assert_allclose(floor / floor.max(), expected / expected.max(), rtol=2e-3)
    dark = (x[:, None] < 0.2) & (x < 0.2)
    assert not dim[dark].any()
    np.testing.assert_allclose(dim[~dark], floor[~dark], rtol=1e-5)
