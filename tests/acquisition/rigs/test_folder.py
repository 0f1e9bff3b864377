# SPDX-License-Identifier: BSD-3-Clause
"""A folder rig end to end with photographs of a virtual rig, and every way in which a folder can be wrong."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl import images
from ltcl.acquisition import FolderRig, Shots, VirtualRig
from ltcl.errors import AcquisitionError, FileError, InputError, LtclError, PhotographMissing
from tests.acquisition.rigs import camera_files

GRID = (3, 4)
WHITE, BLACK, HALF = np.ones(GRID), np.zeros(GRID), np.full(GRID, 128 / 255)
SHOTS = [(WHITE, 0.5), (BLACK, 0.5), (HALF, 0.5), (WHITE, 0.25), (WHITE, 0.5)]
GREY = np.arange(12, dtype=np.uint8).reshape(GRID)


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "shots.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def put(folder: Path, number: int, codes: np.ndarray = GREY, suffix: str = ".png") -> Path:
    path = folder / "photographs" / f"photo_{number:06d}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    camera_files.write(path, codes)
    return path


def prepared(folder: Path, count: int = len(SHOTS), **options: Any) -> FolderRig:
    rig = FolderRig(folder, GRID, **options)
    rig.prepare(SHOTS[:count])
    return rig


def refusal(rig: FolderRig, shot: tuple[np.ndarray, float]) -> str:
    with pytest.raises(AcquisitionError) as error:
        rig.photograph(*shot)
    assert "\n" not in str(error.value)
    assert not isinstance(error.value, PhotographMissing)
    return str(error.value)


@pytest.mark.parametrize(("channels", "bits"), [(1, 8), (3, 8), (1, 16), (3, 16)])
def test_a_round_trip_gives_what_the_scene_gives(tmp_path: Path, channels: int, bits: int) -> None:
    rng = np.random.default_rng(6)
    T = [rng.random((20, 12)) / 12 for _ in range(channels)]
    scene, direct = (Shots(VirtualRig(T, GRID, camera_grid=(4, 5), bits=12, seed=3)) for _ in range(2))
    shape = GRID if channels == 1 else (*GRID, 3)
    patterns = [(rng.integers(0, 2**bits, shape) / (2**bits - 1)).astype(np.float32) for _ in range(4)]
    shots = [(x, s) for x in patterns for s in (0.5, 2.0)] + [(patterns[0], 0.5)]
    options: dict[str, Any] = {"channels": channels, "pattern_bits": bits, "camera_bits": 12}
    first = Shots(FolderRig(tmp_path, GRID, **options))
    first.prepare(shots)
    with pytest.raises(PhotographMissing):
        first.photograph(*shots[0])
    assert len(list((tmp_path / "patterns").iterdir())) == 4  # a bracket shares its pattern
    assert [line["number"] for line in table(tmp_path)] == [str(n + 1) for n in range(9)]
    for line in table(tmp_path):  # what a person does
        levels = images.read_codes(tmp_path / line["project"])
        image = scene.rig.photograph(levels / np.float32(2**bits - 1), float(line["seconds"]))
        images.write(tmp_path / f"{line['save as']}.tif", image / 65535, encoding="linear", bits=16)

    again = Shots(FolderRig(tmp_path, GRID, **options))
    for x, seconds in shots:  # the last is a repeat: another photograph of the same, with other noise
        np.testing.assert_array_equal(again.photograph(x, seconds), direct.photograph(x, seconds))
    assert again.levels == 4096
    assert again.name(9) == "photograph 9 (photo_000009.tif)"
    assert json.loads(json.dumps(again.describe()))["rig"]["kind"] == "folder"


def test_patterns_at_the_projectors_own_resolution(tmp_path: Path) -> None:
    """3 x 4 pixels on 20 x 31: blocks of 6 x 6, 1 pixel of black above and below, 3 and 4 at the sides."""
    rig = FolderRig(tmp_path, GRID, projector=(20, 31))
    codes = np.arange(12).reshape(GRID) / 11
    rig.prepare([(codes, 0.5)])
    expected = np.zeros((20, 31))
    expected[1:19, 3:27] = np.kron(np.rint(codes * 255), np.ones((6, 6)))
    np.testing.assert_array_equal(images.read_codes(tmp_path / "patterns/pattern_000001.png"), expected)
    put(tmp_path, 1)
    np.testing.assert_array_equal(rig.photograph(codes, 0.5), GREY)
    with pytest.raises(InputError, match=r"shots\.json: was made for .*projector"):
        FolderRig(tmp_path, GRID)


def test_what_is_missing_carries_the_next_step(tmp_path: Path) -> None:
    rig = prepared(tmp_path)
    put(tmp_path, 1)
    rig.photograph(*SHOTS[0])
    assert rig.missing() == (2, 3, 4, 5)
    for _ in range(2):  # asking for what is not there does not count as a repeat
        with pytest.raises(PhotographMissing, match=r"photograph 2 .*pattern_000002.*0\.5 s") as error:
            rig.photograph(*SHOTS[1])
        assert error.value.number == 2
        assert error.value.shot == (2, "patterns/pattern_000002.png", 0.5, "photographs/photo_000002")
        assert error.value.missing == 4
    put(tmp_path, 2, GREY + 1)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[1]), GREY + 1)


@pytest.mark.parametrize("name", ["unknown", "0", "photographs.txt"])
def test_other_entries_of_the_folder_hide_no_photograph(tmp_path: Path, name: str) -> None:
    rig = prepared(tmp_path, 1)
    (tmp_path / name).write_text("notes")
    with pytest.raises(PhotographMissing):
        rig.photograph(*SHOTS[0])
    put(tmp_path, 1)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[0]), GREY)


def test_preparing_twice_changes_nothing_and_a_second_batch_counts_on(tmp_path: Path) -> None:
    prepared(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    rig = prepared(tmp_path)
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    put(tmp_path, 1)
    rig.photograph(*SHOTS[0])
    rig.prepare([SHOTS[0], SHOTS[0]])  # the second and a third photograph of the same
    with pytest.raises(PhotographMissing) as error:
        rig.photograph(HALF, 1.0)  # nobody announced it
    assert (error.value.number, len(table(tmp_path))) == (7, 7)


def test_lost_and_stale_files_are_written_again(tmp_path: Path) -> None:
    path = tmp_path / "patterns/pattern_000001.png"
    images.write(path, BLACK, encoding="linear")  # of a run that died before its list was there
    prepared(tmp_path)
    assert np.all(images.read_codes(path) == 255)
    path.unlink()
    (tmp_path / "shots.csv").unlink()
    prepared(tmp_path)
    assert np.all(images.read_codes(path) == 255)
    assert len(table(tmp_path)) == 5


@pytest.mark.parametrize("codes", [np.zeros((4, 3), np.uint8), np.zeros(GRID, np.uint16)])
def test_photographs_of_mixed_kinds_are_named(tmp_path: Path, codes: np.ndarray) -> None:
    put(tmp_path, 1)
    put(tmp_path, 2, codes)
    shots = Shots(prepared(tmp_path))
    shots.photograph(*SHOTS[0])
    with pytest.raises(AcquisitionError) as error:
        shots.photograph(*SHOTS[1])
    expected = f"photograph 2 (photo_000002.png) is {codes.dtype} {codes.shape}; it must be uint8 (3, 4)"
    assert str(error.value).startswith(expected)


def test_floats_above_full_scale_are_warned_of_once(tmp_path: Path, caplog: Any) -> None:
    """Codes of 12 bits as floats; 11 of 12 pixels are above 1. A hot pixel alone is no reason."""
    rig, codes = prepared(tmp_path), np.full((12, 16), 0.5, np.float32)
    codes[3, 4], codes[0, 0] = 7.0, 1.0005
    images.write(tmp_path / "photographs/photo_000001.exr", codes)
    rig.photograph(*SHOTS[0])
    assert not caplog.messages
    for number in (2, 3):
        images.write(tmp_path / f"photographs/photo_{number:06d}.exr", codes * np.float32(300.0))
        rig.photograph(*SHOTS[number - 1])
    (line,) = caplog.messages
    assert line.startswith("photograph 2 (photo_000002.exr) reaches 2100")
    assert "100%" in line


@pytest.mark.parametrize("other", ["PHOTO_000001.PNG", "photo_1.png"])
def test_two_files_for_one_number_are_refused(tmp_path: Path, other: str) -> None:
    """Names that differ in case only are two files as well, where the file system keeps them apart."""
    rig = prepared(tmp_path, 1)
    shutil.copy(put(tmp_path, 1), tmp_path / "photographs" / other)
    text = refusal(rig, SHOTS[0])
    assert other in text
    assert "photo_000001.png" in text
    (tmp_path / "photographs/photo_000001.png").unlink()
    np.testing.assert_allclose(rig.photograph(*SHOTS[0]), GREY, atol=3)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("photo_000001.webp", "photographs are .png"),
        ("PHOTO_000001.heic", "photographs are .png"),
        ("IMG_0001.png", "no photograph on the list"),
        ("photo_000007.png", "no photograph on the list"),
        ("photo_000001 (1).png", "no photograph on the list"),
    ],
)
def test_files_that_are_no_photographs_are_named(tmp_path: Path, name: str, reason: str) -> None:
    rig = prepared(tmp_path, 1)
    shutil.move(put(tmp_path, 1), tmp_path / "photographs" / name)
    with pytest.raises(PhotographMissing) as error:
        rig.photograph(*SHOTS[0])
    assert repr(name) in str(error.value)
    assert reason in str(error.value)


def test_damaged_photographs_are_named(tmp_path: Path) -> None:
    rig = prepared(tmp_path, 1)
    path = put(tmp_path, 1)
    whole = path.read_bytes()
    terabyte = whole[:16] + (1 << 20).to_bytes(4, "big") * 2 + whole[24:]  # so many pixels, it says
    for content in (b"", whole[:40], b"no photograph", terabyte):
        path.write_bytes(content)
        assert refusal(rig, SHOTS[0]).startswith("photograph 1 (photo_000001.png) cannot be used: ")
    path.write_bytes(whole)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[0]), GREY)


def test_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    folder, outside = tmp_path / "scan", tmp_path / "outside"
    rig = prepared(folder, 1)
    target, link = put(outside, 1), folder / "photographs/photo_000001.png"
    link.symlink_to(target)
    assert "leads out of the folder" in refusal(rig, SHOTS[0])
    link.unlink()
    (folder / "photographs").rmdir()
    (folder / "photographs").symlink_to(outside / "photographs")
    for call in (lambda: rig.photograph(*SHOTS[0]), rig.missing):
        with pytest.raises(LtclError, match="leads out of the folder"):
            call()


@pytest.mark.parametrize("name", ["patterns", "shots.json", "shots.csv"])
def test_nothing_is_written_through_links(tmp_path: Path, name: str) -> None:
    folder, outside = tmp_path / "scan", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (folder / name).symlink_to(outside / "target")
    with pytest.raises(FileError, match="leads out of the folder"):
        prepared(folder, 1)
    assert list(outside.iterdir()) == []


@pytest.mark.parametrize("change", [{"projector_grid": (4, 3)}, {"channels": 3}, {"pattern_bits": 16}])
def test_a_list_of_another_rig_is_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    prepared(tmp_path)
    with pytest.raises(InputError, match=r"shots\.json: was made for"):
        FolderRig(tmp_path, **{"projector_grid": GRID, **change})


SHOT = {"codes": "0" * 32, "seconds": 1.0, "repeat": 0}
BAD_SHOTS = [
    [{**SHOT, **change}]
    for change in (
        {"codes": "../../etc/passwd"},
        {"codes": 7},
        {"seconds": -1},
        {"seconds": 1e999},
        {"seconds": "1"},
        {"repeat": 0.5},
    )
]


@pytest.mark.parametrize(
    "content",
    ["{", "[]", "[" * 100_000, "\x00\x01", *BAD_SHOTS, [{"codes": "0" * 32}], [SHOT, SHOT], None, "format"],
)
def test_a_damaged_list_is_refused(tmp_path: Path, content: Any) -> None:
    if not isinstance(content, str) or content == "format":
        rig = {"projector_grid": list(GRID), "channels": 1, "bits": 8}
        version = "ltcl shooting list 9" if content == "format" else "ltcl shooting list 1"
        content = json.dumps({"format": version, "rig": rig, "shots": content})
    (tmp_path / "shots.json").write_text(content, encoding="utf-8")
    with pytest.raises(FileError, match=r"shots\.json: is no shooting list") as error:
        FolderRig(tmp_path, GRID)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400 + len(str(tmp_path))


def test_the_cameras_own_files_are_taken(tmp_path: Path) -> None:
    rig, card = prepared(tmp_path / "scan"), tmp_path / "card"
    card.mkdir()
    (tmp_path / "a.txt").write_text("no photograph")
    for k, name in enumerate(["IMG_9.jpg", "IMG_10.jpg", "IMG_100.jpg", "IMG_101.jpg"]):
        camera_files.write(card / name, np.full((8, 8), 40 * k, np.uint8))
    put(tmp_path / "scan", 2, np.full((8, 8), 200, np.uint8))
    paths = sorted(card.iterdir())
    with pytest.raises(InputError, match="files holds 3 names; 4 photographs are missing"):
        rig.take(paths[1:])
    with pytest.raises(FileError, match=r"a\.txt: extension \.txt"):
        rig.take([*paths[1:], tmp_path / "a.txt"])
    assert rig.missing() == (1, 3, 4, 5)
    rig.take(paths)
    assert rig.missing() == ()
    levels = [int(rig.photograph(*shot)[4, 4]) for shot in SHOTS]
    np.testing.assert_allclose(levels, [0, 200, 40, 80, 120], atol=1)
    assert len(list(card.iterdir())) == 4  # copied, not moved


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"projector_grid": (0, 1)}, "projector_grid"),
        ({"channels": 2}, "channels is 2"),
        ({"camera_bits": 17}, "camera_bits"),
        ({"projector": (2, 1080)}, "grid is 4 x 3.*1080 x 2"),
        ({"projector": 1080}, "projector is 1080"),
    ],
)
def test_impossible_rigs_are_refused(tmp_path: Path, change: dict[str, Any], part: str) -> None:
    with pytest.raises(LtclError, match=part):
        FolderRig(**{"folder": tmp_path, "projector_grid": GRID, **change})
    (tmp_path / "a").write_text("x")
    with pytest.raises(FileError, match="is a file; it must be a folder"):
        FolderRig(tmp_path / "a", GRID)


@pytest.mark.parametrize(("codes", "seconds"), [(np.zeros((1, 1)), 1.0), (WHITE * 2, 1.0), (WHITE, 0.0)])
def test_bad_shots_are_refused_before_anything_is_written(
    tmp_path: Path, codes: np.ndarray, seconds: float
) -> None:
    rig = FolderRig(tmp_path / "scan", GRID)
    with pytest.raises(InputError):
        rig.photograph(codes, seconds)
    with pytest.raises(InputError):
        rig.prepare([(codes, seconds)])
    assert not (tmp_path / "scan").exists()
