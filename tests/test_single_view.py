# SPDX-License-Identifier: BSD-3-Clause
"""What a bounce takes away tells glossy scenes from diffuse ones, whatever the first bounce and the noise."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl import single_view
from ltcl.scenes import box, glossy


@pytest.mark.parametrize("first_bounce", ["diagonal", "exact"])
@pytest.mark.parametrize(("sides", "albedo"), [(2, 0.9), (3, 0.7), (6, 0.45), (6, 0.8)])
def test_diffuse_boxes_take_nothing(device, sides, albedo, first_bounce):
    T = box(6, sides, albedo).transport(first_bounce=first_bounce, device=device)
    assert max(single_view.negative_bounces(T)) < 1e-3


def test_it_is_that_of_the_dense_inverse(device):
    """Between the 16 rectangles of an 8 x 8 picture, of a matrix that takes light away."""
    random = np.random.default_rng(3)
    matrix = np.eye(64) + 0.02 * random.normal(size=(64, 64))
    T = ltcl.Transport(matrix, (8, 8), first_bounce=np.ones(64), device=device)
    A = np.eye(64) - np.linalg.inv(matrix)
    parts = A.reshape(4, 2, 4, 2, 4, 2, 4, 2).sum(axis=(1, 3, 5, 7)).reshape(16, 16)
    np.fill_diagonal(parts, 0.0)
    wanted = -parts[parts < 0].sum() / np.abs(parts).sum()
    assert single_view.negative_bounces(T)[0] == pytest.approx(wanted, rel=2e-2)


def test_noise_averages_out_over_the_parts(device):
    """5 % of noise in every entry of a diffuse corner; each part has 18 pixels."""
    scene = box(12, 2, 0.7)
    (clean,) = scene.matrices()
    noisy = clean * np.random.default_rng(1).normal(1.0, 0.05, clean.shape)
    T = ltcl.Transport(noisy, scene.grid, device=device)
    assert max(single_view.negative_bounces(T)) < 2e-3


def test_gloss_takes_more_the_more_there_is(device, caplog):
    found = []
    for gloss in (0.1, 0.3, 0.8):
        scene = glossy(
            box(1, sides=3),
            6,
            gloss=gloss,
            projector=(2.0, 1.4, 1.2),
            camera=(1.5, 1.2, 1.9),
            directions=16,
        )
        T = scene.transport(device=device)
        b = ltcl.separate(T, T @ np.ones(T.grid), bounces=1)
        assert "section 8.4" in b.warning
        assert b.warning in caplog.text
        found.append(b.negative_bounce)
    assert found == sorted(found)


def test_it_is_found_once(device, monkeypatch):
    T = box(3, 3, 0.5).transport(device=device)
    first = single_view.negative_bounces(T)
    monkeypatch.setattr(single_view, "solve", None)
    assert single_view.negative_bounces(T) == first
