# SPDX-License-Identifier: BSD-3-Clause
"""Rows on a disk, larger than memory: products, solves, the choice of a place, refusals."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.device import Device
from ltcl.errors import FileError, InputError, MemoryLimitError
from ltcl.operators import CSR, Dense, MultiDevice, Operator, ScaledColumns, Streamed, as_operator
from tests import gallery
from tests.operators import helpers
from tests.operators.large import GRID, PIXELS, Stored, mapped, transport

pytestmark = pytest.mark.slow


@pytest.fixture
def no_room(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """A host, and a device, with room for two thirds of T in float32."""
    memory = 4 * PIXELS**2 * 2 // 3
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: memory)
    monkeypatch.setattr(device, "memory", memory)
    monkeypatch.setattr("ltcl.operators.out_of_core.READ_BYTES", 1 << 18)


def mapped_rows(folder: Path, device: Device, A: np.ndarray) -> Operator:
    return Streamed(device, mapped(folder, A))


def stored_rows(folder: Path, device: Device, A: np.ndarray) -> Operator:
    return Streamed(device, Stored(A))


def dense_rows(folder: Path, device: Device, A: np.ndarray) -> Operator:
    return MultiDevice(device, [Dense(device, A[:7]), Dense(device, A[7:])])


def sparse_rows(folder: Path, device: Device, A: np.ndarray) -> Operator:
    pieces = [scipy.sparse.csr_array(rows) for rows in np.split(A, [3, 30])]
    return MultiDevice(device, [CSR(device, rows) for rows in pieces])


FORMS: list[Callable[[Path, Device, np.ndarray], Operator]] = [
    mapped_rows,
    stored_rows,
    dense_rows,
    sparse_rows,
]


@pytest.mark.parametrize("make", FORMS)
@pytest.mark.parametrize("shape", [(53, 53), (53, 7), (40, 129)])
def test_products_transposes_and_facts(tmp_path, device, monkeypatch, make, shape):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 1, 3, 11))
    # 8 rows of float32 at once.
    monkeypatch.setattr("ltcl.operators.out_of_core.READ_BYTES", 4 * 8 * shape[1])
    matrix = gallery.signed(*shape)
    A = make(tmp_path, device, matrix)
    helpers.meets_twin(A, matrix)
    helpers.meets_twin(A, matrix, transpose=True)
    np.testing.assert_array_equal(A.diagonal(), matrix.diagonal())
    np.testing.assert_array_equal(A.to_dense(), matrix)
    helpers.norms_match(A, matrix.astype(np.float64))


@pytest.mark.rare
@pytest.mark.parametrize("make", [mapped_rows, stored_rows])
def test_rows_that_are_larger_than_a_buffer_are_cut(tmp_path, small_device, make):
    matrix = gallery.signed(53, 53)
    helpers.meets_twin(make(tmp_path, small_device, matrix), matrix)


@pytest.mark.parametrize("dtype", ["<f4", "<f8", ">f4"])
@pytest.mark.parametrize("mode", ["r", "c"])
def test_every_view_of_a_file_is_read(tmp_path, device, monkeypatch, dtype, mode):
    monkeypatch.setattr("ltcl.operators.out_of_core.READ_BYTES", 1000)
    channels = [gallery.signed(30, 40) * np.float32(channel) for channel in (1, 2, 3)]
    whole = np.stack(channels).astype(dtype)
    np.save(tmp_path / "T.npy", whole)
    array: Any = np.load(tmp_path / "T.npy", mmap_mode=mode)
    if mode == "c":
        # Not in the file.
        array[2, 3, 4] = 7.0
        whole[2, 3, 4] = 7.0
    views = {
        "channel": (array[2], whole[2]),
        "rows": (np.asarray(array)[1][5:], whole[1][5:]),
        "columns": (array[0][:, 3:20], whole[0][:, 3:20]),
        "turned": (array[1].T, whole[1].T),
    }
    for view, expected in views.values():
        product = helpers.product(Streamed(device, view), np.ones(view.shape[1]))
        row_sums = expected.sum(axis=1, dtype=np.float64)
        helpers.close(product, row_sums, 1e-6 * np.abs(expected).sum(axis=1))


def test_a_file_that_changes_is_refused(tmp_path, device):
    A = Streamed(device, mapped(tmp_path, gallery.signed(53, 53)))
    os.truncate(tmp_path / "T.npy", 1000)
    with pytest.raises(FileError, match=r"T\.npy: has become shorter"):
        A.matvec(np.ones(53))
    (tmp_path / "T.npy").unlink()
    with pytest.raises(FileError, match=r"T\.npy: cannot be read"):
        A.matvec(np.ones(53))


def test_a_file_that_is_cut_before_its_first_use_is_refused(tmp_path, no_room):
    """The size is compared: reading what is mapped there ends the process, by SIGBUS."""
    np.save(tmp_path / "T.npy", transport())
    T = ltcl.load(tmp_path / "T.npy", grid=GRID)
    os.truncate(tmp_path / "T.npy", 5000)
    for use in (
        lambda: T @ np.ones(GRID),
        lambda: T.systems,
        lambda: ltcl.save(tmp_path / "copy.npy", T),
    ):
        with pytest.raises(FileError, match=r"T\.npy: has become shorter"):
            use()


@pytest.mark.slow
@pytest.mark.parametrize("extension", [".npy", ".zarr"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_file_without_room_is_solved_from_the_disk(tmp_path, request, extension, dtype):
    path = tmp_path / f"T{extension}"
    T = ltcl.Transport(transport(dtype=dtype), GRID)
    ltcl.save(path, T)
    light = np.linspace(0.2, 0.8, T.shape[1]).reshape(GRID).astype(np.float32)
    picture = T @ light
    if extension == ".npy":
        request.getfixturevalue("no_room")
    stored = ltcl.load(path, grid=GRID)
    # The one block of so small a store is read whole while it is loaded.
    request.getfixturevalue("no_room")
    R: Any = stored.systems[0].R
    assert isinstance(R, ScaledColumns)
    assert isinstance(R.A, Streamed)
    ours = ltcl.compensate(stored, picture, method="chebyshev")
    theirs = ltcl.compensate(T, picture, method="chebyshev")
    np.testing.assert_allclose(ours.pattern, theirs.pattern, rtol=0, atol=1e-6)
    ours = ltcl.separate(stored, picture, method="chebyshev")
    theirs = ltcl.separate(T, picture, method="chebyshev")
    np.testing.assert_allclose(ours.direct, theirs.direct, rtol=0, atol=1e-6)
    np.testing.assert_allclose(ours.bounces, theirs.bounces, rtol=0, atol=1e-6)


def test_files_with_room_are_solved_in_memory(tmp_path):
    ltcl.save(tmp_path / "T.npy", ltcl.Transport(transport(), GRID))
    assert isinstance(ltcl.load(tmp_path / "T.npy", grid=GRID).systems[0].R, Dense)
    assert isinstance(as_operator(np.load(tmp_path / "T.npy", mmap_mode="r")), Dense)


def test_an_array_in_memory_without_room_is_refused(no_room):
    with pytest.raises(MemoryLimitError):
        ltcl.Transport(transport(), GRID).systems  # noqa: B018 - uploads


def test_one_reading_serves_all_right_hand_sides(no_room, device):
    readings = []
    for k in (1, 9):
        store = Stored(transport())
        S = ltcl.Transport(store, GRID).systems[0]
        before = store.readings
        solution = ltcl.solve(S, gallery.vectors(PIXELS, k) + 2.0, "chebyshev", rtol=1e-3)
        readings.append(store.readings - before)
        assert solution.converged
        # Two more find the row sums of S and of R.
        assert readings[-1] <= solution.products + 2
    assert readings[0] == pytest.approx(readings[1], abs=1)


@pytest.mark.parametrize("rtol", [1e-5, 1e-12])
def test_rows_on_a_disk_correct_the_solves_of_others(tmp_path, no_room, rtol):
    matrix = transport(dtype=np.float64)
    F = matrix.diagonal()
    # Some far light is missing.
    near = np.where(matrix > 0.7 / PIXELS, matrix, 0.0)
    rough = ltcl.Transport(scipy.sparse.csr_array(near), GRID, F)
    T = ltcl.Transport(mapped(tmp_path, matrix), GRID)
    assert isinstance(T.systems[0].R, ScaledColumns)
    b = np.random.default_rng(0).uniform(size=(PIXELS, 3))
    solution = ltcl.solve(rough.systems[0], b, exact=T.systems[0], rtol=rtol)
    residual = matrix / F @ solution.x - b
    assert np.linalg.norm(residual) <= 1.01 * rtol * np.linalg.norm(b)


@pytest.mark.parametrize("method", ["gauss_seidel", "sor", "southwell", "monte_carlo"])
def test_methods_that_read_rows_say_where_these_are(tmp_path, no_room, method):
    S = ltcl.Transport(mapped(tmp_path, transport()), GRID).systems[0]
    with pytest.raises(InputError, match=rf"{method}.*disk"):
        ltcl.solve(S, np.ones(PIXELS), method)


CAPPED = """
import resource, sys
import numpy as np
import ltcl
from tests.operators.test_out_of_core import results

