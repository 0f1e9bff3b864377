# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire` and `show`: scans planned, run, ended early, run again, reported."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import FolderRig, Project, VirtualRig, rigs
from ltcl.store import BlockStore

GRID = (4, 8)
random = np.random.default_rng(0)


@pytest.fixture
def scan(simulated: Path, tmp_path: Path) -> Path:
    """A copy of a simulated folder without photographs."""
    return Path(shutil.copytree(simulated, tmp_path / "scan"))


@pytest.fixture
def finished(acquired: Path, tmp_path: Path) -> Path:
    """A copy of a folder with all photographs."""
    return Path(shutil.copytree(acquired, tmp_path / "finished"))


def change(scan: Path, old: str, new: str) -> None:
    path = scan / "acquisition.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def raise_at(number: int, error: BaseException) -> Callable[..., np.ndarray]:
    """Make a method for VirtualRig that raises an error at a photograph."""
    photograph = VirtualRig.photograph
    count = 0

    def photograph_or_raise(rig: VirtualRig, codes: Any, seconds: float) -> np.ndarray:
        nonlocal count
        count += 1
        if count == number:
            raise error
        return photograph(rig, codes, seconds)

    return photograph_or_raise


def forbid_photographs(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(VirtualRig, "photograph", raise_at(1, OSError("there is no rig")))


def relative_error(scan: Path, truth: Path) -> float:
    """Return the relative error of T p for a pattern p that was not scanned, after one scale."""
    p = random.random(GRID).astype(np.float32)
    measured = np.asarray(ltcl.load(scan / "transport.zarr") @ p)
    exact = np.asarray(ltcl.load(truth / "truth.npz") @ p)
    scale = np.vdot(measured, exact) / np.vdot(measured, measured)
    return float(np.linalg.norm(scale * measured - exact) / np.linalg.norm(exact))


def test_photographs_become_a_transport_and_run_again_reports_it(program, acquired, monkeypatch):
    forbid_photographs(monkeypatch)
    report = program("acquire", "run", acquired, "--json").json
    assert report["strategy"] == "pixel"
    assert report["grid"] == [4, 8]
    assert report["coverage"] == 1.0
    assert report["error"][0] < 0.02
    assert relative_error(acquired, acquired) < 0.02
    assert report == program("acquire", "report", acquired, "--json").json
    printed = program("acquire", "report", acquired).out
    for text in ("T p", f"{report['error'][0]:.2%}", f"{acquired}/transport.zarr"):
        assert text in printed


@pytest.mark.slow
def test_plans_before_and_after_the_calibration(program, simulated, acquired):
    before = program("acquire", "plan", simulated, "--json").json
    after = program("acquire", "plan", acquired, "--json").json
    assert not before["measured"]
    assert after["measured"]
    assert not (simulated / "transport.zarr").exists()
    lines = program("acquire", "plan", simulated).out.splitlines()
    for report in (before, after):
        assert {*report["plans"]} == {line.split()[0] for line in lines[4:10]}
        assert report["auto"] in report["plans"]
        assert report["asked_for"] == "pixel"
        assert report["plans"]["block"]["grid"] == [2, 4]
        pixel = report["plans"]["pixel"]
        exposures = len(report["exposures"])
        # Two photographs are taken again, one for each batch.
        photographs = pixel["patterns"] * exposures + 2 + pixel["calibration"]
        assert pixel["photographs"] == photographs
        computing = pixel["photographs"] * report["megapixels"] * report["pace"]
        assert pixel["computing"] == pytest.approx(computing)
        assert report["megapixels"] == pytest.approx(pixel["grid"][0] * pixel["grid"][1] / 1e6)
    assert after["exposures"] == program("acquire", "report", acquired, "--json").json["exposures"]


def test_a_plan_says_rounds(program, simulated):
    report = program("acquire", "plan", simulated, "--json").json
    assert report["rounds"] == 0
    first = report["plans"]["sketch"]["photographs"]
    with (simulated / "acquisition.toml").open("a") as file:
        file.write(f"photographs = {first + 40}\n")
    report = program("acquire", "plan", simulated, "--json").json
    assert (report["rounds"], report["photographs_of_round"]) == (3, 17)
    text = program("acquire", "plan", simulated).out
    assert "up to 3 rounds, of at most 17 photographs each" in text


def test_overhead_counts_for_each_photograph(program, simulated):
    fast = program("acquire", "plan", simulated, "--json").json["plans"]["pixel"]
    slow = program("acquire", "plan", simulated, "--overhead", "10", "--json").json["plans"][
        "pixel"
    ]
    more = slow["seconds"] - fast["seconds"]
    assert more == pytest.approx(10 * slow["photographs"])


@pytest.mark.rare
def test_a_run_continues_from_each_state_of_the_folder(program, scan, acquired, monkeypatch):
    again = f"'ltcl acquire run {scan}' goes on"
    ends = [
        (20, KeyboardInterrupt(), 130, ["19 photographs", again]),
        (200, KeyboardInterrupt(), 130, [f"{scan / 'transport.zarr'}", again]),
        (10, OSError("unplugged"), 1, ["unplugged", "transport.zarr", again]),
    ]
    for number, error, code, parts in ends:
        program("acquire", "report", scan).assert_refused("transport.zarr")
        with monkeypatch.context() as patch:
            patch.setattr(VirtualRig, "photograph", raise_at(number, error))
            program("acquire", "run", scan).assert_refused(*parts, code=code)

    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        # All photographs are taken, and the transport is not there.
        patch.setattr(BlockStore, "finalize", interrupt)
        assert program("acquire", "run", scan).code == 130
    forbid_photographs(monkeypatch)
    assert program("acquire", "run", scan, "--json").code == 0
    resumed = BlockStore.open(scan / "transport.zarr")
    whole = BlockStore.open(acquired / "transport.zarr")
    for number in range(whole.layout.blocks()):
        np.testing.assert_array_equal(
            resumed.block(0, number).matrix.toarray(), whole.block(0, number).matrix.toarray()
        )


def test_a_live_scan_with_all_photographs_opens_no_camera(program, finished):
    path = finished / "acquisition.toml"
    settings = path.read_text().partition("\n[acquire]\n")[2]
    camera = '[rig.camera]\nkind = "opencv"\nsource = 999\nchannels = 1\n'
    display = "[rig.display]\ngrid = [4, 8]\n"
    path.write_text(f'[rig]\nkind = "live"\n{camera}{display}[acquire]\n{settings}')
    assert program("acquire", "run", finished, "--json").json["strategy"] == "pixel"
    shutil.rmtree(finished / "transport.zarr")
    assert program("acquire", "run", finished).code == 1


@pytest.mark.slow
def test_a_scan_with_other_settings_is_refused(program, finished):
    """The table is named that the setting stands in."""
    change(finished, "bits = 12", "bits = 14")
    program("acquire", "run", finished).assert_refused(
        "acquisition.toml: [rig]", "bits is 14", "12"
    )
    change(finished, "bits = 14", "bits = 12")
    change(finished, 'strategy = "pixel"', 'strategy = "hadamard"')
    outcome = program("acquire", "run", finished)
    outcome.assert_refused("acquisition.toml: [acquire]", "strategy is 'hadamard'", "'pixel'")


@pytest.mark.parametrize("command", ["plan", "run"])
def test_a_bad_setting_is_refused_and_nothing_is_written(program, scan, command):
    change(scan, "bits = 12", "bits = 99")
    outcome = program("acquire", command, scan)
    outcome.assert_refused(f"{scan / 'acquisition.toml'}: [rig] bits is 99")
    names = sorted(path.name for path in scan.iterdir())
    assert names == ["acquisition.toml", "simulate.json", "truth.npz"]


BY_HAND = """
[rig]
kind = "folder"
projector_grid = [4, 8]
pattern_bits = 16
[acquire]
frames = 2
geometry = "aligned"
strategy = "pixel"
response = "linear"
exposures = [0.5, 8.0]
"""


def photograph(truth: Path, folder: Path, missing: list[int], card: Path | None) -> None:
    """Take the missing photographs, into the folder or onto the camera's card."""
    T = ltcl.load(truth / "truth.npz")
    scene = VirtualRig(
        T, T.grid, bits=12, response="linear", black=0.0, ambient=0.01, seed=missing[0]
    )
    rows = [row.split(",") for row in (folder / "shots.csv").read_text().splitlines()]
    for number in missing:
        _, pattern, seconds, name = rows[number]
        codes = images.read_codes(folder / pattern) / 65535
        picture = scene.photograph(codes, float(seconds))
        target = folder / f"{name}.png" if card is None else card / f"IMG_{number + 8}.png"
        cv2.imwrite(str(target), picture.astype(np.uint16) * 16)


@pytest.mark.rare
def test_a_person_is_told_the_next_photograph_and_it_is_no_error(program, tmp_path, simulated):
    """Pattern, exposure and name are on stdout, with an exit code of its own."""
    folder = tmp_path / "my scan"
    folder.mkdir()
    card = tmp_path / "card"
    card.mkdir()
    (folder / "acquisition.toml").write_text(BY_HAND)
    store = folder / "transport.zarr"
    program("acquire", "report", folder).assert_refused(f"{store}: ", "ltcl acquire run")
    for step in range(15):
        outcome = program("acquire", "run", folder)
        if outcome.code == 0:
            break
        assert outcome.code == 3
        assert outcome.err == ""
        report = program("acquire", "run", folder, "--json").document
        assert report["exit_code"] == 3
        shot = report["next"]
        missing = report["missing"]
        # A shell takes the command as it is.
        next_run = f"ltcl acquire run '{folder}'"
        for part in (shot["pattern"], f"{shot['seconds']:.6g} s", shot["save_as"], next_run):
            assert part in outcome.out
        assert (folder / shot["pattern"]).is_file()
        assert shot["number"] in missing
        if step < 2:
            photograph(simulated, folder, missing, None)
            continue
        # The camera's own files stay on its card.
        photograph(simulated, folder, missing, card)
        program("acquire", "run", folder, "--take", card / "none").assert_refused(
            f"{card / 'none'}: "
        )
        assert program("acquire", "run", folder, "--take", card).code in (0, 3)
        still_missing = FolderRig(folder, GRID, pattern_bits=16).missing()
        assert not {*missing} & {*still_missing}
    assert relative_error(folder, simulated) < 0.02


def dim(scan: Path, lamp: float) -> None:
    """Replace the scene of a scan by one with an older lamp."""
    T = ltcl.load(scan / "truth.npz")
    ltcl.save(scan / "truth.npz", ltcl.Transport(lamp * np.asarray(T.matrices[0]), T.grid))


@pytest.mark.slow
def test_a_scan_is_carried_over_to_an_older_lamp(program, finished):
    before = program("acquire", "report", finished, "--json").json
    dim(finished, 0.9)
    report = program("acquire", "update", finished, "--json").json
    assert report["store"] == str(finished / "updated.zarr")
    assert report["scan"] == str(finished / "transport.zarr")
    assert report["photographs"] == 12
    assert report["gain"][0] == pytest.approx(0.9, abs=0.01)
    assert report["largest"] == 0.0
    assert report["holds"]
    assert report["previous_error"] is None
    program("acquire", "update", finished).assert_refused("updated.zarr: exists")
    printed = program("acquire", "update", finished, "--store", finished / "again.zarr").out
    for text in ("12 photographs", "nothing has moved", "the update holds", "again.zarr"):
        assert text in printed
    # The old scan is as it was, but for the scene that it is compared with.
    after = program("acquire", "report", finished, "--json").json
    assert after["photographs"] == before["photographs"]
    p = random.random(GRID).astype(np.float32)
    old = np.asarray(ltcl.load(finished / "transport.zarr") @ p)
    new = np.asarray(ltcl.load(finished / "updated.zarr") @ p)
    assert np.linalg.norm(new - 0.9 * old) < 0.02 * np.linalg.norm(old)


@pytest.mark.slow
def test_one_of_several_projectors_is_updated(program, room_of_two, tmp_path):
    folder = tmp_path / "room"
    shutil.copytree(room_of_two, folder)
    facts = (folder / "right.projector.json").read_bytes()
    words = ("acquire", "update", folder, "--projector", "left")
    program(*words, "--store", folder / "right.zarr").assert_refused("right.zarr: exists")
    assert (folder / "right.projector.json").read_bytes() == facts
    printed = program(*words).out
    command = f"combine {folder}/left.updated.zarr {folder}/right.zarr --out {folder}/combined.npz"
    assert f"next: ltcl {command}" in printed
    assert program(*command.split()).code == 0


@pytest.mark.slow
def test_a_person_takes_the_photographs_of_an_update_in_one_round(program, finished):
    dim(finished, 0.95)
    with Project.open(finished).rig() as camera:
        scene = camera
    path = finished / "acquisition.toml"
    settings = path.read_text().partition("\n[acquire]\n")[2]
    by_hand = 'kind = "folder"\nprojector_grid = [4, 8]\npattern_bits = 16\ncamera_bits = 12\n'
    path.write_text(f"[rig]\n{by_hand}[acquire]\n{settings}")
    outcome = program("acquire", "update", finished)
    assert outcome.code == 3
    folder = finished / "updated.zarr.photographs"
    for part in (f"ltcl show {folder}", f"ltcl acquire update {finished} --take CARD"):
        assert part in outcome.out
    report = program("acquire", "update", finished, "--json").document
    assert report["missing"] == list(range(1, 13))
    assert (folder / report["next"]["pattern"]).is_file()
    for row in (folder / "shots.csv").read_text().splitlines()[1:]:
        _, pattern, seconds, name = row.split(",")
        picture = scene.photograph(images.read_codes(folder / pattern) / 65535, float(seconds))
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    report = program("acquire", "update", finished, "--json").json
    assert report["gain"][0] == pytest.approx(0.95, abs=0.02)


@pytest.mark.rare
def test_what_fails_is_a_further_list(program, finished):
    """Light of some pixels falls elsewhere: after 12 photographs 16 more are asked for, not 32."""
    T = ltcl.load(finished / "truth.npz")
    matrix = np.asarray(T.matrices[0])[:, [*range(7, -1, -1), *range(8, 32)]]
    ltcl.save(finished / "truth.npz", ltcl.Transport(matrix, T.grid))
    with Project.open(finished).rig() as camera:
        scene = camera
    path = finished / "acquisition.toml"
    settings = path.read_text().partition("\n[acquire]\n")[2]
    by_hand = 'kind = "folder"\nprojector_grid = [4, 8]\npattern_bits = 16\ncamera_bits = 12\n'
    path.write_text(f"[rig]\n{by_hand}[acquire]\n{settings}")
    folder = finished / "updated.zarr.photographs"
    command = ("acquire", "update", finished, "--photographs", "30")
    for first, last in ((1, 12), (13, 28)):
        outcome = program(*command)
        assert outcome.code == 3
        assert f"ltcl acquire update {finished} --photographs 30 --take CARD" in outcome.out
        report = program(*command, "--json").document
        assert report["missing"] == list(range(first, last + 1))
        for row in (folder / "shots.csv").read_text().splitlines()[first:]:
            _, pattern, seconds, name = row.split(",")
            picture = scene.photograph(images.read_codes(folder / pattern) / 65535, float(seconds))
            cv2.imwrite(str(folder / f"{name}.png"), picture)
    report = program(*command, "--json").json
    assert report["photographs"] == 28
    assert report["measured_again"] > 0


@pytest.mark.parametrize(
    ("options", "display", "advance", "resize"),
    [
        ([], 1, "key", None),
        (["--display", "0", "--every", "2"], 0, 2.0, None),
        (["--arrival"], 1, "arrival", None),
        (["--resize", "crop"], 1, "key", "crop"),
    ],
)
def test_options_of_show(program, monkeypatch, tmp_path, options, display, advance, resize):
    calls = []

    def show(folder: Path, **settings: Any) -> int:
        del settings["progress"]
        calls.append((folder, settings))
        return 3

    monkeypatch.setattr(rigs, "show", show)
    report = program("show", tmp_path, *options, "--json").json
    assert report == {"folder": str(tmp_path), "shown": 3}
    settings = {"display": display, "advance": advance, "resize": resize}
    assert calls == [(tmp_path, settings)]
