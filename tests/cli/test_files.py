# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info`, `convert`, `compress` and `invert`: transport files, described and made."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl import checks

random = np.random.default_rng(0)


def test_info(program, transport, colour_transport, compressed, inverse, tmp_path, monkeypatch):
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")  # none is needed
    scipy.sparse.save_npz(tmp_path / "S.npz", scipy.sparse.csr_array(np.diag([1.0, 0.0, 2.0, 3.0])))
    np.savez(tmp_path / "rectangular.npz", T=np.ones((6, 4), np.float32), grid=(2, 2))
    files = [
        transport,
        colour_transport,
        compressed,
        inverse,
        tmp_path / "S.npz",
        tmp_path / "rectangular.npz",
    ]
    corner, room, small, inverted, sparse, rectangular = program("info", *files, "--json").json
    assert (corner["shape"], corner["grid"], corner["channels"]) == ([50, 50], [5, 10], 1)
    assert corner["first_bounce"] == pytest.approx([0.6, 0.6], rel=1e-6)
    assert (room["shape"], room["channels"], room["stored"]) == ([48, 48], 3, "dense")
    assert (small["stored"], small["grid"], corner["solution_error"]) == ("compressed", [5, 10], 0.0)
    assert small["dtype"].endswith(f"; error {checks.upwards(small['solution_error'])}")
    assert 0 < small["entries"] < 2500
    assert (inverted["stored"], inverted["shape"]) == ("inverse", [50, 50])
    assert 0 < inverted["solution_error"] <= 1e-3
    assert (sparse["stored"], sparse["entries"], sparse["grid"]) == ("sparse", 3, None)
    assert (sparse["dark_pixels"], sparse["first_bounce"]) == (1, [0.0, 3.0])
    assert (rectangular["first_bounce"], rectangular["dark_pixels"]) == (None, None)
    table = program("info", *files).out
    for part in ("50 x 50", "5 x 10", "the same", "unknown", "compressed", "inverse"):
        assert part in table


def test_a_bad_file_does_not_hide_the_good_ones(program, transport, tmp_path):
    np.savez(tmp_path / "grid.npz", T=np.eye(32), grid=(5, 5))
    np.save(tmp_path / "nan.npy", np.full((4, 4), np.nan))
    (tmp_path / "cut.npz").write_bytes(transport.read_bytes()[:500])
    (tmp_path / "empty.npz").touch()
    bad = [*sorted(tmp_path.iterdir()), tmp_path / "none.npz", tmp_path / "T.xyz"]
    outcome = program("info", transport, *bad, transport)
    assert (outcome.code, outcome.out.count("50 x 50")) == (1, 2)
    lines = outcome.err.splitlines()
    assert all(str(path) in line for path, line in zip(bad, lines, strict=True))
    assert all(line.startswith("ltcl: error: ") for line in lines)
    told = program("info", transport, *bad, "--json").document
    assert told[0]["shape"] == [50, 50]
    assert [str(path) in entry["error"] for path, entry in zip(bad, told[1:], strict=True)] == [True] * len(
        bad
    )


@pytest.mark.parametrize("extension", [".npz", ".npy", ".mtx", ".h5", ".mat", ".zarr"])
def test_values_survive_conversion_without_a_device(program, transport, tmp_path, extension):
    there, back = tmp_path / f"there{extension}", tmp_path / "back.npz"
    outcome = program("convert", transport, there)
    assert outcome.code == 0, outcome.err
    assert ("--grid 5x10" in outcome.err) == (extension == ".npy")
    assert program("info", there).code == 0
    assert program("convert", there, back, "--grid", "5x10").code == 0
    T, again = (scipy.sparse.csr_array(ltcl.load(path).matrices[0]).toarray() for path in (transport, back))
    np.testing.assert_allclose(again, T, rtol=1e-7)


@pytest.mark.parametrize("extension", [".mtx", ".mat"])
def test_sparse_colour_goes_there_and_back(program, tmp_path, extension):
    T = [scipy.sparse.csr_array(np.diag(np.arange(1.0, 5.0) + k)) for k in range(3)]
    source, there, back = tmp_path / "T.npz", tmp_path / f"there{extension}", tmp_path / "back.npz"
    ltcl.save(source, ltcl.Transport(T, (2, 2)))
    outcome = program("convert", source, there)
    assert (outcome.code, " 0 B on disk" in outcome.out) == (0, False)
    assert program("convert", there, back).code == 0
    again = ltcl.load(back)
    assert again.grid == (2, 2)
    for one, other in zip(T, again.matrices, strict=True):
        np.testing.assert_array_equal(one.toarray(), scipy.sparse.csr_array(other).toarray())


