# SPDX-License-Identifier: BSD-3-Clause
"""Rows on a disk, larger than memory, and on several devices: products, solves, what is chosen, refusals."""

from __future__ import annotations

import copy
import dataclasses
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.cli.main import main
from ltcl.device import Device, discovery, tuning
from ltcl.errors import FileError, InputError, MemoryLimitError
from ltcl.operators import (
    CSR,
    Dense,
    MultiDevice,
    Parts,
    ScaledColumns,
    Streamed,
    as_operator,
    out_of_core,
)
from tests import gallery
from tests.operators import helpers

GRID = 24, 32  # too many pixels for "auto" to factorize S at once


class Stored(scipy.sparse.linalg.LinearOperator):
    """A matrix as rows of a store that counts how often it is read."""

    def __init__(self, matrix: Any, rows: int = 20) -> None:
        self.matrix, self.rows, self.readings = scipy.sparse.csr_array(matrix), rows, 0
        self.nnz, self.nbytes = self.matrix.nnz, 8 * self.matrix.nnz
        super().__init__(self.matrix.dtype, matrix.shape)

    def row_blocks(self) -> Iterator[tuple[int, Any]]:
        self.readings += 1
        for first in range(0, self.shape[0], self.rows):
            yield first, self.matrix[first : first + self.rows]

    def diagonal(self) -> np.ndarray:
        return self.matrix.diagonal()

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        return self.matrix @ x


def mapped(folder: Path, matrix: Any) -> Any:
    np.save(folder / "T.npy", matrix)
    return np.load(folder / "T.npy", mmap_mode="r")


def light(pixels: int = GRID[0] * GRID[1], dtype: Any = np.float32) -> np.ndarray:
    """T of a scene in which all pixels see each other, with another first bounce each."""
    i = np.arange(pixels, dtype=np.float32)
    R = np.exp(-np.abs(i[:, None] - i) / (0.2 * pixels)) / pixels
    return ((np.eye(pixels, dtype=np.float32) + R) * (1.0 + 0.5 * np.sin(i))).astype(dtype)


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch, device: Device) -> list[discovery.Description]:
    """Two devices: halves of the one here, or the same one twice where its driver cannot halve it."""
    import pyopencl as cl

    handles = [device.handle] * 2
    if device.handle.partition_max_sub_devices >= 2 and device.compute_units >= 2:
        half = [cl.device_partition_property.EQUALLY, device.compute_units // 2]
        handles = device.handle.create_sub_devices(half)[:2]
    found = [
        dataclasses.replace(
            device.description,
            index=f"7:{d}",
            handle=handle,
            compute_units=handle.max_compute_units,
        )
        for d, handle in enumerate(handles)
    ]
    monkeypatch.delenv("LTCL_DEVICE", raising=False)
    monkeypatch.setattr(discovery, "list_devices", lambda: found)
    monkeypatch.setattr(discovery, "_opened", {})  # none of another test, which had less memory
    return found


@pytest.fixture
def no_room(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """A host, and a device, with room for two thirds of T in float32."""
    memory = 4 * (GRID[0] * GRID[1]) ** 2 * 2 // 3
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: memory)
    monkeypatch.setattr(device, "memory", memory)
    monkeypatch.setattr(out_of_core, "READ_BYTES", 1 << 18)


FORMS: dict[str, Callable[[Path, Device, Any], Parts]] = {
    "mapped": lambda folder, device, A: Streamed(device, mapped(folder, A)),
    "stored": lambda folder, device, A: Streamed(device, Stored(A)),
    "dense rows": lambda folder, device, A: MultiDevice(
        device, [Dense(device, A[:7]), Dense(device, A[7:])]
    ),
    "sparse rows": lambda folder, device, A: MultiDevice(
        device, [CSR(device, scipy.sparse.csr_array(rows)) for rows in np.split(A, [3, 30])]
    ),
}
forms = pytest.mark.parametrize("make", FORMS.values(), ids=list(FORMS))


@forms
@pytest.mark.parametrize("shape", [(53, 53), (53, 7), (40, 129)])
def test_products_transposes_and_facts(tmp_path, device, monkeypatch, make, shape):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 1, 3, 11))
    monkeypatch.setattr(out_of_core, "READ_BYTES", 4 * 8 * shape[1])  # 8 rows of float32 at once
    matrix = gallery.signed(*shape)
    A = make(tmp_path, device, matrix)
    helpers.meets_twin(A, matrix)
    helpers.meets_twin(A, matrix, transpose=True)
    np.testing.assert_array_equal(A.diagonal(), matrix.diagonal())
    np.testing.assert_array_equal(A.to_dense(), matrix)
    expected = [np.linalg.norm(matrix.astype(np.float64), order) for order in (1, np.inf, "fro")]
    assert A.norms()[:3] == pytest.approx(expected, rel=1e-12)


