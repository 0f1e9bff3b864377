# SPDX-License-Identifier: BSD-3-Clause
"""Compression by two workers of a Dask cluster on loopback: the numbers of the serial one."""

from __future__ import annotations

import os
from typing import Any

import dask.array
import distributed
import numpy as np
import pytest
import scipy.sparse
import zarr

import ltcl
from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Wavelet
from ltcl.tasks.compression.basis_pairs import CoefficientAnalysis
from ltcl.tasks.compression.coefficients import coefficients
from ltcl.tasks.compression.sources import source

from_array: Any = dask.array.from_array  # whose chunks are no str
GRID = (8, 16)
N = 128
SMALLEST = 32 * N * 16  # bytes of the smallest block, 16 rows


@pytest.fixture(scope="module")
def client():
    options = {"threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with (
        distributed.LocalCluster(n_workers=2, processes=True, **options) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def matrix() -> np.ndarray:
    return ltcl.scenes.dihedral(8, albedo=0.8).transport().to_numpy()


class Rows:
    """Rows that no more than `most` are read of in the process that made them."""

    def __init__(self, matrix: np.ndarray, most: int = 0) -> None:
        self.matrix = matrix
        self.shape = matrix.shape
        self.most = most
        self.process = os.getpid()

    def rows(self, start: int, stop: int) -> np.ndarray:
        if os.getpid() == self.process:
            self.most -= stop - start
            assert self.most >= 0, "rows were read by the client"
        return self.matrix[start:stop]


class Unpicklable(Rows):
    """Rows that cannot be sent as a whole."""

    def __reduce__(self) -> Any:
        raise TypeError("this stays where it is")


def in_files(matrix: np.ndarray, path: Any) -> Any:
    array = zarr.create_array(path, shape=matrix.shape, chunks=(24, 50), dtype=matrix.dtype)
    array[:] = matrix
    return zarr.open_array(path, mode="r")


HOLDERS = {
    "array": lambda matrix, path: matrix,
    "sparse": lambda matrix, path: scipy.sparse.csr_array(matrix),
    "zarr": in_files,
    "zarr in memory": lambda matrix, path: zarr.array(matrix, chunks=(30, 50)),
    "dask": lambda matrix, path: from_array(matrix, ((50, 70, 8), -1)),
    "dask, persisted": lambda matrix, path: from_array(matrix, ((50, 70, 8), 64)),
    "rows": lambda matrix, path: Rows(matrix),
    "rows that are sent": lambda matrix, path: Unpicklable(matrix, 10_000),
}


@pytest.mark.slow
@pytest.mark.parametrize("holder", HOLDERS)
def test_rows_from_elsewhere_give_the_same_bits(holder, client, matrix, tmp_path):
    rows = HOLDERS[holder](matrix, tmp_path / "T.zarr")
    rows = client.persist(rows) if holder == "dask, persisted" else rows
    serial = coefficients(source("T", matrix, SMALLEST), None, None, drop=0.1).core.toarray()
    assert 0 < np.count_nonzero(serial) < N * N
    for own in (client,) if holder in ("rows", "dask, persisted") else (client, None):
        C = coefficients(source("T", rows, SMALLEST, own), None, None, drop=0.1)
        np.testing.assert_array_equal(C.core.toarray(), serial)


@pytest.mark.rare
def test_workers_give_the_bits_of_the_serial_compression(client, matrix):
    options: dict[str, Any] = {"grid": GRID, "basis": "db2", "memory": SMALLEST}
    serial = ltcl.compress(matrix, 0.02, **options)
    C = ltcl.compress(HOLDERS["dask"](matrix, None), 0.02, client=client, **options)
    arrays = C.to_arrays()
    others = serial.to_arrays()
    for name in others.keys() - {
        "system_0.solution_error",
        "system_0.error_bound",
        "system_0.R.error",
    }:
        np.testing.assert_array_equal(arrays[name], others[name], err_msg=name)
    # Their products, by which errors are measured, are of float32: of other blocks, and on other
    # cores.
    np.testing.assert_allclose(
        [C.error, C.error_bound], [serial.error, serial.error_bound], rtol=1e-4
    )


@pytest.mark.rare
@pytest.mark.parametrize(
    "limits", [{"threshold": 1e-3, "first": 2e-4}, {"drop": 0.1}, {"drop": 0.1, "most": 900}]
)
@pytest.mark.parametrize("sides", [1, 2])
def test_numbers_of_rows_larger_than_memory_are_those_of_the_serial_ones(
    limits, sides, client, matrix, device, monkeypatch
):
    # Half of it is too little for all.
    monkeypatch.setattr(checks, "host_memory", lambda: 4 * N * N)
    monkeypatch.setattr("ltcl.tasks.compression.sources.MAX_ITEMS", 3)  # several blocks in each
    W = CoefficientAnalysis(Wavelet(device, GRID, "db2"))
    out = W if sides == 2 else None
    serial = coefficients(source("T", matrix, SMALLEST), out, W, **limits)
    C = coefficients(source("T", Rows(matrix), SMALLEST, client), out, W, **limits)
    assert 0 < C.core.nnz < N * N
    np.testing.assert_array_equal(C.core.toarray(), serial.core.toarray())
    assert (C.threshold, C.dropped) == (serial.threshold, pytest.approx(serial.dropped, rel=1e-12))


@pytest.mark.slow
def test_a_transport_in_memory(client):
    T = ltcl.scenes.dihedral(4, albedo=0.8).transport()
    serial, C = (ltcl.compress(T, 0.05, basis="haar", client=each) for each in (None, client))
    np.testing.assert_array_equal(C.to_numpy(), serial.to_numpy())


@pytest.mark.slow
def test_what_workers_refuse_is_said_here(client, matrix):
    wrong = matrix.copy()
    wrong[100, 3] = np.nan
    with pytest.raises(InputError, match=r"T in rows 96 to 111 .* NaN .* \(4, 3\)"):
        ltcl.compress(
            Rows(wrong, 1), grid=GRID, first_bounce=np.ones(N), memory=SMALLEST, client=client
        )
    with pytest.raises(InputTypeError, match="client is a str"):
        ltcl.compress(Rows(wrong), grid=GRID, client="127.0.0.1:8786")
