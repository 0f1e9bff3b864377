# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire`: planned, run, ended early, run again, reported."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import FolderRig, VirtualRig
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
    return Path(shutil.copytree(acquired, tmp_path / "scan"))


def change(scan: Path, old: str, new: str) -> None:
    path = scan / "acquisition.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


class Ending:
    """A virtual rig whose photographs end, with this error, at one of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, at: int, error: BaseException) -> None:
        photograph, self.left = VirtualRig.photograph, at

        def end(rig: VirtualRig, codes: Any, seconds: float) -> np.ndarray:
            self.left -= 1
            if self.left == 0:
                raise error
            return photograph(rig, codes, seconds)

        monkeypatch.setattr(VirtualRig, "photograph", end)


def error_of(scan: Path, truth: Path) -> float:
    """Of T p for a pattern p that was not scanned, after one scale."""
    p = random.random(GRID).astype(np.float32)
    found, exact = (
        np.asarray(ltcl.load(path) @ p) for path in (scan / "transport.zarr", truth / "truth.npz")
    )
    scale = np.vdot(found, exact) / np.vdot(found, found)
    return float(np.linalg.norm(scale * found - exact) / np.linalg.norm(exact))


def test_photographs_become_a_transport_and_run_again_reports_it(program, acquired, monkeypatch):
    Ending(monkeypatch, 1, OSError("there is no rig"))
    told = program("acquire", "run", acquired, "--json").json
    assert (told["strategy"], told["grid"], told["coverage"]) == ("pixel", [4, 8], 1.0)
    assert told["error"][0] < 0.02
    assert error_of(acquired, acquired) < 0.02
    assert told == program("acquire", "report", acquired, "--json").json
    outcome = program("acquire", "report", acquired)
    assert "relative error of T p" in outcome.out
    assert f"transport in {acquired / 'transport.zarr'}" in outcome.out


def test_plans_before_and_after_the_calibration(program, simulated, acquired):
    before, after = (program("acquire", "plan", one, "--json").json for one in (simulated, acquired))
    assert (before["measured"], after["measured"]) == (False, True)
    for told in (before, after):
        assert set(told["plans"]) == {"adaptive", "pixel", "block", "hadamard"}
        assert told["asked_for"] == "pixel"
        pixel, coarse, count = told["plans"]["pixel"], told["plans"]["block"], len(told["exposures"])
        assert (pixel["grid"], coarse["grid"]) == ([4, 8], [2, 4])
        assert pixel["photographs"] == pixel["patterns"] * count + pixel["calibration"]
        assert told["auto"] in told["plans"]
    assert after["exposures"] == program("acquire", "report", acquired, "--json").json["exposures"]
    assert not (simulated / "transport.zarr").exists()
    slower = program("acquire", "plan", simulated, "--overhead", "10", "--json").json["plans"]["pixel"]
    more = slower["seconds"] - before["plans"]["pixel"]["seconds"]
    assert more == pytest.approx(10 * slower["photographs"])


def test_a_plan_is_a_table(program, scan):
    lines = program("acquire", "plan", scan).out.splitlines()
    assert lines[0] == f"{scan}: virtual rig, 1 channel(s)"
    assert {line.split()[0] for line in lines[4:8]} == {"adaptive", "pixel", "block", "hadamard"}
    assert "acquisition.toml asks for pixel; auto takes " in lines[-1]
    change(scan, '"pixel"', '"auto"')
    path = scan / "acquisition.toml"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())  # as Notepad writes it
    assert "\nauto takes " in program("acquire", "plan", scan).out


def test_run_goes_on_from_wherever_the_folder_stands(program, scan, acquired, monkeypatch):
    again = f"'ltcl acquire run {scan}' goes on"
    for at, error, code, parts in (
        (20, KeyboardInterrupt(), 130, ["19 photographs of the calibration are kept", again]),
        (200, KeyboardInterrupt(), 130, [f"is kept in {scan / 'transport.zarr'}", again]),
        (10, OSError("unplugged"), 1, ["unplugged", "is kept in", again]),
    ):
        program("acquire", "report", scan).refused("transport.zarr")
        with monkeypatch.context() as patch:
            Ending(patch, at, error)
            program("acquire", "run", scan).refused(*parts, code=code)
    change(scan, '"pixel"', '"hadamard"')
    program("acquire", "run", scan).refused("[acquire] strategy is 'hadamard'", "'pixel'")
    change(scan, '"hadamard"', '"pixel"')
    change(scan, '\nresponse = "film"', '\nresponse = "srgb"')
    program("acquire", "run", scan).refused("rig.response is 'srgb'", "'film'")
    change(scan, '\nresponse = "srgb"', '\nresponse = "film"')
    with monkeypatch.context() as patch:  # all is photographed, and the transport is not there
        patch.setattr(BlockStore, "finalize", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt()))
        assert program("acquire", "run", scan).code == 130
    change(scan, 'transport = "truth.npz"', 'transport = "unplugged.npz"')
    Ending(monkeypatch, 1, OSError("there is no rig"))
    change(scan, 'transport = "unplugged.npz"', 'transport = "truth.npz"')
    assert program("acquire", "finalize", scan, "--json").code == 0
    found, whole = (BlockStore.open(one / "transport.zarr") for one in (scan, acquired))
    for b in range(whole.layout.blocks()):
        np.testing.assert_array_equal(found.read(0, b).toarray(), whole.read(0, b).toarray())


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ('strategy = "pixel"', 'strategy = "hadamard"', ["strategy is 'hadamard'", "'pixel'"]),
        ('transport = "truth.npz"', 'transport = "truth.npz"\ngrid = [8, 4]', ["8", "4"]),
        ('\nresponse = "film"', '\nresponse = "srgb"', ["rig.response is 'srgb'", "'film'"]),
    ],
)
def test_a_finished_scan_is_not_that_of_other_settings(program, finished, old, new, parts):
    change(finished, old, new)
    program("acquire", "run", finished).refused("acquisition.toml: [", *parts)


def test_a_finished_live_scan_opens_no_camera(program, finished):
    path = finished / "acquisition.toml"
    live = '[rig]\nkind = "live"\n[rig.camera]\nkind = "opencv"\nsource = 999\nchannels = 1\n'
    settings = path.read_text().partition("\n[acquire]\n")[2]
    path.write_text(f"{live}[rig.display]\ngrid = [4, 8]\n[acquire]\n{settings}")
    assert program("acquire", "run", finished, "--json").json["strategy"] == "pixel"


def test_a_report_has_pictures(program, acquired, tmp_path):
    told = program("acquire", "report", acquired, "--out", tmp_path, "--json").json
    T, F = ltcl.load(acquired / "transport.zarr"), images.read(tmp_path / "first_bounce.exr")
    np.testing.assert_allclose(F, T.first_bounce.reshape(GRID), rtol=1e-6)
    white = images.read(tmp_path / "white.exr")
    np.testing.assert_allclose(white, T @ np.ones(GRID, np.float32), rtol=0.03)
    assert all((tmp_path / f"{name}.png").is_file() for name in ("ambient", "coverage", "white"))
    assert told["folder"] == str(acquired)


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("bits = 12", "bits = 99", "[rig] bits is 99"),
        ("bits = 12", "bits = 12\ncamera_grid = [8, 8]", "[rig] camera_grid is 8 x 8"),
        ("bits = 12", "bits = 12\nexposures = [0.5]", "rig.exposures has one exposure"),
        ("ambient = 0.05", "ambient = nan", "[rig] ambient has 1 NaN"),
        ('geometry = "aligned"', 'geometry = "stripes"', "[acquire] geometry is 'stripes'"),
        ('strategy = "pixel"', "order = 64", "[acquire] order is 64"),
        ('strategy = "pixel"', "exposures = [0.5, 40]", "[acquire] exposures has 40 s"),
        ('strategy = "pixel"', "sigmas = -1", "[acquire] sigmas is -1"),
    ],
)
def test_settings_are_refused_by_file_and_table(program, scan, old, new, part):
    change(scan, old, new)
    for command in ("plan", "run"):
        program("acquire", command, scan).refused(f"{scan / 'acquisition.toml'}: ", part)
    assert not (scan / "transport.zarr").exists()


def test_progress_goes_from_the_calibration_to_all_patterns(program, scan):
    lines = program("acquire", "run", scan, "--verbose").err.splitlines()
    for stage in ("calibration", "scan", "relative error of T p"):
        assert any(stage in line for line in lines), stage


FOLDER = """\
[rig]
kind = "folder"
projector_grid = [4, 8]
pattern_bits = 16

