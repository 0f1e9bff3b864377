# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire`: planned, run, ended early, resumed, finalized, reported."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import FolderRig, VirtualRig
from ltcl.cli import console
from ltcl.store import BlockStore
from ltcl.store.blocks.shelf import Shelf

from .conftest import Program

GRID = (4, 8)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A corner of two walls; nothing is photographed here."""
    from ltcl.cli.main import main

    out = tmp_path_factory.mktemp("simulated") / "scan"
    arguments = [
        "--size",
        "4",
        "--strategy",
        "pixel",
        "--response",
        "film",
        "--projector-response",
        "gamma2.2",
    ]
    assert main(["simulate", "dihedral", "--out", str(out), *arguments, "--ambient", "0.02"]) == 0
    return out


@pytest.fixture
def scan(simulated: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(simulated, tmp_path / "scan"))


@pytest.fixture(scope="module")
def acquired(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another one, all photographed; not to be changed."""
    from ltcl.cli.main import main

    scan = Path(shutil.copytree(simulated, tmp_path_factory.mktemp("acquired") / "scan"))
    assert main(["acquire", "run", str(scan)]) == 0
    return scan


class Ending:
    """A virtual rig whose photographs end, with this error, at one of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, at: int, error: BaseException) -> None:
        photograph, self.left = VirtualRig.photograph, at

        def taken(rig: VirtualRig, codes: Any, seconds: float) -> np.ndarray:
            self.left -= 1
            if self.left == 0:
                raise error
            return photograph(rig, codes, seconds)

        monkeypatch.setattr(VirtualRig, "photograph", taken)


def test_photographs_become_a_transport(program: Program, scan: Path) -> None:
    told = program("acquire", "run", scan, "--json").json
    assert (told["strategy"], told["grid"], told["coverage"]) == ("pixel", [4, 8], 1.0)
    assert told["off"][0] < 0.02
    T, truth = ltcl.load(scan / "transport.zarr"), ltcl.load(scan / "truth.npz")
    p = np.random.default_rng(0).random(GRID).astype(np.float32)
    found, wanted = np.asarray(T @ p), np.asarray(truth @ p)
    scale = np.vdot(found, wanted) / np.vdot(found, found)
    assert np.linalg.norm(scale * found - wanted) < 0.02 * np.linalg.norm(wanted)
    program("acquire", "run", scan).refused("transport.zarr: is finished; 'ltcl acquire report")
    again = program("acquire", "resume", scan)
    assert (again.code, again.err) == (0, f"ltcl: {scan / 'transport.zarr'}: is finished already\n")


def test_a_camera_of_its_own_pixels(program: Program, tmp_path: Path) -> None:
    """Compared with the truth on the projector's pixels, not with what this camera tells apart."""
    arguments = ["--size", "6", "--camera-grid", "18x36", "--strategy", "hadamard"]
    assert program("simulate", "dihedral", *arguments, "--out", tmp_path).code == 0
    told = program("acquire", "run", tmp_path, "--json").json
    T, truth = ltcl.load(tmp_path / "transport.zarr", on_dark="mask"), ltcl.load(tmp_path / "truth.npz")
    p = (np.random.default_rng(5).random((6, 12)) < 0.5).astype(np.float32)
    seen = ~T.masked.reshape(6, 12)
    found, wanted = np.asarray(T @ p)[seen], np.asarray(truth @ p)[seen]
    scale = np.vdot(found, wanted) / np.vdot(found, found)
    off = np.linalg.norm(scale * found - wanted) / np.linalg.norm(wanted)
    assert told["off"][0] == pytest.approx(off, rel=0.5)


