# SPDX-License-Identifier: BSD-3-Clause
"""The cases that every rank runs: ``python -m mpi4py mpi_ranks.py NAME... FOLDER``."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import scipy.sparse
from mpi4py import MPI

import ltcl
from ltcl.cli.main import main
from ltcl.errors import DeviceError, InputError, MemoryLimitError
from ltcl.operators import CSR, Dense, Distributed, IdentityPlus, Operator, rank_device
from ltcl.solvers import auto
from tests import gallery
from tests.operators import helpers

ROOT = Path(__file__).resolve().parents[2]
comm = MPI.COMM_WORLD


def own_rows(matrix: Any) -> Any:
    """Rows of this rank: fewer on rank 0."""
    stop = matrix.shape[0] * 2 // 5
    return matrix[:stop] if comm.rank == 0 else matrix[stop:]


def assert_same_on_all_ranks(value: Any) -> None:
    """Assert that a value, or the bits of an array, are the same on all ranks."""
    if isinstance(value, np.ndarray):
        value = value.tobytes()
    assert len(set(comm.allgather(value))) == 1


def products() -> None:
    helpers.COLUMNS = (None, 3)
    _check_products(gallery.SPARSE["53x7"], gallery.SPARSE["53x7"].toarray())
    _check_products(gallery.SPARSE["129x129"], gallery.SPARSE["129x129"].toarray())
    square = gallery.signed(53, 53) / 53
    A = _check_products(square, square)
    helpers.steps_match(IdentityPlus(A, -1.0), np.eye(53) - square.astype(np.float64))


def _check_products(matrix: Any, array: np.ndarray) -> Operator:
    dense = array.astype(np.float64)
    A = Distributed(comm, own_rows(matrix))
    np.testing.assert_array_equal(A.to_dense(), dense)
    helpers.meets_twin(A, dense)
    helpers.meets_twin(A, dense, transpose=True)
    np.testing.assert_array_equal(A.diagonal(), dense.diagonal())
    np.testing.assert_allclose(A.row_sums(), dense.sum(axis=1), rtol=1e-5, atol=1e-5)
    helpers.norms_match(A, dense, rtol=1e-6)
    return A


def bits_of_rows() -> None:
    """A row gives the same bits on a rank as where all rows are on one device."""
    matrix = gallery.SPARSE["129x129"]
    x = gallery.vectors(129, None)
    device = ltcl.open_device()
    one = helpers.product(CSR(device, matrix), x)
    many = helpers.product(Distributed(comm, own_rows(matrix)), x)
    helpers.same_rows(device, one, many, np.full(129, 1e-5))


def solves() -> None:
    scene = ltcl.scenes.dihedral(17).transport()
    weights = scene.systems[0].weights
    R = scene.systems[0].R.to_dense()
    b = gallery.vectors(578, 3)
    serial = IdentityPlus(Dense(scene.device, R), weights=weights)
    S = IdentityPlus(Distributed(comm, own_rows(R)), weights=weights)
    for method in ("jacobi", "chebyshev", "gmres", "bicgstab", "cg"):
        one = ltcl.solve(serial, b, method, rtol=1e-5)
        many = ltcl.solve(S, b, method, rtol=1e-5)
        assert_same_on_all_ranks(many.x)
        assert_same_on_all_ranks(many.residuals)
        assert np.linalg.norm(many.x - one.x) <= 1e-6 * np.linalg.norm(one.x), method
        # One more product confirms what the other knows by a norm.
        assert many.products <= one.products + 1
    with pytest.raises(InputError, match=r"gauss_seidel.*ranks"):
        ltcl.solve(S, b, "gauss_seidel")


def times_that_differ() -> None:
    """Rank 0 decides which method is fastest."""
    scene = ltcl.scenes.dihedral(17).transport()
    R = scene.systems[0].R.to_dense()
    b = gallery.vectors(578, None)
    S = IdentityPlus(Distributed(comm, own_rows(R)), weights=scene.systems[0].weights)
    launch_and_wait = (1.0, 0.0) if comm.rank else (0.0, 1.0)
    with mock.patch.object(auto, "_overheads", return_value=launch_and_wait):
        # S is tried, surveyed, known.
        for _ in range(3):
            solution = ltcl.solve(S, b, rtol=1e-4)
            assert_same_on_all_ranks(solution.x)
            assert_same_on_all_ranks((solution.method, solution.products))
            residual = b - solution.x - R @ solution.x
            assert np.linalg.norm(residual) <= 1.01e-4 * np.linalg.norm(b)


def transports() -> None:
    T = ltcl.scenes.dihedral(17).transport()
    folder = Path(sys.argv[-1])
    if comm.rank == 0:
        np.save(folder / "dense.npy", T.to_numpy())
        entries = T.to_numpy()
        # More than half of the entries would be dense on one rank.
        entries[entries < np.quantile(entries, 0.6)] = 0.0
        sparse = ltcl.Transport(scipy.sparse.csr_array(entries), T.grid)
        ltcl.save(folder / "sparse.zarr", sparse)
    comm.barrier()
    for name in ("dense.npy", "sparse.zarr"):
        one = ltcl.load(folder / name, grid=T.grid)
        many = ltcl.load(folder / name, grid=T.grid, device=rank_device(comm))
        _check_transports(one, many)


def _check_transports(one: Any, many: Any) -> None:
    """Compensations on one rank and on all are the same, within wide and narrow bounds."""
    assert many.nbytes < 0.6 * one.nbytes
    desired = np.linspace(0.0, 0.4, 578, dtype=np.float32).reshape(one.grid)
    settings: dict[str, Any] = {"method": "chebyshev", "rtol": 1e-6}

    exact = ltcl.compensate(one, desired, bounds=(-10.0, 10.0), **settings).pattern
    pattern = ltcl.compensate(many, desired, bounds=(-10.0, 10.0), **settings).pattern
    assert np.linalg.norm(exact - pattern) <= 1e-6 * np.linalg.norm(exact)
    assert_same_on_all_ranks(pattern)

    expected = ltcl.compensate(one, desired, bounds=(0.0, 1.0), **settings)
    clipped = ltcl.compensate(many, desired, bounds=(0.0, 1.0), **settings)
    assert expected.clipped != 0.0
    assert clipped.clipped == pytest.approx(expected.clipped, abs=0.01)
    assert clipped.error == pytest.approx(expected.error, abs=1e-5)
    assert_same_on_all_ranks(clipped.pattern)
    assert_same_on_all_ranks(clipped.std.pattern)

    light = np.ones(one.grid, np.float32)
    assert np.linalg.norm(many @ light - one @ light) <= 1e-6 * np.linalg.norm(one @ light)


def refusals() -> None:
    """An error of one rank is raised on both."""
    is_bad = comm.rank == 1
    with pytest.raises(InputError, match=r"\(2, 3\).*\(2, 4\)"):
        Distributed(comm, np.ones((2, 4 if is_bad else 3)))
    with pytest.raises(InputError, match=r"\(0, 3\)"):
        Distributed(comm, np.ones((0 if is_bad else 2, 3)))
    with pytest.raises(InputError, match="rank 1: matrix has 6 NaN"):
        Distributed(comm, np.full((2, 3), np.nan if is_bad else 1.0))
    with pytest.raises(DeviceError, match="rank 1: device is 'absent'"):
        rank_device(comm, "absent" if is_bad else None)
    with pytest.raises(DeviceError, match=r"^device is 'absent'"):
        rank_device(comm, "absent")
    device = ltcl.device.Device(ltcl.open_device().description)
    if is_bad:
        device.memory = 1
    with pytest.raises(MemoryLimitError, match=r"rank 1: a dense matrix .* needs 24 B"):
        Distributed(comm, np.ones((2, 3)), device)
    more_units = device.compute_units + 1
    if is_bad:
        device.compute_units = more_units
    with pytest.raises(DeviceError, match=rf"rank 1 .* {more_units} compute units.*rank 0"):
        rank_device(comm, device)


def the_page() -> None:
    """The script of docs/guide/mpi.md, and its command line beside that of one rank."""
    page = (ROOT / "docs/guide/mpi.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    command = re.search(
        r"mpiexec -n 2 ltcl (compensate T.zarr picture.png --mpi) --out patterns", page
    )
    assert command is not None
    T = ltcl.scenes.dihedral(12).transport()
    if comm.rank == 0:
        stored = ltcl.Transport(scipy.sparse.csr_array(T.to_numpy()), T.grid)
        ltcl.save("T.zarr", stored)
        ltcl.save("T.npz", stored)
        ltcl.images.write("picture.png", np.full(T.grid, 0.1))
    comm.barrier()

    _, printed = _printed(lambda: exec(script, {}))  # noqa: S102
    assert printed.startswith("2 ranks, ") == (comm.rank == 0)

    words = command[1].split()
    status, printed = _printed(lambda: main([*words, "--out", "patterns"]))
    assert status == 0
    assert ("look at patterns" in printed) == (comm.rank == 0)
    if comm.rank == 0:
        words.remove("--mpi")
        status, _ = _printed(lambda: main([*words, "--out", "one"]))
        assert status == 0
        names = {path.name for path in Path("one").iterdir()}
        assert {path.name for path in Path("patterns").iterdir()} == names
        one = ltcl.images.read("one/picture_pattern.exr")
        many = ltcl.images.read("patterns/picture_pattern.exr")
        assert np.linalg.norm(one - many) <= 1e-2 * np.linalg.norm(one)


def _printed(call: Callable[[], Any]) -> tuple[Any, str]:
    """The result of a call, and all that it prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        result = call()
    return result, printed.getvalue()


def refused_commands() -> None:
    """An error of all ranks is printed once, and nothing is written."""
    for words in ("T.zarr a.png --cluster local", "--transports *.zarr a.png"):
        command = ["compensate", *words.split(), "--mpi", "--out", "refused"]
        status, printed = _printed(lambda command=command: main(command))
        assert status == 1
        texts = comm.allgather(printed)
        assert texts[0].startswith("ltcl: error: --mpi is given")
        assert not any(texts[1:])
    assert not Path("refused").exists()


# Cases that end the ranks.


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


def command_fails_alone() -> None:
    """The command line of one rank names a file that is not there."""
    if comm.rank == 0:
        np.save("T.npy", np.eye(600))
        ltcl.images.write("picture.png", np.full((20, 30), 0.1))
    comm.barrier()
    file = "T.npy" + "absent" * comm.rank
    words = f"compensate {file} picture.png --grid 20x30 --mpi --out patterns"
    sys.exit(main(words.split()))


for name in sys.argv[1:-1]:
    globals()[name]()
    comm.barrier()
    if comm.rank == 0:
        sys.stdout.write(f"passed {name}\n")
