# SPDX-License-Identifier: BSD-3-Clause
"""The contract of every operator, as a table; SciPy takes them as they are."""

from __future__ import annotations

import pickle
from functools import partial
from operator import matmul

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import (
    CSR,
    Basis,
    Compressed,
    Coupled,
    Dense,
    Epilogue,
    Host,
    IdentityPlus,
    Pyramid,
    ScaledColumns,
    SubsetBasis,
    Wavelet,
    as_operator,
    wavelets,
)
from tests import gallery, reference
from tests.operators import helpers

NAMES = (
    "dense, csr, transposed dense, transposed csr, host, scaled columns, I + R, I - A, shifted, "
    "shifted where lit, I + transposed, I + (A - I), wavelet, order, pyramid, wavelet and order, both sides, "
    "rows, columns, two bases, more than pixels, fewer than pixels, coupled, mixed"
)
SQUARE, TALL = gallery.sparse(53, 53).toarray(), gallery.signed(53, 7)


@pytest.fixture(scope="module")
def operators(device):
    """Operators and the matrices they stand for, all well scaled, so that one bound serves all."""
    square, tall, sparse = Dense(device, SQUARE), Dense(device, TALL), scipy.sparse.csr_array
    I, d, lit = np.eye(53), gallery.vectors(53, None, 9), np.arange(53) % 5 > 0
    grid, core, order = (5, 6), gallery.sparse(44, 44), np.random.default_rng(4).permutation(30)
    db2, sums, permutation = (
        Wavelet(device, grid),
        Pyramid(device, grid),
        SubsetBasis(device, grid, order),
    )
    some = SubsetBasis(device, grid, order[:9], of=db2)
    W, P = reference.wavelet_split(grid, 3, wavelets.filters("db2")), np.eye(30)[order]
    Q, V = reference.pyramid_gather(np.eye(30).reshape(5, 6, 30)), W[order[:9]]
    C, C9 = core.toarray()[:30, :30], core.toarray()[:9, :9]
    blocks = [[gallery.signed(7, 5, 3 * c + j) for j in range(3)] for c in range(3)]
    mixing = np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.1]])
    c30 = CSR(device, sparse(C))
    made = {
        "dense": (tall, TALL),
        "csr": (CSR(device, sparse(TALL)), TALL),
        "transposed dense": (Dense(device, TALL).T, TALL.T),
        "transposed csr": (CSR(device, sparse(TALL)).T, TALL.T),
        "host": (Host(device, scipy.sparse.linalg.aslinearoperator(TALL.astype(float))), TALL),
        "scaled columns": (ScaledColumns(tall, d[:7]), TALL * d[:7]),
        "I + R": (IdentityPlus(square), I + SQUARE),
        "I - A": (IdentityPlus(as_operator(sparse(SQUARE), device), -1), I - SQUARE),
        "shifted": (ScaledColumns(square, d, 1.0), SQUARE * d - I),
        "shifted where lit": (ScaledColumns(square, d, lit), SQUARE * d - np.diag(lit)),
        "I + transposed": (IdentityPlus(square.T), I + SQUARE.T),
        "I + (A - I)": (IdentityPlus(ScaledColumns(square, d, 1.0)), SQUARE * d),
        "wavelet": (db2, W),
        "order": (permutation, P),
        "pyramid": (sums, Q),
        "wavelet and order": (SubsetBasis(device, grid, order, of=db2), W[order]),
        "both sides": (Compressed(c30, db2, db2), W.T @ C @ W),
        "rows": (Compressed(c30, None, db2), C @ W),
        "columns": (Compressed(c30, db2, None), W.T @ C),
        "two bases": (Compressed(c30, permutation, db2), P.T @ C @ W),
        "more than pixels": (Compressed(CSR(device, core), sums, sums), Q.T @ core @ Q),
        "fewer than pixels": (Compressed(CSR(device, sparse(C9)), some, some), V.T @ C9 @ V),
        "coupled": (
            Coupled([[Dense(device, block) for block in row] for row in blocks], mixing),
            np.block(blocks).astype(np.float64) @ np.kron(mixing, np.eye(5)),
        ),
        "mixed": (Coupled.mixed([square] * 3, mixing), np.kron(mixing, SQUARE.astype(np.float64))),
    }
    assert ", ".join(made) == NAMES
    return made


@pytest.fixture(params=NAMES.split(", "))
def pair(request, operators):
    A, matrix = operators[request.param]
    return A, matrix.astype(np.float64)


def test_products_and_steps_meet_their_twins(pair):
    A, matrix = pair
    helpers.meets_twin(A, matrix)
    helpers.meets_twin(A, matrix, transpose=True)
    if matrix.shape[0] == matrix.shape[1]:
        helpers.steps_match(A, matrix, (None, 1, 3, 11))


def test_a_bound_product_reads_its_arrays_at_every_call(pair):
    A, matrix = pair
    x, y = gallery.vectors(A.shape[1], 3), gallery.vectors(A.shape[0], 3, 5)
    for transpose, before, after, M in ((False, x, y, matrix), (True, y, x, matrix.T)):
        operand, out = A.device.empty(before.shape), A.device.upload(after)
        launch = A.bind(operand, out, Epilogue(0.5, -1.0, out), transpose=transpose)
        operand.set(before)
        launch()
        expected = 0.5 * M @ before - after
        helpers.close(out.get(), expected, reference.product_error(M, before, 0.5, after))
        launch()  # adds to what the first has left
        twice = 0.5 * M @ before - expected
        helpers.close(out.get(), twice, 3 * reference.product_error(M, before, 1.5, after))


