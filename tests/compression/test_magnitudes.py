# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ltcl.compression.magnitudes import Magnitudes

BIN = 2.0**-7  # numbers of one bin differ by no more than this part
VALUES = arrays(
    np.float32, st.integers(1, 300), elements=st.floats(-1e3, 1e3, width=32, allow_subnormal=False)
)


@given(VALUES, st.floats(0, 1e3))
def test_no_more_is_dropped_than_allowed_and_a_bin_more_would_be(values, norm):
    sizes = Magnitudes.of(values)
    threshold = np.float32(sizes.threshold(norm))
    dropped = np.abs(values) < threshold
    assert np.linalg.norm(values[dropped].astype(np.float64)) <= norm * (1 + 1e-9)
    assert sizes.kept(float(threshold)) == np.count_nonzero(~dropped)
    assert sizes.dropped(float(threshold)) == pytest.approx(np.linalg.norm(values[dropped].astype(float)))
    more = np.abs(values) < np.abs(values[~dropped]).min(initial=np.inf) * (1 + BIN) * (1 + 1e-6)
    assert dropped.all() or np.linalg.norm(values[more].astype(np.float64)) >= norm


@given(VALUES, st.integers(0, 300))
def test_no_more_is_kept_than_allowed_and_a_bin_more_would_be(values, count):
    threshold = np.float32(Magnitudes.of(values).at_most(count))
    kept = np.abs(values) >= threshold
    assert np.count_nonzero(kept) <= count
    below = np.abs(values[~kept]).max(initial=0.0)
    more = np.abs(values) >= below / (1 + BIN) * (1 - 1e-6)
    assert kept.all() or np.count_nonzero(more) > count or below < np.finfo(np.float32).tiny
