# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info`, `convert`, `analyze`, `compress`, `denoise` and `invert`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl import checks, scenes

from .conftest import Program

random = np.random.default_rng(0)


def info(program: Program, path: Path) -> dict[str, Any]:
    (entry,) = program("info", path, "--json").json
    return entry


@pytest.fixture
def sparse(tmp_path: Path) -> Path:
    matrix = scipy.sparse.csr_array(np.diag([1.0, 0.0, 2.0, 3.0]))
    scipy.sparse.save_npz(tmp_path / "S.npz", matrix)
    return tmp_path / "S.npz"


@pytest.fixture
def rectangular(tmp_path: Path) -> Path:
    np.savez(tmp_path / "rectangular.npz", T=np.ones((6, 4), np.float32), grid=(2, 2))
    return tmp_path / "rectangular.npz"


def test_info_of_dense_transports(program, transport, colour_transport, monkeypatch):
    # No device is needed.
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")
    corner = info(program, transport)
    assert corner["shape"] == [50, 50]
    assert corner["grid"] == [5, 10]
    assert corner["channels"] == 1
    assert corner["first_bounce"] == pytest.approx([0.6, 0.6], rel=1e-6)
    assert corner["solution_error"] == 0.0
    room = info(program, colour_transport)
    assert room["shape"] == [48, 48]
    assert room["channels"] == 3
    assert room["stored"] == "dense"


@pytest.mark.slow
def test_info_of_compressed_transports_and_inverses(program, compressed, inverse):
    small = info(program, compressed)
    assert small["stored"] == "compressed"
    assert small["grid"] == [5, 10]
    assert small["dtype"].endswith(f"; error {checks.upwards(small['solution_error'])}")
    assert 0 < small["entries"] < 2500
    inverted = info(program, inverse)
    assert inverted["stored"] == "inverse"
    assert inverted["shape"] == [50, 50]
    assert 0 < inverted["solution_error"] <= 1e-3


def test_info_of_sparse_and_rectangular_transports(program, sparse, rectangular):
    entry = info(program, sparse)
    assert entry["stored"] == "sparse"
    assert entry["entries"] == 3
    assert entry["grid"] is None
    assert entry["dark_pixels"] == 1
    assert entry["first_bounce"] == [0.0, 3.0]
    entry = info(program, rectangular)
    assert entry["first_bounce"] is None
    assert entry["dark_pixels"] is None


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("transport", "fewer than 64"),
        ("compressed", "compressed: .*analyze"),
        ("inverse", "inverse: .*analyze"),
        ("sparse", "grid: .*analyze .* --grid"),
        ("rectangular", "grid: .*analyze .* --camera-grid"),
    ],
)
def test_info_tells_why_a_verdict_is_unknown(program, request, name, words):
    entry = info(program, request.getfixturevalue(name))
    assert re.search(f"^Unknown: .*{words}", entry["verdict"]["text"])


def test_info_prints_a_table(program, transport, sparse, inverse):
    printed = program("info", transport, sparse, inverse).out
    for word in ("50 x 50", "5 x 10", "the same", "unknown", "inverse"):
        assert word in printed


def test_a_bad_file_does_not_hide_the_good_ones(program, transport, tmp_path):
    np.savez(tmp_path / "grid.npz", T=np.eye(32), grid=(5, 5))
    np.save(tmp_path / "nan.npy", np.full((4, 4), np.nan))
    (tmp_path / "cut.npz").write_bytes(transport.read_bytes()[:500])
    bad = [*sorted(tmp_path.iterdir()), tmp_path / "none.npz", tmp_path / "T.xyz"]
    outcome = program("info", transport, *bad, transport)
    assert outcome.code == 1
    assert outcome.out.count("50 x 50") == 2
    for path, line in zip(bad, outcome.err.splitlines(), strict=True):
        assert line.startswith(f"ltcl: error: {path}")
    first, *others = program("info", transport, *bad, "--json").document
    assert first["shape"] == [50, 50]
    for path, entry in zip(bad, others, strict=True):
        assert entry["file"] == str(path)
        assert entry["error"].startswith(str(path))
        assert entry["type"] == "FileError"
        assert entry["exit_code"] == 1


def test_grids_that_a_file_does_not_contain_are_asked_for(program, tmp_path):
    np.save(tmp_path / "T.npy", np.ones((6, 4)))
    common = ["convert", tmp_path / "T.npy", tmp_path / "T.npz"]
    assert "--grid HxW" in program(*common).err
    assert "--camera-grid HxW" in program(*common, "--grid", "2x2").err
    assert program(*common, "--grid", "2x2", "--camera-grid", "2x3").err == ""


def test_a_compressed_transport_keeps_its_error(program, compressed, tmp_path):
    copy = tmp_path / "C.npz"
    assert program("convert", compressed, copy, "--grid", "5x10").code == 0
    assert ltcl.load(copy).error == ltcl.load(compressed).error


