# SPDX-License-Identifier: BSD-3-Clause
"""Several projectors of one folder: their scans, a camera that moves, what they are fed."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import Calibration, Correspondence, Project, acquire
from ltcl.acquisition.project import FILE
from ltcl.acquisition.projectors import (
    CameraMoved,
    CombinedSetup,
    Warp,
    camera_geometry,
    check_camera,
    combine_scans,
)
from ltcl.acquisition.projectors.movement import find_movement
from ltcl.acquisition.several import movements, pending_steps
from ltcl.cli.main import main
from ltcl.errors import FileError, InputError, PhotographMissing


def ignore(step: str, done: int, total: int) -> None:
    """Progress that nobody looks at."""


def run(folder: Path) -> tuple[Project, ...]:
    """Take all steps of a folder."""
    projects = Project.open_all(folder)
    for step in pending_steps(projects):
        with step.rig() as rig:
            step.run(rig, projects[0], ignore, None)
    return projects


@pytest.fixture(scope="module")
def scanned(room_of_two: Path) -> Path:
    return room_of_two


@pytest.fixture(scope="module")
def combined(scanned: Path) -> Any:
    return combine_scans([scanned / "left.zarr", scanned / "right.zarr"])


def shown(folder: Path, codes: tuple[np.ndarray, ...]) -> np.ndarray:
    """The light of all projectors together, with the room's, on the pixels of T."""
    light: Any = 0.0
    black: Any = 0.0
    resampling: Any = None
    for project, code in zip(Project.open_all(folder), codes, strict=True):
        with project.rig(own_pixels=True) as rig:
            black = rig.radiance(np.zeros(rig.projector_grid, np.float32))
            light = light + rig.radiance(code) - black
        resampling = Calibration.of(project.store).resampling
    return resampling.apply(light + black)


def projector_grid(folder: Path, name: str) -> tuple[int, int]:
    view = Project.open(folder, name).view()
    assert view is not None
    return view.mapping.grid


def test_two_projectors_show_what_was_asked_for(scanned: Path, combined: Any) -> None:
    """From files of two projectors to codes, on each one's own pixels, that show the picture."""
    H, W = combined.camera_grid
    y, x = np.mgrid[:H, :W]
    desired = (0.15 + 0.05 * np.sin(x / 3.0) * np.cos(y / 2.0)).astype(np.float32)
    c = ltcl.compensate(combined, desired, rtol=1e-3)
    setup = CombinedSetup.of(combined)
    assert setup is not None
    codes = setup.montage.split(setup.codes(c.pattern))
    assert [code.shape for code in codes] == [projector_grid(scanned, "left")] * 2
    picture = shown(scanned, codes)
    # The unit of light is the camera's.
    scale = float((picture * c.appearance).sum() / (picture**2).sum())
    assert scale == pytest.approx(1.0, abs=0.02)
    error = np.linalg.norm(scale * picture - desired) / np.linalg.norm(desired)
    assert error < 0.01
    assert c.error < 0.01


def test_few_pixels_are_enough(tmp_path: Path) -> None:
    """Rows of S without noise, as the window of direct light is the whole projector."""
    folder = tmp_path / "room"
    file = str(tmp_path / "both.npz")
    words = ["simulate", "dihedral", "--size", "6", "--projectors", "2", "--out", str(folder)]
    assert main([*words, "--quiet"]) == 0
    run(folder)
    assert main(["combine", str(folder), "--out", file, "--quiet"]) == 0
    T: Any = ltcl.load(file)
    assert (T.scene.noise.rows == 0.0).any()
    assert main(["analyze", file, "--quiet"]) == 0
    c = ltcl.compensate(T, np.full(T.camera_grid, 0.05))
    assert np.isfinite(c.std.appearance).all()


def test_what_is_done_is_not_done_again(scanned: Path) -> None:
    projects = Project.open_all(scanned)
    assert [*pending_steps(projects)] == []
    found = movements(projects)
    assert list(found) == ["right", "end"]
    assert max(found.values()) < 0.05


def test_the_file_of_all_keeps_what_they_are_fed(combined: Any, tmp_path: Path) -> None:
    ltcl.save(tmp_path / "both.npz", combined)
    again: Any = ltcl.load(tmp_path / "both.npz")
    before = CombinedSetup.of(combined)
    after = CombinedSetup.of(again)
    assert before is not None
    assert after is not None
    pattern = np.random.default_rng(0).random(combined.grid)
    np.testing.assert_array_equal(before.codes(pattern), after.codes(pattern))
    np.testing.assert_allclose(again.blacks[0], combined.blacks[0])
    assert CombinedSetup.of(ltcl.combine(combined.transports)) is None


