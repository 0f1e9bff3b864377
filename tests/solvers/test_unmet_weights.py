# SPDX-License-Identifier: BSD-3-Clause
"""Standard errors hold, too, where walks seldom meet a row that makes them weigh far more than others do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.operators import CSR, Dense
from ltcl.operators.alias import tables, tables_of_columns
from ltcl.operators.links import links
from ltcl.theory.unmet import weights
from tests import gallery

ALIKE, BLOCK = 100, 34  # pixels that look at the same, and those of a room of spectral radius 0.9
A, C, D = range(ALIKE, ALIKE + 3)
ROOM = slice(ALIKE + 3, ALIKE + 3 + BLOCK)


def rare(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """R with rows 0 .. 99 alike, each of which leads to the heavy row A once in 3300 times, and b."""
    n = ROOM.stop
    R, b = np.zeros((n, n)), np.zeros(n)
    R[ROOM, ROOM] = np.random.default_rng(0).random((BLOCK, BLOCK))
    R[ROOM, ROOM] *= 0.9 / R[ROOM, ROOM].sum(axis=1, keepdims=True)
    R[:ALIKE, A], R[:ALIKE, D], b[D] = 1.5e-4, 0.5, 1.0
    if kind == "one light":
        R[A, C], b[C] = 1000.0, 1.0
    elif kind == "a room of light":  # all bounces add up
        R[A, C], R[C, ROOM], b[ROOM] = 100.0, -0.9 / BLOCK, 1.0
        R[ROOM, ROOM] *= -1
    else:  # "two doors"
        R[:ALIKE, A] = R[A, C] = 1e-2
        R[A, D], R[C, D] = 0.5, 300.0
    return R, b


def error_of(found: ltcl.Solution) -> np.ndarray:
    assert found.standard_error is not None
    return found.standard_error.astype(np.float64)


def covered(found: ltcl.Solution, exact: np.ndarray) -> float:
    return float(np.mean(np.abs(found.x - exact) <= 2 * error_of(found)))


@pytest.mark.parametrize("samples", [256, 2048, 16384])
@pytest.mark.parametrize("form", ["dense", "csr", "endpoint"])
@pytest.mark.parametrize("kind", ["one light", "a room of light", "two doors"])
def test_two_standard_errors_hold_where_heavy_rows_are_rarely_met(kind, form, samples):
    R, b = rare(kind)
    S = np.eye(len(R)) + R
    exact = np.linalg.solve(S, b)[:ALIKE]
    options: dict[str, Any] = {"estimator": "endpoint"} if form == "endpoint" else {}
    given: Any = scipy.sparse.csr_array(S) if form == "csr" else S
    found = ltcl.solve(given, b, "monte_carlo", samples=samples, pixels=np.arange(ALIKE), **options)
    assert covered(found, exact) >= 0.9  # 93 % of 100, less one standard deviation


@pytest.mark.parametrize("kind", ["one light", "a room of light", "two doors"])
def test_an_error_is_met_by_what_is_right(kind):
    R, b = rare(kind)
    exact = np.linalg.solve(np.eye(len(R)) + R, b)[0]
    error = abs(exact) / 10
    found = ltcl.solve(np.eye(len(R)) + R, b, "monte_carlo", pixels=np.arange(30), error=error)
    off = np.abs(found.x - exact)
    met = error_of(found) <= error
    assert np.mean(off <= 2 * error_of(found)) >= 0.86  # 95 % of 30, less two standard deviations
    assert np.all(off[met] <= 4 * error)


def test_a_heavy_row_that_no_stage_has_met_is_not_said_to_be_met():
    R = np.zeros((4, 4))
    R[0, 1], R[0, 3], R[1, 2] = 1.5e-4, 0.5, 100.0
    b = np.array([0.0, 0.0, 1.0, 0.0])  # x_0 = 0.015
    for seed in (*range(4), 39):
        found = ltcl.solve(np.eye(4) + R, b, "monte_carlo", pixels=[0], error=1e-3, seed=seed)
        assert "missed error=0.001" in found.reason
        assert abs(found.x[0] - 0.015) <= 3 * error_of(found)[0]


def test_rows_within_a_factor_of_a_few_need_no_more_for_it():
    """Of a corner what weights may add stays below a tenth of the variance of 256 samples."""
    S = ltcl.scenes.box(10, sides=3, albedo=0.4).transport().systems[0]
    b = np.random.default_rng(0).random(300)
    runs = [ltcl.solve(S, b, "monte_carlo", seed=s) for s in range(16)]
    x = np.stack([run.x for run in runs]).astype(float)
    said = np.mean([error_of(run) ** 2 for run in runs], axis=0)
    assert np.mean(x.var(axis=0, ddof=1) / said) > 0.9


@pytest.mark.parametrize("form", ["csr", "dense"])
def test_weights_are_those_of_all_walks(device, form):
    R = gallery.sparse(31, 31, 0.1, seed=4).toarray().astype(np.float32) / 6
    M = CSR(device, scipy.sparse.csr_array(R)) if form == "csr" else Dense(device, R)
    alike = tuple(Dense(device, factor * R) for factor in (1.0, 1.0, 1.0))
    R = np.abs(R.astype(float))
    entries = (R != 0).sum(axis=1) if form == "csr" else np.full(31, 31)
    drawn = np.where(R > 0, R.sum(axis=1)[:, None], 0.0)
    back = np.where(R.T > 0, R.sum(axis=0)[:, None], 0.0)
    alone = entries[:, None] * R
    for found, factor, chance in [
        (weights(M, tables(M))[0], drawn, _shares(R)),
        (weights(M, tables_of_columns(M), True)[0], back, _shares(R.T)),
        (weights(alike[0], links(alike, (1.0,) * 3))[2], drawn, _shares(R)),
        (weights(M, tables(M, "uniform"))[0], alone, np.divide(1.0, np.maximum(entries, 1))[:, None]),
    ]:
        square = fourth = largest = np.ones(31)
        for k in range(8):
            square, fourth = factor**2 * chance @ square, factor**4 * chance @ fourth
            largest = factor.max(axis=1) * np.max((factor > 0) * largest, axis=1)  # uniform: a bound
            np.testing.assert_allclose(found.squares[k], square, rtol=1e-4)
            np.testing.assert_allclose(found.fourths[k], fourth, rtol=1e-4)
            np.testing.assert_allclose(found.largest[k], largest, rtol=1e-4)
        assert found.most == pytest.approx(factor.max())


def _shares(R: np.ndarray) -> np.ndarray:
    whole = R.sum(axis=1, keepdims=True)
    return np.divide(R, whole, out=np.zeros_like(R), where=whole > 0)


def test_fourths_that_float32_cannot_hold_are_no_bound(device):
    R = Dense(device, [[0.0, 1e-15, 0.0], [0.0, 0.0, 1e-15], [0.0, 0.0, 0.0]])
    found = weights(R, tables(R))[0]
    assert np.isinf(found.fourths[1, 0]) or found.fourths[1, 0] >= 0.99e-120
    assert not found.fourths[:, 2].any()