def test_plans_before_and_after_the_calibration(program: Program, scan: Path, acquired: Path) -> None:
    before, after = (program("acquire", "plan", one, "--json").json for one in (scan, acquired))
    assert (before["measured"], after["measured"]) == (False, True)
    for told in (before, after):
        assert set(told["plans"]) == {"adaptive", "pixel", "block", "hadamard"}
        assert told["asked_for"] == "pixel"
        pixel, coarse = told["plans"]["pixel"], told["plans"]["block"]
        assert (pixel["grid"], coarse["grid"]) == ([4, 8], [2, 4])
        assert pixel["photographs"] == pixel["patterns"] * len(told["exposures"])
        better = min(("pixel", "hadamard"), key=lambda name: told["plans"][name]["error"])
        assert told["auto"] in (better, "adaptive")
        assert told["plans"][told["auto"]]["error"] <= 1.5 * told["plans"][better]["error"]
    assert after["exposures"] == pytest.approx(
        program("acquire", "report", acquired, "--json").json["exposures"]
    )
    assert not (scan / "transport.zarr").exists()
    slower = program("acquire", "plan", scan, "--overhead", "10", "--json").json["plans"]["pixel"]
    more = slower["seconds"] - before["plans"]["pixel"]["seconds"]
    assert more == pytest.approx(10 * slower["photographs"])


def test_a_plan_is_a_table(program: Program, scan: Path) -> None:
    outcome = program("acquire", "plan", scan)
    assert outcome.code == 0, outcome.err
    lines = outcome.out.splitlines()
    assert lines[0] == f"{scan}: virtual rig, 1 channel(s)"
    assert "guessed; the calibration will measure them" in lines[1]
    assert {line.split()[0] for line in lines[4:8]} == {"adaptive", "pixel", "block", "hadamard"}
    assert "acquisition.toml asks for pixel; auto would take " in lines[-1]
    (scan / "acquisition.toml").write_text(
        (scan / "acquisition.toml").read_text().replace('"pixel"', '"auto"')
    )
    assert "\nauto takes " in program("acquire", "plan", scan).out


