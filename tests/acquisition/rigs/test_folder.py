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

from ltcl import files, images
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


def put(folder: Path, number: int, codes: np.ndarray = GREY, *more: Any, suffix: str = ".png") -> Path:
    path = folder / "photographs" / f"photo_{number:06d}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    camera_files.write(path, codes, *more)
    return path


def prepared(folder: Path, count: int = len(SHOTS), **more: Any) -> FolderRig:
    rig = FolderRig(folder, GRID, **more)
    rig.prepare(SHOTS[:count])
    return rig


def refusal(rig: FolderRig, shot: tuple[np.ndarray, float]) -> str:
    with pytest.raises(AcquisitionError) as error:
        rig.photograph(*shot)
    assert "\n" not in str(error.value)
    assert not isinstance(error.value, PhotographMissing)
    return str(error.value)


def photographs_of(scene: VirtualRig, folder: Path) -> None:
    """What a person does: project each pattern, expose as the list says, save under the name it gives."""
    for line in table(folder):
        stored = images.read_codes(folder / line["project"])
        codes = stored / np.float32(np.iinfo(stored.dtype).max)
        taken = scene.photograph(codes, float(line["seconds"]))
        images.write(
            folder / f"{line['save as']}.tif", taken / 65535, encoding="linear", bits=16
        )  # 12 bits in 16


@pytest.mark.parametrize(("channels", "bits"), [(1, 8), (3, 8), (1, 16), (3, 16)])
def test_a_round_trip_gives_what_the_scene_gives(tmp_path: Path, channels: int, bits: int) -> None:
    rng = np.random.default_rng(6)
    T = [rng.random((20, 12)) / 12 for _ in range(channels)]
    settings: dict[str, Any] = {"camera_grid": (4, 5), "bits": 12, "seed": 3}
    shape = GRID if channels == 1 else (*GRID, 3)
    most = 2**bits - 1
    patterns = [(rng.integers(0, most + 1, shape) / most).astype(np.float32) for _ in range(4)]
    shots = [(x, s) for x in patterns for s in (0.5, 2.0)] + [(patterns[0], 0.5)]
    settings_of_folder: dict[str, Any] = {"channels": channels, "pattern_bits": bits, "camera_bits": 12}
    first = Shots(FolderRig(tmp_path, GRID, **settings_of_folder))
    first.prepare(shots)
    with pytest.raises(PhotographMissing):
        first.photograph(*shots[0])
    assert len(list((tmp_path / "patterns").iterdir())) == 4  # a bracket shares its pattern
    photographs_of(VirtualRig(T, GRID, **settings), tmp_path)

    again = Shots(FolderRig(tmp_path, GRID, **settings_of_folder))
    direct = Shots(VirtualRig(T, GRID, **settings))
    for x, seconds in shots:  # the last is a repeat: another photograph of the same, with other noise
        np.testing.assert_array_equal(again.photograph(x, seconds), direct.photograph(x, seconds))
    assert again.levels == 4096
    assert json.loads(json.dumps(again.describe()))["rig"]["shots"] == 9


def test_the_list_says_what_to_do(tmp_path: Path) -> None:
    prepared(tmp_path)
    assert [line["number"] for line in table(tmp_path)] == ["1", "2", "3", "4", "5"]
    assert [line["project"][-10:] for line in table(tmp_path)] == [f"00000{n}.png" for n in (1, 2, 3, 1, 1)]
    assert [float(line["seconds"]) for line in table(tmp_path)] == [0.5, 0.5, 0.5, 0.25, 0.5]
    assert table(tmp_path)[4]["save as"] == "photographs/photo_000005"
    np.testing.assert_array_equal(
        images.read_codes(tmp_path / table(tmp_path)[2]["project"]), np.full(GRID, 128)
    )


