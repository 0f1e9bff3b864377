# SPDX-License-Identifier: BSD-3-Clause
"""Operators of SciPy users, which multiply on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Host
from tests.operators import helpers


def doubling(**methods: Any) -> scipy.sparse.linalg.LinearOperator:
    """2 I of 3 pixels, with a product alone and some more methods."""
    methods |= {"shape": (3, 3), "matvec": lambda x: 2.0 * x, "dtype": float}
    return scipy.sparse.linalg.LinearOperator(**methods)


def test_operators_may_lack_a_transpose(device):
    helpers.meets_twin(Host(device, helpers.Plain(np.eye(3))), np.eye(3))
    # SciPy raises another error for several columns.
    for operator in (doubling(), doubling(matmat=lambda X: 2.0 * X)):
        with pytest.raises(InputError, match="no rmatvec"):
            Host(device, operator).rmatmat(np.ones((3, 2)))


def test_operators_may_have_a_diagonal(device, monkeypatch):
    monkeypatch.setattr(helpers.Plain, "diagonal", lambda self: [1, 2], raising=False)
    A = Host(device, helpers.Plain(np.diag([1.0, 2.0])))
    assert A.diagonal().tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("value", "part"),
    [
        (np.nan, "the product of Plain"),
        (np.inf, "the product of Plain"),
        (1e39, "float32"),
    ],
)
def test_unusable_numbers_are_refused(device, value, part):
    A = Host(device, helpers.Plain(np.diag([value, 1.0])))
    with pytest.raises(InputError, match=part):
        A.matvec(np.ones(2))


def test_masked_products_are_refused(device):
    operator = doubling(matmat=lambda X: np.ma.masked_less(X, 0.5))
    with pytest.raises(InputTypeError, match=r"the product of .*1 masked"):
        Host(device, operator).matmat(np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 1.0]]))
