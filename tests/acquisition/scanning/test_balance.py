# SPDX-License-Identifier: BSD-3-Clause
"""Rows that add up to white: the best estimate of entries and their sum, and what stays as it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from ltcl.acquisition import Calibration, Report, acquire
from ltcl.acquisition.scanning import balance
from ltcl.acquisition.scanning.pictures import UNKNOWN, Picture
from ltcl.store import BlockStore

from .helpers import corner, dense, rig


def dense_rows(x: np.ndarray, v: np.ndarray, w: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`balance.rows` of a matrix that has all its entries."""
    rows, columns = x.shape
    parts = (x.ravel(), np.tile(np.arange(columns), rows), np.arange(rows + 1) * columns)
    found, variance = balance.rows(scipy.sparse.csr_array(parts, shape=x.shape), v.ravel(), Picture(w, u))
    return found.toarray(), variance.reshape(x.shape)


@pytest.mark.parametrize("shape", [(1, 1), (3, 7), (5, 1)])
def test_it_is_least_squares(shape: tuple[int, int]) -> None:
    """Of x_j of variance v_j and their sum w of variance u: as weighted normal equations have it."""
    rng = np.random.default_rng(0)
    x, v = rng.random(shape) + 0.1, rng.random(shape) + 0.1
    w, u = x.sum(axis=1) + rng.normal(size=shape[0]), rng.random(shape[0]) + 0.1
    found, variance = dense_rows(x, v, w, u)
    for i in range(shape[0]):
        M = np.diag(1 / v[i]) + 1 / u[i]
        np.testing.assert_allclose(found[i], np.linalg.solve(M, x[i] / v[i] + w[i] / u[i]), rtol=1e-10)
        np.testing.assert_allclose(variance[i], np.diag(np.linalg.inv(M)), rtol=1e-10)


def test_rows_of_which_something_is_not_known_stay() -> None:
    x, v = np.full((3, 2), 0.5), np.array([[0.1, np.nan], [0.1, 0.1], [0.1, 0.1]])
    w, u = np.array([2.0, 2.0, 2.0]), np.array([0.1, UNKNOWN, 0.1])
    found, variance = dense_rows(x, v, w, u)
    np.testing.assert_array_equal(found[:2], x[:2])
    np.testing.assert_array_equal(variance[:2], v[:2])
    assert (found[2] > 0.5).all()


def test_what_was_dropped_goes_to_the_others() -> None:
    """As in rows with entries of the median variance there, whose part of the rest is then moved."""
    x, v = np.array([[1.0, 0.2, 0.0, 0.0]]), np.array([0.3, 0.1])
    w, u = np.array([1.5]), np.array([0.05])
    found, variance = balance.rows(scipy.sparse.csr_array(x), v, Picture(w, u))
    whole, _ = dense_rows(x, np.array([[0.3, 0.1, 0.2, 0.2]]), w, u)
    moved = whole[0, 2:].sum()
    np.testing.assert_allclose(found.data, whole[0, :2] + moved * v / v.sum(), rtol=1e-12)
    np.testing.assert_allclose(variance, v - v**2 / 0.85, rtol=1e-12)


def test_a_row_without_entries_stays_so() -> None:
    empty = scipy.sparse.csr_array((2, 3))
    found, variance = balance.rows(empty, np.zeros(0), Picture(np.ones(2), np.zeros(2)))
    assert (found.nnz, len(variance)) == (0, 0)


@pytest.mark.parametrize("strategy", ["pixel", "hadamard"])
def test_scans_add_up_to_white(tmp_path: Path, strategy: str) -> None:
    """Noise and thresholds of a scan by columns are off by more than white, as its report says."""
    path, truth = tmp_path / "T.zarr", corner().sum(axis=1)
    T = dense(acquire(rig(seed=4), geometry="aligned", strategy=strategy, store=path))
    before = BlockStore.open(path).extra(balance.SUMS)[0]
    white = Calibration.of(path).white.value.ravel()
    scale = float(white @ truth / (white @ white))
    columns, after, alone = (np.abs(scale * s / truth - 1).max() for s in (before, T.sum(axis=1), white))
    assert max(after, alone) < min(0.01, columns)
    told = Report.of(path)
    assert told.beside_white == pytest.approx(
        np.linalg.norm(before - white) / np.linalg.norm(white), rel=1e-4
    )
    assert f"within {100 * told.beside_white:.2g} % (good: below 0.5 %)" in str(told)
