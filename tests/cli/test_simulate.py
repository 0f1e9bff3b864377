# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl simulate`: folders in which scenes are photographed without a camera."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl import scenes
from ltcl.acquisition import Project


@pytest.mark.parametrize(
    ("name", "options"), [("dihedral", {}), ("trihedral", {}), ("box", {"sides": 5})]
)
def test_the_truth_is_the_transport_of_the_scene(program, tmp_path, name, options):
    truth = getattr(scenes, name)(4, **options)
    printed = program("simulate", name, "--size", 4, "--out", tmp_path).out
    assert "{} x {}".format(*truth.grid) in printed
    (matrix,) = truth.matrices()
    np.testing.assert_allclose(ltcl.load(tmp_path / "truth.npz").matrices[0], matrix)


def test_the_rig_is_as_requested(program, tmp_path):
    scene = ["--size", "4", "--albedo", "0.8,0.5,0.3", "--ambient", "0.05"]
    camera = ["--response", "film", "--bits", "8", "--seed", "5", "--camera-grid", "6x14"]
    projector = ["--projector-response", "gamma2.2", "--strategy", "hadamard"]
    options = [*scene, *camera, *projector, "--json"]
    report = program("simulate", "dihedral", "--out", tmp_path, *options).json
    assert report["channels"] == 3
    assert report["projector_grid"] == [4, 8]
    assert report["options"]["bits"] == 8
    project = Project.open(tmp_path)
    assert project.settings == {"geometry": "graycode", "strategy": "hadamard"}
    with project.rig() as rig:
        facts = rig.describe()
        seen = rig.radiance(np.ones((4, 8, 3)))
    truth = ltcl.load(tmp_path / "truth.npz") @ np.ones((4, 8, 3), np.float32) + 0.05
    assert seen.shape == (6, 14, 3)
    assert seen.mean() == pytest.approx(truth.mean(), rel=1e-5)
    expected = {"response": "film", "projector_response": "gamma2.2", "ambient": [0.05], "seed": 5}
    assert expected.items() <= facts.items()


def test_a_transport_file_is_a_scene(program, colour_transport, tmp_path):
    report = program("simulate", colour_transport, "--out", tmp_path, "--json").json
    assert report["channels"] == 3
    assert report["projector_grid"] == [4, 12]


def test_no_acquisition_is_overwritten(program, tmp_path):
    common = ["simulate", "dihedral", "--out", tmp_path, "--size"]
    assert program(*common, 2).code == 0
    assert program(*common, 3).code == 0
    (tmp_path / "transport.zarr").mkdir()
    program(*common, 3).assert_refused(f"{tmp_path}: ", "transport.zarr")
    (tmp_path / "transport.zarr").rmdir()
    (tmp_path / "simulate.json").unlink()
    program(*common, 3).assert_refused(f"{tmp_path}: ", "acquisition.toml")


@pytest.mark.slow
def test_mitsuba_renders_the_photographs(program, tmp_path):
    pytest.importorskip("mitsuba", reason='mitsuba is not installed: pip install "ltcl[rig]"')
    arguments = ["mitsuba:dihedral", "--grid", "6x8", "--out", tmp_path / "m", "--json"]
    report = program("simulate", *arguments).json
    assert report["channels"] == 1
    assert report["projector_grid"] == [6, 8]
    assert not (tmp_path / "m" / "truth.npz").exists()
    with Project.open(tmp_path / "m").rig() as rig:
        assert rig.photograph(np.ones((6, 8)), 0.5).max() > 100
    program("simulate", "mitsuba:nothing.xml", "--out", tmp_path / "n").assert_refused(
        "nothing.xml: "
    )