@pytest.mark.slow
def test_a_scan_goes_on_where_it_was_stopped(scanned: Path, tmp_path: Path) -> None:
    """Killed at any photograph, in any step, it ends as if it had not been, to the bit."""
    for file in ("acquisition.toml", "camera.npz", "left.npz", "right.npz"):
        (tmp_path / file).write_bytes((scanned / file).read_bytes())

    class StoppedError(Exception):
        """A scan that is killed."""

    kinds = []
    for _ in range(40):
        projects = Project.open_all(tmp_path)
        steps = pending_steps(projects)
        step = next(steps, None)
        if step is None:
            break
        kinds.append(step.what)

        def stop(name: str, done: int, total: int, so_far: int = 13 * len(kinds)) -> None:
            if done >= so_far:
                raise StoppedError

        with step.rig() as rig:
            try:
                step.run(rig, projects[0], stop, None)
            except StoppedError:
                continue
    assert [*pending_steps(Project.open_all(tmp_path))] == []
    assert kinds.count("scan") > 2
    for name in ("left.zarr", "right.zarr"):
        a = ltcl.load(scanned / name).to_numpy()
        np.testing.assert_array_equal(a, ltcl.load(tmp_path / name).to_numpy())


@pytest.mark.parametrize(
    ("rows", "columns", "angle"), [(0.0, 0.6, 0.0), (-2.3, 4.7, 0.0), (0.0, 0.0, 0.6)]
)
def test_a_camera_that_moved_is_found(rows: float, columns: float, angle: float) -> None:
    """Shifts by fractions and by many pixels, and turns, to a tenth of a pixel."""
    random = np.random.default_rng(1)
    blocks = np.kron(random.random((12, 16)) < 0.5, np.ones((8, 8)))
    before = cv2.GaussianBlur(np.pad(blocks, 16), (0, 0), 1.0).astype(np.float32)
    H, W = before.shape
    turn = cv2.getRotationMatrix2D(((W - 1) / 2, (H - 1) / 2), angle, 1.0)
    turn[:, 2] += columns, rows
    after = cv2.warpAffine(before, turn, (W, H))
    noise = 0.01 * random.standard_normal((2, H, W)).astype(np.float32)
    expected = np.hypot(rows, columns) + np.deg2rad(angle) * np.hypot(W / 2 - 16, H / 2 - 16)
    movement = find_movement(before + noise[0], 0.9 * after + noise[1])
    assert movement == pytest.approx(expected, abs=0.15)
    still = find_movement(before + noise[0], 0.9 * before + noise[1])
    assert still < 0.1
    with pytest.raises(CameraMoved, match="camera pixels before lunch"):
        check_camera(before, after, "before lunch")


def test_another_picture_is_no_movement() -> None:
    random = np.random.default_rng(0)
    pictures = random.random((2, 60, 80)).astype(np.float32)
    with pytest.raises(CameraMoved, match="cannot be told"):
        check_camera(pictures[0], pictures[1], "now")


def test_a_moved_camera_stops_the_scans(scanned: Path, tmp_path: Path) -> None:
    """One line that names the distance; the scan of the first projector stays."""
    for path in scanned.iterdir():
        if path.is_file() and not path.name.startswith("right."):
            (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "right.npz").write_bytes((scanned / "right.npz").read_bytes())
    (tmp_path / "left.zarr").symlink_to(scanned / "left.zarr")
    with np.load(tmp_path / "left.map.npz") as arrays:
        content = dict(arrays)
    content["blocks"] = np.roll(content["blocks"], 3, axis=1)
    np.savez(tmp_path / "left.map.npz", **content)
    with pytest.raises(CameraMoved, match=r"moved by 3 .* right"):
        run(tmp_path)
    assert not (tmp_path / "right.zarr").exists()


