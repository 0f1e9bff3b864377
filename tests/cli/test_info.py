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