def test_what_is_interrupted_is_resumed(
    program: Program, scan: Path, acquired: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        Ending(patch, 20, KeyboardInterrupt())
        early = program("acquire", "run", scan)
    assert (early.code, early.out) == (130, "")
    place = f"{scan / 'transport.zarr'}.calibration"
    assert f"19 photographs of the calibration are kept in {place}, 'ltcl acquire resume" in early.err
    program("acquire", "run", scan).refused(
        f"{place}: holds 19 photographs", f"acquire resume {scan}' goes on"
    )
    program("acquire", "report", scan).refused("is not begun; 'ltcl acquire resume")
    with monkeypatch.context() as patch:
        Ending(patch, 200, KeyboardInterrupt())
        late = program("acquire", "resume", scan)
    assert late.code == 130
    assert f"is kept in {scan / 'transport.zarr'}, 'ltcl acquire resume {scan}' goes on" in late.err
    program("acquire", "run", scan).refused(f"is begun; 'ltcl acquire resume {scan}' goes on")
    program("acquire", "report", scan).refused("is still being scanned")
    program("acquire", "finalize", scan).refused("batches of patterns are not photographed", "acquire resume")
    with monkeypatch.context() as patch:
        Ending(patch, 10, OSError("unplugged"))
        program("acquire", "resume", scan).refused("unplugged", "is kept in", "goes on")
    assert program("acquire", "resume", scan, "--json").code == 0
    found, whole = (BlockStore.open(one / "transport.zarr") for one in (scan, acquired))
    for b in range(whole.layout.blocks()):
        np.testing.assert_array_equal(found.read(0, b).toarray(), whole.read(0, b).toarray())


def test_a_process_that_is_stopped_exits_with_130(scan: Path) -> None:
    code = (
        "import os, signal\nfrom ltcl.acquisition import VirtualRig\nfrom ltcl.cli.main import main\n"
        "take, count = VirtualRig.photograph, [150]\n"
        "def photograph(*a):\n"
        "    count[0] -= 1\n"
        "    count[0] or os.kill(os.getpid(), signal.SIGINT)\n"
        "    return take(*a)\n"
        f"VirtualRig.photograph = photograph\nraise SystemExit(main(['acquire', 'run', {str(scan)!r}]))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 130, run.stderr
    assert "ltcl acquire resume" in run.stderr
    assert "Traceback" not in run.stderr


def test_resume_of_nothing_begins(program: Program, scan: Path) -> None:
    program("acquire", "finalize", scan).refused("is not begun; 'ltcl acquire run")
    program("acquire", "report", scan).refused("is not begun; 'ltcl acquire run")
    outcome = program("acquire", "resume", scan)
    assert outcome.code == 0
    assert "is not begun yet, so this begins with the calibration" in outcome.err
    assert "T p is off by " in outcome.out


def test_finalize_needs_no_rig(program: Program, scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(BlockStore, "finalize", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt()))
        assert program("acquire", "run", scan).code == 130
    Ending(monkeypatch, 1, OSError("there is no rig"))
    assert program("acquire", "finalize", scan, "--json").json["before"] is False
    assert program("acquire", "finalize", scan).out == f"{scan / 'transport.zarr'}: is finished already\n"
    assert ltcl.load(scan / "transport.zarr").grid == GRID


def test_a_report_has_pictures(program: Program, acquired: Path, tmp_path: Path) -> None:
    outcome = program("acquire", "report", acquired, "--out", tmp_path / "seen")
    assert outcome.code == 0, outcome.err
    assert "reciprocity defect" in outcome.out
    assert outcome.out.endswith(f"pictures in {tmp_path / 'seen'}\n")
    F = images.read(tmp_path / "seen" / "first_bounce.exr")
    np.testing.assert_allclose(
        F, ltcl.load(acquired / "transport.zarr").first_bounce.reshape(GRID), rtol=1e-6
    )
    white = images.read(tmp_path / "seen" / "white.exr")
    np.testing.assert_allclose(
        white, ltcl.load(acquired / "transport.zarr") @ np.ones(GRID, np.float32), rtol=0.03
    )
    assert (tmp_path / "seen" / "coverage.png").is_file()


def test_settings_are_refused_by_file_and_table(program: Program, scan: Path, acquired: Path) -> None:
    path = scan / "acquisition.toml"
    text = path.read_text()
    for old, new, part in (
        ("bits = 12", "bits = 99", "[rig] bits is 99"),
        ('geometry = "aligned"', 'geometry = "stripes"', "[acquire] geometry is 'stripes'"),
        ("bits = 12", "bits = 12.0", "[rig] bits is 12.0"),
        ("bits = 12", "bits = 12\ncamera_grid = [8, 8]", "[rig] camera_grid is 8 x 8"),
        ("bits = 12", "bits = 12\nblack = 1.0", "[rig] black is 1.0"),
        ("bits = 12", "bits = 12\nexposures = [0.5]", "[acquire] rig.exposures has one exposure"),
        ("ambient = 0.02", "ambient = nan", "[rig] ambient has 1 NaN"),
        ('strategy = "pixel"', "order = 64", "[acquire] order is 64"),
        ('strategy = "pixel"', 'strategy = "spiral"', "[acquire] strategy is 'spiral'"),
        ('strategy = "pixel"', "exposures = []", "[acquire] exposures is []"),
        ('strategy = "pixel"', "exposures = [0.5, 40]", "[acquire] exposures has 40 s; the rig takes 0.0001"),
        ('strategy = "pixel"', "threshold = 1.5", "[acquire] threshold is 1.5"),
        ('strategy = "pixel"', "frames = 1.5", "[acquire] frames is 1.5"),
        ('strategy = "pixel"', "sigmas = -1", "[acquire] sigmas is -1"),
        ('geometry = "aligned"', 'geometry = "given"', "[acquire] geometry is 'given'"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        for command in ("plan", "run"):
            program("acquire", command, scan).refused(f"{path}: {part}")
    assert not (scan / "transport.zarr").exists()
    program("acquire", "plan", scan / "nowhere").refused("acquisition.toml: no such file; 'ltcl simulate'")


@pytest.mark.skipif(sys.platform == "win32", reason="folders are not locked there")
def test_a_calibration_that_another_process_is_at_is_not_said_to_have_ended(
    program: Program, scan: Path
) -> None:
    place = scan / "transport.zarr.calibration"
    with Shelf(place, {"rig": {}}) as shelf:
        shelf.put("shot", np.zeros(2))
        for command in ("run", "resume"):
            program("acquire", command, scan).refused(f"{place}: another process is at work there")
    program("acquire", "run", scan).refused("holds 1 photographs of a calibration that has not ended")


def test_a_file_with_a_byte_order_mark_is_read(program: Program, scan: Path) -> None:
    path = scan / "acquisition.toml"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert program("acquire", "plan", scan).code == 0


def test_other_settings_than_begun_with(
    program: Program, scan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        Ending(patch, 200, KeyboardInterrupt())
        assert program("acquire", "run", scan).code == 130
    path = scan / "acquisition.toml"
    path.write_text(path.read_text().replace('strategy = "pixel"', 'strategy = "hadamard"'))
    program("acquire", "resume", scan).refused("[acquire] strategy is 'hadamard'", "was begun with 'pixel'")


def test_another_rig_than_begun_with(program: Program, scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        Ending(patch, 200, KeyboardInterrupt())
        assert program("acquire", "run", scan).code == 130
    path = scan / "acquisition.toml"
    text = path.read_text()
    path.write_text(text.replace('\nresponse = "film"', '\nresponse = "srgb"'))
    program("acquire", "resume", scan).refused("rig.response is 'srgb'", "was begun with 'film'")
    path.write_text(text)
    assert program("acquire", "resume", scan).code == 0


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ('strategy = "pixel"', 'strategy = "hadamard"', "[acquire] strategy is 'hadamard'"),
        ('transport = "truth.npz"', 'transport = "truth.npz"\ngrid = [8, 4]', "rig has (8, 4) pixels"),
        ('\nresponse = "film"', '\nresponse = "srgb"', "rig.response is 'srgb'"),
    ],
)
def test_a_finished_scan_is_not_that_of_other_settings(
    program: Program, acquired: Path, tmp_path: Path, old: str, new: str, part: str
) -> None:
    scan = Path(shutil.copytree(acquired, tmp_path / "scan"))
    path = scan / "acquisition.toml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    program("acquire", "resume", scan).refused(part, "was begun with", "or another store")


def test_a_finished_live_scan_opens_no_camera(program: Program, acquired: Path, tmp_path: Path) -> None:
    scan = Path(shutil.copytree(acquired, tmp_path / "scan"))
    path = scan / "acquisition.toml"
    live = '[rig]\nkind = "live"\n[rig.camera]\nkind = "opencv"\nsource = 999\nchannels = 1\n'
    settings = path.read_text().partition("\n[acquire]\n")[2]
    for grid, code in (("[4, 8]", 0), ("[8, 8]", 1)):
        path.write_text(f"{live}[rig.display]\ngrid = {grid}\n[acquire]\n{settings}")
        outcome = program("acquire", "resume", scan)
        assert outcome.code == code, outcome.err
    assert "rig has (8, 8) pixels" in outcome.err


def test_progress_is_told(program: Program, scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "_PATIENCE", -1.0)
    monkeypatch.setattr(console, "_AGAIN", 0.0)
    lines = program("acquire", "run", scan).err.splitlines()
    told = [line.removeprefix("ltcl: calibration: ").split() for line in lines if "calibration: " in line]
    stages, numbers = [words[0].rstrip(",") for words in told], [int(words[-1]) for words in told]
    wanted = ["exposure", "response", "geometry", "noise", "exposures", "black", "white", "projector"]
    assert stages == wanted
    assert numbers[0] == 1
    assert numbers == sorted(numbers)
    assert numbers[-1] > 50
    assert any(line.startswith("ltcl: pixel: ") for line in lines)
    counted = [line.split()[1] for line in lines if " of 34 patterns" in line and "pixel: " not in line]
    assert counted == [str(n) for n in range(35)]


FOLDER = """\
[rig]
kind = "folder"
projector_grid = [4, 8]
camera_bits = 12
pattern_bits = 16

[acquire]
geometry = "aligned"
strategy = "pixel"
response = "linear"
exposures = [0.5, 8.0]
frames = 2
"""


def photographed(scene: VirtualRig, folder: Path, most: int = 10**6) -> int:
    """Photographs of the shooting list that are not there yet, as a person would take them."""
    taken = 0
    for row in (folder / "shots.csv").read_text().splitlines()[1:]:
        _, pattern, seconds, save = row.split(",")
        target = folder / f"{save}.png"
        if target.exists() or taken == most:
            continue
        codes = np.asarray(cv2.imread(str(folder / pattern), cv2.IMREAD_UNCHANGED), np.float32) / 65535
        cv2.imwrite(str(target), scene.photograph(codes, float(seconds)).astype(np.uint16) * 16)
        taken += 1
    return taken


@pytest.fixture
def by_hand(tmp_path: Path) -> Path:
    """A folder rig's acquisition, of which nothing is there yet."""
    folder = tmp_path / "hand"
    folder.mkdir()
    (folder / "acquisition.toml").write_text(FOLDER.replace("camera_bits = 12\n", ""))
    return folder


def scene_of(simulated: Path) -> VirtualRig:
    T = ltcl.load(simulated / "truth.npz")
    return VirtualRig(T, T.grid, bits=12, response="linear", black=0.0, ambient=0.01)


def test_a_person_photographs(program: Program, by_hand: Path, simulated: Path) -> None:
    scene, rounds = scene_of(simulated), 0
    outcome = program("acquire", "run", by_hand)
    while outcome.code:
        rounds += 1
        assert rounds < 15
        outcome.refused("photograph(s) are missing: ", f"then: ltcl acquire resume {by_hand}")
        count = photographed(scene, by_hand)
        assert f"error: {count} photograph(s)" in outcome.err
        outcome = program("acquire", "resume", by_hand)
    assert "reciprocity defect" in outcome.out
    T, truth = ltcl.load(by_hand / "transport.zarr"), ltcl.load(simulated / "truth.npz")
    p = np.random.default_rng(0).random(GRID).astype(np.float32)
    found, wanted = np.asarray(T @ p), np.asarray(truth @ p)
    scale = np.vdot(found, wanted) / np.vdot(found, found)
    assert np.linalg.norm(scale * found - wanted) < 0.02 * np.linalg.norm(wanted)


def test_files_of_the_camera_are_taken(program: Program, by_hand: Path, simulated: Path) -> None:
    scene, card = scene_of(simulated), by_hand / "card"
    program("acquire", "run", by_hand).refused("1 photograph(s) are missing: 1;")
    rig = FolderRig(by_hand, GRID, pattern_bits=16)
    while len(missing := rig.missing()) <= 2:
        assert photographed(scene, by_hand) == len(missing)
        program("acquire", "resume", by_hand).refused("photograph(s) are missing")
        rig = FolderRig(by_hand, GRID, pattern_bits=16)
    before = set((by_hand / "photographs").iterdir())
    assert photographed(scene, by_hand, 2) == 2
    card.mkdir()
    for number, path in enumerate(sorted(set((by_hand / "photographs").iterdir()) - before)):
        path.rename(card / f"IMG_{9 + number}.png")
    outcome = program("acquire", "resume", by_hand, "--take", card)
    outcome.refused(f"{card}: holds 2 files, but {len(missing)} photographs are missing")
    program("acquire", "resume", by_hand, "--take", card / "none").refused("is no folder; --take needs")
    photographed(scene, by_hand)
    for number in missing[:2]:
        (by_hand / "photographs" / f"photo_{number:06d}.png").unlink()
    assert program("acquire", "resume", by_hand, "--take", card).err != outcome.err
    assert not set(missing) & set(FolderRig(by_hand, GRID, pattern_bits=16).missing())


def test_a_name_that_is_no_number_is_told(program: Program, by_hand: Path) -> None:
    program("acquire", "run", by_hand)
    (by_hand / "photographs" / "IMG_1.png").write_bytes(b"x")
    program("acquire", "resume", by_hand).refused(
        "are missing: 1;", "('IMG_1.png' there is the name of no photograph"
    )


def test_take_is_for_folders(program: Program, scan: Path) -> None:
    program("acquire", "resume", scan, "--take", scan).refused(
        "--take is given, but the rig of", "is virtual"
    )


@pytest.mark.parametrize("command", ["plan", "run", "resume", "finalize", "report"])
def test_every_command_explains_itself(program: Program, command: str) -> None:
    outcome = program("acquire", command, "--help")
    assert outcome.code == 0
    assert "--json" in outcome.out
    assert program("acquire", command).code == 2