def test_a_warp_lights_what_the_camera_sees_there() -> None:
    """Each projector pixel that is seen shows the pixel of T around the place where it is seen."""
    y, x = np.mgrid[:24, :36].astype(np.float32)
    is_seen = (x >= 12) & (x < 34)
    # Projector pixels are as large as 1.5 camera pixels, and begin at column 12.
    mapping = Correspondence(
        np.where(is_seen, (x - 12 + 0.5) / 1.5 - 0.5, np.nan),
        np.where(is_seen, (y + 0.5) / 1.5 - 0.5, np.nan),
        is_seen,
        (16, 14),
    )
    warp = Warp.of(mapping, 6)
    assert warp.grid == (4, 6)
    pattern = np.arange(24.0).reshape(4, 6) + 1.0
    row, column = np.indices((16, 14))
    seen_row = 1.5 * (row + 0.5)
    seen_column = 12 + 1.5 * (column + 0.5)
    expected = 1.0 + 6 * np.floor(seen_row / 6) + np.floor(np.minimum(seen_column, 33.9) / 6)
    np.testing.assert_array_equal(warp.enlarged(pattern), expected)
    assert not warp.lit[:, :2].any()
    assert warp.lit[:, 2:].all()
    with pytest.raises(InputError, match=r"side is 2 .* 3 or more"):
        Warp.of(mapping, 2)
    with pytest.raises(InputError, match="sees no pixel"):
        Warp.of(Correspondence(x, y, np.zeros_like(is_seen), (16, 14)), 6)
    assert camera_geometry((24, 36), 6).grid == warp.grid


SEVERAL = """[rig]
kind = "folder"
projector_grid = [24, 32]
{rig}
[[projector]]
name = "a"
{a}
[[projector]]
name = "b"
[scene]
{scene}
[acquire]
{acquire}
"""


def written(folder: Path, **parts: str) -> Path:
    text = SEVERAL.format(**({"rig": "", "a": "", "scene": "", "acquire": ""} | parts))
    (folder / FILE).write_text(text, "utf-8")
    return folder


