# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from ltcl.store import Record, formats

from .conftest import Program


@pytest.mark.parametrize("extension", [".npz", ".npy", ".h5", ".mat", ".zarr"])
def test_values_survive(program: Program, transport: Path, tmp_path: Path, extension: str) -> None:
    there, back = tmp_path / f"there{extension}", tmp_path / "back.npz"
    assert program("convert", transport, there).code == 0
    assert program("convert", there, back, "--grid", "5x10").code == 0
    before, after = formats.read(transport), formats.read(back)
    assert isinstance(before, Record)
    assert isinstance(after, Record)
    assert after.grid == (5, 10)
    T, again = (scipy.sparse.csr_array(one.in_memory().matrices[0]).toarray() for one in (before, after))
    kept = np.float32 if extension == ".zarr" else np.float64
    np.testing.assert_array_equal(T.astype(kept), again)


def test_sparse_to_matrix_market(program: Program, tmp_path: Path) -> None:
    source, target = tmp_path / "T.npz", tmp_path / "T.mtx"
    T = scipy.sparse.csr_array(np.diag([1.0, 2.0, 3.0, 4.0]))
    scipy.sparse.save_npz(source, T)
    facts = program("convert", source, target, "--grid", "2x2", "--json").json
    assert (facts["file"], facts["entries"]) == (str(target), 4)
    assert formats.read(target).grid == (2, 2)


@pytest.mark.parametrize("extension", [".mtx", ".mat"])
def test_sparse_colour_goes_there_and_back(program: Program, tmp_path: Path, extension: str) -> None:
    T = tuple(scipy.sparse.csr_array(np.diag(np.arange(1.0, 5.0) + k)) for k in range(3))
    source, there, back = tmp_path / "T.npz", tmp_path / f"there{extension}", tmp_path / "back.npz"
    formats.write(source, Record(T, (2, 2)))
    outcome = program("convert", source, there)
    assert (outcome.code, " 0 B on disk" in outcome.out) == (0, False)
    assert program("info", there).code == 0
    assert program("convert", there, back).code == 0
    found = formats.read(back)
    assert isinstance(found, Record)
    assert found.grid == (2, 2)
    for one, again in zip(T, found.matrices, strict=True):
        np.testing.assert_array_equal(one.toarray(), scipy.sparse.csr_array(again).toarray())


def test_losing_the_grid_is_said(program: Program, transport: Path, tmp_path: Path) -> None:
    outcome = program("convert", transport, tmp_path / "T.npy")
    assert "--grid 5x10" in outcome.err


def test_refusals_leave_the_old_file(program: Program, transport: Path, tmp_path: Path) -> None:
    target = tmp_path / "T.npz"
    target.write_text("old")
    program("convert", transport, tmp_path / "T.xyz").refused("extension .xyz is unknown")
    program("convert", tmp_path / "nowhere.npy", target).refused("no such file")
    program("convert", transport, target, "--grid", "6x10").refused("h * w must be 50")
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["T.npz"]


def test_what_could_not_be_loaded_is_not_written(program: Program, tmp_path: Path) -> None:
    np.save(tmp_path / "nan.npy", np.full((4, 4), np.nan))
    program("convert", tmp_path / "nan.npy", tmp_path / "out.npz").refused("nan.npy: T has 16 NaN")
    np.savez(tmp_path / "rect.npz", T=np.ones((6, 4)), first_bounce=np.ones(4))
    program("convert", tmp_path / "rect.npz", tmp_path / "out.npz").refused("rect.npz", "only a square T")
    assert not (tmp_path / "out.npz").exists()


def test_a_grid_that_nobody_told_is_missed(program: Program, tmp_path: Path) -> None:
    np.save(tmp_path / "T.npy", np.ones((6, 4)))
    there = tmp_path / "T.npz"
    assert "does not tell the grid; give --grid HxW" in program("convert", tmp_path / "T.npy", there).err
    outcome = program("convert", tmp_path / "T.npy", there, "--grid", "2x2")
    assert "give --camera-grid HxW" in outcome.err
    outcome = program("convert", tmp_path / "T.npy", there, "--grid", "2x2", "--camera-grid", "2x3")
    assert outcome.err == ""


def test_compressed_ones_stay_what_they_are(
    program: Program, compressed_transport: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "copy.npz"
    assert program("convert", compressed_transport, copy, "--grid", "5x10").code == 0
    a, b = (program("info", path, "--json").json[0] for path in (compressed_transport, copy))
    assert {**a, "file": None} == {**b, "file": None}
    program("convert", compressed_transport, tmp_path / "T.mtx").refused(".mtx does not keep compressed")
    program("convert", compressed_transport, copy, "--grid", "10x5").refused("compressed on its own, (5, 10)")


def test_a_store_is_told_of_and_converted(program: Program, transport: Path, tmp_path: Path) -> None:
    there = tmp_path / "T.zarr"
    assert f"{there}: dense, " in program("convert", transport, there).out
    (entry,) = program("info", there, "--json").json
    assert (entry["stored"], entry["dtype"], entry["entries"]) == ("row blocks", "float32", 2500)
    assert (entry["shape"], entry["grid"]) == ([50, 50], [5, 10])
    values = there / "channel_0" / "block_000000.0" / "values" / "c" / "0"
    values.write_bytes(values.read_bytes()[:-1])
    program("info", there).refused("T.zarr: channel_0/block_000000.0/values", "declares")
    program("convert", there, tmp_path / "back.npz").refused("T.zarr: channel_0/block_000000.0/values")
