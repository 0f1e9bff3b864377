# SPDX-License-Identifier: BSD-3-Clause
"""Rows of whatever holds a matrix, and of R = T F^-1 - I."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import zarr

from ltcl import checks
from ltcl.compression import sources
from ltcl.compression.sources import Interreflection, source
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import CSR, Dense, interreflections
from tests import gallery

MATRIX = gallery.signed(40, 23)


class Rows:
    shape = MATRIX.shape

    def rows(self, start: int, stop: int) -> np.ndarray:
        return MATRIX[start:stop]


def _file(tmp_path) -> np.memmap:
    path = tmp_path / "matrix.npy"
    np.save(path, MATRIX)
    return np.load(path, mmap_mode="r")


def _chunked(tmp_path):
    array = zarr.create_array(tmp_path / "matrix.zarr", shape=MATRIX.shape, chunks=(7, 5), dtype="f4")
    array[:] = MATRIX
    return array


HOLDERS = {
    "array": lambda path: MATRIX,
    "file": _file,
    "zarr": _chunked,
    "csr": lambda path: scipy.sparse.csr_array(MATRIX),
    "csc": lambda path: scipy.sparse.csc_matrix(MATRIX),
    "rows": lambda path: Rows(),
    "linear operator": lambda path: scipy.sparse.linalg.aslinearoperator(MATRIX),
}


@pytest.mark.parametrize("kind", HOLDERS)
def test_rows_of(kind, tmp_path):
    rows = source("T", HOLDERS[kind](tmp_path))
    assert rows.shape == MATRIX.shape
    for start, stop in ((0, 40), (0, 1), (13, 30), (39, 40)):
        np.testing.assert_array_equal(rows.rows(start, stop), MATRIX[start:stop])


@pytest.mark.parametrize("kind", [Dense, CSR])
def test_rows_of_an_operator_on_the_device(device, kind):
    A = kind(device, scipy.sparse.csr_array(MATRIX) if kind is CSR else MATRIX)
    np.testing.assert_array_equal(source("T", A).rows(5, 17), MATRIX[5:17])


@pytest.mark.parametrize("masked", [[], [0, 11]])
def test_rows_of_R_are_those_on_the_device(device, masked):
    T, F = np.abs(gallery.signed(30, 30)), np.full(30, 0.7)
    F[masked] = 0.0
    R = Interreflection(source("T", T), F)
    (S,) = interreflections([T], F[None], device)
    np.testing.assert_array_equal(np.vstack([R.rows(0, 13), R.rows(13, 30)]), S.R.to_dense())


def test_bad_rows_are_refused_by_number():
    class Broken:
        shape = (4, 4)

        def rows(self, start: int, stop: int) -> np.ndarray:
            return np.full((stop - start, 4), np.nan) if start else np.ones((stop - start, 3))

    R = Interreflection(source("T", Broken()), np.ones(4))
    with pytest.raises(InputError, match=r"T in rows 2 to 3 has 8 NaN"):
        R.rows(2, 4)
    with pytest.raises(InputError, match=r"T\.rows\(0, 2\) gave shape \(2, 3\); it must be \(2, 4\)"):
        R.rows(0, 2)


@pytest.mark.parametrize("wrong", ["text", 3.0, None])
def test_what_has_no_rows_is_refused(wrong):
    with pytest.raises(InputTypeError, match="T is a"):
        source("T", wrong)


def test_other_dimensions_are_refused():
    with pytest.raises(InputError, match=r"T has shape \(2, 3, 4\)"):
        source("T", np.zeros((2, 3, 4)))
    with pytest.raises(InputTypeError, match="T holds complex128"):
        source("T", np.zeros((2, 3), complex))


@pytest.mark.parametrize("shape", [(1, 1), (53, 7), (7, 53)])
def test_the_difference_of_two_sources(shape):
    A, B = gallery.signed(*shape), gallery.signed(*shape, seed=1)
    found = sources.difference(source("A", A), source("B", B), memory=32 * shape[1] * 16)
    wanted = np.linalg.norm(A.astype(np.float64) - B)
    assert found == pytest.approx(wanted, rel=1e-12)


def test_an_operator_without_transpose_is_refused():
    class Half(scipy.sparse.linalg.LinearOperator):
        def _matvec(self, x: np.ndarray) -> np.ndarray:
            return x

    with pytest.raises(InputError, match="without rmatvec"):
        source("T", Half(np.float64, (3, 3))).rows(0, 1)


def test_blocks_fit_into_memory(monkeypatch):
    assert sources.at_once(100, 32 * 100 * 50) == 48
    with pytest.raises(MemoryLimitError, match="blocks of 16 rows of 100 values need 50 KiB"):
        sources.at_once(100, 32 * 100 * 15)
    monkeypatch.setattr(checks, "host_memory", lambda: 4 * 32 * 100 * 16)
    assert sources.at_once(100) == 16
