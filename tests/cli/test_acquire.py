# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl simulate`, `acquire` and `show`: planned, run, ended early, run again, reported."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl import images, scenes
from ltcl.acquisition import FolderRig, Project, VirtualRig, rigs
from ltcl.store import BlockStore

GRID = (4, 8)
random = np.random.default_rng(0)


@pytest.fixture
def scan(simulated: Path, tmp_path: Path) -> Path:
    """A copy of a simulated one, of which nothing is photographed."""
    return Path(shutil.copytree(simulated, tmp_path / "scan"))


@pytest.fixture
def finished(acquired: Path, tmp_path: Path) -> Path:
    """A copy of a finished one."""
    return Path(shutil.copytree(acquired, tmp_path / "finished"))


def change(scan: Path, old: str, new: str) -> None:
    before, text, after = (scan / "acquisition.toml").read_text().partition(old)
    assert text
    (scan / "acquisition.toml").write_text(before + new + after)


def end(patch: pytest.MonkeyPatch, at: int, error: BaseException) -> None:
    """The photographs of a virtual rig end, with this error, at one of them."""
    photograph, count = VirtualRig.photograph, iter(range(1, at + 1))

    def photograph_or_end(rig: VirtualRig, codes: Any, seconds: float) -> np.ndarray:
        if next(count) == at:
            raise error
        return photograph(rig, codes, seconds)

    patch.setattr(VirtualRig, "photograph", photograph_or_end)


def error_of(scan: Path, truth: Path) -> float:
    """Of T p for a pattern p that was not scanned, after one scale."""
    p, paths = (
        random.random(GRID).astype(np.float32),
        (scan / "transport.zarr", truth / "truth.npz"),
    )
    measured, exact = (np.asarray(ltcl.load(path) @ p) for path in paths)
    scale = np.vdot(measured, exact) / np.vdot(measured, measured)
    return float(np.linalg.norm(scale * measured - exact) / np.linalg.norm(exact))


def test_photographs_become_a_transport_and_run_again_reports_it(program, acquired, monkeypatch):
    end(monkeypatch, 1, OSError("there is no rig"))
    report = program("acquire", "run", acquired, "--json").json
    assert (report["strategy"], report["grid"], report["coverage"]) == ("pixel", [4, 8], 1.0)
    assert max(report["error"][0], error_of(acquired, acquired)) < 0.02
    assert report == program("acquire", "report", acquired, "--json").json
    printed = program("acquire", "report", acquired).out
    assert all(
        text in printed
        for text in ("T p", f"{report['error'][0]:.2%}", f"{acquired}/transport.zarr")
    )


def test_plans_before_and_after_the_calibration(program, simulated, acquired):
    before, after = (
        program("acquire", "plan", each, "--json").json for each in (simulated, acquired)
    )
    lines = program("acquire", "plan", simulated).out.splitlines()
    assert (before["measured"], after["measured"], (simulated / "transport.zarr").exists()) == (
        0,
        1,
        0,
    )
    for report in (before, after):
        assert {*report["plans"]} == {line.split()[0] for line in lines[4:8]} > {report["auto"]}
        assert (report["asked_for"], report["plans"]["block"]["grid"]) == ("pixel", [2, 4])
        pixel, exposures = report["plans"]["pixel"], len(report["exposures"])
        assert (
            pixel["photographs"] == pixel["patterns"] * exposures + 2 + pixel["calibration"]
        )  # 2 batches
    assert after["exposures"] == program("acquire", "report", acquired, "--json").json["exposures"]
    slower = program("acquire", "plan", simulated, "--overhead", "10", "--json").json["plans"][
        "pixel"
    ]
    more = slower["seconds"] - before["plans"]["pixel"]["seconds"]
    assert more == pytest.approx(10 * slower["photographs"])


