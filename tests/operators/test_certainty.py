# SPDX-License-Identifier: BSD-3-Clause
"""What is certain of walks, against powers of R in float64 and against walks."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.operators import CSR, Dense
from ltcl.operators.alias import tables
from ltcl.operators.certainty import reached, without_noise
from ltcl.operators.links import links
from ltcl.operators.walks import Walker, geometric, whole
from tests import gallery

CHAIN = np.diag(np.full(8, 0.5, np.float32), 1)  # each pixel leads to the next
SPARSE = gallery.sparse(41, 41, 0.04, seed=3).toarray()


@pytest.mark.parametrize("k", [1, 5])
@pytest.mark.parametrize("form", ["csr", "dense"])
@pytest.mark.parametrize("R", [CHAIN, SPARSE, np.zeros((1, 1), np.float32), np.ones((1, 1), np.float32)])
def test_pixels_are_reached_as_by_powers_of_the_pattern(device, R, form, k):
    M = CSR(device, scipy.sparse.csr_array(R)) if form == "csr" else Dense(device, R)
    goal = np.random.default_rng(1).random((len(R), k)) < 0.1
    for steps in (1, 2, 5, 300):
        wanted, now = np.zeros_like(goal), goal
        for _ in range(steps):
            now = (np.abs(R) > 0) @ now.astype(float) > 0
            wanted |= now
        np.testing.assert_array_equal(reached(M, goal, steps), wanted)


def test_entries_that_cancel_do_not_hide_a_pixel(device):
    R = np.array([[0.0, 1.0, -1.0], [0, 0, 0], [0, 0, 0]])
    assert reached(Dense(device, R), np.array([[False], [True], [True]]), 3)[0, 0]


def test_what_is_too_far_apart_counts_as_within_reach(device):
    R = CSR(device, scipy.sparse.csr_array(np.diag(np.full(599, 0.5, np.float32), 1)))
    goal = np.arange(600)[:, None] == 599
    assert reached(R, goal, 10_000).all()
    np.testing.assert_array_equal(np.flatnonzero(reached(R, goal, 100)), np.arange(499, 599))


@pytest.mark.parametrize("lengths", [geometric(0.6, -1.0), whole(np.array([-1.0, 1.0, -1.0]))])
@pytest.mark.parametrize("estimator", ["collision", "endpoint"])
def test_certain_pixels_score_alike_and_the_others_do_not(device, estimator, lengths):
    """Of many samples: those that differ here are frequent."""
    R = CSR(device, scipy.sparse.csr_array(np.vstack([CHAIN[:-1], np.full((1, 9), 0.05), np.zeros((0, 9))])))
    b = np.array([1.0, 0, 0, 0, 0.5, 0, 0, 0, 0])
    made = tables(R)
    only_dark = estimator == "endpoint"
    certain = without_noise(R, made, lengths, b, only_dark)
    found = Walker(made, lengths, estimator, 0).rows(device.upload(b), np.arange(9), 0, 20_000)
    assert found.alike[certain].all()
    if not only_dark or not lengths.are_one:
        np.testing.assert_array_equal(found.alike, certain)
    assert 0 < certain.sum() < 9 or not lengths.are_one


@pytest.mark.parametrize("lengths", [geometric(0.6, 1.0), whole(np.array([1.0, 1.0, 1.0]))])
def test_of_shared_walks_each_channel_is_certain_by_its_own_entries(device, lengths):
    Rs = [np.zeros((9, 9), np.float32) for _ in range(3)]
    Rs[0][:] = CHAIN
    Rs[1][[0, 1, 4, 8], [2, 2, 8, 0]] = 0.5
    Rs[2][8] = 0.05
    Rs = [CSR(device, scipy.sparse.csr_array(R)) for R in Rs]
    b = np.array([1.0, 0, 0, 0, 0.5, 0, 0, 0, 0])
    made = links(Rs, (1.0, 1.0, 1.0))
    light = device.upload(np.stack([b] * 3, axis=1))
    found = Walker(made, lengths, "collision", 0).rows(light, np.arange(9), 0, 20_000)
    for c, R in enumerate(Rs):
        certain = without_noise(R, made, lengths, b)
        np.testing.assert_array_equal(found.alike[:, c], certain)
        assert certain.any()
    assert not found.alike.all()