def test_rows_that_are_larger_than_a_buffer_are_cut(tmp_path, small_device):
    matrix = gallery.signed(53, 53)
    for A in (FORMS[form](tmp_path, small_device, matrix) for form in ("mapped", "stored")):
        helpers.meets_twin(A, matrix)


@pytest.mark.parametrize("dtype", ["<f4", "<f8", ">f4"])
@pytest.mark.parametrize("mode", ["r", "c"])
def test_every_array_that_looks_at_a_file_is_read(tmp_path, device, monkeypatch, dtype, mode):
    monkeypatch.setattr(out_of_core, "READ_BYTES", 1000)
    whole = np.stack([gallery.signed(30, 40)] * 3).astype(dtype) * np.arange(1, 4)[
        :, None, None
    ].astype(dtype)
    np.save(tmp_path / "T.npy", whole)
    array: Any = np.load(tmp_path / "T.npy", mmap_mode=mode)
    if mode == "c":
        array[2, 3, 4] = whole[2, 3, 4] = 7.0  # which is not in the file
    views = {"channel": (array[2], whole[2]), "rows": (np.asarray(array)[1][5:], whole[1][5:])}
    views |= {"columns": (array[0][:, 3:20], whole[0][:, 3:20]), "turned": (array[1].T, whole[1].T)}
    for view, expected in views.values():
        helpers.close(
            helpers.product(Streamed(device, view), np.ones(view.shape[1])),
            expected.sum(axis=1, dtype=np.float64),
            1e-6 * np.abs(expected).sum(axis=1),
        )


def test_a_file_that_changes_is_refused(tmp_path, device):
    A = Streamed(device, mapped(tmp_path, gallery.signed(53, 53)))
    os.truncate(tmp_path / "T.npy", 1000)
    with pytest.raises(FileError, match=r"T\.npy: has become shorter"):
        A.matvec(np.ones(53))
    (tmp_path / "T.npy").unlink()
    with pytest.raises(FileError, match=r"T\.npy: cannot be read"):
        A.matvec(np.ones(53))


def test_a_file_that_is_cut_before_its_first_use_is_refused(tmp_path, no_room):
    """By its size: reading what is mapped there ends the process, by SIGBUS."""
    np.save(tmp_path / "T.npy", light())
    T = ltcl.load(tmp_path / "T.npy", grid=GRID)
    os.truncate(tmp_path / "T.npy", 5000)
    for use in (
        lambda: T @ np.ones(GRID),
        lambda: T.systems,
        lambda: ltcl.save(tmp_path / "copy.npy", T),
    ):
        with pytest.raises(FileError, match=r"T\.npy: has become shorter"):
            use()