@pytest.mark.parametrize("first_bounce", ["diagonal", "exact", "estimate"])
def test_analysis_is_that_of_the_library(program, transport, first_bounce):
    (entry,) = program("analyze", transport, "--first-bounce", first_bounce, "--json").json
    (channel,) = entry["channels"]
    T = ltcl.load(transport, first_bounce=first_bounce)
    (expected,) = ltcl.analyze(T).channels
    for name in (
        "spectral_radius",
        "spectral_radius_bounds",
        "reciprocity_defect",
        "first_bounce",
    ):
        assert channel[name] == pytest.approx(getattr(expected, name), rel=1e-5)
    assert channel["products"]["jacobi"] == expected.products["jacobi"]


def test_analysis_shows_divergence_and_draws(program, transport, tmp_path):
    closed = tmp_path / "closed.npz"
    plot = tmp_path / "a.png"
    ltcl.save(closed, scenes.box(3, albedo=0.8).transport())
    printed = program("analyze", transport, closed, "--plot", plot).out
    assert plot.stat().st_size > 10_000
    # By jacobi and neumann.
    assert printed.count(" diverges") == 2


COMPRESSION = ["--rtol", "0.05", "--basis", "haar", "--basis", "pixels"]


@pytest.mark.rare
def test_a_compressed_file_is_smaller_and_solves(program, colour_transport, tmp_path):
    out = tmp_path / "C.npz"
    arguments = [*COMPRESSION, "--budget", "1.5GiB", "--out", out, "--json"]
    report = program("compress", colour_transport, *arguments).json
    assert report["bytes_on_disk"] == out.stat().st_size
    assert report["options"]["budget"] == 3 << 29
    trials = report["compression"]["channels"][0]["trials"]
    assert [trial["basis"] for trial in trials] == ["haar", "pixels"]
    T = ltcl.load(colour_transport)
    C = ltcl.load(out)
    assert C.error <= 0.05
    assert C.error == pytest.approx(report["solution_error"])
    assert C.error < C.error_bound
    assert C.error_bound == pytest.approx(report["error_bound"])
    pattern = random.random((4, 12, 3))
    seen = T @ pattern
    assert np.linalg.norm(C @ pattern - seen) <= 0.1 * np.linalg.norm(seen)


@pytest.mark.slow
def test_compression_prints_its_error(program, colour_transport, tmp_path):
    out = tmp_path / "C.zarr"
    arguments = [*COMPRESSION, "--norm", "worst", "--out", out]
    printed = program("compress", colour_transport, *arguments).out
    within = checks.upwards(ltcl.load(out).error)
    for word in ("red", "green", "blue", "haar", f"solutions within {within}, "):
        assert word in printed


@pytest.mark.slow
def test_compression_down_to_the_noise(program, colour_transport, tmp_path):
    arguments = ["--rtol", "noise", "--out", tmp_path / "N.npz", "--json"]
    report = program("compress", colour_transport, *arguments).json
    assert report["compression"]["rtol"] == "noise"


@pytest.mark.rare
def test_a_transport_with_less_noise(program, tmp_path):
    noisy = tmp_path / "noisy.npz"
    out = tmp_path / "D.zarr"
    T = scenes.box(8, sides=3, albedo=[(0.7, 0.3, 0.2)] * 3).transport()
    exact = T.to_numpy()
    entries = exact + 1e-3 * random.standard_normal(exact.shape)
    ltcl.save(noisy, ltcl.Transport(entries, T.grid, T.first_bounce))
    noise = program("denoise", noisy, "--out", out, "--json").json["noise"]
    for before, after in zip(noise["before"], noise["after"], strict=True):
        assert after < before
    denoised = ltcl.load(out).to_numpy()
    assert np.linalg.norm(denoised - exact) < np.linalg.norm(entries - exact)


def test_an_inverse_is_written(program, transport, tmp_path):
    out = tmp_path / "inverse.npz"
    report = program("invert", transport, "--out", out, "--rtol", "0.02", "--json").json
    loaded = ltcl.load_inverse(out)
    assert report["errors"] == list(loaded.errors)
    assert report["bytes_on_disk"] == out.stat().st_size
    assert report["bytes"] == loaded.nbytes
    assert 0 < loaded.error <= 0.02


@pytest.mark.parametrize(("options", "masked"), [([], 1), (["--dark", "0"], 0)])
def test_dark_of_0_keeps_every_pixel_lit(program, tmp_path, options, masked):
    np.savez(tmp_path / "T.npz", T=np.diag([1.0, 1e-9, 1.0, 1.0]), grid=(2, 2))
    (entry,) = program("analyze", tmp_path / "T.npz", "--json", *options).json
    assert entry["masked"] == masked
