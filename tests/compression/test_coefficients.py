# SPDX-License-Identifier: BSD-3-Clause
"""Streamed coefficients against matrices of PyWavelets in float64."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ltcl.compression.coefficients import Coefficients, coefficients
from ltcl.compression.sources import COLUMNS, source
from tests.compression.helpers import Transform, matrix_of, smooth, wavelets

GRID = (8, 16)
N = GRID[0] * GRID[1]
LEAST = 32 * N * COLUMNS  # bytes of the smallest block
BASES: dict[str, tuple[str | None, str | None]] = {
    "none": (None, None),
    "rows": (None, "db2"),
    "columns": ("haar", None),
    "two-sided": ("db4", "db4"),
}


def transforms(kind: str) -> tuple[Transform | None, Transform | None]:
    out, into = BASES[kind]
    return (
        None if out is None else wavelets(GRID, out),
        None if into is None else wavelets(GRID, into),
    )


def matrices(kind: str) -> list[np.ndarray]:
    return [np.eye(N) if transform is None else matrix_of(transform, N) for transform in transforms(kind)]


def stands_for(kind: str, found: Coefficients) -> np.ndarray:
    out, into = matrices(kind)
    return out.T @ found.core.toarray().astype(np.float64) @ into


@pytest.mark.parametrize("kind", BASES)
@pytest.mark.parametrize("threshold", [0.0, 1e-4, 1e-2, 10.0])
def test_what_is_dropped_is_the_error(kind, threshold):
    R = smooth(GRID)
    found = coefficients(source("R", R), *transforms(kind), threshold)
    error = np.linalg.norm(stands_for(kind, found) - R)
    assert found.dropped == pytest.approx(error, rel=1e-4, abs=1e-5)
    assert found.first == 0.0
    assert np.all(np.abs(found.core.data) >= threshold)


@pytest.mark.parametrize("kind", ["columns", "two-sided"])
@pytest.mark.parametrize("first", [1e-4, 1e-3, 1e-2])
def test_what_both_passes_drop_bounds_the_error(kind, first):
    R = smooth(GRID)
    found = coefficients(source("R", R), *transforms(kind), 1e-3, first=first)
    assert found.first > 0.0
    error = np.linalg.norm(stands_for(kind, found) - R)
    assert error <= found.dropped * (1 + 1e-4)
    assert found.dropped <= np.sqrt(2) * np.hypot(found.first, found.second) * (1 + 1e-9)


@pytest.mark.parametrize("kind", BASES)
@settings(max_examples=15, deadline=None)
@given(blocks=st.integers(1, 9), threshold=st.sampled_from([0.0, 1e-4, 1e-2]))
def test_blocks_of_any_size_give_the_same_bits(kind, blocks, threshold):
    R = source("R", smooth(GRID))
    whole = coefficients(R, *transforms(kind), threshold)
    parts = coefficients(R, *transforms(kind), threshold, memory=blocks * LEAST)
    for array in ("indptr", "indices"):
        np.testing.assert_array_equal(getattr(whole.core, array), getattr(parts.core, array))
    np.testing.assert_array_equal(whole.core.data.view(np.uint32), parts.core.data.view(np.uint32))
    assert whole.second == parts.second


@pytest.mark.parametrize("first", [1e-3, 0.05, 10.0])
def test_columns_that_the_first_pass_leaves_empty_are_skipped(first):
    """10.0 leaves none."""
    R, asked = smooth(GRID), []
    out, into = transforms("two-sided")
    assert out is not None
    assert into is not None

    def counted(x):
        asked.append(np.count_nonzero(x.any(axis=0)))
        return out(x)

    found = coefficients(source("R", R), counted, into, 1e-3, first=first)
    between = into(R.T.astype(np.float32)).T
    between = np.where(np.abs(between) >= first, between, 0)
    wanted = out(np.ascontiguousarray(between))
    wanted = np.where(np.abs(wanted) >= 1e-3, wanted, 0)
    np.testing.assert_allclose(found.core.toarray(), wanted, atol=1e-6)
    assert found.core.shape == R.shape
    assert sum(asked) == np.count_nonzero(between.any(axis=0))
    assert coefficients(source("R", R), out, into, drop=0.1, first=first).core.shape == R.shape


def test_rows_are_asked_for_in_blocks_that_fit():
    R, asked = smooth(GRID), []

    class Rows:
        shape = R.shape

        def rows(self, start: int, stop: int) -> np.ndarray:
            asked.append((start, stop))
            return R[start:stop]

    coefficients(source("R", Rows()), *transforms("two-sided"), 1e-3, first=1e-6, memory=3 * LEAST)
    size = 3 * COLUMNS
    assert asked == [(start, min(start + size, N)) for start in range(0, N, size)]


@pytest.mark.parametrize("kind", BASES)
def test_a_larger_threshold_later_is_one_from_the_start(kind):
    R = source("R", smooth(GRID))
    later = coefficients(R, *transforms(kind), 1e-5).above(1e-3)
    at_once = coefficients(R, *transforms(kind), 1e-3)
    np.testing.assert_array_equal(later.core.toarray(), at_once.core.toarray())
    assert later.second == pytest.approx(at_once.second, rel=1e-12)
    assert later.above(1e-4) is later


def test_a_rectangular_matrix():
    R = np.random.default_rng(3).standard_normal((N, 32)).astype(np.float32)
    out, into = wavelets(GRID, "haar"), wavelets((4, 8), "haar")
    found = coefficients(source("R", R), out, into, 0.5)
    stands = matrix_of(out, N).T @ found.core.toarray() @ matrix_of(into, 32)
    assert found.core.shape == (N, 32)
    assert found.dropped == pytest.approx(np.linalg.norm(stands - R), rel=1e-4)


def test_progress_reaches_one():
    shares: list[float] = []
    coefficients(
        source("R", smooth(GRID)), *transforms("two-sided"), 0.1, memory=LEAST, progress=shares.append
    )
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
