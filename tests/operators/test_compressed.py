# SPDX-License-Identifier: BSD-3-Clause
"""Cores between bases, and sums: against float64 products of the same parts."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Ordered, Sum
from ltcl.operators import compressed as module
from tests import gallery, reference
from tests.bases import Given, rotation, stands_for, two_sided
from tests.operators import helpers

N = 33


def _sides(device):
    """Every kind of pair: none, out, into, both, two bases, and more coefficients than pixels."""
    W, V = Given(device, rotation(N)), Given(device, rotation(N, 1))
    tall = Given(device, gallery.signed(N + 12, N, 2) / 4)
    return {
        "none": (None, None),
        "out": (W, None),
        "into": (None, W),
        "both": (W, W),
        "two": (W, V),
        "tall": (tall, tall),
        "tall out": (tall, W),
    }


def _make(device, sides, kind):
    out, into = _sides(device)[sides]
    shape = [N if W is None else W.shape[0] for W in (out, into)]
    core = gallery.sparse(*shape)
    return Compressed(CSR(device, core) if kind == "csr" else Dense(device, core.toarray()), out, into)


def _slack(R, transpose=False):
    """Rounding of three products in a row: each adds a part of the sum of absolute values so far."""
    whole = np.abs(R.core.to_dense())
    whole = whole if R.out is None else np.abs(R.out.matrix.T) @ whole
    whole = whole if R.into is None else whole @ np.abs(R.into.matrix)
    return (whole.T if transpose else whole) * 3 * (N + 16) * reference.UNIT


@pytest.mark.parametrize("transpose", [False, True])
@pytest.mark.parametrize("kind", ["csr", "dense"])
@pytest.mark.parametrize("sides", ["none", "out", "into", "both", "two", "tall", "tall out"])
def test_products_are_those_of_the_parts(device, sides, kind, transpose):
    R = _make(device, sides, kind)
    truth = stands_for(R).T if transpose else stands_for(R)
    slack = _slack(R, transpose)
    apply = R.apply_transpose if transpose else R.apply
    for k in helpers.COLUMNS:
        x = gallery.vectors(N, k)
        for scale, kind_of_sum in helpers.EPILOGUES.values():
            add, out = helpers.operands(R, gallery.vectors(N, k, 2), kind_of_sum)
            added = 0.0 if add is None else add.get().astype(np.float64)
            expected = scale * (truth @ x) + added
            assert apply(device.upload(x), out, scale=scale, add=add) is out
            rounding = 2 * reference.UNIT * (np.abs(expected) + np.abs(added))
            helpers.close(out.get(), expected, slack @ np.abs(x) + rounding)


def test_one_pixel(device):
    W = Given(device, np.array([[-1.0]]))
    R = Compressed(Dense(device, [[0.5]]), W, W)
    assert R.matmat(np.array([[2.0, 4.0]])).tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize("kind", ["csr", "dense"])
def test_adjoint(device, kind):
    R = _make(device, "tall out", kind)
    x, y = gallery.vectors(N, None, 3), gallery.vectors(N, None, 4)
    left, right = np.vdot(np.float64(R.matvec(x)), y), np.vdot(x, np.float64(R.rmatvec(y)))
    assert abs(left - right) <= np.abs(y) @ _slack(R) @ np.abs(x) + np.abs(x) @ _slack(R, True) @ np.abs(y)


def test_the_same_bits_at_every_call_whatever_came_between(device):
    """Scratch arrays are kept from call to call, for as many right-hand sides as came last."""
    R = two_sided(device, gallery.bounces(N, 0.5))
    x = gallery.vectors(N, 3)
    first = R.matmat(x)
    R.matmat(gallery.vectors(N, 5))
    R.matvec(gallery.vectors(N, None))
    helpers.same_bits(R.matmat(x), first)


def test_facts(device):
    sides = _sides(device)
    W = sides["both"][0]
    core = Dense(device, np.eye(N))
    assert Compressed(core, W, W).two_sided
    assert not any(Compressed(core, *sides[name]).two_sided for name in ("none", "out", "into", "two"))
    tall = sides["tall"][0]
    assert not Compressed(Dense(device, np.eye(N + 12)), tall, tall).two_sided
    assert Compressed(core, W, W).nbytes == core.nbytes + W.nbytes
    assert Compressed(core, W, sides["two"][1]).nbytes == core.nbytes + 2 * W.nbytes
    assert Compressed(core, W, W).error == 0.0
    assert (
        Compressed(core, None, None, 0.25).error == IdentityPlus(Compressed(core, W, W, 0.25)).error == 0.25
    )
    core.error = 0.5
    assert Compressed(core, W, None).error == 0.5


@pytest.mark.parametrize("sides", ["none", "out", "into", "both", "two", "tall", "tall out"])
def test_diagonal(device, sides):
    R = _make(device, sides, "csr")
    truth = stands_for(R).diagonal()
    np.testing.assert_allclose(R.diagonal(), truth, rtol=0, atol=np.max(_slack(R)))
    np.testing.assert_allclose(IdentityPlus(R).diagonal(), 1 + truth, rtol=0, atol=np.max(_slack(R)))


def test_a_diagonal_of_many_pixels_has_to_be_told(device, monkeypatch):
    monkeypatch.setattr(module, "_FEW", N - 1)
    R = two_sided(device, gallery.bounces(N, 0.5))
    with pytest.raises(InputError, match=rf"{N} pixels takes as many products; make it with diagonal="):
        R.diagonal()
    told = Compressed(R.core, R.out, R.into, diagonal=np.arange(N))
    assert told.diagonal().tolist() == list(range(N))
    assert len(Compressed(Dense(device, np.eye(N)), None, None).diagonal()) == N  # of pixels, at hand
    order = Ordered(device, (1, N), np.random.default_rng(0).permutation(N))
    core = gallery.signed(N, N)
    expected = (order.to_dense().T @ core @ order.to_dense()).diagonal()
    np.testing.assert_array_equal(Compressed(Dense(device, core), order, order).diagonal(), expected)


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


def test_sums(device):
    sharp = CSR(device, gallery.sparse(N, N, 0.05))
    smooth = two_sided(device, gallery.bounces(N, 0.5), keep=0.4)
    sharp.error, smooth.error = 0.25, 0.5
    A = Sum(sharp, smooth)
    truth = sharp.to_dense() + stands_for(smooth)
    for transpose in (False, True):
        slack = _slack(smooth, transpose) + 2 * N * reference.UNIT * np.abs(truth.T if transpose else truth)
        slack += 4 * N * reference.UNIT * np.abs(sharp.to_dense().T if transpose else sharp.to_dense())
        apply = A.apply_transpose if transpose else A.apply
        for k in helpers.COLUMNS:
            x = gallery.vectors(N, k)
            for scale, kind in helpers.EPILOGUES.values():
                add, out = helpers.operands(A, gallery.vectors(N, k, 2), kind)
                added = 0.0 if add is None else add.get().astype(np.float64)
                expected = scale * ((truth.T if transpose else truth) @ x) + added
                apply(device.upload(x), out, scale=scale, add=add)
                rounding = 4 * reference.UNIT * (np.abs(expected) + np.abs(added))
                helpers.close(out.get(), expected, slack @ np.abs(x) + rounding)
    assert A.error == 0.75
    assert A.nbytes == sharp.nbytes + smooth.nbytes
    np.testing.assert_allclose(A.diagonal(), truth.diagonal(), atol=1e-5)


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