@pytest.mark.parametrize("extension", [".npy", ".zarr"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_file_without_room_is_solved_from_the_disk(
    tmp_path, monkeypatch, request, extension, dtype
):
    path, T = tmp_path / f"T{extension}", ltcl.Transport(light(dtype=dtype), GRID)
    ltcl.save(path, T)
    picture = T @ np.linspace(0.2, 0.8, T.shape[1]).reshape(GRID).astype(np.float32)
    if extension == ".npy":
        request.getfixturevalue("no_room")
    stored = ltcl.load(path, grid=GRID)
    request.getfixturevalue("no_room")  # for more than the one block that so small a store has
    R: Any = stored.systems[0].R
    assert isinstance(R, ScaledColumns)
    assert isinstance(R.A, Streamed)
    for solve in (ltcl.compensate, ltcl.separate):
        ours, theirs = (solve(each, picture, method="chebyshev") for each in (stored, T))
        for name in ("pattern", "direct", "bounces"):
            if hasattr(ours, name):
                np.testing.assert_allclose(
                    getattr(ours, name), getattr(theirs, name), rtol=0, atol=1e-6
                )


def test_files_with_room_are_solved_in_memory(tmp_path):
    ltcl.save(tmp_path / "T.npy", ltcl.Transport(light(), GRID))
    assert isinstance(ltcl.load(tmp_path / "T.npy", grid=GRID).systems[0].R, Dense)
    assert isinstance(as_operator(np.load(tmp_path / "T.npy", mmap_mode="r")), Dense)


def test_an_array_in_memory_without_room_is_refused(no_room):
    with pytest.raises(MemoryLimitError):
        ltcl.Transport(light(), GRID).systems  # noqa: B018 - uploads


def test_one_reading_serves_all_right_hand_sides(no_room, device):
    readings = []
    for k in (1, 9):
        rows = Stored(light())
        S = ltcl.Transport(rows, GRID).systems[0]
        before = rows.readings
        s = ltcl.solve(S, gallery.vectors(S.shape[0], k) + 2.0, "chebyshev", rtol=1e-3)
        assert s.converged
        assert rows.readings - before <= s.products + 2  # and for the row sums of S and of R
        readings.append(rows.readings - before)
    assert readings[0] == pytest.approx(readings[1], abs=1)


@pytest.mark.parametrize("rtol", [1e-5, 1e-12])
def test_rows_on_a_disk_correct_what_others_solve(tmp_path, no_room, rtol):
    matrix = light(dtype=np.float64)
    F = matrix.diagonal()
    rough = scipy.sparse.csr_array(
        np.where(matrix > 0.7 / len(F), matrix, 0.0)
    )  # some far light is missing
    T = ltcl.Transport(mapped(tmp_path, matrix), GRID)
    assert isinstance(T.systems[0].R, ScaledColumns)
    b = np.random.default_rng(0).uniform(size=(len(F), 3))
    s = ltcl.solve(ltcl.Transport(rough, GRID, F).systems[0], b, exact=T.systems[0], rtol=rtol)
    assert np.linalg.norm(matrix / F @ s.x - b) <= 1.01 * rtol * np.linalg.norm(b)


@pytest.mark.parametrize("method", ["gauss_seidel", "sor", "southwell", "monte_carlo"])
@pytest.mark.parametrize("where", ["disk", "devices"])
def test_methods_that_read_rows_say_where_these_are(request, tmp_path, two, method, where):
    if where == "disk":
        request.getfixturevalue("no_room")
        S = ltcl.Transport(mapped(tmp_path, light()), GRID).systems[0]
    else:
        S = ltcl.Transport(light(), GRID, device="all").systems[0]
    with pytest.raises(InputError, match=rf"{method}.*{where}"):
        ltcl.solve(S, np.ones(S.shape[0]), method)


@pytest.mark.parametrize("method", ["auto", "chebyshev", "cg", "gmres", "neumann", "bicgstab"])
def test_methods_of_products_alone_solve_on_all_devices(two, method):
    S, b = ltcl.Transport(light(), GRID, device="all").systems[0], np.ones(GRID[0] * GRID[1])
    for _ in range(3):  # "auto" tries, then surveys
        s = ltcl.solve(S, b, method, rtol=1e-5)
        assert np.linalg.norm(S.to_dense() @ s.x - b) <= 1.01e-5 * np.linalg.norm(b)


@pytest.mark.parametrize("kind", ["dense", "sparse", "stored"])
@pytest.mark.parametrize("colour", [False, True])
def test_all_devices_give_the_answer_of_one(two, monkeypatch, kind, colour):
    monkeypatch.setattr(
        tuning, "seconds", lambda device, *_: 1.0 if device.description.index == "all" else 3.0
    )
    make: Any = {"dense": np.asarray, "sparse": scipy.sparse.csr_array, "stored": Stored}[kind]
    matrices = [make(light() * (1.0 + c / 10)) for c in range(3 if colour else 1)]
    one: Any = ltcl.Transport(matrices, GRID)
    several: Any = ltcl.Transport(matrices, GRID, device="all")
    assert len({part.device for S in several.systems for _, part in S.R.parts}) == 2
    shares = [[part.shape[0] for _, part in S.R.parts] for S in several.systems]
    assert shares == [[576, 192]] * len(matrices)  # three times as fast, three times as many
    picture = one @ np.full((*GRID, 3) if colour else GRID, 0.5, np.float32)
    for solve, name in ((ltcl.compensate, "pattern"), (ltcl.separate, "bounces")):
        ours, theirs = (
            getattr(solve(T, picture, method="chebyshev"), name) for T in (several, one)
        )
        assert np.linalg.norm(ours - theirs) <= 1e-6 * np.linalg.norm(theirs)
    fine = ltcl.solve(
        several.systems[0], np.ones(several.shape[0]), rtol=1e-12
    )  # in float64, on the host
    assert fine.residual <= 1e-12


def test_a_rectangular_T_is_on_all_devices(two):
    matrix = gallery.vectors(12, 20) + 2.0
    one, several = (
        ltcl.Transport(matrix, (4, 5), camera_grid=(3, 4), device=d) for d in (None, "all")
    )
    assert isinstance(several.operators[0], MultiDevice)
    np.testing.assert_allclose(several @ np.ones((4, 5)), one @ np.ones((4, 5)), rtol=1e-6)


def test_all_devices_are_opened_once(two, monkeypatch):
    device = ltcl.open_device("all")
    assert ltcl.open_device(" ALL ") is device
    assert [each.description.index for each in (device, *device.others)] == ["all", "7:1"]
    assert ltcl.open_device("7:1") is device.others[0]
    assert not ltcl.open_device().others
    T = ltcl.Transport(light(), GRID, device=device)
    assert copy.deepcopy(T).device is device
    monkeypatch.setenv("LTCL_DEVICE", "all")
    assert ltcl.open_device() is device
    monkeypatch.setattr(discovery, "list_devices", lambda: two[:1])
    assert ltcl.open_device("all") is ltcl.open_device("7:0")


def test_the_command_line_takes_all_devices(two, tmp_path, capsys):
    ltcl.save(tmp_path / "T.npz", ltcl.Transport(light(), GRID))
    ltcl.images.write(tmp_path / "picture.exr", np.full(GRID, 0.5, np.float32))
    folders = [tmp_path / "one", tmp_path / "all"]
    for device, folder in zip(("7:0", "all"), folders, strict=True):
        files = [str(tmp_path / name) for name in ("T.npz", "picture.exr")]
        assert main(["compensate", *files, "--out", str(folder), "--device", device]) == 0
    patterns = [ltcl.images.read(folder / "picture_pattern.exr") for folder in folders]
    np.testing.assert_allclose(patterns[1], patterns[0], rtol=1e-5)


def test_the_page_on_scale_runs(two, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).resolve().parents[2] / "docs" / "guide" / "scale.md").read_text(
        encoding="utf-8"
    )
    names: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(code, names)  # noqa: S102
    assert isinstance(names["T"].systems[0].R, MultiDevice)
    assert names["patterns"].shape == (8, 24, 48)
    assert (
        abs(names["separated"].direct - 0.5 * names["T"].first_bounce.reshape(24, 48)).max() < 1e-3
    )


CAPPED = """
import resource, sys
import numpy as np
import ltcl

def solve(T, rough, picture):
    separation = ltcl.separate(T, picture[0], 2)
    return {
        "pattern": ltcl.compensate(T, picture).pattern,
        "bounces": np.stack([separation.direct, *separation.bounces]),
        "corrected": ltcl.compensate(rough, picture, exact=T, rtol=1e-4).pattern,
    }

folder, side = sys.argv[1], int(sys.argv[2])
small = ltcl.Transport(np.load(folder + "/small.npy"), (24, 24))
solve(small, small, np.full((3, 24, 24), 0.5, np.float32))  # compiling takes more than solving
picture, rough = np.load(folder + "/picture.npy"), ltcl.load(folder + "/rough.npz")
rough.systems
with open("/proc/self/statm") as file:
    used = int(file.read().split()[5]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_DATA, (used + (192 << 20),) * 2)
try:
    whole = np.fromfile(folder + "/T.npy", np.float32)
    raise SystemExit("there is room for T")
except MemoryError:
    pass
np.savez(folder + "/results.npz", **solve(ltcl.load(folder + "/T.npy", grid=(side, side)), rough, picture))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory of a process is limited as on Linux")
def test_a_file_beyond_the_memory_of_the_process(tmp_path):
    side = 90  # T has 262 MB, the process 201 MB for it
    matrix = light(side * side)
    np.save(tmp_path / "T.npy", matrix)
    np.save(tmp_path / "small.npy", light(24 * 24))
    T = ltcl.Transport(matrix, (side, side))
    near = scipy.sparse.csr_array(np.where(matrix > 0.9 / side**2, matrix, 0.0))
    rough = ltcl.Transport(near, (side, side), T.first_bounce)
    ltcl.save(tmp_path / "rough.npz", rough)
    picture = T @ np.random.default_rng(0).uniform(0.3, 0.7, (3, side, side)).astype(np.float32)
    np.save(tmp_path / "picture.npy", picture)
    run = subprocess.run(
        [sys.executable, "-c", CAPPED, str(tmp_path), str(side)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    separation = ltcl.separate(T, picture[0], 2)
    expected = {
        "pattern": ltcl.compensate(T, picture).pattern,
        "bounces": np.stack([separation.direct, *separation.bounces]),
        "corrected": ltcl.compensate(rough, picture, exact=T, rtol=1e-4).pattern,
    }
    with np.load(tmp_path / "results.npz") as results:
        for name, values in expected.items():
            assert np.linalg.norm(results[name] - values) <= 1e-6 * np.linalg.norm(values), name
