# SPDX-License-Identifier: BSD-3-Clause
"""The contract of every operator, as a table; SciPy takes them as they are."""

from __future__ import annotations

import gc
import pickle
import weakref
from functools import partial
from operator import matmul
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import ltcl
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import (
    CSR,
    Basis,
    Compressed,
    Coupled,
    Dense,
    Epilogue,
    Hats,
    Host,
    IdentityPlus,
    Operator,
    PatchHats,
    Product,
    Pyramid,
    RowBlocks,
    ScaledBasis,
    ScaledColumns,
    SubsetBasis,
    Tiles,
    Wavelet,
    as_operator,
    wavelets,
)
from tests import gallery, reference
from tests.operators import helpers

SQUARE = gallery.sparse(53, 53).toarray()
TALL = gallery.signed(53, 7)
GRID = (5, 6)
PIXELS = 30
EYE = np.eye(53)
# Some columns of seven, twice.
CHOICE = 2 * np.eye(7, 5, dtype=np.float32)

Pair = tuple[Operator, np.ndarray]


def plain_operators(device: Device) -> dict[str, Pair]:
    """Operators of one matrix, with that matrix."""
    tall = Dense(device, TALL)
    sparse = CSR(device, scipy.sparse.csr_array(TALL))
    d = gallery.vectors(53, None, 9)
    user = scipy.sparse.linalg.aslinearoperator(TALL.astype(float))
    return {
        "dense": (tall, TALL),
        "csr": (sparse, TALL),
        "transposed dense": (tall.T, TALL.T),
        "transposed csr": (sparse.T, TALL.T),
        "host": (Host(device, user), TALL),
        "scaled columns": (ScaledColumns(tall, d[:7]), TALL * d[:7]),
    }


def shifted_operators(device: Device) -> dict[str, Pair]:
    """Operators with an identity or a diagonal."""
    square = Dense(device, SQUARE)
    sparse = as_operator(scipy.sparse.csr_array(SQUARE), device)
    d = gallery.vectors(53, None, 9)
    lit = np.arange(53) % 5 > 0
    return {
        "I + R": (IdentityPlus(square), EYE + SQUARE),
        "I - A": (IdentityPlus(sparse, -1), EYE - SQUARE),
        "shifted": (ScaledColumns(square, d, 1.0), SQUARE * d - EYE),
        "shifted where lit": (ScaledColumns(square, d, lit), SQUARE * d - np.diag(lit)),
        "I + transposed": (IdentityPlus(square.T), EYE + SQUARE.T),
        "I + (A - I)": (IdentityPlus(ScaledColumns(square, d, 1.0)), SQUARE * d),
    }


def bases_and_compressed(device: Device) -> dict[str, Pair]:
    """Bases, and cores between them."""
    order = np.random.default_rng(4).permutation(PIXELS)
    wavelet = Wavelet(device, GRID)
    pyramid = Pyramid(device, GRID)
    permutation = SubsetBasis(device, GRID, order)
    some = SubsetBasis(device, GRID, order[:9], of=wavelet)
    W = reference.wavelet_split(GRID, 3, wavelets.filters("db2"))
    P = np.eye(PIXELS)[order]
    Q = reference.pyramid_gather(np.eye(PIXELS).reshape(*GRID, PIXELS))
    V = W[order[:9]]
    core = gallery.sparse(44, 44)
    C = core.toarray()[:PIXELS, :PIXELS]
    C9 = core.toarray()[:9, :9]
    scale = np.linspace(0.2, 1.5, PIXELS)
    scaled = ScaledBasis(pyramid, scale)
    large = CSR(device, core)
    middle = CSR(device, scipy.sparse.csr_array(C))
    small = CSR(device, scipy.sparse.csr_array(C9))
    return {
        "wavelet": (wavelet, W),
        "order": (permutation, P),
        "pyramid": (pyramid, Q),
        "hats": (Hats(device, GRID), reference.hats_gather(GRID)),
        "patch hats": (PatchHats(device, (4, 12), 2, 2), reference.patch_hats((4, 12), 2, 2)),
        "wavelet and order": (SubsetBasis(device, GRID, order, of=wavelet), W[order]),
        "both sides": (Compressed(middle, wavelet, wavelet), W.T @ C @ W),
        "rows": (Compressed(middle, None, wavelet), C @ W),
        "columns": (Compressed(middle, wavelet, None), W.T @ C),
        "two bases": (Compressed(middle, permutation, wavelet), P.T @ C @ W),
        "more than pixels": (Compressed(large, pyramid, pyramid), Q.T @ core @ Q),
        "fewer than pixels": (Compressed(small, some, some), V.T @ C9 @ V),
        "scaled": (scaled, Q * scale),
        "scaled rows": (Compressed(large, scaled, pyramid), (Q * scale).T @ core @ Q),
    }


