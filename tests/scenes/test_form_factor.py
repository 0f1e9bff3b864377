# SPDX-License-Identifier: BSD-3-Clause
"""Bounces without a stored matrix, and rays past boxes: twins, exact matrices, solves."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import ltcl
from ltcl.operators import IdentityPlus
from ltcl.scenes import Block, FormFactor, Patches, box, cut, visibility
from ltcl.scenes.builders import WALLS
from ltcl.scenes.exchange import form_factors
from ltcl.scenes.visibility import Rays
from tests import gallery, reference
from tests.operators import helpers
from tests.scenes.closed_forms import closed_room, slope

BLOCK = [[(0.25, 0.25, 0.0), (0.75, 0.5, 0.5)]]


def tiles(count: int) -> Patches:
    """Parallelograms of many sizes around a middle, most of which see each other."""
    rng = np.random.default_rng(count)
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    right = np.cross(out, rng.normal(size=(count, 3)))
    scale = rng.uniform(0.02, 0.1, (count, 1))
    return Patches(3 * out, scale * right, scale * (np.cross(right, out) + 0.3 * right))


# A patch on the floor, and one 20 sizes away that stands half below its plane: both see but a part.
ASTRIDE = Patches(
    np.eye(3)[[0, 0]] * [[0], [20]] + [[0, 0, 0], [0, 0, 0.1]],
    np.eye(3)[:2],
    np.eye(3)[[1, 2]] * [[-1], [1]],
)
SCENES = {
    "astride a plane": (ASTRIDE, None),
    "1 patch": (cut(WALLS[:1], 1), None),
    "53 tiles": (tiles(53), None),
    "room": (cut(WALLS, 3), None),
    "two blocks": (cut(WALLS, 3), [*BLOCK, [(0.4, 0.6, 0.2), (0.6, 0.7, 0.9)]]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_products_meet_their_twin(shaped, name):
    patches, blocks = SCENES[name]
    albedo = np.linspace(0.2, 0.9, len(patches))
    A = FormFactor(patches, albedo, blocks, shaped)
    G = reference.form_factor_entries(
        A._geometry.get()[:, : len(patches)], A._blocks.get()[: len(blocks or ())]
    )
    kernel = albedo[:, None] * G * A._area.get().astype(np.float64)
    near = A._near.to_dense()
    matrix = kernel + near
    dense = A.to_dense()
    # An entry is some 30 roundings; corrections cancel kernel values, which then count with their
    # size.
    size = np.abs(kernel) + np.abs(near) + np.abs(matrix)
    off = np.abs(dense - matrix) > 1e-4 * size
    if blocks is not None:  # a ray that grazes a block counts either way
        assert np.count_nonzero(off) <= 0.01 * off.size
        matrix = dense
    for k in helpers.COLUMNS if name == "53 tiles" else (None, 5):
        x = gallery.vectors(len(patches), k)
        y = gallery.vectors(len(patches), k, 2)
        for apply, twin, bound in ((A.apply, matrix, size), (A.apply_transpose, matrix.T, size.T)):
            out = apply(shaped.upload(x), None, scale=-0.75, add=shaped.upload(y)).get()
            error = 32 * reference.product_error(bound, x, -0.75, y)
            helpers.close(out, reference.dense_matvec(twin, x, -0.75, y), error)


def smooth(patches: Patches) -> np.ndarray:
    """Three smooth pictures, (N, 3)."""
    x, y, z = patches.centre.T
    return np.stack([np.ones_like(x), 1 + np.sin(3 * x + 1) * np.cos(2 * y) + z, z**2], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("walls", "n"),
    [(WALLS, 1), (WALLS, 8), (WALLS[:3], 8), (WALLS[:2], 20)]
    + [((slope(angle), WALLS[2]), 12) for angle in (30, 70, 120)]
    + [(closed_room((1000.0, 0, 0), (0, 1000.0, 0), (700.0, 0, 700.0)), 6)],
)
def test_products_are_those_of_the_exact_matrix(device, walls, n):
    """F x within 1e-4 of the largest value for smooth x; F within `error` where areas are equal."""
    patches = cut(walls, n)
    F = form_factors(walls, n)
    A = FormFactor(patches, device=device)
    x = smooth(cut(walls, n))
    np.testing.assert_array_less(np.abs(A @ x - F @ x).max(axis=0), 1e-4 * (F @ x).max(axis=0))
    if np.ptp(patches.area) < 1e-9 * patches.area.max():
        assert np.linalg.norm(A.to_dense() - F, 2) <= A.error == 1e-4
    assert not A.diagonal().any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "block",
    [
        Block((0.31, 0.23, 0), (0.37, 0.29, 0.43), albedo=0.5),  # on the floor, faces cut patches
        # Faces between patches.
        Block((0.25, 0.25, 0.25), (0.5, 0.5, 0.25), albedo=(0.5, 0.3, 0.2)),
        Block((0, 0.4, 0), (0.3, 0.6, 0.7), albedo=0.5),  # in a corner
        None,
    ],
)
def test_a_scene_gives_its_operators(device, block):
    """Exact form factors times 256 rays a pair agree to 1.5 % of the norm, and so does light."""
    room = box(8, albedo=0.5, occluder=block, device=device)
    l_d = np.random.default_rng(2).random(len(room.area))
    matrices = room.A if room.channels == 3 else (room.A,)
    for A, dense in zip(FormFactor.of(room, device), matrices, strict=True):
        assert np.linalg.norm(A.to_dense() - dense) < (0.015 if block else 1e-4) * np.linalg.norm(
            dense
        )
        assert A.row_sums().max() < 0.51
        light = ltcl.solve(IdentityPlus(A, sign=-1), l_d, rtol=1e-4).x
        expected = np.linalg.solve(np.eye(len(l_d)) - dense, l_d)
        assert np.linalg.norm(light - expected) < 0.01 * np.linalg.norm(expected)


@pytest.mark.slow
def test_launches_in_slabs_give_the_same(device, monkeypatch):
    patches = cut(WALLS, 3)
    A = FormFactor(patches, 0.5, device=device)
    x = device.upload(gallery.vectors(54, 5))
    whole = A.apply(x).get()
    seen = visibility(patches, BLOCK, device)
    monkeypatch.setattr("ltcl.scenes.form_factor.PAIRS_PER_LAUNCH", 7 * 56)
    monkeypatch.setattr(sys.modules[Rays.__module__], "TESTS_PER_LAUNCH", 54 * 16 * 7)
    helpers.same_rows(
        device, whole, A.apply(x).get(), reference.product_error(A.to_dense(), x.get())
    )
    np.testing.assert_array_equal(visibility(patches, BLOCK, device), seen)


@pytest.mark.parametrize(
    ("count", "boxes", "samples"), [(1, 1, 1), (8, 2, 3), (9, 1, 4), (53, 5, 4)]
)
def test_rays_meet_their_twin(shaped, count, boxes, samples):
    rng = np.random.default_rng(count)
    patches = Patches(*rng.uniform(-1, 1, (3, count, 3)) * np.array([3, 0.3, 0.3])[:, None, None])
    low = rng.uniform(-3, 2, (boxes, 3))
    blocks = np.stack([low, low + rng.uniform(0.2, 2, (boxes, 3))], axis=1)
    seen = visibility(patches, blocks, shaped, samples=samples)
    rays = Rays(patches, blocks, shaped, samples)
    starts, ends = (
        p.get().reshape(samples**2, 3, -1)[..., :count] for p in (rays._starts, rays._ends)
    )
    expected = reference.form_factor_visible(
        starts, ends, rays._normals.get()[:, :count], rays._blocks.get()
    )
    # A ray that grazes a box or a plane to rounding counts either way: one in a hundred entries at
    # most.
    assert np.count_nonzero(np.abs(seen - expected) > 1e-6) <= 0.01 * count**2
    np.testing.assert_array_equal(seen, seen.T)