[acquire]
geometry = "aligned"
strategy = "pixel"
response = "linear"
exposures = [0.5, 8.0]
frames = 2
"""


@pytest.fixture
def by_hand(tmp_path: Path) -> Path:
    """A folder rig's acquisition, of which nothing is there yet."""
    (tmp_path / "hand").mkdir()
    (tmp_path / "hand" / "acquisition.toml").write_text(FOLDER)
    return tmp_path / "hand"


@pytest.fixture
def scene(simulated: Path) -> VirtualRig:
    T = ltcl.load(simulated / "truth.npz")
    return VirtualRig(T, T.grid, bits=12, response="linear", black=0.0, ambient=0.01)


def photograph(scene: VirtualRig, folder: Path, to: Path | None = None) -> int:
    """Photographs of the shooting list that are not there yet, as a person would take them; their number."""
    count = 0
    for row in (folder / "shots.csv").read_text().splitlines()[1:]:
        number, pattern, seconds, save = row.split(",")
        target = folder / f"{save}.png"
        if not target.exists():
            codes = np.asarray(cv2.imread(str(folder / pattern), cv2.IMREAD_UNCHANGED), np.float32) / 65535
            taken = scene.photograph(codes, float(seconds)).astype(np.uint16) * 16
            cv2.imwrite(str(target if to is None else to / f"IMG_{int(number) + 8}.png"), taken)
            count += 1
    return count


