# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import Radiance, mixing, unmix
from ltcl.errors import InputError, InputTypeError
from tests.acquisition.radiometry.cameras import corner

M = np.array([[1.0, 0.3, 0.02], [0.1, 1.0, 0.2], [0.01, 0.15, 1.0]])
WALL = np.stack(
    [corner(64), 0.5 * corner(64)[::-1], 0.8 * corner(64).T], axis=-1
)  # what T does in each channel


def lit(sigma: float, seed: int = 0, M: np.ndarray = M, ambient: float = 0.0) -> list[Radiance]:
    rng = np.random.default_rng(seed)
    clean = [ambient + WALL * M[..., d] for d in range(3)]
    shape = WALL.shape
    return [
        Radiance(c + rng.normal(0, sigma, shape), np.full(shape, sigma**2), np.full(shape, True))
        for c in clean
    ]


def test_the_mixing_of_a_set_up_is_found_without_bias():
    found = [mixing(lit(0.2, seed)) for seed in range(16)]
    error = np.std(found, axis=0) / 4
    off = np.abs(np.mean(found, axis=0) - M)
    assert np.all(off[error > 0] < 4 * error[error > 0])
    assert error.max() < 0.015
    np.testing.assert_array_equal(np.diagonal(found[0]), 1.0)


def test_black_is_subtracted():
    black = Radiance(np.full(WALL.shape, 0.3), np.full(WALL.shape, 1e-8), np.full(WALL.shape, True))
    np.testing.assert_allclose(mixing(lit(1e-4, ambient=0.3), black), M, atol=1e-3)


def test_each_pixel_has_its_own_where_it_is_told():
    own = np.broadcast_to(M, (64, 64, 3, 3)).copy()
    own[:32, :, 0, 1] = 0.6
    pictures = lit(1e-4, M=own)
    found = mixing(pictures, per_pixel=True)
    assert found.shape == (64, 64, 3, 3)
    told = WALL.min(axis=-1) > 0.1
    np.testing.assert_allclose(found[told], own[told], atol=0.01)
    pictures[0].valid[3, 4] = False
    np.testing.assert_array_equal(mixing(pictures, per_pixel=True)[3, 4], mixing(pictures))


def test_unmix_undoes_the_mixing():
    pattern = np.random.default_rng(0).random((5, 7, 3))
    np.testing.assert_allclose(unmix(pattern @ M.T, M), pattern, atol=1e-6)
    own = M + 0.1 * np.random.default_rng(1).random((5, 7, 3, 3))
    np.testing.assert_allclose(unmix((own @ pattern[..., None])[..., 0], own), pattern, atol=1e-6)


def test_what_tells_no_mixing_is_refused():
    good = lit(1e-3)
    with pytest.raises(InputError, match=r"lit holds 2 picture\(s\)"):
        mixing(good[:2])
    with pytest.raises(InputTypeError, match=r"lit\[1\] is a ndarray"):
        mixing([good[0], WALL, good[2]])  # pyright: ignore[reportArgumentType]
    dark = Radiance(np.zeros(WALL.shape), good[0].variance, good[0].valid)
    with pytest.raises(InputError, match=r"no light in its own channel"):
        mixing([dark, dark, dark])
    with pytest.raises(InputError, match="condition number"):
        mixing([lit(0.0)[0]] * 3)  # all three colours look the same
    with pytest.raises(InputError, match="condition number"):
        unmix(np.ones(3), np.ones((3, 3)))
    with pytest.raises(InputError, match=r"picture has shape \(2,\)"):
        unmix(np.ones(2), M)
