# SPDX-License-Identifier: BSD-3-Clause
"""The contract of every operator, as a table; SciPy takes them as they are."""

from __future__ import annotations

import pickle

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

SQUARE = gallery.sparse(53, 53).toarray()
TALL = gallery.signed(53, 7)
SCALES, LONG = gallery.vectors(7, None, 9), gallery.vectors(53, None, 9)
PICTURES = np.eye(30).reshape(5, 6, 30)  # of one lit pixel each
DB2 = reference.wavelet_split((5, 6), 3, wavelets.filters("db2"))
ORDER = np.random.default_rng(4).permutation(30)
SUMS = reference.pyramid_gather(PICTURES)
TALLER = gallery.sparse(44, 44)
BLOCKS = [[gallery.signed(7, 5, 3 * c + j) for j in range(3)] for c in range(3)]
MIXING = np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.1]])


def between(device, out, into):
    """Coefficients between bases that are named, pixels where None."""
    bases = {
        "db2": Wavelet(device, (5, 6)),
        "order": SubsetBasis(device, (5, 6), ORDER),
        "some": SubsetBasis(device, (5, 6), ORDER[:9], of=Wavelet(device, (5, 6))),
        "sums": Pyramid(device, (5, 6)),
        None: None,
    }
    sizes = [30 if name is None else bases[name].shape[0] for name in (out, into)]
    return Compressed(CSR(device, TALLER[: sizes[0]][:, : sizes[1]]), bases[out], bases[into])


def coupled(device, blocks, mixing):
    return Coupled([[Dense(device, block) for block in row] for row in blocks], mixing)


# An operator and the float64 matrix it stands for; all are kept well scaled, so that one bound serves all.
OPERATORS = {
    "dense": (lambda device: Dense(device, TALL), TALL),
    "csr": (lambda device: CSR(device, scipy.sparse.csr_array(TALL)), TALL),
    "transposed dense": (lambda device: Dense(device, TALL).T, TALL.T),
    "transposed csr": (lambda device: CSR(device, scipy.sparse.csr_array(TALL)).T, TALL.T),
    "host": (lambda device: Host(device, scipy.sparse.linalg.aslinearoperator(TALL.astype(float))), TALL),
    "scaled columns": (lambda device: ScaledColumns(Dense(device, TALL), SCALES), TALL * SCALES),
    "I + R": (lambda device: IdentityPlus(Dense(device, SQUARE)), np.eye(53) + SQUARE),
    "I - A": (
        lambda device: IdentityPlus(as_operator(scipy.sparse.csr_array(SQUARE), device), -1),
        np.eye(53) - SQUARE,
    ),
    "shifted": (
        lambda device: ScaledColumns(Dense(device, SQUARE), LONG, 1.0),
        SQUARE * LONG - np.eye(53),
    ),
    "shifted where lit": (
        lambda device: ScaledColumns(Dense(device, SQUARE), LONG, np.arange(53) % 5 > 0),
        SQUARE * LONG - np.diag(np.arange(53) % 5 > 0),
    ),
    "I + transposed": (lambda device: IdentityPlus(Dense(device, SQUARE).T), np.eye(53) + SQUARE.T),
    "I + (A - I)": (
        lambda device: IdentityPlus(ScaledColumns(Dense(device, SQUARE), LONG, 1.0)),
        SQUARE * LONG,
    ),
    "wavelet": (lambda device: Wavelet(device, (5, 6), "db2"), DB2),
    "order": (lambda device: SubsetBasis(device, (5, 6), ORDER), np.eye(30)[ORDER]),
    "pyramid": (lambda device: Pyramid(device, (5, 6)), SUMS),
    "wavelet and order": (
        lambda device: SubsetBasis(device, (5, 6), ORDER, of=Wavelet(device, (5, 6))),
        DB2[ORDER],
    ),
    "both sides": (lambda device: between(device, "db2", "db2"), DB2.T @ TALLER.toarray()[:30, :30] @ DB2),
    "rows": (lambda device: between(device, None, "db2"), TALLER.toarray()[:30, :30] @ DB2),
    "columns": (lambda device: between(device, "db2", None), DB2.T @ TALLER.toarray()[:30, :30]),
    "two bases": (
        lambda device: between(device, "order", "db2"),
        np.eye(30)[:, ORDER] @ TALLER.toarray()[:30, :30] @ DB2,
    ),
    "more than pixels": (lambda device: between(device, "sums", "sums"), SUMS.T @ TALLER @ SUMS),
    "fewer than pixels": (
        lambda device: between(device, "some", "some"),
        DB2[ORDER[:9]].T @ TALLER.toarray()[:9, :9] @ DB2[ORDER[:9]],
    ),
    "coupled": (
        lambda device: coupled(device, BLOCKS, MIXING),
        np.block(BLOCKS).astype(np.float64) @ np.kron(MIXING, np.eye(5)),
    ),
    "mixed": (
        lambda device: Coupled.mixed([Dense(device, SQUARE)] * 3, MIXING),
        np.kron(MIXING, SQUARE.astype(np.float64)),
    ),
}


@pytest.fixture(params=OPERATORS)
def pair(request, device):
    make, matrix = OPERATORS[request.param]
    return make(device), matrix.astype(np.float64)


def test_products_meet_their_twin(pair):
    A, matrix = pair
    helpers.meets_twin(A, matrix)
    helpers.meets_twin(A, matrix, transpose=True)


def test_steps_meet_their_twin(pair):
    A, matrix = pair
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
    terms = reference.product_error(matrix, x) @ np.abs(y) + reference.product_error(matrix.T, y) @ np.abs(x)
    assert abs(left - right) <= terms