def test_what_is_missing_is_told_and_asked_again(tmp_path: Path) -> None:
    rig = prepared(tmp_path)
    put(tmp_path, 1)
    rig.photograph(*SHOTS[0])
    assert rig.missing() == (2, 3, 4, 5)
    for _ in range(2):  # asking for what is not there does not count as a repeat
        with pytest.raises(PhotographMissing) as error:
            rig.photograph(*SHOTS[1])
        assert error.value.number == 2
        text = str(error.value)
        assert (
            "photograph 2 is missing (and 3 more): project patterns/pattern_000002.png, expose for 0.5 s"
            in text
        )
    put(tmp_path, 2, GREY + 1)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[1]), GREY + 1)


def test_shots_that_were_not_foreseen_go_to_the_end(tmp_path: Path) -> None:
    rig = prepared(tmp_path, 2)
    with pytest.raises(PhotographMissing) as error:
        rig.photograph(HALF, 1.0)
    assert error.value.number == 3
    assert FolderRig(tmp_path, GRID).missing() == (1, 2, 3)


def test_preparing_twice_changes_nothing(tmp_path: Path) -> None:
    prepared(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    prepared(tmp_path)
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_a_second_batch_counts_on(tmp_path: Path) -> None:
    rig = prepared(tmp_path, 1)
    put(tmp_path, 1)
    rig.photograph(*SHOTS[0])
    rig.prepare(SHOTS[:1])  # the same again is a second photograph
    assert len(table(tmp_path)) == 2


def test_lost_files_are_written_again(tmp_path: Path) -> None:
    prepared(tmp_path)
    (tmp_path / "patterns/pattern_000001.png").unlink()
    (tmp_path / "shots.csv").unlink()
    prepared(tmp_path)
    assert np.all(images.read_codes(tmp_path / "patterns/pattern_000001.png") == 255)
    assert len(table(tmp_path)) == 5


def test_a_pattern_of_a_run_that_died_is_replaced(tmp_path: Path) -> None:
    images.write(tmp_path / "patterns/pattern_000001.png", BLACK, encoding="linear")  # its list never was
    prepared(tmp_path, 1)
    assert np.all(images.read_codes(tmp_path / "patterns/pattern_000001.png") == 255)


def test_a_full_disk_is_told_and_nothing_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = prepared(tmp_path, 2)
    flush, left = files._flush, iter([True, False])

    def fill(path: Path) -> None:
        if not next(left):
            raise OSError(28, "No space left on device", str(path))
        flush(path)

    with monkeypatch.context() as patch:
        patch.setattr(files, "_flush", fill)
        with pytest.raises(FileError, match="No space left"):
            rig.prepare(SHOTS)  # the third pattern is written, the list is not
    assert FolderRig(tmp_path, GRID).missing() == (1, 2)
    rig.prepare(SHOTS)
    assert FolderRig(tmp_path, GRID).missing() == (1, 2, 3, 4, 5)


def test_colour_photographs_of_a_grey_rig_give_green(tmp_path: Path) -> None:
    rig = prepared(tmp_path, 1)
    colour = np.random.default_rng(1).integers(0, 256, (5, 6, 3), dtype=np.uint8)
    put(tmp_path, 1, colour)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[0]), colour[..., 1])


def test_grey_photographs_of_a_colour_rig_are_refused(tmp_path: Path) -> None:
    rig = prepared(tmp_path, 1, channels=3)
    put(tmp_path, 1)
    assert "photograph 1 (photo_000001.png) is grey" in refusal(rig, SHOTS[0])


@pytest.mark.parametrize(
    ("codes", "part"),
    [
        (np.zeros((4, 3), np.uint8), "is uint8 (4, 3); it must be uint8 (3, 4), as photograph 1"),
        (np.zeros(GRID, np.uint16), "is uint16 (3, 4); it must be uint8"),
    ],
)
def test_photographs_of_mixed_kinds_are_named(tmp_path: Path, codes: np.ndarray, part: str) -> None:
    rig = prepared(tmp_path)
    put(tmp_path, 1)
    put(tmp_path, 2, codes)
    rig.photograph(*SHOTS[0])
    text = refusal(rig, SHOTS[1])
    assert text.startswith("photograph 2 (photo_000002.png)")
    assert part in text
    put(tmp_path, 2)
    rig.photograph(*SHOTS[1])  # put right, it serves


