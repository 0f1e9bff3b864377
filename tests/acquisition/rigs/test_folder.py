# SPDX-License-Identifier: BSD-3-Clause
"""A folder rig with photographs of every kind, damaged folders, and mistakes in a scan."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import FolderRig, Shots, VirtualRig, acquire
from ltcl.acquisition.radiometry import Response
from ltcl.errors import AcquisitionError, FileError, InputError, LtclError, PhotographMissing
from ltcl.store import BlockStore
from tests.acquisition.rigs import camera_files

random = np.random.default_rng()
GRID = (3, 4)
WHITE = np.ones(GRID)
BLACK = np.zeros(GRID)
HALF = np.full(GRID, 128 / 255)
SHOTS = [(WHITE, 0.5), (BLACK, 0.5), (HALF, 0.5), (WHITE, 0.25), (WHITE, 0.5)]
GREY = np.arange(12, dtype=np.uint8).reshape(GRID)
COLOUR = np.arange(105, dtype=np.uint8).reshape(5, 7, 3)
RAW = np.tile(np.array([[1000, 2000], [2000, 3000]], np.uint16), (16, 24))


def place(folder: Path, suffix: str = ".png", number: int = 1) -> Path:
    path = folder / "photographs" / f"photo_{number:06d}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def put(folder: Path, number: int = 1) -> Path:
    path = place(folder, number=number)
    camera_files.write(path, GREY)
    return path


def write(path: Path, seconds: float = 1 / 30) -> None:
    if path.suffix == ".dng":
        camera_files.write_dng(path, RAW, seconds)
    else:
        camera_files.write(path, COLOUR, seconds)


def prepared(folder: Path) -> FolderRig:
    rig = FolderRig(folder, GRID)
    rig.prepare(SHOTS)
    return rig


def photograph(folder: Path, channels: int = 3) -> np.ndarray:
    """The photograph of white for 1/30 s, the only one."""
    return FolderRig(folder, (1, 1), channels).photograph([[1.0]], 1 / 30)


@pytest.mark.parametrize(("channels", "bits"), [(1, 8), (3, 16)])
def test_a_round_trip_gives_what_the_scene_gives(tmp_path: Path, channels: int, bits: int) -> None:
    T = [random.random((20, 12)) / 12 for _ in range(channels)]
    scene, direct = (Shots(VirtualRig(T, GRID, camera_grid=(4, 5), bits=12)) for _ in range(2))
    shape = GRID if channels == 1 else (*GRID, 3)
    levels = random.integers(0, 2**bits, (4, *shape))
    patterns = list((levels / (2**bits - 1)).astype(np.float32))
    shots = [(x, s) for x in patterns for s in (0.5, 2.0)] + [(patterns[0], 0.5)]
    options: dict[str, Any] = {"channels": channels, "pattern_bits": bits, "camera_bits": 12}
    Shots(FolderRig(tmp_path, GRID, **options)).prepare(shots)
    assert len(list((tmp_path / "patterns").iterdir())) == 4  # a bracket shares its pattern
    for line in camera_files.shooting_list(tmp_path):  # what a person does
        levels = images.read_codes(tmp_path / line["project"])
        image = scene.rig.photograph(levels / np.float32(2**bits - 1), float(line["seconds"]))
        images.write(tmp_path / f"{line['save as']}.tif", image / 65535, encoding="linear", bits=16)

    again = Shots(FolderRig(tmp_path, GRID, **options))
    # The last is a repeat: another photograph of the same, with other noise.
    for x, seconds in shots:
        np.testing.assert_array_equal(again.photograph(x, seconds), direct.photograph(x, seconds))
    assert (again.levels, again.name(9)) == (4096, "photograph 9 (photo_000009.tif)")
    assert again.describe()["rig"]["kind"] == "folder"


def test_patterns_at_the_projectors_own_resolution(tmp_path: Path) -> None:
    """3 x 4 pixels on 20 x 31 are blocks of 6 x 6, with 1 row of black above and below."""
    rig = FolderRig(tmp_path, GRID, projector=(20, 31))
    codes = np.arange(12).reshape(GRID) / 11
    rig.prepare([(codes, 0.5)])
    expected = np.pad(np.kron(np.rint(codes * 255), np.ones((6, 6))), [(1, 1), (3, 4)])
    np.testing.assert_array_equal(
        images.read_codes(tmp_path / "patterns/pattern_000001.png"), expected
    )
    put(tmp_path)
    np.testing.assert_array_equal(rig.photograph(codes, 0.5), GREY)
    # Another grid on the projector is another pattern.
    with pytest.raises(PhotographMissing, match="photograph 2 "):
        FolderRig(tmp_path, GRID).photograph(codes, 0.5)


@pytest.mark.parametrize("name", ["unknown", "0", "photographs.txt", "photographs/photo_1.webp"])
def test_the_first_that_is_missing_is_the_next_step(tmp_path: Path, name: str) -> None:
    """Other entries of the folder hide no photograph; a missing one is not counted as a repeat."""
    rig = prepared(tmp_path)
    (tmp_path / name).write_text("notes")
    message = r"photograph 1 .*pattern_000001.*0\.5 s"
    for codes, seconds in (SHOTS[0], SHOTS[2]):
        with pytest.raises(PhotographMissing, match=message) as error:
            rig.photograph(codes, seconds)
        assert (error.value.number, error.value.missing) == (1, 5)
        shot = error.value.shot
        assert (shot.number, shot.seconds) == (1, 0.5)
        assert shot.pattern == "patterns/pattern_000001.png"
        assert shot.save_as == "photographs/photo_000001"
    put(tmp_path)
    np.testing.assert_array_equal(rig.photograph(*SHOTS[0]), GREY)
    assert rig.missing() == (2, 3, 4, 5)


def test_preparing_twice_changes_nothing_and_a_second_batch_counts_on(tmp_path: Path) -> None:
    path = tmp_path / "patterns/pattern_000001.png"
    images.write(path, BLACK, encoding="linear")  # of a run that died before its list was there
    prepared(tmp_path)
    assert np.all(images.read_codes(path) == 255)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    path.unlink()
    (tmp_path / "shots.csv").unlink()
    rig = prepared(tmp_path)
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    put(tmp_path)
    rig.photograph(*SHOTS[0])
    with pytest.raises(InputError):  # after the second and a third photograph of the same
        rig.prepare([SHOTS[0], SHOTS[0], (WHITE, 0.0)])
    with pytest.raises(PhotographMissing) as error:
        rig.photograph(HALF, 1.0)  # nobody announced it
    assert (error.value.number, error.value.missing) == (2, 6)
    assert len(FolderRig(tmp_path, GRID).shots) == 7


@pytest.mark.parametrize("other", ["PHOTO_000001.PNG", "photo_1.png"])
def test_two_files_for_one_number_are_refused(tmp_path: Path, other: str) -> None:
    """Names that differ in case only are two files as well, if the file system keeps them apart."""
    rig = prepared(tmp_path)
    path = put(tmp_path)
    shutil.copy(path, path.with_name(other))
    names = "|".join([other, path.name])
    with pytest.raises(AcquisitionError, match=f"({names}) and ({names})"):
        rig.photograph(*SHOTS[0])
    path.unlink()
    np.testing.assert_array_equal(rig.photograph(*SHOTS[0]), GREY)


BROKEN = ["", "[]", "[" * 100_000, "\x00\x01", '{"format": "ltcl shooting list 9", "shots": []}']
WRONG = [
    7,
    None,
    [{"codes": "0"}],
    [{"codes": "0", "seconds": -1}],
    [{"codes": "0", "seconds": np.inf}],
]
LISTS = [json.dumps({"format": "ltcl shooting list 1", "shots": shots}) for shots in WRONG]


@pytest.mark.parametrize("damage", [b"", b"damaged", None])
def test_a_damaged_pattern_is_written_again(tmp_path: Path, damage: bytes | None) -> None:
    prepared(tmp_path)
    pattern = tmp_path / "patterns/pattern_000001.png"
    good = pattern.read_bytes()
    pattern.write_bytes(good[:-20] if damage is None else damage)
    prepared(tmp_path)
    assert pattern.read_bytes() == good


@pytest.mark.parametrize("content", BROKEN + LISTS)
def test_a_damaged_list_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "shots.json").write_text(content, encoding="utf-8")
    with pytest.raises(FileError, match=r"shots\.json: ") as error:
        FolderRig(tmp_path, GRID)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400 + len(str(tmp_path))


def test_the_cameras_own_files_are_taken(tmp_path: Path) -> None:
    """Files come in the order of their numbers, all or none, and each once."""
    rig = prepared(tmp_path)
    paths = [tmp_path / name for name in ("IMG_101.png", "IMG_100.png", "IMG_10.png", "IMG_9.png")]
    for k, path in enumerate(paths):
        camera_files.write(path, GREY + 4 - k)
    put(tmp_path, 2)
    with pytest.raises(InputError, match=r"holds 3 .* 4 "):
        rig.take(paths[1:])
    with pytest.raises(InputError, match=r"test_folder\.py: "):
        rig.take([*paths[1:], __file__])
    assert rig.missing() == (1, 3, 4, 5)
    rig.take(paths)
    first_codes = [rig.photograph(codes, seconds)[0, 0] for codes, seconds in SHOTS]
    assert first_codes == [1, 0, 2, 3, 4]
    assert all(path.exists() for path in paths)  # copied, not moved
    rig.prepare([(HALF, 1.0), (HALF, 1.0)])
    with pytest.raises(InputError, match=r"0 new .* 2 .* 6 to 7"):
        rig.take(paths)
    new = tmp_path / "IMG_11.png"
    camera_files.write(new, GREY + 5)
    twin = tmp_path / "IMG_102.png"
    shutil.copyfile(paths[0], twin)  # a second one, equal in every byte
    rig.take([twin, new, *paths])
    assert rig.photograph(HALF, 1.0)[0, 0] == 5
    assert rig.photograph(HALF, 1.0)[0, 0] == 4


def test_photographs_of_another_scan_are_left_out(tmp_path: Path) -> None:
    """The card keeps them; one that is new is named."""
    scan = tmp_path / "scan"
    rig = FolderRig(scan, GRID)
    rig.prepare([(HALF, 1.0)])
    old = tmp_path / "IMG_1.png"
    camera_files.write(old, GREY + 1)
    new = tmp_path / "IMG_2.png"
    camera_files.write(new, GREY + 2)
    copies = [shutil.copyfile(old, tmp_path / "copy.png")]
    with pytest.raises(InputError, match=r"0 new photographs, but 1 is missing, number 1;"):
        rig.take([old], known=copies)
    with pytest.raises(InputError, match=r"2 new photographs, IMG_1\.png to IMG_2\.png, but 1 is"):
        rig.take([old, new])
    rig.take([old, new], known=copies)
    assert rig.photograph(HALF, 1.0)[0, 0] == 2


NAMES = ["projector_grid", "channels", "camera_bits", "pattern_bits", "projector", "exposures"]


@pytest.mark.parametrize(
    ("change", "part"),
    [
        *(({name: 1080}, f"{name} is 1080") for name in NAMES),
        ({"projector": (2, 1080)}, "grid is 4 x 3.*1080 x 2"),
        ({"folder": __file__}, "is a file"),
    ],
)
def test_impossible_rigs_are_refused(tmp_path: Path, change: dict[str, Any], part: str) -> None:
    with pytest.raises(LtclError, match=part):
        FolderRig(**{"folder": tmp_path, "projector_grid": GRID, **change})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
@pytest.mark.parametrize(
    "kind", [".png 8", ".tif 8", ".bmp 8", ".png 16", ".tif 16", ".tif 32", ".exr 32"]
)
def test_codes_are_not_changed(tmp_path: Path, kind: str, shape: tuple[int, ...]) -> None:
    suffix, bits = kind.split()
    codes = random.integers(0, 1 << min(int(bits), 16), shape)
    light: Any = np.float32(codes / (255 if bits == "8" else 65535))
    images.write(place(tmp_path, suffix), light, encoding="linear", bits=int(bits))
    expected = light if bits == "32" else codes
    np.testing.assert_array_equal(photograph(tmp_path), expected)
    (tmp_path / "shots.json").unlink()
    np.testing.assert_array_equal(
        photograph(tmp_path, 1), expected if codes.ndim == 2 else expected[..., 1]
    )


def test_floats_above_full_scale_are_refused(tmp_path: Path) -> None:
    """Codes of 12 bits as floats. A hot pixel alone is no reason."""
    codes = np.full((12, 16), 0.5, np.float32)
    codes[3, 4] = 7.0
    codes[0, 0] = 1.0005
    images.write(place(tmp_path, ".exr"), codes)
    np.testing.assert_array_equal(photograph(tmp_path), codes)
    images.write(place(tmp_path, ".exr"), codes * np.float32(300.0))
    with pytest.raises(AcquisitionError, match=r"photograph 1 \(photo_000001\.exr\) reaches 2100"):
        photograph(tmp_path)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".dng"])
def test_exposures_in_the_file_are_those_of_the_list(tmp_path: Path, suffix: str) -> None:
    path = place(tmp_path, suffix)
    for seconds in (1 / 30, 1 / 31, 0.0):
        write(path, seconds)
        assert photograph(tmp_path).shape[2] == 3
    for seconds in (1 / 34, 1 / 24):
        write(path, seconds)
        with pytest.raises(AcquisitionError, match=rf"exposed for {seconds:.4g} s .* 0\.03333 s"):
            photograph(tmp_path)


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".png", ".dng"])
def test_damage_gives_one_line_or_a_photograph(tmp_path: Path, suffix: str) -> None:
    path = place(tmp_path, suffix)
    write(path)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    for _ in range(50):
        damaged = content.copy()
        end, *places = random.integers(0, len(content), 4)
        damaged[places] = random.integers(0, 256, 3)
        if end % 2:
            damaged = damaged[:end]
        path.write_bytes(damaged.tobytes())
        try:
            assert photograph(tmp_path).size
        except LtclError as error:
            message = str(error)
            assert message.startswith(f"photograph 1 ({path.name}) ")
            assert "\n" not in message


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_raw_is_linear_keeps_its_black_and_depends_on_nothing_else(
    tmp_path: Path, scale: float
) -> None:
    raw = np.rint(RAW * scale).astype(np.uint16)
    expected = np.array([1000, 2000, 3000]) * scale * 65535 / 4095  # no gain but that of full scale
    for _ in range(2):
        camera_files.write_dng(place(tmp_path, ".dng"), raw, 1 / 30)
        codes = photograph(tmp_path)
        assert (codes.shape, codes.dtype) == ((32, 48, 3), np.uint16)
        np.testing.assert_allclose(codes[20:], np.broadcast_to(expected, (12, 48, 3)), atol=1.5)
        raw[10:14, 10:14] = 4000


@pytest.mark.parametrize("channels", [1, 3])
def test_raw_of_a_monochrome_camera_is_grey(tmp_path: Path, channels: int) -> None:
    raw = random.integers(500, 4000, (64, 96)).astype(np.uint16)
    path = place(tmp_path, ".dng")
    camera_files.write_dng(path, raw, 1 / 30, photometric=34892)
    codes = photograph(tmp_path, channels)
    np.testing.assert_allclose(codes, raw * (65535 / 4095), atol=1.5)


def test_raw_in_a_folder_whose_name_is_not_utf_8(tmp_path: Path) -> None:
    folder = tmp_path / b"caf\xe9".decode("utf-8", "surrogateescape")
    camera_files.write_dng(place(folder, ".dng"), RAW, 1 / 30)
    assert photograph(folder).shape == (32, 48, 3)


def test_raw_without_rawpy_and_of_a_size_beyond_memory_is_refused(
    tmp_path: Path, monkeypatch: Any
) -> None:
    camera_files.write_dng(place(tmp_path, ".dng"), RAW, 1 / 30, w=40_000, h=40_000)
    for message in (r"^photograph 1 \(photo_000001\.dng\) cannot be used: ", r"ltcl\[camera\]"):
        with pytest.raises(AcquisitionError, match=message):
            photograph(tmp_path)
        monkeypatch.setitem(sys.modules, "rawpy", None)


LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))  # of a camera with an offset of 0.4 %


def scan(folder: Path, store: Path, progress: Any = None) -> np.ndarray:
    """T, (32, 32) float64."""
    options: dict[str, Any] = {
        "geometry": "aligned",
        "strategy": "pixel",
        "frames": 2,
        "response": LINE,
    }
    T = acquire(
        FolderRig(folder, (4, 8)), **options, exposures=[0.5, 8.0], store=store, progress=progress
    )
    return T.matrices[0].tocsr().toarray().astype(np.float64)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A folder with all that a person photographed for a scan, and the T that came of it."""
    root = tmp_path_factory.mktemp("session")
    truth = ltcl.scenes.dihedral(4, albedo=0.6).transport().matrices[0]
    lit = VirtualRig(truth, (4, 8), ambient=0.01, response="linear")
    for _ in range(30):
        try:
            T = scan(root / "photos", root / "T.zarr")
        except PhotographMissing:
            for shot in camera_files.shooting_list(root / "photos"):
                path = root / "photos" / f"{shot['save as']}.png"
                seconds = float(shot["seconds"])
                codes = images.read_codes(root / "photos" / shot["project"]) / np.float32(255)
                if not path.exists():
                    camera_files.write(path, lit.photograph(codes, seconds), seconds)
        else:
            unit = np.sum(truth @ np.ones(32)) / np.sum(T)
            assert np.linalg.norm(unit * T - truth) < 0.05 * np.linalg.norm(truth)
            assert FolderRig(root / "photos", (4, 8)).missing() == ()  # no number is left over
            return root / "photos", T
    raise AssertionError("the list of photographs has no end")


