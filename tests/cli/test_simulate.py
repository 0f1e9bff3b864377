# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl simulate`: scenes as folders that can be acquired."""

from __future__ import annotations

import json

import numpy as np
import pytest

import ltcl
from ltcl import scenes
from ltcl.acquisition import Project


@pytest.mark.parametrize("scene", ["dihedral", "trihedral", "box"])
def test_the_truth_is_that_of_the_scene(program, tmp_path, scene):
    truth = getattr(scenes, scene)(4, **({"sides": 5} if scene == "box" else {}))
    outcome = program("simulate", scene, "--size", 4, "--out", tmp_path)
    assert outcome.code == 0, outcome.err
    assert "{} x {} projector pixels, 1 channel(s)".format(*truth.grid) in outcome.out
    T = ltcl.load(tmp_path / "truth.npz")
    np.testing.assert_allclose(T.matrices[0], truth.matrices()[0])
    names = ["acquisition.toml", "simulate.json", "truth.npz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_the_rig_is_as_asked_for(program, tmp_path):
    arguments = ["--size", "4", "--albedo", "0.8,0.5,0.3", "--response", "film", "--bits", "8", "--seed", "5"]
    more = ["--ambient", "0.05", "--strategy", "hadamard", "--projector-response", "gamma2.2", "--json"]
    told = program("simulate", "dihedral", "--out", tmp_path, *arguments, *more).json
    assert (told["channels"], told["projector_grid"]) == (3, [4, 8])
    project = Project.open(tmp_path)
    assert project.settings == {"geometry": "aligned", "strategy": "hadamard"}
    with project.rig() as rig:
        facts = rig.describe()
    assert (facts["response"], facts["projector_response"], facts["bits"]) == ("film", "gamma2.2", 8)
    assert (facts["ambient"], facts["seed"]) == ([0.05], 5)
    assert json.loads((tmp_path / "simulate.json").read_text())["options"]["bits"] == 8


def test_a_camera_of_its_own_pixels_sees_the_same_light(program, tmp_path):
    outcome = program("simulate", "dihedral", "--size", 4, "--camera-grid", "6x14", "--out", tmp_path)
    assert outcome.code == 0, outcome.err
    project = Project.open(tmp_path)
    assert project.settings["geometry"] == "graycode"
    with project.rig() as rig:
        assert rig.camera_grid == (6, 14)
        seen = rig.radiance(np.ones((4, 8)))
    truth = ltcl.load(tmp_path / "truth.npz") @ np.ones((4, 8), np.float32) + 0.01
    assert seen.mean() == pytest.approx(truth.mean(), rel=1e-5)


def test_a_transport_file_is_a_scene(program, colour_transport, tmp_path):
    told = program("simulate", colour_transport, "--out", tmp_path / "a", "--json").json
    assert (told["channels"], told["projector_grid"]) == (3, [4, 12])
    np.save(tmp_path / "T.npy", np.eye(8))
    common = ["simulate", tmp_path / "T.npy", "--out", tmp_path / "b"]
    program(*common).refused("T.npy", "--grid")
    program(*common, "--grid", "3x3").refused("--grid is 3 x 3")
    assert program(*common, "--grid", "2x4").code == 0


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["sphere"], ["SCENE is 'sphere'", "dihedral"]),
        (["nowhere.npz"], ["nowhere.npz: no such file"]),
        (["dihedral", "--grid", "4x8"], ["--grid", "--size"]),
        (["mitsuba:dihedral", "--ambient", "0.1"], ["--ambient", "mitsuba"]),
        (["mitsuba:a.xml", "--albedo", "0.1"], ["--albedo", "a.xml"]),
        (["dihedral", "--albedo", "1.5"], ["albedo"]),
    ],
)
def test_what_cannot_be_simulated_is_refused_and_leaves_nothing(program, tmp_path, arguments, parts):
    program("simulate", *arguments, "--out", tmp_path / "scan").refused(*parts)
    assert list(tmp_path.iterdir()) == []


def test_no_acquisition_is_overwritten(program, tmp_path):
    common = ["simulate", "dihedral", "--out", tmp_path, "--size"]
    assert program(*common, 2).code == program(*common, 3).code == 0
    (tmp_path / "transport.zarr").mkdir()
    program(*common, 3).refused("holds a transport.zarr")
    (tmp_path / "transport.zarr").rmdir()
    (tmp_path / "simulate.json").unlink()
    program(*common, 3).refused("holds an acquisition.toml")


def test_mitsuba_renders_what_is_photographed(program, tmp_path):
    pytest.importorskip("mitsuba", reason='mitsuba is not installed: pip install "ltcl[rig]"')
    told = program("simulate", "mitsuba:dihedral", "--grid", "6x8", "--out", tmp_path / "m", "--json").json
    assert (told["channels"], told["projector_grid"]) == (1, [6, 8])
    assert not (tmp_path / "m" / "truth.npz").exists()
    with Project.open(tmp_path / "m").rig() as rig:
        assert rig.photograph(np.ones((6, 8)), 0.5).max() > 100
    program("simulate", "mitsuba:nothing.xml", "--out", tmp_path / "n").refused("nothing.xml: no such file")