def coupled_operators(device: Device) -> dict[str, Pair]:
    """Three channels that see the light of each other, or that are mixed before."""
    mixing = np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.1]])
    matrices = [[gallery.signed(7, 5, 3 * c + j) for j in range(3)] for c in range(3)]
    blocks = [[Dense(device, block) for block in row] for row in matrices]
    coupled = np.block(matrices).astype(np.float64) @ np.kron(mixing, np.eye(5))
    square = Dense(device, SQUARE)
    mixed = np.kron(mixing, SQUARE.astype(np.float64))
    return {
        "coupled": (Coupled(blocks, mixing), coupled),
        "mixed": (Coupled.mixed([square] * 3, mixing), mixed),
        "product": (Product(Dense(device, TALL), Dense(device, CHOICE)), TALL @ CHOICE),
    }


NAMES = (
    "dense, csr, transposed dense, transposed csr, host, scaled columns, I + R, I - A, shifted, "
    "shifted where lit, I + transposed, I + (A - I), wavelet, order, pyramid, hats, "
    "patch hats, wavelet and order, both sides, rows, columns, two bases, more than pixels, "
    "fewer than pixels, scaled, scaled rows, coupled, mixed, product"
)


@pytest.fixture(scope="module")
def operators(device):
    """Operators and their matrices, all well scaled, so that one bound serves all."""
    pairs = {
        **plain_operators(device),
        **shifted_operators(device),
        **bases_and_compressed(device),
        **coupled_operators(device),
    }
    assert ", ".join(pairs) == NAMES
    return pairs


@pytest.fixture(params=NAMES.split(", "))
def pair(request, operators):
    A, matrix = operators[request.param]
    return A, matrix.astype(np.float64)


def test_a_product_has_to_be_written(device):
    with pytest.raises(TypeError, match="_queue_product"):
        Operator(device, (1, 1))  # pyright: ignore[reportAbstractUsage]


@pytest.mark.slow
def test_products_and_steps_meet_their_twins(pair):
    A, matrix = pair
    helpers.meets_twin(A, matrix)
    helpers.meets_twin(A, matrix, transpose=True)
    if matrix.shape[0] == matrix.shape[1]:
        helpers.steps_match(A, matrix, (None, 1, 3, 11))


@pytest.mark.parametrize("transpose", [False, True])
def test_a_bound_product_reads_its_arrays_at_every_call(pair, transpose):
    A, matrix = pair
    if transpose:
        matrix = matrix.T
    x = gallery.vectors(matrix.shape[1], 3)
    y = gallery.vectors(matrix.shape[0], 3, 5)
    operand = A.device.empty(x.shape)
    out = A.device.upload(y)
    launch = A.bind(operand, out, Epilogue(0.5, -1.0, out), transpose=transpose)
    operand.set(x)
    launch()
    once = 0.5 * matrix @ x - y
    helpers.close(out.get(), once, reference.product_error(matrix, x, 0.5, y))
    # The second call adds to what the first has left.
    launch()
    twice = 0.5 * matrix @ x - once
    helpers.close(out.get(), twice, 3 * reference.product_error(matrix, x, 1.5, y))


