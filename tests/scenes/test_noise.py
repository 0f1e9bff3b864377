# SPDX-License-Identifier: BSD-3-Clause
"""Noise keeps its forms at any resolution; steps and blends meet their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.scenes.noise import blend, fractal, look_up, ridged, step


@pytest.mark.parametrize("noise", [fractal, ridged])
def test_noise_is_the_same_at_any_resolution(noise) -> None:
    coarse, fine = (noise(np.random.default_rng(4), (size, 2 * size), (3, 6), 3) for size in (64, 192))
    # The middle of every 3 x 3 fine pixels lies where the coarse pixel has its centre, half a texel off
    # in OpenCV's convention of pixel corners.
    assert np.corrcoef(coarse.ravel(), fine[1::3, 1::3].ravel())[0, 1] > 0.98


def test_fractal_noise_has_mean_one_half_and_ridged_noise_stays_in_range() -> None:
    rng = np.random.default_rng(9)
    assert fractal(rng, (256, 256), (32, 32), 4).mean() == pytest.approx(0.5, abs=0.02)
    ridges = ridged(rng, (256, 256), (8, 8), 5)
    assert ridges.min() >= 0
    assert ridges.max() <= 1


def test_step_is_monotone_between_its_ends() -> None:
    x = np.linspace(-1, 3, 41)
    rising = step(0, 2, x)
    assert (np.diff(rising) >= 0).all()
    assert (rising[0], rising[-1], step(0, 2, 1.0)) == (0, 1, 0.5)
    assert step(2, 0, x) == pytest.approx(1 - rising)


def test_blend_goes_from_one_colour_to_the_other() -> None:
    weight = np.array([[0.0, 0.25, 1.0]], np.float32)
    assert blend((1, 0, 0), (0, 0, 1), weight).tolist() == [[[1, 0, 0], [0.75, 0, 0.25], [0, 0, 1]]]


def test_look_up_broadcasts_and_mirrors() -> None:
    texture = np.arange(12, dtype=np.float32).reshape(3, 4)
    values = look_up(texture, np.array([[0.0, 1.0, -1.0, 4.0]]), np.array([[0.0], [2.0]]))
    assert values.tolist() == [[0, 1, 0, 3], [8, 9, 8, 11]]
