# SPDX-License-Identifier: BSD-3-Clause
"""Bounds on 2-norms against singular values in float64."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from ltcl import theory
from ltcl.operators import CSR, Dense
from tests import gallery
from tests.bases import rotation


def with_values(values: np.ndarray, seed: int) -> np.ndarray:
    """A square matrix with these singular values."""
    n = len(values)
    return (rotation(n, seed) * values) @ rotation(n, seed + 1000)


SPECTRA = {
    "one far above the rest": lambda n: np.r_[1e4, np.ones(n - 1)],
    "one hardly above the rest": lambda n: np.r_[1.05, np.ones(n - 1)],
    "cluster at the top": lambda n: np.r_[
        1 + 1e-5 * np.arange(n // 2), np.linspace(0, 0.9, n - n // 2)
    ],
    "evenly spread": lambda n: np.linspace(0, 1, n),
    "fast decay": lambda n: 0.5 ** np.arange(n),
    "crowded below the top": lambda n: 1 - np.linspace(0, 1, n) ** 2,
    "all equal": np.ones,
    "rank one": lambda n: np.r_[1.0, np.zeros(n - 1)],
}


@pytest.mark.slow
@pytest.mark.parametrize("spectrum", SPECTRA)
@settings(max_examples=12, deadline=None)
@given(
    n=st.integers(2, 150),
    seed=st.integers(0, 2**16),
    steps=st.integers(1, 20),
    starts=st.integers(1, 8),
)
def test_the_bound_is_never_below_the_norm(device, spectrum, n, seed, steps, starts):
    values = SPECTRA[spectrum](n)
    A = Dense(device, with_values(values, seed))
    truth = float(np.linalg.norm(A.to_dense(), 2))
    found = theory.two_norm(A, maxsteps=steps, starts=starts, seed=seed)
    assert found.upper >= truth
    assert found.estimate <= truth * (1 + 1e-5)


@pytest.mark.parametrize("spectrum", SPECTRA)
def test_a_few_steps_bring_the_bounds_together(device, spectrum):
    A = Dense(device, with_values(SPECTRA[spectrum](300), 7))
    found = theory.two_norm(A, factor=1.1)
    assert found.upper <= 1.1 * found.estimate * (1 + 1e-5)
    assert found.products <= 2 * 24


def test_the_bound_fails_as_often_as_it_may(device):
    """The bound of one step and one start is sharp if one value is far above all others."""
    n = 40
    runs = 400
    A = Dense(device, np.diag(np.r_[1.0, np.zeros(n - 1) + 1e-3]))
    found = [
        theory.two_norm(A, confidence=0.5, starts=1, maxsteps=1, seed=seed) for seed in range(runs)
    ]
    failed = sum(norm.upper < 1.0 for norm in found)
    assert failed <= runs / 2 + 4 * np.sqrt(runs) / 2


DIFFERENCE = [gallery.sparse(129, 129, 0.2, seed).toarray() for seed in (0, 5)]
SHAPES = [(1, 1), (53, 7), (7, 53), (1, 300), (300, 1)]


@pytest.mark.parametrize("matrices", [*([gallery.signed(*shape)] for shape in SHAPES), DIFFERENCE])
@pytest.mark.parametrize("form", [Dense, CSR])
def test_matrices_of_any_shape_and_differences(device, form, matrices):
    operators = [form(device, scipy.sparse.csr_array(M) if form is CSR else M) for M in matrices]
    found = theory.two_norm(*operators)
    truth = np.linalg.norm(matrices[0].astype(np.float64) - sum(matrices[1:]), 2)
    assert truth <= found.upper <= 1.1 * truth * (1 + 1e-4)


def test_a_difference_in_the_last_bits_is_bounded_by_rounding(device):
    A = Dense(device, gallery.signed(65, 65))
    found = theory.two_norm(A, A)
    assert found.estimate == 0.0
    assert 0.0 < found.upper < 1e-5 * np.linalg.norm(A.to_dense(), 2)


def test_a_smaller_frobenius_norm_is_certain_and_zero_has_the_norm_zero(device):
    found = theory.two_norm(Dense(device, np.diag([2.0] + [0.0] * 40)), frobenius=2.0, maxsteps=1)
    assert (found.upper, found.confidence) == (2.0, 1.0)
    found = theory.two_norm(Dense(device, np.zeros((17, 9))))
    assert (found.estimate, found.upper) == (0.0, 0.0)


def test_steps_end_when_the_question_is_answered(device):
    A = Dense(device, with_values(np.linspace(0, 1, 200), 3))
    whole = theory.two_norm(A, factor=1.001)
    clear = theory.two_norm(A, factor=1.001, below=2.0)
    assert clear.products < whole.products
    assert clear.upper <= 2.0
    above = theory.two_norm(A, factor=1.001, below=0.3)
    assert above.products < whole.products
    assert above.estimate > 0.3