@pytest.mark.parametrize(
    ("seconds", "good"), [(0.5, True), (0.52, True), (0.48, True), (0.53, False), (0.4, False)]
)
def test_exposures_are_those_of_the_list(tmp_path: Path, seconds: float, good: bool) -> None:
    rig = prepared(tmp_path, 1)
    put(tmp_path, 1, GREY, seconds, suffix=".jpg")
    if good:
        assert rig.photograph(*SHOTS[0]).shape == GRID
    else:
        text = refusal(rig, SHOTS[0])
        assert (
            f"photograph 1 (photo_000001.jpg) was exposed for {seconds:.4g} s by its EXIF; the list asks 0.5"
            in text
        )


def test_floats_above_full_scale_are_warned_of_once(tmp_path: Path, caplog: Any) -> None:
    """Codes of 12 bits as floats; 11 of 12 pixels are above 1."""
    rig = prepared(tmp_path)
    for number in range(1, len(SHOTS) + 1):
        images.write(tmp_path / f"photographs/photo_{number:06d}.exr", GREY * np.float32(300.0))
    for shot in SHOTS:
        np.testing.assert_array_equal(rig.photograph(*shot), GREY * np.float32(300.0))
    (line,) = caplog.messages
    assert line.startswith(
        "photograph 1 (photo_000001.exr) reaches 3300; full scale of float photographs is 1"
    )
    assert "92% of its pixels count as saturated" in line


def test_floats_with_a_hot_pixel_are_not_warned_of(tmp_path: Path, caplog: Any) -> None:
    rig, codes = prepared(tmp_path, 1), np.full((12, 16), 0.5, np.float32)
    codes[3, 4], codes[0, 0] = 7.0, 1.0005
    images.write(tmp_path / "photographs/photo_000001.exr", codes)
    rig.photograph(*SHOTS[0])
    assert not caplog.messages


def at(second: float) -> str:
    return f"2026:03:01 12:00:{second:05.2f}"


def test_photographs_in_the_wrong_order_are_named(tmp_path: Path) -> None:
    rig = prepared(tmp_path)
    for number, second in [(1, 1.0), (2, 3.0), (3, 2.0)]:
        put(tmp_path, number, GREY, 0.5, at(second))
    rig.photograph(*SHOTS[0])
    rig.photograph(*SHOTS[1])
    text = refusal(rig, SHOTS[2])
    assert "photograph 3 (photo_000003.png) was taken at 2026-03-01 12:00:02, photograph 2 at" in text
    relaxed = FolderRig(tmp_path, GRID, in_order=False)
    for shot in SHOTS[:3]:
        relaxed.photograph(*shot)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1)])
def test_order_is_that_of_numbers_not_of_asking(tmp_path: Path, order: tuple[int, ...]) -> None:
    prepared(tmp_path)
    for number in range(1, 5):
        put(tmp_path, number, GREY, None, at(float(number)))
    rig = FolderRig(tmp_path, GRID)
    for k in order:
        rig.photograph(*SHOTS[k])
    put(tmp_path, 3, GREY, None, at(4.5))  # now taken behind number 4
    worse = FolderRig(tmp_path, GRID)
    outcomes = []
    for k in order:
        try:
            worse.photograph(*SHOTS[k])
        except AcquisitionError as error:
            outcomes.append(str(error))
    assert len(outcomes) == 1
    assert "photograph 3" in outcomes[0]
    assert "photograph 4" in outcomes[0]


def test_equal_times_are_no_disorder(tmp_path: Path) -> None:
    rig = prepared(tmp_path)
    for number in range(1, 5):
        put(tmp_path, number, GREY, None, camera_files.NOON)
    for shot in SHOTS[:4]:
        np.testing.assert_array_equal(rig.photograph(*shot), GREY)


def test_two_files_for_one_number_are_refused(tmp_path: Path) -> None:
    rig = prepared(tmp_path, 1)
    put(tmp_path, 1)
    put(tmp_path, 1, suffix=".jpg")
    assert "photo_000001.jpg and photo_000001.png; keep one" in refusal(rig, SHOTS[0])