def test_projectors_have_keys_of_their_own(tmp_path: Path) -> None:
    a, b = Project.open_all(written(tmp_path, a="projector_grid = [12, 16]", scene="side = 5"))
    assert a.table["projector_grid"] == [12, 16]
    assert b.table["projector_grid"] == [24, 32]
    assert (a.side, b.side) == (5, 5)
    assert (a.store, b.store) == (tmp_path / "a.zarr", tmp_path / "b.zarr")
    assert Project.open(tmp_path, "b") == b


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ({"scene": "side = 2"}, r"\[scene\] side is 2"),
        ({"scene": "sides = 2"}, r"\[scene\] has 'sides'"),
        ({"acquire": 'geometry = "aligned"'}, "geometry is 'aligned'"),
        ({"acquire": 'strategy = "block"'}, "strategy is 'block'"),
        ({"a": 'grid = "4"'}, r"\[projector a\] has 'grid'"),
        ({"a": '[[projector]]\nname = "b"'}, "has the name 'b', as one before it"),
        ({"a": '[[projector]]\nname = "B"'}, "has the name 'b', as one before it"),
        ({"a": '[[projector]]\nname = "Transport"'}, "has the name 'Transport', which is that"),
        ({"a": '[[projector]]\nname = "a b"'}, "has the name 'a b'; it must be 1 to 32 letters"),
        ({"a": '[[projector]]\nname = "a/b"'}, "has the name 'a/b'"),
        ({"a": '[[projector]]\nname = "end"'}, "has the name 'end', .* none of transport"),
        ({"a": "[[projector]]"}, "has the name ''"),
        ({"rig": "[projectors]"}, r"has 'projectors'.*\[\[projector\]\]"),
    ],
)
def test_unusable_tables_are_refused(tmp_path: Path, parts: dict[str, str], text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        Project.open_all(written(tmp_path, **parts))
    assert "\n" not in str(caught.value)
    assert FILE in str(caught.value)


def test_one_of_several_must_be_named(tmp_path: Path) -> None:
    written(tmp_path)
    with pytest.raises(InputError, match="projectors a, b"):
        Project.open(tmp_path)
    with pytest.raises(InputError, match=r"projector is 'c'; .* a, b"):
        Project.open(tmp_path, "c")
    with pytest.raises(InputError, match="size that is not known yet"):
        Project.open(tmp_path, "a").outlook()
    text = '[rig]\nkind = "folder"\nprojector_grid = [4, 8]\n[[projector]]\nname = "a"\n'
    (tmp_path / FILE).write_text(text, "utf-8")
    with pytest.raises(InputError, match="has 1"):
        Project.open_all(tmp_path)
    (tmp_path / FILE).write_text('[rig]\nkind = "virtual"\n[scene]\nside = 4\n', "utf-8")
    with pytest.raises(InputError, match=r"\[scene\], but no"):
        Project.open_all(tmp_path)


def test_other_stores_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = ltcl.scenes.dihedral(4).transport()
    rig = ltcl.acquisition.VirtualRig(truth, truth.grid)
    acquire(rig, geometry="aligned", store=tmp_path / "T.zarr")
    with pytest.raises(InputError, match="no finished scan"):
        combine_scans([tmp_path / "T.zarr", tmp_path / "T.zarr"])
    shutil.copytree(tmp_path / "T.zarr", tmp_path / "other.zarr")
    words = ["combine", str(tmp_path / "T.zarr"), str(tmp_path / "other.zarr")]
    assert main([*words, "--out", str(tmp_path / "both.npz")]) == 1
    assert "T.zarr: is the scan of one projector alone" in capsys.readouterr().err
    assert not (tmp_path / "both.npz").exists()


def test_a_store_may_be_the_working_folder(scanned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(scanned / "left.zarr")
    setup = CombinedSetup.of_scan(".")
    assert setup is not None
    assert setup.names == ("left",)


def test_other_files_in_the_folder_of_scans_are_no_scans(scanned: Path, tmp_path: Path) -> None:
    """Files with the names of stores, such as what `ltcl convert` makes of them."""
    files = []
    for name in ("left", "right"):
        (tmp_path / f"{name}.projector.json").symlink_to(scanned / f"{name}.projector.json")
        files.append(tmp_path / f"{name}.npz")
        ltcl.save(files[-1], ltcl.load(scanned / f"{name}.zarr", on_dark="mask"))
    out = tmp_path / "both.npz"
    assert main(["combine", *map(str, files), "--out", str(out), "--quiet"]) == 0
    assert CombinedSetup.of(ltcl.load(out)) is None


def test_damaged_facts_are_named(scanned: Path, tmp_path: Path) -> None:
    (tmp_path / "left.zarr").symlink_to(scanned / "left.zarr")
    (tmp_path / "left.projector.json").write_text('{"side": 6}')
    with pytest.raises(FileError, match=r"left\.projector\.json: is damaged"):
        combine_scans([tmp_path / "left.zarr", tmp_path / "left.zarr"])


def take_by_hand(rig: Any, folder: Path, camera: Any) -> None:
    """Take the photographs of a shooting list that are not there."""
    for shot in rig.shots:
        place = folder / f"{shot.save_as}.png"
        if not place.exists():
            pattern = images.read(folder / shot.pattern, encoding="linear")
            cv2.imwrite(str(place), camera(pattern, shot.seconds))


@pytest.mark.slow
def test_projectors_by_hand(scanned: Path, tmp_path: Path) -> None:
    """Each projector, and each check, has a list of its own; a person takes all photographs."""
    sources = {project.name: project for project in Project.open_all(scanned)}
    grid = projector_grid(scanned, "left")
    written(tmp_path, rig="camera_bits = 12", scene="side = 6", acquire='strategy = "sketch"')
    text = (tmp_path / FILE).read_text().replace("[24, 32]", str([*grid]))
    text = text.replace('"a"', '"left"').replace('"b"', '"right"')
    (tmp_path / FILE).write_text(text)
    projects = Project.open_all(tmp_path)
    places = []
    for _ in range(60):
        step = next(pending_steps(projects), None)
        if step is None:
            break
        with step.rig() as rig, sources[step.project.name].rig(own_pixels=True) as camera:
            try:
                step.run(rig, projects[0], ignore, None)
            except PhotographMissing:
                take_by_hand(rig, step.folder, camera.photograph)
                places.append(step.folder.relative_to(tmp_path).as_posix())
    assert [*pending_steps(projects)] == []
    assert list(dict.fromkeys(places)) == ["left", "checks/right", "right", "checks/end"]
    T = combine_scans([project.store for project in projects])
    c = ltcl.compensate(T, np.full(T.camera_grid, 0.15, np.float32))
    setup = CombinedSetup.of(T)
    assert setup is not None
    picture = shown(scanned, setup.montage.split(setup.codes(c.pattern)))
    scale = float((picture * 0.15).sum() / (picture**2).sum())
    assert np.abs(scale * picture / 0.15 - 1.0).mean() < 0.02
