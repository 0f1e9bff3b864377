# SPDX-License-Identifier: BSD-3-Clause
"""Operators made of others: what is special to each (products are in `test_base.py`)."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse.linalg

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Dense, Host, IdentityPlus, ScaledColumns, Shifted
from tests import gallery
from tests.operators import helpers


class Plain(scipy.sparse.linalg.LinearOperator):
    """A user's own operator that knows no transpose."""

    def __init__(self, matrix):
        super().__init__(matrix.dtype, matrix.shape)
        self.matrix = matrix

    def _matvec(self, x):
        return self.matrix @ x


def test_inverse_of_two_pixels_undoes_their_interreflection(device):
    S, inverse = gallery.two_pixels(0.5, 0.25)
    forward, back = (
        IdentityPlus(Dense(device, S - np.eye(2))),
        IdentityPlus(Dense(device, inverse - np.eye(2))),
    )
    np.testing.assert_allclose(back.matvec(forward.matvec(np.array([0.3, 0.7]))), [0.3, 0.7], rtol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_identity_and_operand_may_be_what_is_added(device, sign):
    matrix = gallery.signed(33, 33)
    S = IdentityPlus(Dense(device, matrix), sign)
    x = gallery.vectors(33, 2)
    on_device = device.upload(x)
    found = S.apply(on_device, scale=0.5, add=on_device).get()
    np.testing.assert_allclose(found, 0.5 * (x + sign * matrix @ x) + x, atol=1e-5)
    np.testing.assert_array_equal(on_device.get(), x)


def test_errors_of_compressed_operators_are_handed_on(device):
    A = Dense(device, gallery.signed(5, 5))
    A.error = 0.25
    assert A.T.error == IdentityPlus(A).error == Shifted(A).error == 0.25
    assert ScaledColumns(A, np.array([1, -4, 2, 0, 0])).error == 1.0
    S = IdentityPlus(A, solution_error=0.01)
    assert S.T.solution_error == S.T.T.solution_error == 0.01
    assert ScaledColumns(S, np.array([1, -4, 2, 1, 1])).solution_error == 0.04
    assert ScaledColumns(S, np.array([1, -4, 2, 0, 0])).solution_error == np.inf
    assert ScaledColumns(A, np.array([1, -4, 2, 0, 0])).solution_error == 0.0


def test_only_square_operators_have_an_identity_beside_them(device):
    A = Dense(device, gallery.signed(3, 2))
    for kind in (IdentityPlus, Shifted):
        with pytest.raises(InputError, match=r"shape \(3, 2\).*square"):
            kind(A)
    with pytest.raises(InputError, match="sign is 2"):
        IdentityPlus(Dense(device, np.eye(2)), 2)


@pytest.mark.parametrize(
    ("d", "kind", "part"),
    [
        ([1.0], InputError, r"d has shape \(1,\); it must be \(2,\)"),
        ([1.0, np.nan], InputError, "d has 1 NaN"),
        (["a", "b"], InputTypeError, "d holds"),
    ],
)
def test_bad_diagonals_are_refused(device, d, kind, part):
    with pytest.raises(kind, match=part):
        ScaledColumns(Dense(device, np.eye(2)), d)


def test_host_operators_without_a_transpose_say_so(device):
    A = Host(device, Plain(np.eye(3)))
    helpers.meets_twin(A, np.eye(3))
    with pytest.raises(InputError, match="Plain has no rmatvec"):
        A.rmatvec(np.ones(3))


def test_host_operators_are_asked_for_their_diagonal(device, monkeypatch):
    with pytest.raises(InputError, match=r"Plain has no diagonal\(\)"):
        Host(device, Plain(np.eye(3))).diagonal()
    plain = Plain(np.diag([1.0, 2.0]))
    monkeypatch.setattr(Plain, "diagonal", lambda self: [1, 2], raising=False)
    assert Host(device, plain).diagonal().tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("bad", "part"), [(np.nan, "the product of Plain"), (np.inf, "the product of Plain"), (1e39, "float32")]
)
def test_host_operators_that_give_unusable_numbers_are_refused(device, bad, part):
    with pytest.raises(InputError, match=part):
        Host(device, Plain(np.diag([bad, 1.0]))).matvec(np.ones(2))


def test_complex_host_operators_are_refused(device):
    with pytest.raises(InputTypeError, match="real numbers"):
        Host(device, Plain(1j * np.eye(2)))


def test_entries_that_cannot_be_seen_have_no_norms(device):
    with pytest.raises(InputError, match="cannot see its entries"):
        Host(device, Plain(np.eye(2))).norms()
