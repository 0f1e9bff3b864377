# SPDX-License-Identifier: BSD-3-Clause
"""Pictures written and read, format by format; the sRGB curve and resampling."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image, ImageOps

from ltcl import images
from ltcl.errors import FileError, InputError, InputTypeError

random = np.random.default_rng(3)
SHAPES = [(1, 1), (53, 7), (1, 9, 3)]
INTEGERS = [(".png", 8), (".png", 16), (".bmp", 8), (".tif", 8), (".tiff", 16)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("encoding", ["auto", "srgb", "linear"])
@pytest.mark.parametrize(("suffix", "bits"), INTEGERS)
def test_integer_formats_give_every_code_back(tmp_path, suffix, bits, encoding, shape):
    path = tmp_path / f"a{suffix}"
    white = 2**bits - 1
    codes = random.integers(0, white + 1, shape)
    linear = codes / white
    if encoding != "linear":
        linear = images.from_srgb(linear)
    images.write(path, linear, encoding=encoding, bits=bits)
    result = images.read(path, encoding=encoding)
    assert (result.dtype, result.flags.c_contiguous) == (np.float32, True)
    np.testing.assert_array_equal(result, linear.astype(np.float32))
    np.testing.assert_array_equal(images.read_codes(path), codes)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("suffix", "bits"), [(".tif", 32), (".exr", 32), (".EXR", 16)])
def test_float_formats_are_exact_and_never_clip(tmp_path, suffix, bits, shape):
    linear = (10 * random.normal(size=shape)).astype(np.float16 if bits == 16 else np.float32)
    images.write(tmp_path / f"a{suffix}", linear, bits=bits)
    assert images.read_codes(tmp_path / f"a{suffix}").dtype == linear.dtype
    np.testing.assert_array_equal(images.read(tmp_path / f"a{suffix}"), linear)


@pytest.mark.parametrize(
    ("suffix", "dtype", "bgr"),
    [
        *((name, np.uint8, [0, 255, 0]) for name in (".png", ".jpg", ".bmp")),
        (".tif", np.float32, [0, 2, -1]),
    ],
)
def test_defaults_clipping_and_order_of_channels_as_other_programs_see_them(
    tmp_path, suffix, dtype, bgr
):
    images.write(tmp_path / f"a{suffix}", np.tile([-1.0, 2.0, 0.0], (8, 8, 1)))
    stored = cv2.imread(str(tmp_path / f"a{suffix}"), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored.dtype == dtype
    np.testing.assert_allclose(stored[4, 4], bgr, atol=2 if suffix == ".jpg" else 0)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_a_picture_is_read_upright_and_a_photograph_keeps_its_pixels(
    tmp_path, suffix, orientation, channels
):
    path = tmp_path / f"a{suffix}"
    codes = random.integers(0, 256, (2, 3, *channels)).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    picture = Image.fromarray(codes)
    picture.getexif()[274] = orientation
    picture.save(path, exif=picture.getexif(), quality=100, subsampling=0)
    upright = np.asarray(ImageOps.exif_transpose(picture))
    np.testing.assert_allclose(images.read_codes(path), codes, atol=4)
    for is_upright, expected in ((True, upright), (False, codes)):
        light = images.read(path, encoding="linear", upright=is_upright)
        np.testing.assert_allclose(255 * light, expected, atol=4)


def test_palettes_are_looked_up_and_bits_are_black_and_white(tmp_path):
    palette = Image.fromarray(np.array([[1, 0]], np.uint8), "P")
    bits = Image.fromarray(np.eye(2) > 0)
    palette.putpalette([10, 20, 30, 40, 50, 60])
    for picture, codes in ((palette, [[[40, 50, 60], [10, 20, 30]]]), (bits, 255 * np.eye(2))):
        picture.save(tmp_path / "a.png")
        np.testing.assert_array_equal(images.read_codes(tmp_path / "a.png"), codes)


@pytest.mark.parametrize(
    ("suffix", "dtype"), [(".png", "uint8"), (".png", "uint16"), (".tif", "float32")]
)
def test_alpha_is_dropped_only_where_it_is_opaque(tmp_path, suffix, dtype):
    path = tmp_path / f"a{suffix}"
    white = 1 if dtype == "float32" else np.iinfo(dtype).max
    codes = np.full((3, 3, 4), white, dtype)
    cv2.imwrite(str(path), codes)
    np.testing.assert_array_equal(images.read(path), np.ones((3, 3, 3)))
    codes[0, 0, 3] = 0
    cv2.imwrite(str(path), codes)
    with pytest.raises(FileError, match="1 transparent"):
        images.read(path)


PLANE = np.ones((2, 3), np.float32)
RGB = {"R": PLANE, "G": 2 * PLANE, "B": 3 * PLANE}
PLAIN = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
SHIFTED = {**PLAIN, "dataWindow": (np.array([2, 1], np.int32), np.array([4, 2], np.int32))}


@pytest.mark.parametrize(
    ("content", "outcome"),  # header and channels of an .exr, or pages of a .tif
    [
        ((PLAIN, {"depth": PLANE}), PLANE),
        ((PLAIN, {**RGB, "A": PLANE}), np.stack([*RGB.values()], axis=-1)),
        ((PLAIN, {**RGB, "A": 0 * PLANE}), "6 transparent"),
        ((PLAIN, {**RGB, "Z": PLANE}), "'Z'"),
        ((PLAIN, {"id": PLANE.astype(np.uint32)}), "UINT"),
        ((SHIFTED, {"Y": PLANE}), "window"),
        ((PLAIN, {"Y": np.nan * PLANE}), "6 NaN"),
        ([np.nan * PLANE], "6 NaN"),
        ([np.zeros((2, 2), np.int16)], "int16"),
        ([PLANE, PLANE], "pages"),
    ],
)
def test_files_of_other_programs(tmp_path, content, outcome):
    path = tmp_path / ("a.exr" if isinstance(content, tuple) else "a.tif")
    if isinstance(content, tuple):
        OpenEXR.File(*content).write(str(path))
    else:
        path.write_bytes(cv2.imencodemulti(".tif", content)[1].tobytes())
    if isinstance(outcome, str):
        with pytest.raises(FileError, match=f"{path}: .*{outcome}"):
            images.read(path)
    else:
        np.testing.assert_array_equal(images.read(path), outcome)


BLACK = np.zeros((2, 2))


@pytest.mark.parametrize(
    ("name", "image", "options", "text"),
    [
        ("a.png", np.full((2, 2), np.inf), {}, "image has 4 NaN"),
        ("a.png", np.zeros((2, 2, 4)), {}, "image has shape"),
        ("a.png", BLACK, {"bits": 32}, "bits is 32; .* 8 or 16"),
        ("a.png", BLACK, {"encoding": "gamma"}, "encoding is 'gamma'"),
        ("a.exr", np.full((2, 2), 1e5), {"bits": 16}, "65504"),
        ("a.jpg", np.zeros((1, 70000)), {}, r"a\.jpg: .*70000"),
        ("a.gif", BLACK, {}, r"\.gif .*\.png.*\.exr"),
    ],
)
def test_what_cannot_be_written_is_refused_and_the_earlier_file_stays(
    tmp_path, name, image, options, text
):
    path: Path = tmp_path / name
    path.write_bytes(b"earlier")
    with pytest.raises((InputError, InputTypeError), match=text):
        images.write(path, image, **options)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [(name, b"earlier")]


# float32 keeps 24 bits; the power 2.4 multiplies a relative rounding error by 2.4.
@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 1e-7), (np.float32, 1e-6)])
def test_the_srgb_curve_is_the_closed_form_and_undone_also_outside_0_to_1(dtype, rtol):
    for code in np.linspace(0, 1, 257):
        # IEC 61966-2-1.
        exact = code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4
        assert images.from_srgb(np.float64(code)) == pytest.approx(exact, rel=1e-14)
    values = np.concatenate([[0, 0.04045], np.linspace(-2, 3, 501)]).astype(dtype)
    assert images.from_srgb(values).dtype == dtype
    np.testing.assert_allclose(
        images.to_srgb(images.from_srgb(values)), values, rtol=rtol, atol=1e-7
    )
    np.testing.assert_allclose(
        images.from_srgb(images.to_srgb(values)), values, rtol=3 * rtol, atol=1e-7
    )
    with pytest.raises(InputTypeError, match="encoded holds"):
        images.from_srgb(np.array([1j]))


def test_shrinking_averages_areas_per_axis_and_growing_interpolates():
    image = random.random((12, 20, 3))
    blocks = image.reshape(4, 3, 4, 5, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(images.resize(image, (4, 4)), blocks, rtol=1e-5)
    np.testing.assert_allclose(images.resize(image, (7, 11)).mean(), image.mean(), rtol=1e-5)
    ramp = images.resize(np.arange(4.0)[None, :], (1, 8))[0, 1:-1]
    np.testing.assert_allclose(ramp, np.linspace(0.25, 2.75, 6), rtol=1e-6)
    columns = images.resize(image, (4, 20))
    np.testing.assert_array_equal(images.resize(image, (4, 31)), images.resize(columns, (4, 31)))
    with pytest.raises(InputError, match="grid"):
        images.resize(image, (0, 4))


def test_other_proportions_are_cut_off_or_lie_between_bars():
    """A wide picture, bright in the middle, and a tall one, onto a square."""
    wide = np.zeros((4, 8), np.float32)
    wide[:, 2:6] = np.arange(4)[:, None] + 1.0
    middle = wide[:, 2:6]
    np.testing.assert_array_equal(images.resize(wide, (4, 4), "crop"), middle)
    np.testing.assert_array_equal(images.resize(wide.T, (4, 4), "crop"), middle.T)
    colours = np.stack([wide, 2 * wide, 3 * wide], axis=2)
    np.testing.assert_array_equal(images.resize(colours, (4, 4), "crop")[..., 2], 3 * middle)

    between = images.resize(wide, (8, 8), "letterbox")
    np.testing.assert_array_equal(between[2:6], wide)
    assert not between[:2].any()
    assert not between[6:].any()
    np.testing.assert_array_equal(images.resize(wide.T, (8, 8), "letterbox"), between.T)
    for how in ("crop", "letterbox", "stretch"):
        np.testing.assert_array_equal(images.resize(wide, (4, 8), how), wide)
        # One row or column, however far the proportions are from those of the grid.
        assert images.resize(np.ones((1, 50), np.float32), (7, 2), how).shape == (7, 2)
    with pytest.raises(InputError, match="how is 'fill'"):
        images.resize(wide, (4, 4), "fill")