def test_run_goes_on_from_wherever_the_folder_stands(program, scan, acquired, monkeypatch):
    again = f"'ltcl acquire run {scan}' goes on"
    for at, error, code, parts in (
        (20, KeyboardInterrupt(), 130, ["19 photographs", again]),
        (200, KeyboardInterrupt(), 130, [f"{scan / 'transport.zarr'}", again]),
        (10, OSError("unplugged"), 1, ["unplugged", "transport.zarr", again]),
    ):
        program("acquire", "report", scan).refused("transport.zarr")
        with monkeypatch.context() as patch:
            end(patch, at, error)
            program("acquire", "run", scan).refused(*parts, code=code)
    with monkeypatch.context() as patch:  # all is photographed, and the transport is not there
        patch.setattr(
            BlockStore, "finalize", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt())
        )
        assert program("acquire", "run", scan).code == 130
    end(monkeypatch, 1, OSError("there is no rig"))
    assert program("acquire", "run", scan, "--json").code == 0
    ours, whole = (BlockStore.open(each / "transport.zarr") for each in (scan, acquired))
    for b in range(whole.layout.blocks()):
        np.testing.assert_array_equal(
            ours.block(0, b).matrix.toarray(), whole.block(0, b).matrix.toarray()
        )


def test_a_live_scan_that_is_photographed_opens_no_camera(program, finished):
    path = finished / "acquisition.toml"
    live = '[rig]\nkind = "live"\n[rig.camera]\nkind = "opencv"\nsource = 999\nchannels = 1\n'
    settings = path.read_text().partition("\n[acquire]\n")[2]
    path.write_text(f"{live}[rig.display]\ngrid = [4, 8]\n[acquire]\n{settings}")
    assert program("acquire", "run", finished, "--json").json["strategy"] == "pixel"
    shutil.rmtree(finished / "transport.zarr")
    assert program("acquire", "run", finished).code == 1


def test_a_scan_is_not_that_of_other_settings(program, scan, finished):
    change(finished, 'strategy = "pixel"', 'strategy = "hadamard"')
    program("acquire", "run", finished).refused(
        "acquisition.toml: [", "strategy is 'hadamard'", "'pixel'"
    )
    change(scan, "bits = 12", "bits = 99")
    for command in ("plan", "run"):
        program("acquire", command, scan).refused(f"{scan / 'acquisition.toml'}: [rig] bits is 99")
    assert sorted(path.name for path in scan.iterdir()) == [
        "acquisition.toml",
        "simulate.json",
        "truth.npz",
    ]


BY_HAND = (
    '[rig]\nkind = "folder"\nprojector_grid = [4, 8]\npattern_bits = 16\n[acquire]\nframes = 2\n'
)
BY_HAND += 'geometry = "aligned"\nstrategy = "pixel"\nresponse = "linear"\nexposures = [0.5, 8.0]\n'


def photograph(truth: Path, folder: Path, missing: list[int], card: Path | None) -> None:
    """What is missing of the shooting list, as a person would: into the folder, or onto the camera's card."""
    T = ltcl.load(truth / "truth.npz")
    scene = VirtualRig(
        T, T.grid, bits=12, response="linear", black=0.0, ambient=0.01, seed=missing[0]
    )
    rows = [row.split(",") for row in (folder / "shots.csv").read_text().splitlines()]
    for number in missing:
        _, pattern, seconds, name = rows[number]
        picture = scene.photograph(images.read_codes(folder / pattern) / 65535, float(seconds))
        target = folder / f"{name}.png" if card is None else card / f"IMG_{number + 8}.png"
        cv2.imwrite(str(target), picture.astype(np.uint16) * 16)


def test_a_person_is_told_the_next_photograph_and_it_is_no_error(program, tmp_path, simulated):
    """Which pattern, for how long, under which name; on stdout, with an exit code of its own."""
    (folder := tmp_path / "my scan").mkdir()
    (card := tmp_path / "card").mkdir()
    (folder / "acquisition.toml").write_text(BY_HAND)
    program("acquire", "report", folder).refused(
        f"{folder / 'transport.zarr'}: ", "ltcl acquire run"
    )
    for step in range(15):
        outcome, report = (
            program("acquire", "run", folder),
            program("acquire", "run", folder, "--json"),
        )
        if outcome.code == 0:
            break
        assert (outcome.code, outcome.err, report.code, report.document["exit_code"]) == (
            3,
            "",
            3,
            3,
        )
        shot, missing = report.document["next"], report.document["missing"]
        next_run = f"ltcl acquire run '{folder}'"  # a shell takes it as it is
        for part in (shot["pattern"], f"{shot['seconds']:.6g} s", shot["save_as"], next_run):
            assert part in outcome.out
        assert ((folder / shot["pattern"]).is_file(), shot["number"] in missing) == (True, True)
        photograph(simulated, folder, missing, card if step >= 2 else None)
        if step >= 2:  # the camera's own files, which stay on its card
            program("acquire", "run", folder, "--take", card / "none").refused(f"{card / 'none'}: ")
            assert program("acquire", "run", folder, "--take", card).code in (0, 3)
            assert not {*missing} & {*FolderRig(folder, GRID, pattern_bits=16).missing()}
    assert error_of(folder, simulated) < 0.02


