# SPDX-License-Identifier: BSD-3-Clause
"""Resampling keeps means when shrinking and ranges always."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ltcl.errors import InputError
from ltcl.images import resize

random = np.random.default_rng(7)


def test_shrinking_by_a_whole_factor_averages_blocks():
    image = random.random((12, 20, 3))
    blocks = image.reshape(4, 3, 4, 5, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(resize(image, (4, 4)), blocks, rtol=1e-5)


def test_shrinking_keeps_the_mean_at_any_factor():
    image = random.random((53, 47))
    np.testing.assert_allclose(resize(image, (7, 11)).mean(), image.mean(), rtol=1e-5)


def test_one_axis_may_shrink_while_the_other_grows():
    image = random.random((12, 5))
    columns = resize(image, (4, 5))
    np.testing.assert_allclose(columns, image.reshape(4, 3, 5).mean(axis=1), rtol=1e-5)
    np.testing.assert_array_equal(resize(image, (4, 9)), resize(columns, (4, 9)))


def test_growing_keeps_a_ramp_between_its_ends():
    ramp = np.arange(4.0)[None, :]
    inner = resize(ramp, (1, 8))[0, 1:-1]
    np.testing.assert_allclose(inner, np.linspace(0.25, 2.75, 6), rtol=1e-6)


def test_the_same_grid_changes_nothing():
    image = random.random((3, 5, 3)).astype(np.float32)
    np.testing.assert_array_equal(resize(image, (3, 5)), image)


@settings(max_examples=60, deadline=None)
@given(
    *[st.integers(1, 40) for _ in range(4)],
    st.sampled_from([(), (3,)]),
    st.integers(0, 2**32 - 1),
)
def test_no_value_leaves_the_range_of_the_input(h, w, new_h, new_w, channels, seed):
    image = np.random.default_rng(seed).normal(size=(h, w, *channels)).astype(np.float32)
    result = resize(image, (new_h, new_w))
    assert result.shape == (new_h, new_w, *channels)
    assert result.dtype == np.float32
    room = 1e-5 * np.abs(image).max()  # float32 sums of up to 1600 weights
    assert result.min() >= image.min() - room
    assert result.max() <= image.max() + room


@pytest.mark.parametrize("grid", [(0, 4), (4,), "44", (2.5, 3), None])
def test_a_bad_grid_is_refused(grid):
    with pytest.raises(InputError, match="grid"):
        resize(np.zeros((4, 4)), grid)


@pytest.mark.parametrize(
    "image",
    [np.zeros(4), np.zeros((0, 4)), np.zeros((4, 4, 2)), np.zeros((2, 4, 4, 3)), np.full((2, 2), np.nan)],
)
def test_a_bad_image_is_refused(image):
    with pytest.raises(InputError, match="image"):
        resize(image, (2, 2))
