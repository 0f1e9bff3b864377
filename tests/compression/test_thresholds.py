# SPDX-License-Identifier: BSD-3-Clause
"""What a threshold drops, and the threshold for what may be dropped."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.compression.thresholds import above, norm_2, random_start, threshold_for
from tests import gallery


@pytest.mark.parametrize("name", gallery.SPARSE)
@pytest.mark.parametrize("threshold", [0.0, 0.3, 5.0])
def test_what_is_kept_and_what_is_lost_make_the_whole(name, threshold):
    C = gallery.SPARSE[name]
    kept, lost = above(C, threshold)
    dense = C.toarray().astype(np.float64)
    np.testing.assert_array_equal(kept.toarray(), np.where(abs(dense) >= threshold, dense, 0.0))
    assert lost == pytest.approx(np.sum((dense - kept.toarray()) ** 2), abs=1e-12)


@pytest.mark.parametrize("error", [1e-3, 0.3, 2.0, 1e3])
@pytest.mark.parametrize("name", [name for name in gallery.SPARSE if name != "all empty"])
def test_a_threshold_drops_about_what_it_may(name, error):
    C = gallery.SPARSE[name]
    kept, _lost = above(C, threshold_for(C, error))
    dropped = np.linalg.norm(C.toarray().astype(np.float64) - kept.toarray(), 2)
    assert dropped <= 1.05 * error  # found by power iteration, which comes from below
    frobenius = np.linalg.norm(C.data.astype(np.float64))
    assert kept.nnz == 0 if frobenius <= error else kept.nnz > 0
    smallest = abs(kept.data).min(initial=np.inf)
    more = above(C, np.nextafter(smallest, np.float32(np.inf)))[0]
    # One number more would be too much, or has come close.
    assert kept.nnz == 0 or dropped > 0.5 * error or np.linalg.norm((C - more).toarray(), 2) > 0.5 * error


def test_nothing_has_no_threshold():
    assert threshold_for(scipy.sparse.csr_array((4, 4)), 0.1) == 0.0


@pytest.mark.parametrize("n", [1, 30])
def test_the_norm_from_below(n):
    A = gallery.signed(n, n).astype(np.float64)
    norm, v = norm_2(A.__matmul__, A.T.__matmul__, random_start(n), steps=200)
    assert norm == pytest.approx(np.linalg.norm(A, 2), rel=1e-3)
    again, _ = norm_2(A.__matmul__, A.T.__matmul__, v, steps=1)
    assert norm * (1 - 1e-12) <= again <= np.linalg.norm(A, 2) * (1 + 1e-12)


def test_the_norm_of_nothing():
    assert norm_2(np.zeros((3, 3)).__matmul__, np.zeros((3, 3)).__matmul__, np.ones(3))[0] == 0.0
