# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl import checks

from .conftest import Program


def test_a_file_smaller_than_before_that_solves(program: Program, transport: Path, tmp_path: Path) -> None:
    out = tmp_path / "C.npz"
    outcome = program("compress", transport, "--out", out, "--rtol", "0.05", "--basis", "db2", "--json")
    assert outcome.code == 0
    told = outcome.json
    assert told["bytes_compressed"] < told["bytes"]
    assert told["bytes_on_disk"] == out.stat().st_size
    assert [trial["basis"] for trial in told["compression"]["channels"][0]["trials"]] == ["db2"]
    T, C = ltcl.load(transport), ltcl.load(out)
    assert C.error == pytest.approx(told["solution_error"])
    assert C.error <= 0.05
    pattern = np.random.default_rng(0).random(T.grid)
    assert np.linalg.norm(C @ pattern - T @ pattern) <= 0.1 * np.linalg.norm(T @ pattern)


def test_the_tables_tell_what_was_tried(program: Program, colour_transport: Path, tmp_path: Path) -> None:
    outcome = program(
        "compress", colour_transport, "-o", tmp_path / "C.npz", "--basis", "haar", "--basis", "pixels"
    )
    assert outcome.code == 0
    for part in ("red", "green", "blue", "haar", "pixels", "solutions within", "on disk"):
        assert part in outcome.out
    within = checks.upwards(ltcl.load(tmp_path / "C.npz").error)  # enough to ask for
    assert f"solutions within {within}, " in outcome.out


def test_a_folder_of_row_blocks_takes_it_too(program: Program, transport: Path, tmp_path: Path) -> None:
    out = tmp_path / "C.zarr"
    outcome = program("compress", transport, "--out", out, "--rtol", "0.05", "--basis", "haar")
    assert outcome.code == 0
    assert "  taken" in outcome.out
    assert 0.0 < ltcl.load(out).error <= 0.05


def test_what_it_came_from_is_never_replaced(program: Program, transport: Path, tmp_path: Path) -> None:
    own = tmp_path / "T.npz"
    own.write_bytes(before := transport.read_bytes())
    for command in ("compress", "invert"):
        program(command, own, "--out", own).refused("which is TRANSPORT itself; it must be another file")
    assert own.read_bytes() == before


def test_what_is_compressed_already_is_named(program: Program, transport: Path, tmp_path: Path) -> None:
    C = tmp_path / "C.npz"
    ltcl.save(C, ltcl.compress(ltcl.load(transport), 0.05, basis="haar"))
    program("compress", C, "--out", tmp_path / "D.npz").refused(f"{C}: is compressed already")


def test_refusals(program: Program, transport: Path, tmp_path: Path) -> None:
    out = tmp_path / "C.npz"
    program("compress", transport, "--out", out, "--rtol", "2").refused("rtol is 2.0")
    program("compress", transport, "--out", out, "--basis", "bior2.2").refused("basis is 'bior2.2'")
    program("compress", transport, "--out", tmp_path / "C.txt").refused("C.txt")
    program("compress", transport, "--out", tmp_path / "C.npy").refused(
        "C.npy; a compressed transport must be"
    )
    assert not list(tmp_path.iterdir())


def test_a_budget_is_refused_with_what_it_takes(program: Program, transport: Path, tmp_path: Path) -> None:
    out = tmp_path / "C.npz"
    outcome = program("compress", transport, "--out", out, "--budget", "10B", "--basis", "db2")
    assert (outcome.code, outcome.out) == (1, "")
    last = outcome.err.splitlines()[-1]
    assert last.startswith("ltcl: error: --budget is 10 bytes, but rtol 0.01 needs ")
    assert " of at least " in last
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "size"), [("50MB", 50_000_000), ("1.5GiB", 3 << 29), ("7", 7), ("2 kB", 2000), ("3Ki", 3072)]
)
def test_sizes(text: str, size: int) -> None:
    from ltcl.cli.compress import _bytes

    assert _bytes(text) == size


@pytest.mark.parametrize("text", ["much", "0", "-5MB", "5 parsecs", "5iB", ""])
def test_what_is_no_size_is_wrong_usage(program: Program, transport: Path, tmp_path: Path, text: str) -> None:
    assert program("compress", transport, "-o", tmp_path / "C.npz", "--budget", text).code == 2
