# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info`, `convert`, `analyze`, `compress` and `invert`: transport files, described and made."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl import checks, scenes

random = np.random.default_rng(0)


def test_info(program, transport, colour_transport, compressed, inverse, tmp_path, monkeypatch):
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")  # none is needed
    scipy.sparse.save_npz(tmp_path / "S.npz", scipy.sparse.csr_array(np.diag([1.0, 0.0, 2.0, 3.0])))
    np.savez(tmp_path / "rectangular.npz", T=np.ones((6, 4), np.float32), grid=(2, 2))
    files = [transport, colour_transport, compressed, inverse, *sorted(tmp_path.iterdir())]
    corner, room, small, inverted, sparse, rectangular = program("info", *files, "--json").json
    assert (corner["shape"], corner["grid"], corner["channels"]) == ([50, 50], [5, 10], 1)
    assert corner["first_bounce"] == pytest.approx([0.6, 0.6], rel=1e-6)
    assert (room["shape"], room["channels"], room["stored"]) == ([48, 48], 3, "dense")
    assert (small["stored"], small["grid"], corner["solution_error"]) == (
        "compressed",
        [5, 10],
        0.0,
    )
    assert small["dtype"].endswith(f"; error {checks.upwards(small['solution_error'])}")
    assert 0 < small["entries"] < 2500
    assert (inverted["stored"], inverted["shape"]) == ("inverse", [50, 50])
    assert 0 < inverted["solution_error"] <= 1e-3
    assert (sparse["stored"], sparse["entries"], sparse["grid"]) == ("sparse", 3, None)
    assert (sparse["dark_pixels"], sparse["first_bounce"]) == (1, [0.0, 3.0])
    assert (rectangular["first_bounce"], rectangular["dark_pixels"]) == (None, None)
    reasons = (
        (corner, "fewer than 64"),
        (small, "compressed: .*analyze"),
        (inverted, "inverse: .*analyze"),
    )
    reasons += (
        (sparse, "grid: .*analyze .* --grid"),
        (rectangular, "grid: .*convert .* --camera-grid"),
    )
    assert all(
        re.search(f"^Unknown: .*{words}", entry["verdict"]["text"]) for entry, words in reasons
    )
    printed, words = (
        program("info", *files).out,
        ("50 x 50", "5 x 10", "the same", "unknown", "inverse"),
    )
    assert all(word in printed for word in words)


def test_a_bad_file_does_not_hide_the_good_ones(program, transport, tmp_path):
    np.savez(tmp_path / "grid.npz", T=np.eye(32), grid=(5, 5))
    np.save(tmp_path / "nan.npy", np.full((4, 4), np.nan))
    (tmp_path / "cut.npz").write_bytes(transport.read_bytes()[:500])
    bad = [*sorted(tmp_path.iterdir()), tmp_path / "none.npz", tmp_path / "T.xyz"]
    outcome = program("info", transport, *bad, transport)
    assert (outcome.code, outcome.out.count("50 x 50")) == (1, 2)
    for path, line in zip(bad, outcome.err.splitlines(), strict=True):
        assert line.startswith(f"ltcl: error: {path}")
    first, *others = program("info", transport, *bad, "--json").document
    assert first["shape"] == [50, 50]
    for path, entry in zip(bad, others, strict=True):
        assert entry["error"].startswith(str(path))
        assert (entry["type"], entry["exit_code"]) == ("FileError", 1)


def test_grids_that_a_file_does_not_contain_are_asked_for(program, compressed, tmp_path):
    np.save(tmp_path / "T.npy", np.ones((6, 4)))
    common = ["convert", tmp_path / "T.npy", tmp_path / "T.npz"]
    assert "--grid HxW" in program(*common).err
    assert "--camera-grid HxW" in program(*common, "--grid", "2x2").err
    assert program(*common, "--grid", "2x2", "--camera-grid", "2x3").err == ""
    assert program("convert", compressed, tmp_path / "C.npz", "--grid", "5x10").code == 0
    assert ltcl.load(tmp_path / "C.npz").error == ltcl.load(compressed).error