def test_adjoint(pair):
    """<A x, y> = <x, A^T y>: the two sums run over the same products, each in its own order."""
    A, matrix = pair
    x = gallery.vectors(A.shape[1], None, 3)
    y = gallery.vectors(A.shape[0], None, 4)
    left = np.vdot(np.float64(A @ x), y)
    right = np.vdot(x, np.float64(A.T @ y))
    forward_error = reference.product_error(matrix, x) @ np.abs(y)
    backward_error = reference.product_error(matrix.T, y) @ np.abs(x)
    assert abs(left - right) <= forward_error + backward_error


def test_numpy_in_numpy_out(pair):
    A, matrix = pair
    x = gallery.vectors(A.shape[1], 3)
    y = gallery.vectors(A.shape[0], 3, 5)
    for product, M, operand in (
        (A.matvec(np.float64(x[:, 0])), matrix, x[:, 0]),
        # SciPy 1.18 warns of `matvec` with a column.
        (A.matmat(x[:, :1]), matrix, x[:, :1]),
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
    assert A.shape == matrix.shape
    assert A.T.shape == matrix.T.shape
    assert A.T.T.shape == matrix.shape
    assert A.dtype == np.float32
    assert A.error == 0.0
    assert A.nbytes == A.T.nbytes
    ones = np.ones(matrix.shape[1])
    helpers.close(A.row_sums(), matrix @ ones, reference.product_error(matrix, ones))
    assert A.row_sums() is A.row_sums()
    # A column is one value times 1, and perhaps the identity: a few roundings.
    error = 8 * reference.UNIT * np.abs(matrix).max()
    np.testing.assert_allclose(A.to_dense(), matrix, rtol=0, atol=error)
    # Others do not know it.
    if not isinstance(A, Host | Basis | Coupled | Product):
        np.testing.assert_allclose(A.diagonal(), matrix.diagonal(), atol=4 * reference.UNIT)


@pytest.mark.parametrize("transpose", [False, True])
def test_norm_bounds_are_bounds(pair, transpose):
    A, matrix = pair
    if transpose:
        A, matrix = A.T, matrix.T
    bound = A.norm_bound()
    assert bound == A.norm_bound()
    # A core between isometric bases has the norm of the operator, but other entries.
    entries = matrix if isinstance(A, Compressed) else np.abs(matrix)
    if bound.is_bound:
        assert bound.value >= np.linalg.norm(entries, 2)
    else:
        row_sums = matrix.sum(axis=1)
        assert bound.value >= max(1.0, row_sums.max(), -row_sums.min()) * (1 - 1e-5)


def test_float64_products_have_no_error_of_float32(pair):
    A, matrix = pair
    product = A.product_float64()
    x = gallery.vectors(A.shape[1], 3).astype(np.float64)
    if product is not None:
        np.testing.assert_allclose(product(x), matrix @ x, rtol=0, atol=1e-6)
    if A.shape[0] != A.shape[1]:
        return
    dense, is_given = A.matrix_float64()
    assert is_given == (product is not None)
    assert dense.dtype == np.float64
    np.testing.assert_allclose(dense, matrix, rtol=0, atol=1e-5)
    if product is not None:
        np.testing.assert_allclose(dense @ x, product(x), rtol=0, atol=1e-13)


def test_float64_products_use_the_numbers_that_were_given(device):
    matrix = np.random.default_rng(0).uniform(-1.0, 1.0, (53, 53))
    x = np.random.default_rng(1).uniform(size=(53, 2))
    exact = (np.eye(53) - matrix) @ x
    sparse = scipy.sparse.csr_array(matrix)
    stored = RowBlocks(device, (53, 53), lambda: iter([(0, sparse)]), sparse.nnz)
    assert IdentityPlus(stored, -1).product_float64() is None
    dense, is_given = IdentityPlus(stored, -1).matrix_float64()
    assert is_given
    np.testing.assert_allclose(dense @ x, exact, rtol=0, atol=1e-13)
    user = scipy.sparse.linalg.aslinearoperator(matrix)
    for R in (CSR(device, sparse), Host(device, user)):
        product = IdentityPlus(R, -1).product_float64()
        assert product is not None
        np.testing.assert_allclose(product(x), exact, rtol=0, atol=1e-13)
    # Tiles and dense matrices keep what lies on the device.
    for R in (Tiles(device, sparse, 1, "float32"), Dense(device, matrix)):
        product = IdentityPlus(R, -1).product_float64()
        assert product is not None
        on_device = (np.eye(53) - matrix.astype(np.float32)) @ x
        np.testing.assert_allclose(product(x), on_device, rtol=0, atol=1e-12)


@pytest.mark.parametrize("method", ["auto", "direct", "gauss_seidel", "southwell", "gmres"])
@pytest.mark.parametrize("form", helpers.ROWS)
def test_operators_are_freed_by_reference_counting_alone(device, form, method):
    """Whatever solvers keep of an operator refers to its parts at most."""
    R = helpers.FORMATS[form](device, gallery.bounces(53, 0.3))
    S = IdentityPlus(R)
    S.norm_bound()
    S.product_float64()
    ltcl.solve(S, np.ones(53), method, rtol=1e-4)
    alive = [weakref.ref(S), weakref.ref(R)]
    gc.disable()
    try:
        del S, R
        assert [reference() for reference in alive] == [None, None]
    finally:
        gc.enable()


def test_bad_operands_are_refused(pair, monkeypatch):
    A, _ = pair
    device = A.device
    rows, columns = A.shape
    x = device.empty((columns, 2))
    out = device.empty((rows, 2))
    other_device = Device(device.description)
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 64)
    helpers.refused(
        InputError,
        (rf"needs \({columns},\)", A.apply, device.empty(columns + 1)),
        (rf"needs \({rows},\)", A.apply_transpose, device.empty(rows + 1)),
        ("out has shape", A.apply, x, device.empty((rows, 3))),
        ("out has shape", A.apply, x, device.empty(rows)),
        ("add has shape", partial(A.apply, add=device.empty((rows, 1))), x, out),
        ("x holds float64", A.apply, device.empty((columns, 2), np.float64)),
        ("another device", A.apply, other_device.empty(columns)),
    )
    helpers.refused(
        InputTypeError,
        ("real numbers", A.matvec, np.full(columns, 1j)),
        ("Transport", pickle.dumps, A),
    )
    helpers.refused(MemoryLimitError, ("but the host has 64 B", A.to_dense))


