# SPDX-License-Identifier: BSD-3-Clause
"""What is light is kept, however weak, when there is enough of it; noise is dropped, and no sum with it."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.scanning.pictures import UNKNOWN
from ltcl.acquisition.scanning.thresholds import keep
from ltcl.errors import InputError

GRID = (24, 20)
M = 480


def noise(k: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((k, M))


def test_a_weak_block_is_kept_though_no_entry_stands_out():
    value, block = 0.3 * noise(200), np.zeros(GRID, bool)
    block[4:12, 8:16] = True
    value += np.clip(noise(200, 1), -0.5, 0.5)
    value[:, block.ravel()] += 1.0
    value = np.clip(value, -2.9, 2.9)  # below three standard deviations, all of them
    kept = keep(value, np.ones_like(value), GRID)
    assert kept[:, block.ravel()].mean() > 0.999
    assert np.sum(value[kept]) == pytest.approx(np.sum(value), rel=0.05)


def test_noise_is_dropped_without_a_bias():
    value = noise(400)
    kept = [keep(part, np.ones_like(part), GRID) for part in np.split(value, 40)]
    kept = np.concatenate(kept)
    assert kept.mean() < 0.05
    error = np.sqrt(np.sum(value[kept] ** 2))
    assert abs(np.sum(value[kept])) < 4 * error


def test_the_sum_of_a_column_is_light():
    """0.4 standard deviations everywhere: only the whole picture tells."""
    value = noise(50) + 0.4
    assert keep(value, np.ones_like(value), GRID).mean() > 0.99


def test_all_columns_together_tell_what_one_does_not():
    value = np.full((64, M), 0.1)
    assert not keep(value[:1], np.ones((1, M)), GRID).any()
    assert keep(value, np.ones((64, M)), GRID).all()


def test_strong_entries_stand_alone_and_the_unknown_stay():
    value, variance = np.zeros((1, M)), np.ones((1, M))
    value[0, 7], variance[0, 9] = 8.0, UNKNOWN
    np.testing.assert_array_equal(np.flatnonzero(keep(value, variance, GRID)), [7, 9])
    assert keep(value, variance, GRID, 0.0).all()
    with pytest.raises(InputError, match="sigmas is -1"):
        keep(value, variance, GRID, -1)
