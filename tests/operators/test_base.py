# SPDX-License-Identifier: BSD-3-Clause
"""The contract of every operator, as a table; SciPy takes them as they are."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import (
    CSR,
    Chained,
    Compressed,
    Coupled,
    Dense,
    Epilogue,
    Host,
    IdentityPlus,
    Operator,
    Pyramid,
    ScaledColumns,
    Shifted,
    SubsetBasis,
    Sum,
    Wavelet,
    as_operator,
    base,
    wavelets,
)
from tests import gallery, reference
from tests.operators import helpers

SQUARE = gallery.sparse(53, 53).toarray()
TALL = gallery.signed(53, 7)
SCALES = gallery.vectors(7, None, 9)
PICTURES = np.eye(30).reshape(5, 6, 30)  # of one lit pixel each
DB2 = reference.wavelet_split_all(PICTURES, 3, wavelets.filters("db2")).reshape(30, 30)
ORDER = np.random.default_rng(4).permutation(30)
SUMS = reference.pyramid_gather(PICTURES)
CORE, TALLER = gallery.sparse(30, 30), gallery.sparse(44, 44)
C = CORE.toarray()
BLOCKS = [[gallery.signed(7, 5, 3 * c + j) for j in range(3)] for c in range(3)]
MIXING = np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.1]])


def between(device, out, into):
    """C between bases that are named, pixels where None."""
    bases = {
        "db2": Wavelet(device, (5, 6)),
        "order": SubsetBasis(device, (5, 6), ORDER),
        "some": Chained(SubsetBasis(device, (5, 6), ORDER[:9]), Wavelet(device, (5, 6))),
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
    "shifted": (lambda device: Shifted(Dense(device, SQUARE)), SQUARE - np.eye(53)),
    "shifted where lit": (
        lambda device: Shifted(Dense(device, SQUARE), np.arange(53) % 5 > 0),
        SQUARE - np.diag(np.arange(53) % 5 > 0),
    ),
    "I + transposed": (lambda device: IdentityPlus(Dense(device, SQUARE).T), np.eye(53) + SQUARE.T),
    "I + (A - I)": (lambda device: IdentityPlus(Shifted(Dense(device, SQUARE))), SQUARE),
    "wavelet": (lambda device: Wavelet(device, (5, 6), "db2"), DB2),
    "order": (lambda device: SubsetBasis(device, (5, 6), ORDER), np.eye(30)[ORDER]),
    "pyramid": (lambda device: Pyramid(device, (5, 6)), SUMS),
    "wavelet and order": (
        lambda device: Chained(SubsetBasis(device, (5, 6), ORDER), Wavelet(device, (5, 6))),
        DB2[ORDER],
    ),
    "sum": (lambda device: Sum(CSR(device, CORE), Dense(device, C.T)), C + C.T),
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
    silent = isinstance(A, Host | Wavelet | Chained) or (isinstance(A, Coupled) and A.shape[0] != A.shape[1])
    if not silent:
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


def test_a_shift_needs_a_square_operator(device):
    with pytest.raises(InputError, match=r"shift is 2"):
        Dense(device, TALL).apply(device.empty(7), shift=2.0)


def test_product_over_its_own_operand_is_refused(device):
    A, x = Dense(device, SQUARE), device.empty(53)
    with pytest.raises(InputError, match="out is x"):
        A.apply(x, x)


def test_too_many_right_hand_sides_are_refused(device, monkeypatch):
    x = device.empty((1, 1))
    monkeypatch.setattr(type(x), "columns", property(lambda _: 1 << 31))
    with pytest.raises(InputError, match="one product takes"):
        Dense(device, [[1.0]]).apply(x)


def test_dense_copy_beyond_the_hosts_memory_is_refused(pair, monkeypatch):
    A, _ = pair
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 64)
    with pytest.raises(MemoryLimitError, match="but the host has 64 B"):
        A.to_dense()


def test_widths_cut_all_columns_into_pieces_that_kernels_take():
    for k in range(40):
        pieces = base.widths(k)
        assert [c for offset, width in pieces for c in range(offset, offset + width)] == list(range(k))
        assert all(width in base.WIDTHS for _, width in pieces)


# SciPy. R is scaled to norm 0.5, so that S is well conditioned and single precision suffices.
R = (0.5 / np.linalg.norm(gallery.signed(53, 53, 6), 2) * gallery.signed(53, 53, 6)).astype(np.float32)
G = R @ R.T


def solves(S: Operator, x: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.linalg.norm(S.to_dense() @ x - b) <= 1e-4 * np.linalg.norm(b))


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
def test_scipy_solvers_take_operators(device, form):
    b = gallery.vectors(53, None).astype(np.float64)
    S = IdentityPlus(as_operator(form(R), device))
    x, info = scipy.sparse.linalg.gmres(S, b, rtol=1e-5)
    assert info == 0
    assert solves(S, x, b)
    S = IdentityPlus(as_operator(form(G), device))
    x, info = scipy.sparse.linalg.cg(S, b, rtol=1e-5)
    assert info == 0
    assert solves(S, x, b)
    x = scipy.sparse.linalg.lsqr(S, b, atol=1e-6, btol=1e-6)[0]
    assert solves(S, x, b)


def test_scipy_finds_spectra_of_operators(device):
    A = Dense(device, G)
    largest = np.linalg.eigvalsh(np.asarray(G, np.float64))[-1]
    found = scipy.sparse.linalg.eigs(A, k=1, return_eigenvectors=False, v0=np.ones(53))
    assert found[0] == pytest.approx(largest, rel=1e-4)
    singular = scipy.sparse.linalg.svds(Dense(device, TALL), k=2, return_singular_vectors=False, rng=0)
    assert sorted(np.asarray(singular)) == pytest.approx(sorted(np.linalg.svd(TALL)[1][:2]), rel=1e-4)


def test_operators_add_and_multiply_as_scipys_do(device):
    A = Dense(device, SQUARE)
    x = gallery.vectors(53, None)
    composed = scipy.sparse.linalg.aslinearoperator(2 * A + A @ A)
    np.testing.assert_allclose(composed.matvec(x), 2 * SQUARE @ x + SQUARE @ SQUARE @ x, atol=1e-3)


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
