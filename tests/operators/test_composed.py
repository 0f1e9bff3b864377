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
    Compressed,
    Coupled,
    Dense,
    Host,
    IdentityPlus,
    ScaledColumns,
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
    assert A.T.error == IdentityPlus(A).error == ScaledColumns(A, np.ones(5), 1.0).error == 0.25
    assert ScaledColumns(A, np.array([1, -4, 2, 0, 0])).error == 1.0
    S = IdentityPlus(A, solution_error=0.01)
    assert S.T.solution_error == S.T.T.solution_error == 0.01
    assert ScaledColumns(S, np.array([1, -4, 2, 1, 1])).solution_error == 0.04
    assert ScaledColumns(S, np.array([1, -4, 2, 0, 0])).solution_error == np.inf
    assert ScaledColumns(A, np.array([1, -4, 2, 0, 0])).solution_error == 0.0


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


def test_masks_of_what_host_operators_give_are_refused(device):
    known: dict[str, Any] = {"shape": (2, 2), "matvec": lambda x: x, "dtype": float}
    known["matmat"] = lambda X: np.ma.masked_less(X, 0.5)
    A = Host(device, scipy.sparse.linalg.LinearOperator(**known))
    with pytest.raises(InputTypeError, match=r"the product of .*1 masked"):
        A.matmat(np.array([[0.0, 1.0], [1.0, 1.0]]))


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
    assert IdentityPlus(Compressed(core, W, W, 0.25)).error == 0.25


def test_what_does_not_fit_is_refused(device, small_device):
    W, tall = Given(device, rotation(N)), Given(device, gallery.signed(N + 1, N))
    core, skew = Dense(device, np.eye(N)), Given(device, gallery.signed(N, N))
    dropped = Dense(device, np.eye(N))
    dropped.error = 0.1
    a, b = Dense(device, gallery.signed(3, 3)), Dense(device, gallery.signed(3, 2))
    assert Compressed(dropped, skew, skew, 0.3).error == 0.3
    for make, part in (
        (lambda: IdentityPlus(b), r"R .*\(3, 2\)"),
        (lambda: ScaledColumns(b, np.ones(2), 1.0), r"\(3, 2\)"),
        (lambda: ScaledColumns(a, np.ones(3), np.ones(2)), r"shift .*\(2,\)"),
        (lambda: IdentityPlus(a, 2), "sign is 2"),
        (lambda: IdentityPlus(a, solution_error=-1e-9), "solution_error is -1e-09"),
        (lambda: IdentityPlus(a, solution_error=np.nan), "solution_error is nan"),
        (lambda: ScaledColumns(a, np.ones(1)), r"d .*\(1,\).*\(3,\)"),
        (lambda: ScaledColumns(b, np.array([1.0, np.nan])), "d has 1 NaN"),
        (lambda: ScaledColumns(b, np.array(["a", "b"])), "d holds"),
        (lambda: Compressed(core, tall, W), rf"out .*{N + 1} .* {N}"),
        (lambda: Compressed(core, None, tall), rf"into .*{N + 1} "),
        (lambda: Compressed(core, W, Given(small_device, np.eye(N))), "into .*device"),
        (lambda: Compressed(core, W, W, -1.0), "error is -1.0"),
        (lambda: Compressed(core, W, W, np.nan), "error is nan"),
        (lambda: Compressed(dropped, skew, skew), "error is None"),  # that of coefficients is none of pixels
        (lambda: Compressed(core, W, W, diagonal=np.ones(2)), r"diagonal .*\(2,\)"),
        (lambda: Compressed(core, W, W, diagonal=np.full(N, np.nan)), f"diagonal has {N} NaN"),
        (lambda: Coupled([[a] * 3] * 2), "blocks"),
        (lambda: Coupled([[a] * 2] * 3), "blocks"),
        (lambda: Coupled([[a, a, b], [a] * 3, [a] * 3]), "blocks"),
        (lambda: Coupled([[None] * 3] * 3), "blocks"),
        (lambda: Host(device, Plain(1j * np.eye(2))), "Plain"),
        (lambda: Host(device, Plain(np.eye(2))).norms(), "Host"),
    ):
        with pytest.raises((InputError, InputTypeError), match=part):
            make()