@pytest.mark.parametrize("name", ["photo_000001.webp", "photo_1.gif", "PHOTO_000001.heic"])
def test_kinds_that_are_not_read_are_told(tmp_path: Path, name: str) -> None:
    rig = prepared(tmp_path, 1)
    shutil.move(put(tmp_path, 1), tmp_path / "photographs" / name)
    with pytest.raises(PhotographMissing, match=f"'{name}' there is of a kind that is not read; photographs"):
        rig.photograph(*SHOTS[0])


@pytest.mark.parametrize("name", ["IMG_0001.png", "photo_000007.png", "notes.txt", "photo_000001 (1).png"])
def test_names_that_mean_nothing_are_told(tmp_path: Path, name: str) -> None:
    rig = prepared(tmp_path, 1)
    shutil.move(put(tmp_path, 1), tmp_path / "photographs" / name)
    with pytest.raises(PhotographMissing, match="is the name of no photograph on the list") as error:
        rig.photograph(*SHOTS[0])
    assert repr(name) in str(error.value)


@pytest.mark.parametrize("name", ["photo_1.png", "PHOTO_000001.PNG", "photo_01.png"])
def test_names_need_not_be_padded(tmp_path: Path, name: str) -> None:
    rig = prepared(tmp_path, 1)
    shutil.move(put(tmp_path, 1), tmp_path / "photographs" / name)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[0]), GREY)


def test_damaged_photographs_are_named(tmp_path: Path) -> None:
    rig = prepared(tmp_path, 1)
    path = put(tmp_path, 1)
    whole = path.read_bytes()
    lie = bytearray(images_header(whole, 1 << 20))
    for content in (b"", whole[:40], b"no photograph", bytes(lie)):
        path.write_bytes(content)
        assert refusal(rig, SHOTS[0]).startswith("photograph 1 (photo_000001.png) cannot be used: ")
    path.write_bytes(whole)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[0]), GREY)


def images_header(png: bytes, size: int) -> bytes:
    """A PNG that declares size x size pixels: a terabyte in a few bytes."""
    return png[:16] + size.to_bytes(4, "big") * 2 + png[24:]


def test_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    folder, outside = tmp_path / "scan", tmp_path / "outside"
    outside.mkdir()
    rig = prepared(folder, 1)
    target = put(outside, 1)
    (folder / "photographs/photo_000001.png").symlink_to(target)
    assert "leads out of the folder" in refusal(rig, SHOTS[0])
    (folder / "photographs/photo_000001.png").unlink()
    (folder / "photographs").rmdir()
    (folder / "photographs").symlink_to(outside / "photographs")
    with pytest.raises(LtclError, match="leads out of the folder"):
        rig.photograph(*SHOTS[0])
    with pytest.raises(LtclError, match="leads out of the folder"):
        rig.missing()


@pytest.mark.parametrize("name", ["patterns", "shots.json", "shots.csv"])
def test_nothing_is_written_through_links(tmp_path: Path, name: str) -> None:
    folder, outside = tmp_path / "scan", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (folder / name).symlink_to(outside / "target")
    with pytest.raises(FileError, match="leads out of the folder"):
        prepared(folder, 1)
    assert list(outside.iterdir()) == []


def test_links_inside_are_no_harm(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "scan").symlink_to(tmp_path / "real")
    rig = prepared(tmp_path / "scan", 1)
    elsewhere = tmp_path / "real" / "IMG_1.png"
    shutil.move(put(tmp_path / "real", 1), elsewhere)
    (tmp_path / "real/photographs/photo_000001.png").symlink_to(elsewhere)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[0]), GREY)


@pytest.mark.parametrize(
    "change",
    [
        {"projector_grid": (4, 3)},
        {"channels": 3},
        {"pattern_bits": 16},
    ],
)
def test_a_list_of_another_rig_is_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    prepared(tmp_path)
    with pytest.raises(InputError, match=r"shots\.json: was made for .*take a new folder"):
        FolderRig(tmp_path, **{"projector_grid": GRID, **change})