def test_adjoint(pair):
    """<A x, y> = <x, A^T y>: the two sums run over the same products, each in its own order."""
    A, matrix = pair
    x, y = gallery.vectors(A.shape[1], None, 3), gallery.vectors(A.shape[0], None, 4)
    left, right = np.vdot(np.asarray(A @ x, np.float64), y), np.vdot(x, np.float64(A.T @ y))
    terms = reference.product_error(matrix, x) @ np.abs(y) + reference.product_error(
        matrix.T, y
    ) @ np.abs(x)
    assert abs(left - right) <= terms


def test_numpy_in_numpy_out(pair):
    A, matrix = pair
    x, y = gallery.vectors(A.shape[1], 3), gallery.vectors(A.shape[0], 3, 5)
    for product, M, operand in (
        (A.matvec(np.float64(x[:, 0])), matrix, x[:, 0]),
        (A.matvec(x[:, :1]), matrix, x[:, :1]),
        (A.matmat(x), matrix, x),
        (A.rmatvec(y[:, 0]), matrix.T, y[:, 0]),
        (A.rmatmat(y), matrix.T, y),
        (A.H @ y, matrix.T, y),
        (A.T.T @ x, matrix, x),
        (A @ x[:, :0], matrix, x[:, :0]),
    ):
        assert product.dtype == np.float32
        helpers.close(product, M @ operand, reference.product_error(M, operand))


def test_facts(pair):
    A, matrix = pair
    assert A.shape == A.T.T.shape == A.T.shape[::-1] == matrix.shape
    assert (A.dtype, A.error) == (np.float32, 0.0)
    assert A.nbytes == A.T.nbytes
    ones = np.ones(matrix.shape[1])
    helpers.close(A.row_sums(), matrix @ ones, reference.product_error(matrix, ones))
    assert A.row_sums() is A.row_sums()
    # A column is one value times 1, plus what the identity brings: a few roundings.
    np.testing.assert_allclose(
        A.to_dense(), matrix, rtol=0, atol=8 * reference.UNIT * np.abs(matrix).max()
    )
    if not isinstance(A, Host | Basis | Coupled):  # which do not know it
        np.testing.assert_allclose(A.diagonal(), matrix.diagonal(), atol=4 * reference.UNIT)


def test_what_no_operator_takes_is_refused(pair, monkeypatch):
    A, _ = pair
    device, (rows, columns) = A.device, A.shape
    x, out = device.empty((columns, 2)), device.empty((rows, 2))
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 64)
    helpers.refused(
        InputError,
        (rf"needs \({columns},\)", A.apply, device.empty(columns + 1)),
        (rf"needs \({rows},\)", A.apply_transpose, device.empty(rows + 1)),
        ("out has shape", A.apply, x, device.empty((rows, 3))),
        ("out has shape", A.apply, x, device.empty(rows)),
        ("add has shape", partial(A.apply, add=device.empty((rows, 1))), x, out),
        ("x holds float64", A.apply, device.empty((columns, 2), np.float64)),
        ("another device", A.apply, Device(device.description).empty(columns)),
    )
    helpers.refused(
        InputTypeError,
        ("real numbers", A.matvec, np.full(columns, 1j)),
        ("Transport", pickle.dumps, A),
    )
    helpers.refused(MemoryLimitError, ("but the host has 64 B", A.to_dense))


def test_shifts_operands_widths_and_masks_that_no_product_takes_are_refused(device, monkeypatch):
    A, x, masked = Dense(device, SQUARE), device.empty(53), np.ma.masked_less(np.arange(53.0), 1)
    helpers.refused(
        InputTypeError,
        *((r"x .*1 masked", matmul, *pair) for pair in ((A, masked), (A.T, masked), (masked, A))),
    )
    helpers.refused(
        InputError,
        ("shift is 2", partial(Dense(device, TALL).apply, shift=2.0), device.empty(7)),
        ("out is x", A.apply, x, x),
    )
    monkeypatch.setattr(type(x), "columns", property(lambda _: 1 << 31))
    helpers.refused(InputError, (f"x has {1 << 31}", A.apply, x))


def test_dense_copy_beyond_a_limit_of_the_process_is_refused(device, monkeypatch):
    """2 PiB: more than a process can address, whatever the host has."""
    A = CSR(device, scipy.sparse.csr_array((1 << 17, (1 << 31) - 1), dtype=np.float32))
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 1 << 62)
    with pytest.raises(MemoryLimitError, match=r"131072 x 2147483647.* 2048 TiB"):
        A.to_dense()


def test_scipy_solvers_take_operators(device):
    """R has norm 0.5, so that S is well conditioned and single precision suffices."""
    signed, b = gallery.signed(53, 53, 6), gallery.vectors(53, None).astype(np.float64)
    R = signed / np.float32(2 * np.linalg.norm(signed, 2))
    S = IdentityPlus(Dense(device, R))
    gmres, lsqr = (
        scipy.sparse.linalg.gmres(S, b, rtol=1e-5),
        scipy.sparse.linalg.lsqr(S, b, 0.0, 1e-6, 1e-6),
    )
    for x in (gmres[0], lsqr[0]):
        assert np.linalg.norm(b - x - R @ x) <= 1e-4 * np.linalg.norm(b)


def test_as_operator_knows_what_scipy_users_hold(device):
    for matrix, kind in (
        (TALL, Dense),
        (TALL.tolist(), Dense),
        (scipy.sparse.coo_array(TALL), CSR),
        (scipy.sparse.csr_matrix(TALL), CSR),
        (scipy.sparse.linalg.aslinearoperator(TALL), Host),
    ):
        A = as_operator(matrix, device)
        assert type(A) is kind
        assert as_operator(A, device) is A