folder, side = sys.argv[1], int(sys.argv[2])
small = ltcl.Transport(np.load(folder + "/small.npy"), (24, 24))
results(small, small, np.full((3, 24, 24), 0.5, np.float32))  # compiling takes more than solving
picture = np.load(folder + "/picture.npy")
rough = ltcl.load(folder + "/rough.npz")
rough.systems
with open("/proc/self/statm") as file:
    used = int(file.read().split()[5]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_DATA, (used + (192 << 20),) * 2)
try:
    whole = np.fromfile(folder + "/T.npy", np.float32)
    raise SystemExit("there is room for T")
except MemoryError:
    pass
T = ltcl.load(folder + "/T.npy", grid=(side, side))
np.savez(folder + "/results.npz", **results(T, rough, picture))
"""


def results(T: Any, rough: Any, picture: np.ndarray) -> dict[str, np.ndarray]:
    """A compensation, a separation, and a compensation by `rough` that T corrects."""
    separation = ltcl.separate(T, picture[0], 2)
    return {
        "pattern": ltcl.compensate(T, picture).pattern,
        "bounces": np.stack([separation.direct, *separation.bounces]),
        "corrected": ltcl.compensate(rough, picture, exact=T, rtol=1e-4).pattern,
    }


@pytest.mark.rare
@pytest.mark.skipif(sys.platform != "linux", reason="memory of a process is limited as on Linux")
def test_a_file_beyond_the_memory_of_the_process(tmp_path):
    """T has 262 MB, the process 201 MB for it."""
    side = 90
    matrix = transport(side * side)
    T = ltcl.Transport(matrix, (side, side))
    near = np.where(matrix > 0.9 / side**2, matrix, 0.0)
    rough = ltcl.Transport(scipy.sparse.csr_array(near), (side, side), T.first_bounce)
    light = np.random.default_rng(0).uniform(0.3, 0.7, (3, side, side)).astype(np.float32)
    picture = T @ light
    np.save(tmp_path / "T.npy", matrix)
    np.save(tmp_path / "small.npy", transport(24 * 24))
    np.save(tmp_path / "picture.npy", picture)
    ltcl.save(tmp_path / "rough.npz", rough)
    # First, so that no kernel has to be compiled where memory is short.
    expected = results(T, rough, picture)
    run = subprocess.run(
        [sys.executable, "-c", CAPPED, str(tmp_path), str(side)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    with np.load(tmp_path / "results.npz") as found:
        for name, values in expected.items():
            assert np.linalg.norm(found[name] - values) <= 1e-6 * np.linalg.norm(values), name
