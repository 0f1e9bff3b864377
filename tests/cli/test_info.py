# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from .conftest import Program


def test_json(program: Program, transport: Path, colour_transport: Path) -> None:
    corner, room = program("info", transport, colour_transport, "--json").json
    assert (corner["shape"], corner["grid"], corner["channels"]) == ([50, 50], [5, 10], 1)
    assert corner["first_bounce"] == pytest.approx([0.6, 0.6], rel=1e-6)
    assert corner["dark_pixels"] == 0
    assert (room["shape"], room["channels"], room["stored"]) == ([48, 48], 3, "dense")


def test_table(program: Program, transport: Path) -> None:
    outcome = program("info", transport)
    assert outcome.code == 0
    assert "50 x 50" in outcome.out
    assert "5 x 10" in outcome.out


def test_sparse_and_dark(program: Program, tmp_path: Path) -> None:
    path = tmp_path / "T.npz"
    scipy.sparse.save_npz(path, scipy.sparse.csr_array(np.diag([1.0, 0.0, 2.0, 3.0])))
    (entry,) = program("info", path, "--json").json
    assert (entry["stored"], entry["entries"], entry["grid"]) == ("sparse", 3, None)
    assert (entry["dark_pixels"], entry["first_bounce"]) == (1, [0.0, 3.0])


def test_rectangular_has_no_first_bounce(program: Program, tmp_path: Path) -> None:
    path = tmp_path / "T.npy"
    np.save(path, np.ones((6, 4), np.float32))
    (entry,) = program("info", path, "--json").json
    assert entry["first_bounce"] is None
    assert entry["dark_pixels"] is None


def test_needs_no_device(program: Program, transport: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")
    assert program("info", transport).code == 0


def test_refusals(program: Program, transport: Path, tmp_path: Path) -> None:
    program("info", "nowhere.npz").refused("nowhere.npz: no such file")
    program("info", tmp_path / "T.xyz").refused("extension .xyz is unknown")
    cut = tmp_path / "cut.npz"
    cut.write_bytes(transport.read_bytes()[:500])
    program("info", cut).refused("cut.npz")
    empty = tmp_path / "empty.npz"
    empty.touch()
    program("info", empty).refused("the file is empty")
    bad = tmp_path / "nan.npy"
    np.save(bad, np.full((4, 4), np.nan))
    program("info", bad).refused("nan.npy", "NaN")


@pytest.fixture
def bad_grid(tmp_path: Path) -> Path:
    path = tmp_path / "badgrid.npz"
    np.savez(path, T=np.eye(32), grid=(5, 5))
    return path


def test_a_grid_of_other_pixels_is_refused(program: Program, bad_grid: Path, tmp_path: Path) -> None:
    program("info", bad_grid).refused("badgrid.npz", "grid is 5 x 5 = 25", "must be 32")
    program("convert", bad_grid, tmp_path / "out.npz").refused("badgrid.npz", "must be 32")
    assert not (tmp_path / "out.npz").exists()
    assert program("convert", bad_grid, tmp_path / "out.npz", "--grid", "4x8").code == 0


def test_rectangular_without_camera_grid_is_not_the_same(program: Program, tmp_path: Path) -> None:
    path = tmp_path / "nonsq.npz"
    np.savez(path, T=np.ones((40, 32)), grid=(4, 8))
    outcome = program("info", path)
    assert "not told" in outcome.out
    assert "the same" not in outcome.out


def test_a_bad_file_does_not_hide_the_good_ones(program: Program, transport: Path, bad_grid: Path) -> None:
    outcome = program("info", transport, bad_grid, transport)
    assert outcome.code == 1
    assert outcome.out.count("50 x 50") == 2
    assert outcome.err.startswith("ltcl: error: ")
    assert outcome.err.count("\n") == 1
    outcome = program("info", transport, bad_grid, "--json")
    assert outcome.code == 1
    good, bad = outcome.json
    assert good["shape"] == [50, 50]
    assert bad["file"] == str(bad_grid)
    assert "must be 32" in bad["error"]


def test_compressed(
    program: Program, transport: Path, compressed_transport: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")  # none is needed
    exact, entry = program("info", transport, compressed_transport, "--json").json
    assert (exact["solution_error"], entry["solution_error"]) == (0.0, 0.0041)
    assert (entry["shape"], entry["grid"], entry["channels"]) == ([50, 50], [5, 10], 1)
    assert (entry["stored"], entry["dtype"]) == ("compressed", "csr, db2; error 0.0041")
    assert 0 < entry["entries"] < 2500
    assert entry["nbytes"] < 2 * 8 * entry["entries"]
    assert entry["first_bounce"] == exact["first_bounce"]
    assert entry["dark_pixels"] == 0
    assert "compressed" in program("info", compressed_transport).out