def stop(step: str, done: int, total: int) -> None:
    if step == "scan":
        raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.parametrize(
    ("swaps", "text"),
    [
        ([], r"photograph {0} is missing .*project patterns/pattern_"),
        ([(0, 3)], r"photograph {0} \(photo_{0:06}\.png\) was exposed for"),
        ([(0, 2), (1, 3)], r"{0} \(photo_.* {1} .* {2} .* {3} "),  # two patterns
    ],
)
def test_a_bad_photograph_is_named_by_its_file(
    session: tuple[Path, np.ndarray], tmp_path: Path, swaps: list[tuple[int, int]], text: str
) -> None:
    """The calibration is of an earlier session; with the right files the scan goes on."""
    folder = tmp_path / "photos"
    store = tmp_path / "T.zarr"
    shutil.copytree(session[0], folder)
    with pytest.raises(KeyboardInterrupt):
        scan(folder, store, stop)
    first = len(list((folder / "photographs").iterdir())) - 6  # before the pattern of blocks
    paths = [place(folder, number=first + k) for k in range(4)]
    for a, b in swaps:
        content = paths[a].read_bytes()
        shutil.copy(paths[b], paths[a])
        paths[b].write_bytes(content)
    if not swaps:
        paths[0].unlink()
    with pytest.raises(AcquisitionError, match=text.format(*range(first, first + 4))):
        scan(folder, store)
    assert BlockStore.open(store).written
    shutil.copytree(session[0] / "photographs", folder / "photographs", dirs_exist_ok=True)
    np.testing.assert_array_equal(scan(folder, store), session[1])


def test_the_first_photograph_tells_the_size_of_the_camera(tmp_path: Path) -> None:
    rig = prepared(tmp_path)
    assert rig.photographed_grid() is None
    path = place(tmp_path, number=2)
    write(path)
    assert rig.photographed_grid() == images.read_codes(path).shape[:2]