def test_what_cannot_be_loaded_is_not_written(program, transport, compressed, tmp_path):
    np.save(tmp_path / "nan.npy", np.full((4, 4), np.nan))
    np.savez(tmp_path / "grid.npz", T=np.eye(32), grid=(5, 5))
    np.savez(tmp_path / "first.npz", T=np.ones((6, 4)), first_bounce=np.ones(4))
    target = tmp_path / "T.npz"
    target.write_text("old")
    program("convert", tmp_path / "nan.npy", target).refused("nan.npy: ", "NaN")
    program("convert", tmp_path / "grid.npz", target).refused("grid.npz: grid is 5 x 5", "32", "(--grid)")
    program("convert", tmp_path / "first.npz", target).refused("first.npz: first_bounce")
    program("convert", tmp_path / "none.npy", target).refused("none.npy: no such file")
    program("convert", transport, target, "--grid", "6x10").refused("grid is 6 x 10", "50", "(--grid)")
    program("convert", transport, tmp_path / "T.xyz").refused("T.xyz: ", ".xyz")
    program("convert", compressed, tmp_path / "T.mtx").refused("T.mtx: ", "compressed")
    program("convert", compressed, target, "--grid", "10x5").refused("(10, 5)", "(5, 10)")
    assert target.read_text() == "old"
    assert program("convert", tmp_path / "grid.npz", target, "--grid", "4x8").code == 0
    assert program("convert", compressed, target, "--grid", "5x10").code == 0
    assert ltcl.load(target).error == ltcl.load(compressed).error


def test_grids_that_a_file_does_not_contain_are_asked_for(program, tmp_path):
    np.save(tmp_path / "T.npy", np.ones((6, 4)))
    common = ["convert", tmp_path / "T.npy", tmp_path / "T.npz"]
    assert "--grid HxW" in program(*common).err
    assert "--camera-grid HxW" in program(*common, "--grid", "2x2").err
    assert program(*common, "--grid", "2x2", "--camera-grid", "2x3").err == ""


def test_a_compressed_file_is_smaller_and_solves(program, colour_transport, tmp_path):
    out = tmp_path / "C.npz"
    arguments = ["--rtol", "0.05", "--basis", "haar", "--basis", "pixels", "--out", out]
    told = program("compress", colour_transport, *arguments, "--json").json
    assert told["bytes_on_disk"] == out.stat().st_size
    assert [trial["basis"] for trial in told["compression"]["channels"][0]["trials"]] == ["haar", "pixels"]
    T, C = ltcl.load(colour_transport), ltcl.load(out)
    assert C.error == pytest.approx(told["solution_error"])
    assert C.error <= 0.05
    pattern = random.random((*T.grid, 3))
    assert np.linalg.norm(C @ pattern - T @ pattern) <= 0.1 * np.linalg.norm(T @ pattern)
    table = program("compress", colour_transport, *arguments[:-1], tmp_path / "C.zarr").out
    within = checks.upwards(ltcl.load(tmp_path / "C.zarr").error)  # enough to ask for
    for part in ("red", "green", "blue", "haar", "pixels", "chosen", f"solutions within {within}, "):
        assert part in table


def test_an_inverse_is_made_and_kept(program, transport, tmp_path):
    out = tmp_path / "inverse.npz"
    told = program("invert", transport, "--out", out, "--rtol", "0.02", "--json").json
    kept = ltcl.load_inverse(out)
    assert told["errors"] == list(kept.errors)
    assert told["bytes_on_disk"] == out.stat().st_size
    S = ltcl.load(transport).systems[0].to_dense()
    assert np.linalg.norm(np.eye(50) - kept.systems[0].to_dense() @ S, 2) <= kept.error <= 0.02
    assert "solutions within 0.0" in program("invert", transport, "--out", out, "--basis", "haar").out


def test_refusals_of_compress_and_invert(program, transport, compressed, tmp_path):
    out, own = tmp_path / "C.npz", tmp_path / "T.npz"
    own.write_bytes(before := transport.read_bytes())
    for command in ("compress", "invert"):
        program(command, own, "--out", own).refused("which is TRANSPORT itself")
    program("compress", transport, "--out", out, "--rtol", "2").refused("rtol is 2.0", "(--rtol)")
    program("compress", transport, "--out", out, "--basis", "bior2.2").refused(
        "basis is 'bior2.2'", "(--basis)"
    )
    program("compress", transport, "--out", tmp_path / "C.npy").refused(
        "C.npy; a compressed transport must be"
    )
    program("compress", compressed, "--out", out).refused(f"{compressed}: is compressed already")
    program("compress", transport, "--out", out, "--budget", "10B").refused(
        "budget is 10 bytes", "(--budget)"
    )
    program("invert", transport, "--out", tmp_path / "inverse.npy").refused("inverse.npy", ".npz")
    assert own.read_bytes() == before
    assert list(tmp_path.iterdir()) == [own]


@pytest.mark.parametrize(
    ("text", "size"), [("50MB", 50_000_000), ("1.5GiB", 3 << 29), ("0.1 kB", 100), ("7", 7)]
)
def test_sizes(program, transport, tmp_path, text, size):
    arguments = ["--basis", "haar", "--rtol", "0.05", "--out", tmp_path / "C.npz", "--budget", text, "--json"]
    outcome = program("compress", transport, *arguments)
    if size > 10_000:
        assert outcome.json["options"]["budget"] == size
    else:
        assert f"budget is {size} bytes" in outcome.document["error"]