def broken_lists() -> list[str]:
    good = {"codes": "0" * 32, "seconds": 1.0, "repeat": 0}
    rig = {"projector_grid": list(GRID), "channels": 1, "bits": 8}

    def listed(*shots: Any, **change: Any) -> str:
        return json.dumps({"format": "ltcl shooting list 1", "rig": rig, "shots": list(shots), **change})

    return [
        "{",
        "[]",
        "5",
        "[" * 100_000,
        "\x00\x01",
        listed({**good, "codes": "../../etc/passwd"}),
        listed({**good, "codes": 7}),
        listed({**good, "seconds": -1}),
        listed({**good, "seconds": 1e999}),
        listed({**good, "seconds": "1"}),
        listed({**good, "repeat": 0.5}),
        listed({"codes": "0" * 32}),
        listed(good, good),
        listed(good, format="ltcl shooting list 9"),
        listed(shots=None),
    ]


@pytest.mark.parametrize("content", broken_lists())
def test_a_damaged_list_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "shots.json").write_text(content, encoding="utf-8")
    with pytest.raises(FileError, match=r"shots\.json: is no shooting list") as error:
        FolderRig(tmp_path, GRID)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400 + len(str(tmp_path))


def test_the_camera_s_own_files_are_taken(tmp_path: Path) -> None:
    rig = prepared(tmp_path / "scan")
    (tmp_path / "card").mkdir()
    names = ["IMG_9.jpg", "IMG_10.jpg", "IMG_100.jpg", "IMG_101.jpg"]
    for k, name in enumerate(names):
        camera_files.write(tmp_path / "card" / name, np.full((8, 8), 40 * k, np.uint8), None, at(k))
    put(tmp_path / "scan", 2, np.full((8, 8), 200, np.uint8))
    paths = sorted((tmp_path / "card").iterdir())
    with pytest.raises(InputError, match="files holds 3 names; 4 photographs are missing"):
        rig.take(paths[1:])
    assert rig.missing() == (1, 3, 4, 5)
    rig.take(paths)
    assert rig.missing() == ()
    found = [int(rig.photograph(*shot)[4, 4]) for shot in SHOTS]
    np.testing.assert_allclose(found, [0, 200, 40, 80, 120], atol=1)
    assert len(list((tmp_path / "card").iterdir())) == 4  # copied, not moved


def test_only_photographs_are_taken(tmp_path: Path) -> None:
    rig = prepared(tmp_path, 1)
    (tmp_path / "a.txt").write_text("no picture")
    with pytest.raises(FileError, match=r"a\.txt: extension \.txt is unknown; photographs are \.png"):
        rig.take([tmp_path / "a.txt"])
    with pytest.raises(FileError, match="no such file"):
        rig.take([tmp_path / "b.png"])


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"projector_grid": (0, 1)}, "projector_grid"),
        ({"channels": 2}, "channels is 2"),
        ({"pattern_bits": 12}, "pattern_bits is 12; it must be 8 or 16"),
        ({"camera_bits": 17}, "camera_bits"),
        ({"in_order": 1}, "in_order"),
    ],
)
def test_impossible_rigs_are_refused(tmp_path: Path, change: dict[str, Any], part: str) -> None:
    with pytest.raises(LtclError, match=part):
        FolderRig(**{"folder": tmp_path, "projector_grid": GRID, **change})


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("x")
    with pytest.raises(FileError, match="is a file; it must be a folder"):
        FolderRig(tmp_path / "a", GRID)


def test_bad_shots_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    rig = FolderRig(tmp_path / "scan", GRID)
    for codes, seconds in [(np.zeros((1, 1)), 1.0), (WHITE * 2, 1.0), (WHITE, 0.0)]:
        with pytest.raises(InputError):
            rig.photograph(codes, seconds)
        with pytest.raises(InputError):
            rig.prepare([(codes, seconds)])
    assert not (tmp_path / "scan").exists()
