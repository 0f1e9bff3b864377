# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl simulate`: scenes as folders that can be acquired."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl import images, scenes, store
from ltcl.acquisition import Project
from ltcl.cli import simulate

from .conftest import Program


@pytest.mark.parametrize(
    ("scene", "made"),
    [
        ("dihedral", scenes.dihedral(4)),
        ("trihedral", scenes.trihedral(4)),
        ("box", scenes.box(4, sides=5)),
    ],
)
def test_the_truth_is_that_of_the_scene(
    program: Program, tmp_path: Path, scene: str, made: scenes.Scene
) -> None:
    outcome = program("simulate", scene, "--size", 4, "--out", tmp_path / "scan")
    assert outcome.code == 0, outcome.err
    h, w = made.grid
    assert f"{h} x {w} projector pixels, 1 channel(s)" in outcome.out
    record = store.formats.read(tmp_path / "scan" / "truth.npz")
    assert isinstance(record, store.Record)
    np.testing.assert_allclose(np.asarray(record.matrices[0]), made.matrices()[0])
    found = sorted(path.name for path in (tmp_path / "scan").iterdir())
    assert found == ["acquisition.toml", "black.png", "simulate.json", "truth.npz", "white.png"]


def test_the_rig_is_as_asked_for(program: Program, tmp_path: Path) -> None:
    out = tmp_path / "scan"
    arguments = ["--size", "4", "--albedo", "0.8,0.5,0.3", "--response", "film", "--bits", "8", "--seed", "5"]
    more = ["--ambient", "0.05", "--strategy", "hadamard", "--projector-response", "gamma2.2", "--json"]
    told = program("simulate", "dihedral", "--out", out, *arguments, *more).json
    assert (told["channels"], told["projector_grid"], told["camera_grid"]) == (3, [4, 8], [4, 8])
    project = Project.open(out)
    assert project.settings == {"geometry": "aligned", "strategy": "hadamard"}
    with project.rig() as rig:
        said = rig.describe()
        assert (said["response"], said["projector_response"], said["bits"]) == ("film", "gamma2.2", 8)
        assert (said["ambient"], said["seed"]) == ([0.05], 5)
        white = rig.photograph(np.ones((4, 8)), told["seconds"])
    shown = images.read_codes(out / "white.png")
    np.testing.assert_allclose(shown.astype(float), white, atol=12)  # noise of its own
    assert white.max() > 128
    assert images.read_codes(out / "black.png").max() < white.min()
    assert json.loads((out / "simulate.json").read_text())["options"]["bits"] == 8


def test_a_camera_of_its_own_pixels_sees_the_same_light(program: Program, tmp_path: Path) -> None:
    outcome = program("simulate", "dihedral", "--size", 4, "--camera-grid", "6x14", "--out", tmp_path)
    assert outcome.code == 0, outcome.err
    project = Project.open(tmp_path)
    assert project.settings["geometry"] == "graycode"
    with project.rig() as rig:
        assert rig.camera_grid == (6, 14)
        seen = rig.radiance(np.ones((4, 8)))
    truth = ltcl.load(tmp_path / "truth.npz") @ np.ones((4, 8), np.float32) + 0.01
    assert seen.mean() == pytest.approx(truth.mean(), rel=1e-5)
    np.testing.assert_allclose(simulate._covered(3, 5).sum(axis=1), 1.0)
    np.testing.assert_allclose(simulate._covered(5, 3).sum(axis=0), 3 / 5)


def test_a_transport_file_is_a_scene(program: Program, colour_transport: Path, tmp_path: Path) -> None:
    told = program("simulate", colour_transport, "--out", tmp_path / "a", "--json").json
    assert (told["channels"], told["projector_grid"]) == (3, [4, 12])
    np.save(tmp_path / "T.npy", np.eye(8))
    program("simulate", tmp_path / "T.npy", "--out", tmp_path / "b").refused(
        "does not tell its grid; give --grid"
    )
    program("simulate", tmp_path / "T.npy", "--grid", "3x3", "--out", tmp_path / "b").refused(
        "--grid is 3 x 3"
    )
    assert program("simulate", tmp_path / "T.npy", "--grid", "2x4", "--out", tmp_path / "b").code == 0


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (
            ["sphere"],
            ["SCENE is 'sphere'; it must be dihedral, trihedral, box, mitsuba:NAME or a transport file"],
        ),
        (["nowhere.npz"], ["nowhere.npz: no such file"]),
        (["dihedral", "--grid", "4x8"], ["--grid is given, but it is for mitsuba and files; give --size"]),
        (["mitsuba:dihedral", "--ambient", "0.1"], ["--ambient is given, but it is not for mitsuba"]),
        (["mitsuba:a.xml", "--albedo", "0.1"], ["--albedo is given, but it is for dihedral, trihedral, box"]),
        (["dihedral", "--albedo", "1.5"], ["albedo"]),
    ],
)
def test_what_cannot_be_made_is_refused_and_leaves_nothing(
    program: Program, tmp_path: Path, arguments: list[str], parts: list[str]
) -> None:
    program("simulate", *arguments, "--out", tmp_path / "scan").refused(*parts)
    assert list(tmp_path.iterdir()) == []


def test_no_acquisition_is_overwritten(program: Program, tmp_path: Path) -> None:
    out = tmp_path / "scan"
    assert program("simulate", "dihedral", "--size", 2, "--out", out).code == 0
    assert program("simulate", "dihedral", "--size", 3, "--out", out).code == 0
    (out / "transport.zarr").mkdir()
    program("simulate", "dihedral", "--out", out).refused("holds a transport.zarr that was acquired")
    (out / "transport.zarr").rmdir()
    (out / "simulate.json").unlink()
    program("simulate", "dihedral", "--out", out).refused(
        "acquisition.toml that 'ltcl simulate' did not make"
    )


def test_mitsuba_renders_what_is_photographed(program: Program, tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason='mitsuba is not installed: pip install "ltcl[rig]"')
    told = program("simulate", "mitsuba:dihedral", "--grid", "6x8", "--out", tmp_path / "m", "--json").json
    assert (told["channels"], told["projector_grid"], told["camera_grid"]) == (1, [6, 8], [6, 8])
    assert not (tmp_path / "m" / "truth.npz").exists()
    assert images.read_codes(tmp_path / "m" / "white.png").max() > 100
    program("simulate", "mitsuba:nothing.xml", "--out", tmp_path / "n").refused("nothing.xml: no such file")


@pytest.mark.parametrize("arguments", [["--albedo", "0.1,0.2"], ["--bits", "7"], ["--response", "agfa"]])
def test_wrong_usage(program: Program, tmp_path: Path, arguments: list[str]) -> None:
    assert program("simulate", "dihedral", "--out", tmp_path / "scan", *arguments).code == 2
