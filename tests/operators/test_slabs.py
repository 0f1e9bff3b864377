# SPDX-License-Identifier: BSD-3-Clause
"""Matrices cut into slabs of whole rows."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ltcl.errors import MemoryLimitError
from ltcl.operators import slabs


@given(st.lists(st.integers(0, 20), max_size=40), st.integers(20, 60))
def test_slabs_cover_all_rows_within_the_limit_and_are_few(row_bytes, limit):
    pieces = slabs.cut(np.array(row_bytes, np.int64), limit, "A")
    assert pieces[0][0] == 0
    assert pieces[-1][1] == len(row_bytes)
    assert all(a[1] == b[0] for a, b in itertools.pairwise(pieces))
    assert all(sum(row_bytes[start:stop]) <= limit for start, stop in pieces)
    # As few as possible: no slab has room for the first row of the next.
    assert all(sum(row_bytes[a : b + 1]) > limit for a, b in pieces[:-1])


def test_row_beyond_the_limit_is_refused():
    with pytest.raises(MemoryLimitError, match=r"row 1 of A has 2 KiB, the largest buffer .* 1 KiB"):
        slabs.cut(np.array([1, 2048]), 1024, "A")


@pytest.mark.parametrize(("allowed", "limit"), [(4096, 4096), (1 << 34, 1 << 33), (1 << 33, 1 << 33)])
def test_positions_within_a_slab_stay_32_bit_numbers(allowed, limit):
    found = slabs.largest(SimpleNamespace(max_allocation=allowed))  # pyright: ignore[reportArgumentType]
    assert found <= limit
    # Kernels step along a row by up to 256 beyond its end.
    assert found // 4 + 256 < 1 << 31
