# SPDX-License-Identifier: BSD-3-Clause
"""What `test_distributed.py` has every rank run: ``python -m mpi4py mpi_ranks.py NAME... FOLDER``."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import scipy.sparse
from mpi4py import MPI

import ltcl
from ltcl.errors import DeviceError, InputError, MemoryLimitError
from ltcl.operators import CSR, Dense, Distributed, IdentityPlus, rank_device
from ltcl.solvers import auto
from tests import gallery
from tests.operators import helpers

comm = MPI.COMM_WORLD


def share(matrix: Any) -> Any:
    """Rows of this rank: fewer on rank 0."""
    stop = matrix.shape[0] * 2 // 5
    return matrix[:stop] if comm.rank == 0 else matrix[stop:]


def same_on_all_ranks(array: np.ndarray) -> None:
    assert len(set(comm.allgather(array.tobytes()))) == 1


def products() -> None:
    helpers.COLUMNS = (None, 3)
    sparse: list[Any] = [gallery.SPARSE["53x7"], gallery.SPARSE["129x129"]]
    for matrix in [*sparse, gallery.signed(53, 53) / 53]:
        A, dense = Distributed(comm, share(matrix)), np.empty(0)
        dense = (matrix.toarray() if scipy.sparse.issparse(matrix) else matrix).astype(np.float64)
        np.testing.assert_array_equal(A.to_dense(), dense)
        helpers.meets_twin(A, dense)
        helpers.meets_twin(A, dense, transpose=True)
        np.testing.assert_array_equal(A.diagonal(), dense.diagonal())
        np.testing.assert_allclose(A.row_sums(), dense.sum(axis=1), rtol=1e-5, atol=1e-5)
        expected = [np.linalg.norm(dense, order) for order in (1, np.inf, "fro")]
        assert A.norms()[:3] == pytest.approx(expected, rel=1e-6)
        assert A.norms().lowest == min(dense.min(), 0.0)
        S = IdentityPlus(A, -1.0) if A.shape[0] == 53 == A.shape[1] else None
        if S is not None:
            helpers.steps_match(S, np.eye(53) - dense)


def bits_of_rows() -> None:
    """A row gives the same bits on a rank as where all rows are on one device."""
    matrix: Any = gallery.SPARSE["129x129"]
    x, device = gallery.vectors(129, None), ltcl.open_device()
    one, many = (
        helpers.product(A, x) for A in (CSR(device, matrix), Distributed(comm, share(matrix)))
    )
    helpers.same_rows(device, one, many, np.full(129, 1e-5))


def solves() -> None:
    scene = ltcl.scenes.dihedral(17).transport()
    R, b = scene.systems[0].R.to_dense(), gallery.vectors(578, 3)
    S, serial = IdentityPlus(Distributed(comm, share(R))), IdentityPlus(Dense(scene.device, R))
    S.weights = serial.weights = scene.systems[0].weights
    for method in ("jacobi", "chebyshev", "gmres", "bicgstab", "cg"):
        one, many = (ltcl.solve(A, b, method, rtol=1e-5) for A in (serial, S))
        same_on_all_ranks(many.x)
        assert np.linalg.norm(many.x - one.x) <= 1e-6 * np.linalg.norm(one.x), method
        assert len(set(comm.allgather(many.residuals))) == 1
        assert many.products <= one.products + 1  # which confirms what the other knows by a norm
    with pytest.raises(InputError, match=r"gauss_seidel.*ranks"):
        ltcl.solve(S, b, "gauss_seidel")


def times_that_differ() -> None:
    """Which method is fastest, rank 0 says."""
    scene = ltcl.scenes.dihedral(17).transport()
    R, b = scene.systems[0].R.to_dense(), gallery.vectors(578, None)
    S = IdentityPlus(Distributed(comm, share(R)), weights=scene.systems[0].weights)
    launch_and_wait = (1.0, 0.0) if comm.rank else (0.0, 1.0)
    with mock.patch.object(auto, "_overheads", return_value=launch_and_wait):
        for _ in range(3):  # tried, surveyed, known
            found = ltcl.solve(S, b, rtol=1e-4)
            same_on_all_ranks(found.x)
            assert len(set(comm.allgather((found.method, found.products)))) == 1
            assert np.linalg.norm(b - found.x - R @ found.x) <= 1.01e-4 * np.linalg.norm(b)


def transports() -> None:
    folder, T = Path(sys.argv[-1]), ltcl.scenes.dihedral(17).transport()
    desired, grid = np.linspace(0.0, 0.4, 578, dtype=np.float32).reshape(T.grid), T.grid
    files = folder / "dense.npy", folder / "sparse.zarr"
    if comm.rank == 0:
        np.save(files[0], T.to_numpy())
        ltcl.save(files[1], ltcl.Transport(scipy.sparse.csr_array(T.to_numpy()), grid))
    comm.barrier()
    for file in files:
        one, many = (
            ltcl.load(file, grid=grid, device=device) for device in (None, rank_device(comm))
        )
        assert many.nbytes < 0.6 * one.nbytes
        exact, within = (
            [
                ltcl.compensate(t, desired, method="chebyshev", rtol=1e-6, bounds=bounds)
                for t in (one, many)
            ]
            for bounds in ((-10.0, 10.0), (0.0, 1.0))
        )
        assert np.linalg.norm(exact[0].pattern - exact[1].pattern) <= 1e-6 * np.linalg.norm(
            exact[0].pattern
        )
        assert within[1].clipped == pytest.approx(within[0].clipped, abs=0.01) != 0.0
        assert within[1].error == pytest.approx(within[0].error, abs=1e-5)
        for array in (exact[1].pattern, within[1].pattern, within[1].std.pattern):
            same_on_all_ranks(array)
        light = np.ones(grid, np.float32)
        assert np.linalg.norm(many @ light - one @ light) <= 1e-6 * np.linalg.norm(one @ light)


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
    own = ltcl.device.Device(ltcl.open_device().description)
    own.memory = 1 if other else own.memory
    with pytest.raises(MemoryLimitError, match=r"rank 1: a dense matrix .* needs 24 B"):
        Distributed(comm, np.ones((2, 3)), own)
    own.compute_units += other
    with pytest.raises(
        DeviceError, match=rf"rank 1 .* {own.compute_units - other + 1} compute units.*rank 0"
    ):
        rank_device(comm, own)


def is_killed() -> None:
    A = Distributed(comm, np.eye(4)[2 * comm.rank : 2 * comm.rank + 2])
    if comm.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    A.row_sums()


def fails_alone() -> None:
    A = Distributed(comm, np.eye(4)[2 * comm.rank : 2 * comm.rank + 2])
    if comm.rank == 1:
        raise InputError("only here")
    A.row_sums()


for name in sys.argv[1:-1]:
    globals()[name]()
    comm.barrier()
    if comm.rank == 0:
        sys.stdout.write(f"passed {name}\n")
