# SPDX-License-Identifier: BSD-3-Clause
"""Scenes of many pixels in each patch: their T is (I - A)^-1 diag(r), and near the exact one."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest

import ltcl
from ltcl.scenes import Block, FormFactor, RefinedScene, Scene, box, dihedral, refine, trihedral
from tests.scenes.test_scene import COLOURS

SCENES: dict[str, Callable[[], Scene]] = {
    "two walls, one of them black": lambda: dihedral(3, albedo=[0.9, 0.0]),
    "three colours": lambda: box(2, sides=3, albedo=COLOURS),
    "slanted walls": lambda: trihedral(2, albedo=0.6, angle=60),
    "patches of two sizes": lambda: box(
        2, sides=3, albedo=0.7, occluder=Block((0.2, 0.3, 0), (0.5, 0.3, 0.4), albedo=0.6)
    ),
}


def bounces(scene: RefinedScene) -> list[np.ndarray]:
    """A of each channel, (N, N)."""
    return [np.asarray(A @ np.eye(len(scene.area))) for A in scene.bounces]


@pytest.mark.parametrize("detail", [1, 2, 3])
@pytest.mark.parametrize("name", SCENES)
def test_transport_solves_equation_4(name: str, detail: int) -> None:
    patches = SCENES[name]()
    scene = refine(patches, detail)
    T = scene.transport()
    assert T.grid == scene.grid == tuple(detail * side for side in patches.grid)
    matrices = T.to_numpy().reshape(scene.channels, *T.shape)
    for channel, A in enumerate(bounces(scene)):
        S = np.linalg.inv(np.eye(len(A)) - A)
        expected = S * scene.albedo[channel]
        np.testing.assert_allclose(matrices[channel], expected, rtol=0, atol=2e-6)
        diagonal = T.systems[channel].diagonal()
        np.testing.assert_allclose(diagonal, np.diagonal(S), rtol=0, atol=2e-6)
        weights = T.systems[channel].weights
        assert (weights is None) == (not scene.albedo.all())
        if weights is not None:
            weighted = weights[:, None] * S
            np.testing.assert_allclose(weighted, weighted.T, rtol=0, atol=1e-12)
    if detail == 1:
        exact = np.stack(patches.matrices())
        np.testing.assert_allclose(matrices, exact, rtol=0, atol=2e-6)


@pytest.mark.parametrize(("rows", "columns"), [([0, 5, 7, 16], [5, 3]), ([16], [16, 0, 16])])
@pytest.mark.parametrize("name", SCENES)
def test_entries_of_some_pixels_are_those_of_products(name, rows, columns) -> None:
    scene = refine(SCENES[name](), 3)
    T = scene.transport()
    matrices = T.to_numpy().reshape(scene.channels, *T.shape)
    for matrix, operator in zip(matrices, T.matrices, strict=True):
        entries = operator.between(np.array(rows), np.array(columns))
        expected = matrix[np.ix_(rows, columns)]
        np.testing.assert_allclose(entries, expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("name", SCENES)
def test_pixels_exchange_light_reciprocally_and_make_none(name: str) -> None:
    patches = SCENES[name]()
    scene = refine(patches, 3)
    (A, *_) = bounces(scene)
    lit = scene.albedo[0] > 0
    F = A[lit] / scene.albedo[0][lit, None]
    exchanged = scene.area[lit, None] * F[:, lit]
    np.testing.assert_allclose(exchanged, exchanged.T, rtol=0, atol=1e-15)
    assert F.min() >= 0
    assert F.sum(axis=1).max() <= patches.form_factors.sum(axis=1).max() + 1e-12
    assert scene.area.sum() == pytest.approx(patches.area.sum())


def test_light_approaches_that_of_exact_form_factors() -> None:
    """The error of a picture falls by a third and more with half the patch."""
    exact = dihedral(32, albedo=0.7)
    desired = exact.sample(ltcl.scenes.landscape(240, 480)[..., 1]).ravel().astype(np.float64)
    (T,) = exact.matrices()
    seen = T @ desired
    errors = []
    for patches in (4, 8, 16):
        scene = refine(dihedral(patches, albedo=0.7), 32 // patches)
        picture = (scene.transport() @ desired.reshape(scene.grid)).ravel()
        errors.append(np.linalg.norm(picture - seen) / np.linalg.norm(seen))
    assert errors[1] < 0.67 * errors[0]
    assert errors[2] < 0.67 * errors[1]
    assert errors[2] < 0.012


def test_exact_form_factors_of_its_pixels_are_those_of_small_patches(device) -> None:
    scene = refine(box(2, sides=3, albedo=0.5), 4)
    (A,) = FormFactor.of(scene, device)
    np.testing.assert_allclose(A.to_dense(), box(8, sides=3, albedo=0.5).A, rtol=0, atol=1e-4)


def test_pictures_are_on_its_pixels() -> None:
    scene = refine(box(4, sides=3, albedo=COLOURS), 4)
    fine = box(16, sides=3, albedo=COLOURS)
    image = ltcl.scenes.landscape(60, 80)
    np.testing.assert_array_equal(scene.sample(image), fine.sample(image))
    picture = scene.picture(scene.first_bounce)
    np.testing.assert_array_equal(picture, fine.picture(fine.first_bounce))
    np.testing.assert_array_equal(scene.view(picture, size=50), fine.view(picture, size=50))
    lamp = (0.5, 0.6, 0.7)
    np.testing.assert_array_equal(scene.irradiance(lamp), fine.irradiance(lamp))
    assert "16 x 48" in repr(scene)


def test_it_comes_back_from_a_file_and_as_a_copy(tmp_path) -> None:
    scene = refine(box(3, sides=3, albedo=COLOURS), 4)
    T = scene.transport()
    pattern = np.random.default_rng(1).random((*scene.grid, 3))
    picture = T @ pattern
    ltcl.save(tmp_path / "T.npz", T)
    for again in (ltcl.load(tmp_path / "T.npz"), copy.deepcopy(T)):
        np.testing.assert_array_equal(again @ pattern, picture)
        np.testing.assert_array_equal(again.first_bounce, T.first_bounce)


def test_T_is_no_larger_than_that_of_the_patches() -> None:
    patches = dihedral(8, albedo=0.5)
    T = refine(patches, 16).transport()
    core = 4 * len(patches.area) ** 2
    hats = 9 * 4 * T.shape[0]
    assert core < T.nbytes < core + 2 * hats
