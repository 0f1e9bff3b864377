# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import Radiance, mixing
from ltcl.errors import InputError, InputTypeError
from tests.acquisition.radiometry.cameras import corner

M = np.array([[1.0, 0.3, 0.02], [0.1, 1.0, 0.2], [0.01, 0.15, 1.0]])
WALL = np.stack([corner(64), 0.5 * corner(64)[::-1], 0.8 * corner(64).T], axis=-1)  # T in each channel
random = np.random.default_rng()


def lit(sigma: float, M: np.ndarray = M, ambient: float = 0.0) -> list[Radiance]:
    clean = [ambient + WALL * M[:, d] for d in range(3)]
    variance, valid = np.full(WALL.shape, sigma**2), np.full(WALL.shape, True)
    return [Radiance(c + random.normal(0, sigma, c.shape), variance, valid) for c in clean]


def test_the_mixing_of_a_set_up_is_estimated_without_bias():
    estimates = [mixing(lit(0.2)) for _ in range(16)]
    error = np.std(estimates, axis=0) / 4
    bias = np.abs(np.mean(estimates, axis=0) - M)
    assert np.all(bias[error > 0] < 4 * error[error > 0])
    assert error.max() < 0.015
    np.testing.assert_array_equal(np.diagonal(estimates[0]), 1.0)


def test_black_is_subtracted():
    black = Radiance(np.full(WALL.shape, 0.3), np.full(WALL.shape, 1e-8), np.full(WALL.shape, True))
    np.testing.assert_allclose(mixing(lit(1e-4, ambient=0.3), black), M, atol=1e-3)


@pytest.mark.parametrize(("condition", "refused"), [(0.9e6, False), (1.1e6, True)])
def test_mixings_are_refused_from_a_condition_number_of_a_million(condition, refused):
    """[[1, 1 - d], [1 - d, 1]] has the condition number (2 - d) / d."""
    d = 2.0 / (condition + 1.0)
    nearly = np.array([[1.0, 1.0 - d, 0.0], [1.0 - d, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.linalg.cond(nearly) == pytest.approx(condition, rel=1e-6)
    pictures = lit(0.0, nearly)
    if refused:
        with pytest.raises(InputError, match=r"condition number 1\.1e\+06"):
            mixing(pictures)
    else:
        np.testing.assert_allclose(mixing(pictures), nearly, atol=1e-12)


def test_pictures_without_a_mixing_are_refused():
    good = lit(1e-3)
    dark = Radiance(np.zeros(WALL.shape), good[0].variance, good[0].valid)
    unknown = Radiance(good[0].value, good[0].variance, np.zeros(WALL.shape, bool))
    grey = Radiance(*(part[..., 0] for part in (good[0].value, good[0].variance, good[0].valid)))
    for pictures, part in (
        (good[:2], "lit holds 2"),
        ([dark, dark, dark], r"lit\[0\]"),
        ([good[0], grey, good[2]], r"lit\[1\] has shape \(64, 64\)"),
        ([unknown, *good[1:]], "lit have no pixel"),
    ):
        with pytest.raises(InputError, match=part):
            mixing(pictures)
    with pytest.raises(InputTypeError, match=r"lit\[1\] is a ndarray"):
        mixing([good[0], WALL, good[2]])  # pyright: ignore[reportArgumentType]
