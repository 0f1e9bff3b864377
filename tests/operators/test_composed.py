# SPDX-License-Identifier: BSD-3-Clause
"""Operators made of others: what is special to each (products are in `test_base.py`)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    CSR,
    Compressed,
    Coupled,
    Dense,
    Host,
    IdentityPlus,
    ScaledColumns,
    Shifted,
    Sum,
    composed,
)
from tests import gallery
from tests.bases import Given, rotation, two_sided
from tests.operators import helpers

N = 33


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
    known: dict[str, Any] = {"shape": (3, 3), "matvec": lambda x: 2.0 * x, "dtype": float}
    for parts in ({}, {"matmat": lambda x: 2.0 * x}):  # SciPy's own TypeError, for several columns
        own = scipy.sparse.linalg.LinearOperator(**known, **parts)
        with pytest.raises(InputError, match="no rmatvec"):
            Host(device, own).rmatmat(np.ones((3, 2)))


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


def test_one_pixel(device):
    W = Given(device, np.array([[-1.0]]))
    R = Compressed(Dense(device, [[0.5]]), W, W)
    assert R.matmat(np.array([[2.0, 4.0]])).tolist() == [[1.0, 2.0]]


def test_threads_share_an_operator(device):
    R = two_sided(device, gallery.bounces(N, 0.5))
    pictures = [gallery.vectors(N, 1 + seed % 3, seed) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        for x, product in zip(pictures, pool.map(R.matmat, pictures), strict=True):
            helpers.same_bits(product, R.matmat(x))


def test_a_diagonal_of_many_pixels_has_to_be_told(device, monkeypatch):
    monkeypatch.setattr(composed, "_FEW", N - 1)
    R = two_sided(device, gallery.bounces(N, 0.5))
    with pytest.raises(InputError, match=rf"{N} pixels.*diagonal="):
        R.diagonal()
    told = Compressed(R.core, R.out, R.into, diagonal=np.arange(N))
    assert told.diagonal().tolist() == list(range(N))
    assert len(Compressed(Dense(device, np.eye(N)), None, None).diagonal()) == N  # of pixels, at hand


def test_parts_that_do_not_fit_are_refused(device, small_device):
    W = Given(device, rotation(N))
    tall = Given(device, gallery.signed(N + 1, N))
    core = Dense(device, np.eye(N))
    for make, kind, part in (
        (lambda: Compressed(core, tall, W), InputError, rf"out has {N + 1} .* must have {N}"),
        (lambda: Compressed(core, None, tall), InputError, rf"into has {N + 1} "),
        (
            lambda: Compressed(core, W, Given(small_device, np.eye(N))),
            InputError,
            "into is on another device",
        ),
        (lambda: Compressed(core, W, W, -1.0), InputError, "error is -1.0; it must be"),
        (lambda: Compressed(core, W, W, np.nan), InputError, "error is nan"),
        (lambda: Compressed(core, W, W, diagonal=np.ones(2)), InputError, r"diagonal has shape \(2,\)"),
        (lambda: Compressed(core, W, W, diagonal=np.full(N, np.nan)), InputError, "diagonal has 33 NaN"),
        (lambda: Compressed(core, W, W, diagonal=np.array(["a"] * N)), InputTypeError, "diagonal holds"),
    ):
        with pytest.raises(kind, match=part):
            make()


def test_an_error_of_coefficients_is_none_of_pixels_in_a_skew_basis(device):
    tall = Given(device, gallery.signed(N, N))
    core = Dense(device, np.eye(N))
    core.error = 0.1
    with pytest.raises(InputError, match=r"error is None.*it must be given"):
        Compressed(core, tall, tall)
    assert Compressed(core, tall, tall, 0.3).error == 0.3


def test_sums_that_do_not_fit_are_refused(device, small_device):
    A = CSR(device, scipy.sparse.csr_array(np.eye(3)))
    for parts, part in (
        ((), r"shapes \[\]"),
        ((A, Dense(device, np.eye(2))), r"shapes \[\(2, 2\), \(3, 3\)\]"),
        ((A, Dense(small_device, np.eye(3))), "several devices"),
    ):
        with pytest.raises(InputError, match=part):
            Sum(*parts)


@pytest.mark.parametrize("bad", [-1e-9, np.nan])
def test_bad_errors_of_solutions_are_refused(device, bad):
    with pytest.raises(InputError, match=r"solution_error is .*at least 0"):
        IdentityPlus(Dense(device, np.eye(2)), solution_error=bad)


def test_what_is_known_of_compressed_operators(device):
    W, V = Given(device, rotation(N)), Given(device, rotation(N, 1))
    tall, core = Given(device, gallery.signed(N + 12, N, 2) / 4), Dense(device, np.eye(N))
    assert Compressed(core, W, W).two_sided
    assert not any(
        Compressed(core, *sides).two_sided for sides in ((None, None), (W, None), (None, W), (W, V))
    )
    assert not Compressed(Dense(device, np.eye(N + 12)), tall, tall).two_sided
    assert Compressed(core, W, W).nbytes == core.nbytes + W.nbytes
    assert Compressed(core, W, V).nbytes == core.nbytes + 2 * W.nbytes
    assert Compressed(core, W, W).error == 0.0
    core.error = 0.5
    assert Compressed(core, W, None).error == 0.5
    assert IdentityPlus(Compressed(core, W, W, 0.25)).error == Sum(core, core).error / 4 == 0.25


def test_blocks_that_do_not_fit_are_refused(device):
    a, b = Dense(device, gallery.signed(3, 3)), Dense(device, gallery.signed(3, 2))
    for blocks in ([[a] * 3] * 2, [[a] * 2] * 3, [[a, a, b], [a] * 3, [a] * 3], [[None] * 3] * 3):
        with pytest.raises(InputError, match="blocks"):
            Coupled(blocks)