def test_analysis_is_that_of_the_library_and_shows_what_diverges(program, transport, tmp_path):
    for first_bounce in ("diagonal", "exact", "estimate"):
        (entry,) = program("analyze", transport, "--first-bounce", first_bounce, "--json").json
        (expected,) = ltcl.analyze(ltcl.load(transport, first_bounce=first_bounce)).channels
        for name in (
            "spectral_radius",
            "spectral_radius_bounds",
            "reciprocity_defect",
            "first_bounce",
        ):
            assert entry["channels"][0][name] == pytest.approx(getattr(expected, name), rel=1e-5)
        assert entry["channels"][0]["products"]["jacobi"] == expected.products["jacobi"]
    ltcl.save(tmp_path / "closed.npz", scenes.box(3, albedo=0.8).transport())
    printed = program(
        "analyze", transport, tmp_path / "closed.npz", "--plot", tmp_path / "a.png"
    ).out
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert printed.count(" diverges") == 2  # jacobi and neumann


def test_a_compressed_file_is_smaller_and_solves(program, colour_transport, tmp_path):
    out, arguments = (
        tmp_path / "C.npz",
        ["--rtol", "0.05", "--basis", "haar", "--basis", "pixels", "--out"],
    )
    report = program(
        "compress", colour_transport, *arguments, out, "--budget", "1.5GiB", "--json"
    ).json
    assert (report["bytes_on_disk"], report["options"]["budget"]) == (out.stat().st_size, 3 << 29)
    assert [trial["basis"] for trial in report["compression"]["channels"][0]["trials"]] == [
        "haar",
        "pixels",
    ]
    T, C, pattern = ltcl.load(colour_transport), ltcl.load(out), random.random((4, 12, 3))
    assert 0.05 >= C.error == pytest.approx(report["solution_error"])
    assert np.linalg.norm(C @ pattern - T @ pattern) <= 0.1 * np.linalg.norm(T @ pattern)
    assert C.error < C.error_bound == pytest.approx(report["error_bound"])
    printed = program(
        "compress", colour_transport, *arguments, tmp_path / "C.zarr", "--norm", "worst"
    ).out
    within = checks.upwards(ltcl.load(tmp_path / "C.zarr").error)  # enough to ask for
    assert all(
        word in printed for word in ("red", "green", "blue", "haar", f"solutions within {within}, ")
    )
    noise = program(
        "compress", colour_transport, "--rtol", "noise", "--out", tmp_path / "N.npz", "--json"
    ).json
    assert noise["compression"]["rtol"] == "noise"


def test_a_transport_with_less_noise(program, colour_transport, tmp_path):
    noisy, out = tmp_path / "noisy.npz", tmp_path / "D.zarr"
    T = ltcl.load(colour_transport)
    entries = T.to_numpy() + 1e-3 * random.standard_normal((3, 48, 48))
    ltcl.save(noisy, ltcl.Transport(entries, T.grid, T.first_bounce))
    report = program("denoise", noisy, "--out", out, "--json").json
    noise = report["noise"]
    assert all(a < b for a, b in zip(noise["after"], noise["before"], strict=True))
    assert np.linalg.norm(ltcl.load(out).to_numpy() - T.to_numpy()) < np.linalg.norm(
        entries - T.to_numpy()
    )


def test_an_inverse_is_made_and_kept(program, transport, tmp_path):
    out = tmp_path / "inverse.npz"
    report = program("invert", transport, "--out", out, "--rtol", "0.02", "--json").json
    loaded = ltcl.load_inverse(out)
    assert report["errors"] == list(loaded.errors)
    assert (report["bytes_on_disk"], report["bytes"]) == (out.stat().st_size, loaded.nbytes)
    assert 0 < loaded.error <= 0.02


def test_dark_of_0_keeps_every_pixel_lit(program, tmp_path):
    np.savez(tmp_path / "T.npz", T=np.diag([1.0, 1e-9, 1.0, 1.0]), grid=(2, 2))
    reports = [
        program("analyze", tmp_path / "T.npz", "--json", *dark).json[0]
        for dark in ([], ["--dark", "0"])
    ]
    assert [report["masked"] for report in reports] == [1, 0]