def test_how_the_next_pattern_comes(program, monkeypatch, tmp_path):
    calls = []
    monkeypatch.setattr(rigs, "show", lambda *args, **kwargs: calls.append((args, kwargs)) or 3)
    for options in ([], ["--display", "0", "--every", "2"], ["--arrival"]):
        assert program("show", tmp_path, *options, "--json").json == {
            "folder": str(tmp_path),
            "shown": 3,
        }
    assert [arguments for arguments, _ in calls] == [(tmp_path,)] * 3
    assert [(each["display"], each["advance"]) for _, each in calls] == [
        (1, "key"),
        (0, 2.0),
        (1, "arrival"),
    ]


@pytest.mark.parametrize("scene", ["dihedral", "trihedral", "box"])
def test_the_truth_is_that_of_the_scene(program, tmp_path, scene):
    truth = getattr(scenes, scene)(4, **({"sides": 5} if scene == "box" else {}))
    assert (
        "{} x {}".format(*truth.grid)
        in program("simulate", scene, "--size", 4, "--out", tmp_path).out
    )
    np.testing.assert_allclose(ltcl.load(tmp_path / "truth.npz").matrices[0], truth.matrices()[0])


def test_the_rig_is_as_asked_for(program, tmp_path):
    options = (
        "--size 4 --albedo 0.8,0.5,0.3 --response film --bits 8 --seed 5 --strategy hadamard --json"
    )
    options += " --ambient 0.05 --camera-grid 6x14 --projector-response gamma2.2"
    report = program("simulate", "dihedral", "--out", tmp_path, *options.split()).json
    assert (report["channels"], report["projector_grid"], report["options"]["bits"]) == (
        3,
        [4, 8],
        8,
    )
    project = Project.open(tmp_path)
    assert project.settings == {"geometry": "graycode", "strategy": "hadamard"}
    with project.rig() as rig:
        facts, seen = rig.describe(), rig.radiance(np.ones((4, 8, 3)))
    truth = ltcl.load(tmp_path / "truth.npz") @ np.ones((4, 8, 3), np.float32) + 0.05
    assert (seen.shape, seen.mean()) == ((6, 14, 3), pytest.approx(truth.mean(), rel=1e-5))
    expected = {"response": "film", "projector_response": "gamma2.2", "ambient": [0.05], "seed": 5}
    assert expected.items() <= facts.items()


def test_a_transport_file_is_a_scene_and_no_acquisition_is_overwritten(
    program, colour_transport, tmp_path
):
    report = program("simulate", colour_transport, "--out", tmp_path, "--json").json
    assert (report["channels"], report["projector_grid"]) == (3, [4, 12])
    common = ["simulate", "dihedral", "--out", tmp_path, "--size"]
    assert program(*common, 2).code == program(*common, 3).code == 0
    (tmp_path / "transport.zarr").mkdir()
    program(*common, 3).refused(f"{tmp_path}: ", "transport.zarr")
    (tmp_path / "transport.zarr").rmdir()
    (tmp_path / "simulate.json").unlink()
    program(*common, 3).refused(f"{tmp_path}: ", "acquisition.toml")


def test_mitsuba_renders_what_is_photographed(program, tmp_path):
    pytest.importorskip("mitsuba", reason='mitsuba is not installed: pip install "ltcl[rig]"')
    report = program(
        "simulate", "mitsuba:dihedral", "--grid", "6x8", "--out", tmp_path / "m", "--json"
    ).json
    assert (report["channels"], report["projector_grid"]) == (1, [6, 8])
    assert not (tmp_path / "m" / "truth.npz").exists()
    with Project.open(tmp_path / "m").rig() as rig:
        assert rig.photograph(np.ones((6, 8)), 0.5).max() > 100
    program("simulate", "mitsuba:nothing.xml", "--out", tmp_path / "n").refused("nothing.xml: ")
