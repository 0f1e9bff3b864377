# SPDX-License-Identifier: BSD-3-Clause
"""Videos of other programs: codecs, transparency, display matrices, HDR and damage."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from ltcl import images
from ltcl.errors import FileError
from ltcl.images.frames import open_frames, write_video

random = np.random.default_rng(11)
H, W = 48, 64
y, x = np.mgrid[:H, :W]
# Smooth, and unlike in all four corners.
PICTURE = np.stack([40 + 2 * x, 60 + 3 * y, 200 - x - y], axis=-1).astype(np.uint8)


def encode(
    path: Path, codec: str, pixels: str, codes: list[np.ndarray] | None = None, **settings: Any
) -> Path:
    """A video of frames (h, w, 3 or 4), 25 a second; `settings` are those of the codec context."""
    frames = codes or [np.roll(PICTURE, k, axis=1) for k in range(6)]
    options = {"x265-params": "log-level=none"} if codec == "libx265" else {}
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=Fraction(25), options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        for name, value in settings.items():
            setattr(stream.codec_context, name, value)
        for picture in frames:
            format = "rgba" if picture.shape[2] == 4 else "rgb24"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format=format)))
        container.mux(stream.encode())
    return path


def read(path: Path, **options: Any) -> list[np.ndarray]:
    return [frame.picture() for frame in open_frames(path, **options)]


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mov", "libx264", "yuv422p10le"),
        ("a.mkv", "libx265", "yuv420p10le"),
        ("a.mp4", "libsvtav1", "yuv420p"),
        ("a.webm", "libvpx-vp9", "yuv420p"),
        ("a.ts", "mpeg2video", "yuv420p"),
        ("a.wmv", "wmv2", "yuv420p"),
        ("a.avi", "mjpeg", "yuvj420p"),
        ("a.mov", "prores_ks", "yuv422p10le"),
        ("a.mkv", "ffv1", "gray"),
        ("a.mov", "png", "rgb24"),
    ],
)
def test_every_common_codec_is_read(tmp_path, name, codec, pixels):
    path = encode(tmp_path / name, codec, pixels)
    light = read(path)
    assert len(light) == 6
    assert open_frames(path).fps == 25
    codes = 255 * images.to_srgb(light[0])
    expected = PICTURE
    if pixels == "gray":
        expected = PICTURE @ np.array([0.299, 0.587, 0.114])
    # Colours are stored at half the resolution, and compressed.
    assert np.median(np.abs(codes - expected)) < 6


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mkv", "ffv1", "bgra"),
        ("a.mov", "prores_ks", "yuva444p10le"),
        ("a.mov", "png", "rgba"),
        ("a.mov", "qtrle", "argb"),
    ],
)
def test_transparent_frames_are_refused_and_opaque_ones_read(tmp_path, name, codec, pixels):
    opaque = np.dstack([PICTURE, np.full((H, W), 255, np.uint8)])
    path = encode(tmp_path / name, codec, pixels, [opaque] * 2)
    assert len(read(path)) == 2
    clear = opaque.copy()
    clear[:8, :8, 3] = 40
    path = encode(tmp_path / name, codec, pixels, [opaque, clear])
    frames = iter(open_frames(path))
    next(frames)
    with pytest.raises(FileError, match=rf"{path}: .* transparent"):
        next(frames)


def test_vp9_with_transparency_is_refused(tmp_path):
    path = encode(tmp_path / "a.webm", "libvpx-vp9", "yuva420p")
    with pytest.raises(FileError, match=rf"{path}: .*transparency"):
        open_frames(path)


ONE = 1 << 16


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("is_mirrored", [False, True])
def test_a_display_matrix_turns_and_mirrors_as_a_player_does(tmp_path, turns, is_mirrored):
    path = encode(tmp_path / "a.mp4", "libx264", "yuv420p")
    stored = read(path)
    data = path.read_bytes()
    identity = struct.pack(">9i", ONE, 0, 0, 0, ONE, 0, 0, 0, 1 << 30)
    # A pixel goes from (x, y) to (x, y) @ matrix; mirrored left and right before the turns.
    matrix = np.diag([-1 if is_mirrored else 1, 1])
    quarter_turn_clockwise = np.array([[0, 1], [-1, 0]])
    matrix = matrix @ np.linalg.matrix_power(quarter_turn_clockwise, turns)
    a, b, c, d = (ONE * matrix).ravel().tolist()
    turned = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    place = data.index(identity, data.index(b"tkhd"))
    path.write_bytes(data[:place] + turned + data[place + 36 :])
    for picture, expected in zip(read(path), stored, strict=True):
        if is_mirrored:
            expected = expected[:, ::-1]
        np.testing.assert_array_equal(picture, np.rot90(expected, -turns))


def test_a_sheared_video_is_refused(tmp_path):
    path = encode(tmp_path / "a.mp4", "libx264", "yuv420p")
    data = path.read_bytes()
    identity = struct.pack(">9i", ONE, 0, 0, 0, ONE, 0, 0, 0, 1 << 30)
    sheared = struct.pack(">9i", ONE, ONE // 2, 0, 0, ONE, 0, 0, 0, 1 << 30)
    place = data.index(identity, data.index(b"tkhd"))
    path.write_bytes(data[:place] + sheared + data[place + 36 :])
    with pytest.raises(FileError, match=f"{path}: .*display matrix"):
        read(path)


@pytest.mark.parametrize(("curve", "name"), [(16, "PQ"), (18, "HLG")])
def test_hdr_is_refused_unless_the_caller_knows_better(tmp_path, curve, name):
    path = encode(tmp_path / "a.mp4", "libx264", "yuv420p10le", color_trc=curve)
    with pytest.raises(FileError, match=rf"{path}: .*{name}"):
        open_frames(path)
    assert len(read(path, encoding="srgb")) == 6


def test_a_video_of_linear_light_is_linear(tmp_path):
    path = encode(tmp_path / "a.mp4", "libx264", "yuv444p", color_trc=8)
    np.testing.assert_array_equal(read(path), read(path, encoding="linear"))


def test_wide_gamut_is_told_once(tmp_path, caplog):
    path = encode(tmp_path / "a.mp4", "libx264", "yuv420p", color_primaries=9)
    read(path)
    assert [record.message.count("BT.2020") for record in caplog.records] == [1]


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [("a.avi", "mpeg4", "yuv420p"), ("a.ts", "mpeg2video", "yuv420p"), ("a.mkv", "ffv1", "bgr0")],
)
def test_damage_is_told_once_and_by_us_alone(tmp_path, capfd, caplog, name, codec, pixels):
    noise = [random.integers(0, 256, (H, W, 3)).astype(np.uint8) for _ in range(6)]
    path = encode(tmp_path / name, codec, pixels, noise)
    data = bytearray(path.read_bytes())
    for place in random.integers(len(data) // 2, int(0.9 * len(data)), 20):
        data[place] ^= 255
    path.write_bytes(bytes(data))
    try:
        read(path)
        messages = [record.message for record in caplog.records]
    except FileError as error:
        messages = [str(error)]
    assert len(messages) == 1
    assert messages[0].startswith(f"{path}: ")
    assert "damaged" in messages[0]
    assert capfd.readouterr() == ("", "")


PLAYLIST = "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n"


@pytest.mark.parametrize("text", [PLAYLIST, "ffconcat version 1.0\nfile {}\n"])
def test_playlists_that_name_other_files_are_no_videos(tmp_path, text):
    other = encode(tmp_path / "a.ts", "mpeg2video", "yuv420p")
    path = tmp_path / "list.mkv"
    path.write_text(text.format(other))
    with pytest.raises(FileError, match=f"{path}: "):
        open_frames(path)


LATIN_1 = b"H\xf6he".decode("utf-8", "surrogateescape")


@pytest.mark.parametrize("folder", ["", LATIN_1])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr", ".mkv", ".mp4"])
def test_names_that_are_not_utf_8(tmp_path, folder, suffix):
    (tmp_path / folder).mkdir(exist_ok=True)
    path = tmp_path / folder / f"{LATIN_1}{suffix}"
    light = np.full((4, 6), 0.5)
    if suffix in images.BITS:
        images.write(path, light)
        found = images.read(path)
    else:
        assert write_video(path, [light] * 2) == 2
        found, _ = read(path)
    np.testing.assert_allclose(found, 0.5, atol=0.03)
    assert [file.name for file in (tmp_path / folder).iterdir() if file.is_file()] == [path.name]
