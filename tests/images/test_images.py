# SPDX-License-Identifier: BSD-3-Clause
"""What is written is what is read, format by format."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from ltcl import images
from ltcl.errors import FileError, InputError, InputTypeError

random = np.random.default_rng(3)
SHAPES = [(1, 1), (5, 7), (53, 7), (5, 7, 3), (1, 9, 3)]
INTEGER = [(".png", 8), (".png", 16), (".bmp", 8), (".tif", 8), (".tiff", 16)]


def opencv_reads(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    stored = cv2.imread(str(path), flags)
    assert stored is not None
    return stored


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("encoding", ["auto", "srgb", "linear"])
@pytest.mark.parametrize(("suffix", "bits"), INTEGER)
def test_integer_formats_give_every_code_back(tmp_path, suffix, bits, encoding, shape):
    most = 2**bits - 1
    codes = random.integers(0, most + 1, shape)
    linear = codes / most if encoding == "linear" else images.from_srgb(codes / most)
    images.write(tmp_path / f"a{suffix}", linear, encoding=encoding, bits=bits)
    result = images.read(tmp_path / f"a{suffix}", encoding=encoding)
    assert result.dtype == np.float32
    assert result.flags.c_contiguous
    np.testing.assert_array_equal(result, linear.astype(np.float32))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("suffix", "bits"), [(".tif", 32), (".exr", 32), (".exr", 16), (".EXR", 32)])
def test_float_formats_are_exact_and_never_clip(tmp_path, suffix, bits, shape):
    linear = (10 * random.normal(size=shape)).astype(np.float16 if bits == 16 else np.float32)
    images.write(tmp_path / f"a{suffix}", linear, bits=bits)
    result = images.read(tmp_path / f"a{suffix}")
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result, linear)


def test_float_formats_can_hold_srgb(tmp_path):
    linear = random.random((4, 5)).astype(np.float32)
    images.write(tmp_path / "a.tif", linear, encoding="srgb")
    np.testing.assert_array_equal(images.read(tmp_path / "a.tif"), images.to_srgb(linear))
    np.testing.assert_allclose(images.read(tmp_path / "a.tif", encoding="srgb"), linear, rtol=1e-5)


@pytest.mark.parametrize("shape", [(16, 24), (16, 24, 3)])
def test_jpeg_is_close(tmp_path, shape):
    linear = np.broadcast_to(
        np.linspace(0.1, 0.9, 24)[(None, slice(None)) + (None,) * (len(shape) - 2)], shape
    )
    images.write(tmp_path / "a.jpg", linear)
    assert images.read(tmp_path / "a.jpg").shape == shape
    # JPEG at 95 moves a smooth ramp by some codes of 255; the curve's slope is below 2.3.
    np.testing.assert_allclose(images.read(tmp_path / "a.jpg"), linear, atol=2.3 * 4 / 255)


def test_the_usual_bits_of_each_format(tmp_path):
    for suffix, name in {".png": "uint8", ".jpg": "uint8", ".bmp": "uint8", ".tif": "float32"}.items():
        images.write(tmp_path / f"a{suffix}", np.full((2, 2), 0.5))
        assert opencv_reads(tmp_path / f"a{suffix}").dtype == name


def test_integer_formats_clip_and_float_ones_do_not(tmp_path):
    beyond = np.array([[-1.0, 2.0]])
    images.write(tmp_path / "a.png", beyond)
    np.testing.assert_array_equal(images.read(tmp_path / "a.png"), [[0, 1]])
    images.write(tmp_path / "a.exr", beyond)
    np.testing.assert_array_equal(images.read(tmp_path / "a.exr"), beyond)


def test_channels_are_red_green_blue_for_other_programs(tmp_path):
    red = np.zeros((2, 2, 3))
    red[..., 0] = 1
    images.write(tmp_path / "a.png", red)
    assert opencv_reads(tmp_path / "a.png")[0, 0].tolist() == [0, 0, 255]
    images.write(tmp_path / "a.exr", red)
    assert OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()["R"].pixels.min() == 1


def test_exif_rotation_is_ignored(tmp_path):
    data = cv2.imencode(".jpg", np.zeros((5, 9, 3), np.uint8))[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01" + struct.pack(">HHIHH", 0x112, 3, 1, 6, 0) + b"\0\0\0\0"
    (tmp_path / "a.jpg").write_bytes(
        data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    )
    assert opencv_reads(tmp_path / "a.jpg", cv2.IMREAD_COLOR).shape == (9, 5, 3)  # OpenCV's own choice
    assert images.read(tmp_path / "a.jpg").shape == (5, 9, 3)


def test_palettes_are_looked_up(tmp_path):
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    (tmp_path / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 1, 8, 3, 0, 0, 0))
        + chunk(b"PLTE", bytes([10, 20, 30, 40, 50, 60]))
        + chunk(b"IDAT", zlib.compress(bytes([0, 1, 0])))
        + chunk(b"IEND", b"")
    )
    result = images.read(tmp_path / "a.png", encoding="linear")
    np.testing.assert_array_equal(np.rint(result * 255), [[[40, 50, 60], [10, 20, 30]]])


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", "uint8"), (".png", "uint16"), (".tif", "float32")])
def test_alpha_is_dropped_only_where_it_is_opaque(tmp_path, suffix, dtype):
    path = tmp_path / f"a{suffix}"
    opaque = 1 if dtype == "float32" else np.iinfo(dtype).max
    codes = np.full((3, 3, 4), opaque, dtype)
    cv2.imwrite(str(path), codes)
    np.testing.assert_array_equal(images.read(path), np.ones((3, 3, 3)))
    codes[0, 0, 3] = 0
    cv2.imwrite(str(path), codes)
    with pytest.raises(FileError, match="1 transparent"):
        images.read(path)


def test_exr_alpha_and_other_channels(tmp_path):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    plane = np.ones((2, 3), np.float32)
    rgb, path = dict.fromkeys("RGB", plane), tmp_path / "a.exr"
    for channels, shape in [({"depth": plane}, (2, 3)), (rgb, (2, 3, 3)), ({**rgb, "A": plane}, (2, 3, 3))]:
        OpenEXR.File(header, channels).write(str(path))
        np.testing.assert_array_equal(images.read(path), np.ones(shape))
    refused = [
        ({**rgb, "A": 0 * plane}, "6 transparent"),
        ({**rgb, "Z": plane}, "'B', 'G', 'R', 'Z'"),
        ({"id": plane.astype(np.uint32)}, "uint32"),
    ]
    for channels, text in refused:
        OpenEXR.File(header, channels).write(str(path))
        with pytest.raises(FileError, match=text):
            images.read(path)


def test_exr_windows_must_be_equal(tmp_path):
    window = (np.array([2, 1], np.int32), np.array([4, 2], np.int32))
    header = {"type": OpenEXR.scanlineimage, "dataWindow": window}
    OpenEXR.File(header, {"Y": np.ones((2, 3), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(FileError, match="window"):
        images.read(tmp_path / "a.exr")


@pytest.mark.parametrize("suffix", [".tif", ".exr"])
def test_nan_in_a_file_is_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    if suffix == ".exr":
        header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": np.full((2, 3), np.nan, np.float32)}).write(str(path))
    else:
        cv2.imwrite(str(path), np.full((2, 3), np.nan, np.float32))
    with pytest.raises(FileError, match="6 NaN") as error:
        images.read(path)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize(
    ("name", "image", "options", "text"),
    [
        ("a.png", np.full((2, 2), np.inf), {}, "image has 4 NaN"),
        ("a.png", np.zeros((2, 2, 4)), {}, "image has shape"),
        ("a.png", np.zeros((0, 2)), {}, "image has shape"),
        ("a.png", np.zeros((2, 2)), {"bits": 32}, "bits is 32; for .png it must be 8 or 16"),
        ("a.png", np.zeros((2, 2)), {"encoding": "gamma"}, "encoding is 'gamma'"),
        ("a.exr", np.full((2, 2), 1e5), {"bits": 16}, "65504"),
        ("a.gif", np.zeros((2, 2)), {}, ".gif is unknown; pictures are .png, .jpg"),
        ("a", np.zeros((2, 2)), {}, "has no extension"),
    ],
)
def test_what_cannot_be_written_is_refused_and_the_earlier_file_stays(tmp_path, name, image, options, text):
    path: Path = tmp_path / name
    path.write_bytes(b"earlier")
    with pytest.raises(InputError, match=text):
        images.write(path, image, **options)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == b"earlier"


def test_complex_pictures_are_refused(tmp_path):
    with pytest.raises(InputTypeError, match="image holds complex"):
        images.write(tmp_path / "a.png", np.zeros((2, 2), complex))


def test_a_file_of_several_pages_is_refused(tmp_path):
    done, data = cv2.imencodemulti(".tif", [np.zeros((4, 5), np.uint8), np.ones((4, 5), np.uint8)])
    assert done
    (tmp_path / "pages.tif").write_bytes(data.tobytes())
    with pytest.raises(FileError, match=r"pages\.tif: holds 2 pages; it must hold one picture"):
        images.read(tmp_path / "pages.tif")
