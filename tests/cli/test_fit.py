# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire fit`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl import images, scenes
from ltcl.images.frames import write_video

FRAMES = 60


@pytest.fixture(scope="module")
def T(device):
    return scenes.dihedral(8, albedo=0.6).transport(device=device)


@pytest.fixture(scope="module")
def pairs(T, tmp_path_factory) -> Path:
    """Folder of patterns and photographs, with ambient light, and a photograph of black."""
    folder = tmp_path_factory.mktemp("pairs")
    random = np.random.default_rng(0)
    for number in range(1, FRAMES + 1):
        pattern = random.random((4, 8)).repeat(2, axis=0).repeat(2, axis=1)
        images.write(folder / "patterns" / f"p{number}.exr", pattern)
        images.write(folder / "photographs" / f"c{number}.exr", T @ pattern + 0.05)
    images.write(folder / "black.exr", np.full(T.grid, 0.05))
    return folder


def test_a_folder_of_pairs_gives_T(program, pairs, T, tmp_path):
    out = tmp_path / "T.npz"
    arguments = ["acquire", "fit", pairs, "--black", pairs / "black.exr", "--out", out]
    report = program(*arguments, "--json").json
    assert report["pairs"] == FRAMES
    assert report["error"] < 0.01
    fitted = ltcl.load(out)
    pattern = np.ones(T.grid)
    np.testing.assert_allclose(fitted @ pattern, T @ pattern, rtol=0.02)


def test_films_and_another_grid(program, pairs, T, tmp_path):
    folder = tmp_path / "films"
    folder.mkdir()
    shown = []
    seen = []
    for number in range(1, FRAMES + 1):
        pattern = images.read(pairs / "patterns" / f"p{number}.exr")
        shown.append(pattern)
        seen.append(T @ pattern)
    write_video(folder / "patterns.mkv", shown)
    write_video(folder / "photographs.mkv", seen)
    outcome = program("acquire", "fit", folder, "--grid", "4x8")
    assert "4 x 8 pixels, from 60 pairs" in outcome.out, outcome.err
    assert ltcl.load(folder / "transport.npz").grid == (4, 8)


def test_a_film_in_colour_begins_in_black(program, T, tmp_path):
    """Its black frames are read as grey."""
    random = np.random.default_rng(0)
    shown = []
    seen = []
    for number in range(30):
        pattern = np.repeat(random.random((8, 16, 1)), 3, axis=2)
        pattern[..., 2] *= 0.5
        if number < 2:
            pattern[:] = 0.0
        shown.append(pattern)
        seen.append(T @ pattern)
    write_video(tmp_path / "patterns.mkv", shown)
    write_video(tmp_path / "photographs.mkv", seen)
    outcome = program("acquire", "fit", tmp_path)
    assert "8 x 16 pixels, from 30 pairs" in outcome.out, outcome.err
    assert ltcl.load(tmp_path / "transport.npz").channels == 3


def test_what_is_missing_is_named(program, pairs, tmp_path):
    program("acquire", "fit", tmp_path).assert_refused(str(tmp_path), "no patterns")
    (tmp_path / "patterns").mkdir()
    (tmp_path / "patterns.mkv").touch()
    program("acquire", "fit", tmp_path).assert_refused("patterns and patterns.mkv", "must have one")
    bad = tmp_path / "T.xyz"
    program("acquire", "fit", pairs, "--out", bad).assert_refused("T.xyz")
    assert not bad.exists()


def test_pixels_that_are_not_there_are_refused(program, pairs, tmp_path):
    """Nothing is scaled up, and nothing stretched in silence."""
    out = tmp_path / "T.npz"
    fit = ("acquire", "fit", pairs, "--out", out)
    program(*fit, "--grid", "8x17").assert_refused("--grid is 8x17", "8 x 16 pixels")
    images.write(tmp_path / "black.exr", np.full((9, 16), 0.05))
    program(*fit, "--black", tmp_path / "black.exr").assert_refused("black.exr", "9 x 16", "8 x 16")
    assert program(*fit, "--resize", "crop").code == 2
    assert not out.exists()


def test_a_black_that_is_bright_is_refused(program, pairs, tmp_path):
    out = tmp_path / "T.npz"
    images.write(tmp_path / "black.exr", np.full((8, 16), 0.5))
    outcome = program("acquire", "fit", pairs, "--out", out, "--black", tmp_path / "black.exr")
    outcome.assert_refused("black.exr: is brighter than the mean photograph at", "shows black")
    assert not out.exists()
