# SPDX-License-Identifier: BSD-3-Clause
"""Matrices of `bench/products.py`: R by mirrors is the scene's, thresholds cost as stated."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from ltcl.scenes import dihedral

BENCH = Path(__file__).resolve().parents[1] / "bench"


@pytest.fixture(autouse=True)
def benches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the helpers of benches importable, which lie beside them."""
    monkeypatch.syspath_prepend(str(BENCH))


@pytest.mark.parametrize(("n", "albedo"), [(2, 0.3), (10, 0.95)])
def test_R_by_mirrors_is_that_of_the_corner(n: int, albedo: float) -> None:
    R = importlib.import_module("_corner").interreflection(n, albedo, str)
    A = dihedral(n, albedo=albedo).A
    exact = np.linalg.inv(np.eye(len(A)) - A) - np.eye(len(A))
    assert R.dtype == np.float32
    np.testing.assert_allclose(R, exact, rtol=0, atol=1e-6 * exact.max())


@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (1100, 30)])
@pytest.mark.parametrize("tolerance", [0.3, 0.01])
@pytest.mark.parametrize("make", [np.array, scipy.sparse.csr_array])
def test_no_more_is_kept_than_an_error_takes(
    shape: tuple[int, int], tolerance: float, make
) -> None:
    bench = importlib.import_module("_coefficients")
    rng = np.random.default_rng(5)
    dense = (rng.choice([-1, 1], shape) * 2.0 ** -rng.uniform(0, 20, shape)).astype(np.float32)
    x = rng.random(shape[1])
    y = dense @ x
    kept = bench.keep_largest(make(dense), x, y, tolerance).toarray()
    np.testing.assert_array_equal(kept, np.where(kept != 0, dense, 0))
    assert bench.relative_error(kept @ x, y) <= tolerance * (1 + 1e-9)
    least = np.abs(kept[kept != 0]).min()
    assert np.abs(dense[kept == 0]).max(initial=0) < least  # the largest ones
    fewer = np.where(np.abs(dense) >= least * (1 + 2**-6), dense, 0)
    assert bench.relative_error(fewer @ x, y) > tolerance
