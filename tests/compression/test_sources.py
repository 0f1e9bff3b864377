# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl.compress` of rows from wherever they come, with and without room on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import zarr

import ltcl
from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import CSR, Dense
from tests.compression.helpers import dense_systems, smooth, worst_error


@pytest.fixture(scope="module")
def corner() -> ltcl.Transport:
    return ltcl.scenes.dihedral(8, albedo=0.8).transport()


class Rows:
    """Rows of a matrix, of so many columns, and so many more than were asked for."""

    def __init__(self, matrix: Any, columns: int = 128, more: int = 0, shape: Any = (128, 128)) -> None:
        self.matrix, self.columns, self.more, self.shape = matrix, columns, more, shape

    def rows(self, start: int, stop: int) -> np.ndarray:
        return self.matrix[start : stop + self.more, : self.columns]


def chunked(matrix, folder):
    array = zarr.create_array(folder / "T.zarr", shape=matrix.shape, chunks=(30, 50), dtype=matrix.dtype)
    array[:] = matrix
    return array


HOLDERS = {
    "array": lambda matrix, folder: matrix,
    "zarr": chunked,
    "csc": lambda matrix, folder: scipy.sparse.csc_matrix(matrix),
    "rows": lambda matrix, folder: Rows(matrix),
}
OPERATORS = {
    "SciPy's": lambda matrix, device: scipy.sparse.linalg.aslinearoperator(matrix),
    "dense": lambda matrix, device: Dense(device, matrix),
    "csr": lambda matrix, device: CSR(device, scipy.sparse.csr_array(matrix)),
}


@pytest.mark.parametrize("kind", HOLDERS)
def test_rows_from_elsewhere_give_the_same_bits(kind, corner, tmp_path):
    matrix = HOLDERS[kind](corner.matrices[0], tmp_path)
    direct = ltcl.compress(corner, 0.02, basis="db2")
    for memory in (None, 32 * 128 * 16):  # the second is that of the smallest block
        C = ltcl.compress(matrix, 0.02, basis="db2", grid=corner.grid, memory=memory)
        np.testing.assert_array_equal(direct.systems[0].R.to_dense(), C.systems[0].R.to_dense())
        np.testing.assert_array_equal(direct.first_bounce, C.first_bounce)


@pytest.mark.parametrize("kind", OPERATORS)
def test_operators_give_their_rows_by_products(kind, corner, device):
    operator = OPERATORS[kind](corner.matrices[0], device)
    F = corner.first_bounce if kind == "SciPy's" else None
    C = ltcl.compress(operator, 0.05, basis="db2", grid=corner.grid, first_bounce=F)
    np.testing.assert_allclose(C.first_bounce, corner.first_bounce, rtol=1e-6)
    assert worst_error(dense_systems(corner)[0], C.systems[0].to_dense()) <= C.error <= 0.05


@pytest.mark.parametrize("basis", ["db2", "db2 rows", "pixels"])
def test_rows_may_be_dropped_where_no_memory_holds_them(basis, monkeypatch):
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    assert T.systems  # before there is no memory left
    monkeypatch.setattr(checks, "host_memory", lambda: 1 << 20)  # half of it for 512 x 512 numbers
    rtol = {"db2": 0.05, "db2 rows": 0.2, "pixels": 0.6}[basis]
    C = ltcl.compress(T, rtol, basis=basis, memory=1 << 20)
    monkeypatch.undo()
    (S,), R, (report,) = dense_systems(T), C.systems[0].to_dense(), C.compression.channels
    assert worst_error(S, R) <= C.error <= rtol
    assert np.linalg.norm(R - S) <= report.dropped + report.quantisation + 1e-6 * np.linalg.norm(S)


def test_bases_are_compared_in_the_middle_of_a_large_picture():
    S = np.eye(512) + smooth((4, 128))
    T = ltcl.Transport(S, (4, 128), first_bounce=np.ones(512))
    C = ltcl.compress(T, 0.02)
    assert C.compression.window == (4, 64)
    assert len(C.compression.channels[0].trials) == 4
    assert worst_error(S, C.systems[0].to_dense()) <= C.error <= 0.02


@pytest.mark.parametrize("first_bounce", [None, np.ones(128)])
@pytest.mark.parametrize(
    ("rows", "kind", "words"),
    [
        (Rows(np.eye(128), columns=3), InputError, r"T.*\(1, 3\).* \(1, 128\)"),
        (Rows(np.eye(128), more=1), InputError, r"T.*\(2, 128\).* \(1, 128\)"),
        (Rows(np.eye(128) * 1j), InputTypeError, r"T.*complex"),
        (Rows(np.eye(128), shape=128), InputError, "T has shape 128"),
        (Rows(np.diag([np.nan] * 128)), InputError, "NaN"),
        ([np.eye(128)] * 2, InputError, "T has 2 channels"),
        (np.eye(128)[:, :5], InputError, r"T has shape \(128, 5\)"),
        (np.zeros((2, 3, 4)), InputError, r"T has shape \(2, 3, 4\)"),
        ("T.npz", InputTypeError, "T is a str"),
    ],
)
def test_rows_must_be_what_the_shape_says(rows, kind, words, first_bounce):
    with pytest.raises(kind, match=words):
        ltcl.compress(rows, grid=(8, 16), first_bounce=first_bounce)


@pytest.mark.parametrize("first_bounce", [None, np.arange(128) != 2])
def test_dark_pixels_are_refused(first_bounce):
    with pytest.raises(InputError, match=r"first_bounce .* 1 of 128 pixels, the first 2"):
        ltcl.compress(np.diag(np.arange(128) != 2) * 1.0, grid=(8, 16), first_bounce=first_bounce)


def test_operators_without_a_transpose_are_refused():
    parts: dict[str, Any] = {"shape": (128, 128), "matvec": lambda x: x, "dtype": float}
    with pytest.raises(InputError, match="rmatvec"):
        ltcl.compress(scipy.sparse.linalg.LinearOperator(**parts), grid=(8, 16), first_bounce=np.ones(128))
