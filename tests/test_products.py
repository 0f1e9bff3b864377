# SPDX-License-Identifier: BSD-3-Clause
"""What `bench/products.py` multiplies: R by mirrors is the scene's, and thresholds cost what they claim."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from ltcl.scenes import dihedral

BENCH = Path(__file__).resolve().parents[1] / "bench"


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module


@pytest.mark.parametrize("n", [2, 4, 10])
@pytest.mark.parametrize("albedo", [0.3, 0.95])
def test_R_by_mirrors_is_that_of_the_corner(load: Callable[[str], Any], n: int, albedo: float) -> None:
    told: list[str] = []
    found = load("_corner").interreflection(n, albedo, told.append)
    A = dihedral(n, albedo=albedo).A
    exact = np.linalg.inv(np.eye(len(A)) - A) - np.eye(len(A))
    assert (found.dtype, len(told)) == (np.float32, 4)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-6 * exact.max())


@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (1100, 30)])
@pytest.mark.parametrize("wanted", [0.3, 0.01])
@pytest.mark.parametrize("make", [np.array, scipy.sparse.csr_array])
def test_no_more_is_kept_than_an_error_takes(
    load: Callable[[str], Any], shape: tuple[int, int], wanted: float, make: Callable[..., Any]
) -> None:
    select, rng = load("_kept"), np.random.default_rng(5)
    dense = (rng.choice([-1, 1], shape) * 2.0 ** -rng.uniform(0, 20, shape)).astype(np.float32)
    x = rng.random(shape[1])
    y = dense @ x

    def error(matrix: Any) -> float:
        return float(np.linalg.norm(matrix @ x - y) / np.linalg.norm(y))

    kept = select.kept(make(dense), select.errors(make(dense), x, y), wanted)
    np.testing.assert_array_equal(kept.toarray()[kept.toarray() != 0], dense[kept.toarray() != 0])
    assert error(kept) <= wanted * (1 + 1e-9)
    least = np.abs(kept.data).min()
    assert not np.any((np.abs(dense) >= least) & (kept.toarray() == 0))  # the largest ones
    fewer = np.where(np.abs(dense) >= least * (1 + 2**-6), dense, 0)  # a bin spans less than that
    assert error(fewer) > wanted


def test_what_was_left_out_before_counts_as_error(load: Callable[[str], Any]) -> None:
    found = load("_kept").errors(np.array([[0.5, 0.25]], np.float32), np.ones(2), np.array([1.0]))
    assert (found[0], found[-1]) == (0.25, 1.0)