def test_a_person_is_told_the_next_photograph_and_it_is_no_error(program, by_hand, scene, simulated):
    """Which pattern, for how long, under which name; on stdout, with an exit code of its own."""
    rounds, outcome = 0, program("acquire", "run", by_hand)
    while outcome.code:
        rounds += 1
        assert rounds < 15
        assert (outcome.code, outcome.err) == (3, "")
        told = program("acquire", "run", by_hand, "--json")
        assert (told.code, told.document["exit_code"]) == (3, 3)
        shot = told.document["next"]
        assert shot["number"] in told.document["missing"]
        for part in (shot["pattern"], f"{shot['seconds']:.6g} s", shot["save_as"], "ltcl acquire run"):
            assert part in outcome.out
        assert (by_hand / shot["pattern"]).is_file()
        assert photograph(scene, by_hand) == len(told.document["missing"])
        outcome = program("acquire", "run", by_hand)
    assert "reciprocity" in outcome.out
    assert error_of(by_hand, simulated) < 0.02


def test_files_of_the_camera_are_taken(program, by_hand, scene):
    card = by_hand / "card"
    card.mkdir()
    missing = program("acquire", "run", by_hand, "--json").document["missing"]
    while len(missing) <= 2:
        assert photograph(scene, by_hand) == len(missing)
        missing = program("acquire", "run", by_hand, "--json").document["missing"]
    assert photograph(scene, by_hand, card) == len(missing)
    (spare := card / "IMG_1.png").write_bytes(b"")
    program("acquire", "run", by_hand, "--take", card).refused(f"{len(missing) + 1}", f"{len(missing)}")
    spare.unlink()
    program("acquire", "run", by_hand, "--take", card / "none").refused("none: is no folder")
    outcome = program("acquire", "run", by_hand, "--take", card)
    assert outcome.code in (0, 3), outcome.err
    assert not set(missing) & set(FolderRig(by_hand, GRID, pattern_bits=16).missing())


def test_take_is_for_folder_rigs_and_no_file_is_no_acquisition(program, scan):
    program("acquire", "run", scan, "--take", scan).refused("--take", "virtual")
    program("acquire", "run", scan / "nowhere").refused("acquisition.toml: no such file", "ltcl simulate")
