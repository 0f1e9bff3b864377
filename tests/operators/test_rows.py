# SPDX-License-Identifier: BSD-3-Clause
"""How products of matrices in rows choose among their kernels."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.device import tuning
from ltcl.operators import CSR, Dense, rows
from tests import gallery
from tests.operators import helpers


@pytest.fixture(params=[CSR, Dense])
def A(request, device):
    matrix = gallery.sparse(65, 53)
    return CSR(device, matrix) if request.param is CSR else Dense(device, matrix.toarray())


@pytest.fixture
def asked(monkeypatch):
    """The variants `tuning.choose` was asked about; it answers with the last of them."""
    calls = []

    def choose(device, file, problem, variants):
        for launch in variants.values():
            launch()
        calls.append((file, problem, list(variants)))
        return list(variants)[-1]

    monkeypatch.setattr(tuning, "choose", choose)
    return calls


def test_small_matrices_take_the_first_variant_untimed(A, asked):
    A.matvec(np.ones(53))
    assert not asked


def test_each_width_is_asked_about_once(A, asked, monkeypatch):
    monkeypatch.setattr(rows, "_WORTH_TIMING", 0)
    for _ in range(2):
        A.matmat(np.ones((53, 11)))
    assert [problem.split(",")[0] for _, problem, _ in asked] == ["k=8 of 11", "k=3 of 11"]
    assert all(file == A.file and len(names) > 1 for file, _, names in asked)


def test_trials_leave_the_operands_alone(A, asked, monkeypatch):
    monkeypatch.setattr(rows, "_WORTH_TIMING", 0)
    helpers.meets_twin(A, A.to_dense())  # accumulates into `out`, too
    assert asked


def test_products_repeat_to_the_bit(A):
    x = gallery.vectors(53, 3)
    helpers.same_bits(A @ x, A @ x)
    helpers.same_bits(A.T @ gallery.vectors(65, 3), A.T @ gallery.vectors(65, 3))