def test_numpy_in_numpy_out(pair):
    A, matrix = pair
    x, y = gallery.vectors(A.shape[1], 3), gallery.vectors(A.shape[0], 3, 5)
    for found, expected, error in (
        (A.matvec(np.float64(x[:, 0])), matrix @ x[:, 0], reference.product_error(matrix, x[:, 0])),
        (A.matvec(x[:, :1]), matrix @ x[:, :1], reference.product_error(matrix, x[:, :1])),
        (A.matmat(x), matrix @ x, reference.product_error(matrix, x)),
        (A.rmatvec(y[:, 0]), matrix.T @ y[:, 0], reference.product_error(matrix.T, y[:, 0])),
        (A.rmatmat(y), matrix.T @ y, reference.product_error(matrix.T, y)),
        (A.H @ y, matrix.T @ y, reference.product_error(matrix.T, y)),
        (A.T.T @ x, matrix @ x, reference.product_error(matrix, x)),
    ):
        assert found.dtype == np.float32
        helpers.close(found, expected, error)


def test_facts(pair):
    A, matrix = pair
    assert A.shape == A.T.T.shape == A.T.shape[::-1] == matrix.shape
    assert A.dtype == np.float32
    assert A.nbytes == A.T.nbytes
    assert A.error == 0.0
    ones = np.ones(matrix.shape[1])
    helpers.close(A.row_sums(), matrix @ ones, reference.product_error(matrix, ones))
    assert A.row_sums() is A.row_sums()
    # A column is one value times 1, plus what the identity brings: a few roundings.
    np.testing.assert_allclose(A.to_dense(), matrix, rtol=0, atol=8 * reference.UNIT * np.abs(matrix).max())
    if not isinstance(A, Host | Basis | Coupled):  # which do not know it
        np.testing.assert_allclose(A.diagonal(), matrix.diagonal(), atol=4 * reference.UNIT)


@pytest.mark.parametrize("k", [0, 1])
def test_empty_operands_are_no_trouble(pair, k):
    A, _ = pair
    assert (A @ np.zeros((A.shape[1], k), np.float32)).shape == (A.shape[0], k)


def test_unfit_operands_are_refused(pair):
    A, _ = pair
    device, (rows, columns) = A.device, A.shape
    x, out = device.empty((columns, 2)), device.empty((rows, 2))
    for bad, part in (
        (lambda: A.apply(device.empty(columns + 1)), f"needs \\({columns},\\)"),
        (lambda: A.apply_transpose(device.empty(rows + 1)), f"needs \\({rows},\\)"),
        (lambda: A.apply(x, device.empty((rows, 3))), "out has shape"),
        (lambda: A.apply(x, device.empty(rows)), "out has shape"),
        (lambda: A.apply(x, out, add=device.empty((rows, 1))), "add has shape"),
        (lambda: A.apply(device.empty((columns, 2), np.float64)), "x holds float64"),
        (lambda: A.apply(Device(device.description).empty(columns)), "another device"),
    ):
        with pytest.raises(InputError, match=part):
            bad()
    with pytest.raises(InputTypeError, match="real numbers"):
        A.matvec(np.full(columns, 1j))


def test_shifts_operands_and_widths_that_no_product_takes_are_refused(device, monkeypatch):
    x = device.empty(53)
    with pytest.raises(InputError, match="shift is 2"):
        Dense(device, TALL).apply(device.empty(7), shift=2.0)
    with pytest.raises(InputError, match="out is x"):
        Dense(device, SQUARE).apply(x, x)
    monkeypatch.setattr(type(x), "columns", property(lambda _: 1 << 31))
    with pytest.raises(InputError, match=f"x has {1 << 31}"):
        Dense(device, SQUARE).apply(x)


def test_dense_copy_beyond_the_hosts_memory_is_refused(pair, monkeypatch):
    A, _ = pair
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 64)
    with pytest.raises(MemoryLimitError, match="but the host has 64 B"):
        A.to_dense()


def test_dense_copy_beyond_a_limit_of_the_process_is_refused(device, monkeypatch):
    """2 PiB: more than a process can address, whatever the host has."""
    A = CSR(device, scipy.sparse.csr_array((1 << 17, (1 << 31) - 1), dtype=np.float32))
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 1 << 62)
    with pytest.raises(MemoryLimitError, match=r"131072 x 2147483647.* 2048 TiB"):
        A.to_dense()


@pytest.mark.parametrize("multiply", [lambda A, x: A @ x, lambda A, x: A.T @ x, lambda A, x: x @ A])
def test_masks_are_refused_not_dropped(device, multiply):
    with pytest.raises(InputTypeError, match=r"x .*1 masked"):
        multiply(Dense(device, SQUARE), np.ma.masked_less(np.arange(53.0), 1))


def test_operators_say_that_they_cannot_be_pickled(pair):
    with pytest.raises(InputTypeError, match="Transport"):
        pickle.dumps(pair[0])


# SciPy. R is scaled to norm 0.5, so that S is well conditioned and single precision suffices.
R = (0.5 / np.linalg.norm(gallery.signed(53, 53, 6), 2) * gallery.signed(53, 53, 6)).astype(np.float32)


def test_scipy_solvers_take_operators(device):
    b = gallery.vectors(53, None).astype(np.float64)
    S = IdentityPlus(Dense(device, R))
    for x in (
        scipy.sparse.linalg.gmres(S, b, rtol=1e-5)[0],
        scipy.sparse.linalg.lsqr(S, b, 0.0, 1e-6, 1e-6)[0],
    ):
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