def test_shifts_operands_widths_and_masks_that_no_product_takes_are_refused(device, monkeypatch):
    A = Dense(device, SQUARE)
    tall = Dense(device, TALL)
    x = device.empty(53)
    masked = np.ma.masked_less(np.arange(53.0), 1)
    helpers.refused(
        InputTypeError,
        ("x .*1 masked", matmul, A, masked),
        ("x .*1 masked", matmul, A.T, masked),
        ("x .*1 masked", matmul, masked, A),
    )
    helpers.refused(
        InputError,
        ("shift is 2", partial(tall.apply, shift=2.0), device.empty(7)),
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
    signed = gallery.signed(53, 53, 6)
    b = gallery.vectors(53, None).astype(np.float64)
    R = signed / np.float32(2 * np.linalg.norm(signed, 2))
    S = IdentityPlus(Dense(device, R))
    by_gmres = scipy.sparse.linalg.gmres(S, b, rtol=1e-5)[0]
    by_lsqr = scipy.sparse.linalg.lsqr(S, b, 0.0, 1e-6, 1e-6)[0]
    for x in (by_gmres, by_lsqr):
        assert np.linalg.norm(b - x - R @ x) <= 1e-4 * np.linalg.norm(b)


KINDS: list[tuple[Any, type[Operator]]] = [
    (TALL, Dense),
    (TALL.tolist(), Dense),
    (scipy.sparse.coo_array(TALL), CSR),
    (scipy.sparse.csr_matrix(TALL), CSR),
    (scipy.sparse.linalg.aslinearoperator(TALL), Host),
]


@pytest.mark.parametrize(("matrix", "kind"), KINDS, ids=[type(M).__name__ for M, _ in KINDS])
def test_as_operator_takes_all_matrices_of_scipy(device, matrix, kind):
    A = as_operator(matrix, device)
    assert type(A) is kind
    assert as_operator(A, device) is A
