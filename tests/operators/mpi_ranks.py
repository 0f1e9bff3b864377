# SPDX-License-Identifier: BSD-3-Clause
"""What `test_distributed.py` has every rank run: ``python -m mpi4py mpi_ranks.py NAME... FOLDER``."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from mpi4py import MPI

import ltcl
from ltcl.errors import DeviceError, InputError, MemoryLimitError
from ltcl.operators import CSR, Dense, Distributed, IdentityPlus, rank_device
from tests import gallery
from tests.operators import helpers

comm = MPI.COMM_WORLD


def rows(matrix, shares=(2, 3)):
    """Those of this rank, fewer on rank 0."""
    stop = matrix.shape[0] * shares[0] // sum(shares)
    return matrix[:stop] if comm.rank == 0 else matrix[stop:]


def same_on_all_ranks(array) -> None:
    assert len(set(comm.allgather(array.tobytes()))) == 1


def products() -> None:
    helpers.COLUMNS = (None, 3)
    for matrix in (gallery.SPARSE["53x7"], gallery.SPARSE["129x129"], gallery.signed(53, 53) / 53):
        A = Distributed(comm, rows(matrix))
        dense = matrix.toarray() if scipy.sparse.issparse(matrix) else matrix.astype(np.float32)
        dense = dense.astype(np.float32).astype(np.float64)
        np.testing.assert_array_equal(A.to_dense(), dense)
        helpers.meets_twin(A, dense)
        helpers.meets_twin(A, dense, transpose=True)
        np.testing.assert_array_equal(A.diagonal(), dense.diagonal())
        np.testing.assert_allclose(A.row_sums(), dense.sum(axis=1), rtol=1e-5, atol=1e-5)
        expected = [np.linalg.norm(dense, order) for order in (1, np.inf, "fro")]
        assert A.norms()[:3] == pytest.approx(expected, rel=1e-6)
        assert A.norms().lowest == min(dense.min(), 0.0)
    helpers.steps_match(IdentityPlus(A, -1.0), np.eye(53) - dense)


def bits_of_rows() -> None:
    """A row gives the same bits on a rank as where all rows are on one device."""
    matrix, x = gallery.SPARSE["129x129"], gallery.vectors(129, None)
    device = ltcl.open_device()
    helpers.same_rows(
        device, Distributed(comm, rows(matrix)) @ x, CSR(device, matrix) @ x, np.full(129, 1e-5)
    )


def solves() -> None:
    T = ltcl.scenes.dihedral(17).transport()
    R, b = T.interreflection.R.to_dense(), gallery.vectors(578, 3)
    S, serial = IdentityPlus(Distributed(comm, rows(R))), IdentityPlus(Dense(T.device, R))
    S.weights = serial.weights = T.interreflection.weights
    for method in ("jacobi", "chebyshev", "gmres", "bicgstab", "cg"):
        one, many = (ltcl.solve(A, b, method, rtol=1e-5) for A in (serial, S))
        same_on_all_ranks(many.x)
        assert np.linalg.norm(many.x - one.x) <= 1e-6 * np.linalg.norm(one.x), method
        assert len(set(comm.allgather(many.residuals))) == 1
        assert many.products <= one.products + 1  # which confirms what the serial solve knows by a norm
    for _ in range(3):  # tried, surveyed, known: as it goes on, times decide
        found = ltcl.solve(S, b, rtol=1e-4)
        same_on_all_ranks(found.x)
        assert np.linalg.norm(b - (found.x + R @ found.x)) <= 1.01e-4 * np.linalg.norm(b)


def transports() -> None:
    folder, scene = Path(sys.argv[-1]), ltcl.scenes.dihedral(17)
    T, desired = scene.transport(), np.linspace(0.0, 0.4, 578, dtype=np.float32).reshape(17, 34)
    files = folder / "dense.npy", folder / "sparse.zarr"
    if comm.rank == 0:
        np.save(files[0], T.to_numpy())
        ltcl.save(files[1], ltcl.Transport(scipy.sparse.csr_array(T.to_numpy()), T.grid))
    comm.barrier()
    for file in files:
        one, many = (ltcl.load(file, grid=T.grid, device=device) for device in (None, rank_device(comm)))
        assert isinstance(many.interreflection.R, Distributed)
        assert many.nbytes < 0.6 * one.nbytes
        for options in ({"method": "chebyshev", "rtol": 1e-6}, {"gain": "auto"}):
            a, b = (ltcl.compensate(each, desired, **options) for each in (one, many))
            same_on_all_ranks(b.pattern)
            assert b.error == pytest.approx(a.error, abs=1e-2)
        assert np.linalg.norm(many @ a.pattern - one @ a.pattern) <= 1e-6 * np.linalg.norm(one @ a.pattern)
        same_on_all_ranks(b.std.pattern)


def refusals() -> None:
    """An error of one rank is raised on both."""
    other = comm.rank == 1
    with pytest.raises(InputError, match=r"\(2, 3\).*\(2, 4\)"):
        Distributed(comm, np.ones((2, 4 if other else 3)))
    with pytest.raises(InputError, match=r"\(0, 3\)"):
        Distributed(comm, np.ones((0 if other else 2, 3)))
    with pytest.raises(InputError, match="rank 1: matrix has 6 NaN"):
        Distributed(comm, np.full((2, 3), np.nan if other else 1.0))
    with pytest.raises(DeviceError, match="rank 1: device is 'absent'"):
        rank_device(comm, "absent" if other else None)
    with pytest.raises(DeviceError, match=r"^device is 'absent'"):
        rank_device(comm, "absent")
    device = rank_device(comm, ltcl.device.Device(ltcl.open_device().description))  # of its own
    device.memory = 1 if other else device.memory
    with pytest.raises(MemoryLimitError, match=r"rank 1: a dense matrix .* needs 24 B"):
        Distributed(comm, np.ones((2, 3)), device)


def is_killed() -> None:
    A = Distributed(comm, np.eye(4)[2 * comm.rank : 2 * comm.rank + 2])
    if comm.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    A @ np.ones(4)


def fails_alone() -> None:
    A = Distributed(comm, np.eye(4)[2 * comm.rank : 2 * comm.rank + 2])
    if comm.rank == 1:
        raise InputError("only here")
    A @ np.ones(4)


for name in sys.argv[1:-1]:
    globals()[name]()
    comm.barrier()
    if comm.rank == 0:
        sys.stdout.write(f"passed {name}\n")
