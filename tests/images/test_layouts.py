# SPDX-License-Identifier: BSD-3-Clause
"""Layouts of TIFF and PNG that decoders get wrong: the picture that was stored, or refused."""

from __future__ import annotations

import itertools
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ltcl import images
from ltcl.errors import FileError

random = np.random.default_rng(5)
H, W = 5, 7
WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE, CMYK = 0, 1, 2, 3, 5
NONE, LZW, JPEG_2000, PACK_BITS, DEFLATE, ZSTANDARD = 1, 5, 34712, 32773, 8, 50000
NUMBERS = {"u": 1, "i": 2, "f": 3, "c": 6}


def tiff(
    codes: np.ndarray,
    photometric: int,
    *,
    planar: bool = False,
    compression: int = NONE,
    bits: int | None = None,
    **tags: int,
) -> bytes:
    """A TIFF file of one strip, or of one a plane; `tags` are t266=2 and the like."""
    h, w, channels = codes.shape
    if planar:
        strips = [codes[..., channel].tobytes() for channel in range(channels)]
    else:
        strips = [codes.tobytes()]
    if compression == DEFLATE:
        strips = [zlib.compress(strip) for strip in strips]
    kind = NUMBERS[codes.dtype.kind]
    values = {
        256: [w],
        257: [h],
        258: [bits or 8 * codes.itemsize] * channels,
        259: [compression],
        262: [photometric],
        273: [0] * len(strips),
        277: [channels],
        278: [h],
        279: [len(strip) for strip in strips],
        284: [2 if planar else 1],
        339: [kind] * channels,
    }
    for name, value in tags.items():
        values[int(name[1:])] = [value]
    start = 8 + 2 + 12 * len(values) + 4
    sizes = {tag: 4 * len(entry) for tag, entry in values.items() if len(entry) > 1}
    place = start + sum(sizes.values())
    values[273] = [place + sum(values[279][:number]) for number in range(len(strips))]
    directory = struct.pack("<H", len(values))
    extra = b""
    for tag in sorted(values):
        entry = struct.pack(f"<{len(values[tag])}I", *values[tag])
        if len(entry) > 4:
            directory += struct.pack("<HHII", tag, 4, len(values[tag]), start + len(extra))
            extra += entry
        else:
            directory += struct.pack("<HHI", tag, 4, 1) + entry
    header = struct.pack("<2sHI", b"II", 42, 8)
    return header + directory + struct.pack("<I", 0) + extra + b"".join(strips)


def codes_of(dtype: str, channels: int = 1) -> np.ndarray:
    if dtype[0] == "f":
        return random.random((H, W, channels)).astype(dtype)
    return random.integers(0, np.iinfo(dtype).max, (H, W, channels)).astype(dtype)


def opaque(dtype: str, channels: int) -> np.ndarray:
    codes = codes_of(dtype, channels)
    codes[..., -1] = 1 if dtype[0] == "f" else np.iinfo(dtype).max
    return codes


@pytest.mark.parametrize("dtype", ["u1", "u2", "f4"])
@pytest.mark.parametrize(("photometric", "channels"), [(BLACK_IS_ZERO, 1), (RGB, 3)])
@pytest.mark.parametrize("compression", [NONE, DEFLATE])
def test_plain_tiffs_are_read(tmp_path, dtype, photometric, channels, compression):
    codes = codes_of(dtype, channels)
    path = tmp_path / "a.tif"
    path.write_bytes(tiff(codes, photometric, compression=compression))
    np.testing.assert_array_equal(images.read_codes(path), codes.squeeze())


@pytest.mark.parametrize(
    ("dtype", "photometric", "planar"), [("u1", RGB, True), ("f4", BLACK_IS_ZERO, False)]
)
def test_planes_of_8_bits_and_floats_that_say_grey_are_in_colour(
    tmp_path, dtype, photometric, planar
):
    codes = codes_of(dtype, 3)
    path = tmp_path / "a.tif"
    path.write_bytes(tiff(codes, photometric, planar=planar))
    np.testing.assert_array_equal(images.read_codes(path), codes)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_codes_of_10_to_14_bits_are_the_upper_ones_of_16(tmp_path, bits):
    codes = random.integers(0, 1 << bits, (H, 8))
    ones = codes[..., None] >> np.arange(bits)[::-1] & 1
    packed = np.packbits(ones.reshape(H, -1).astype(np.uint8), axis=1)
    path = tmp_path / "a.tif"
    path.write_bytes(tiff(packed[..., None], BLACK_IS_ZERO, bits=bits, t256=8))
    np.testing.assert_array_equal(images.read_codes(path), codes << (16 - bits))


@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_inverted_grey_is_black_where_codes_are_largest(tmp_path, dtype):
    codes = codes_of(dtype)
    path = tmp_path / "a.tif"
    path.write_bytes(tiff(codes, WHITE_IS_ZERO))
    np.testing.assert_array_equal(images.read_codes(path), np.iinfo(dtype).max - codes[..., 0])


def test_grey_with_alpha_keeps_its_bits_or_is_refused(tmp_path):
    codes = opaque("u1", 2)
    path = tmp_path / "a.tif"
    path.write_bytes(tiff(codes, BLACK_IS_ZERO, t338=2))
    np.testing.assert_array_equal(images.read_codes(path), codes[..., 0])
    codes[0, 0, 1] = 9
    path.write_bytes(tiff(codes, BLACK_IS_ZERO, t338=2))
    with pytest.raises(FileError, match="1 transparent"):
        images.read(path)


# What the tag ExtraSamples says of alpha: nothing, that grey is multiplied by it, that it is not.
EXTRAS = [{}, {"t338": 1}, {"t338": 2}]


@pytest.mark.parametrize("extra", EXTRAS)
@pytest.mark.parametrize("compression", [NONE, DEFLATE])
def test_grey_with_alpha_is_read_whatever_it_says_of_alpha(tmp_path, extra, compression):
    codes = opaque("u1", 2)
    path = tmp_path / "a.tif"
    path.write_bytes(tiff(codes, BLACK_IS_ZERO, compression=compression, **extra))
    np.testing.assert_array_equal(images.read_codes(path), codes[..., 0])
    codes[1, 2, 1] = 254
    path.write_bytes(tiff(codes, BLACK_IS_ZERO, compression=compression, **extra))
    with pytest.raises(FileError, match="1 transparent"):
        images.read(path)


# Compressions of Pillow, and whether it writes BigTIFF, which it does without compression alone.
WRITERS = [
    ("raw", False),
    ("raw", True),
    ("packbits", False),
    ("tiff_lzw", False),
    ("tiff_adobe_deflate", False),
]


@pytest.mark.parametrize(("compression", "is_big"), WRITERS)
def test_grey_that_another_writer_multiplied_by_alpha_is_read(tmp_path, compression, is_big):
    codes = opaque("u1", 2)
    path = tmp_path / "a.tif"
    Image.fromarray(codes, "LA").save(path, compression=compression, big_tiff=is_big)
    # The tag says 2, alpha by which grey is not multiplied, and now 1.
    data = bytearray(path.read_bytes())
    place = data.index(struct.pack("<HH", 338, 3)) + (12 if is_big else 8)
    assert data[place] == 2
    data[place] = 1
    path.write_bytes(data)
    np.testing.assert_array_equal(images.read_codes(path), codes[..., 0])


@pytest.mark.parametrize(
    "data",
    [
        tiff(codes_of("u1", 2), BLACK_IS_ZERO, planar=True),
        tiff(codes_of("u2", 3), RGB, planar=True, compression=DEFLATE),
        tiff(codes_of("f4", 3), RGB, planar=True),
        tiff(codes_of("f4", 1), WHITE_IS_ZERO),
        tiff(opaque("u2", 2), BLACK_IS_ZERO, t338=2),
        tiff(codes_of("u1", 3), BLACK_IS_ZERO),
        tiff(codes_of("u1", 4), CMYK),
        tiff(opaque("u2", 4), CMYK),
        tiff(codes_of("u2", 5), RGB),
        tiff(codes_of("u2", 1), PALETTE),
        tiff(codes_of("i1", 1), BLACK_IS_ZERO),
        tiff(codes_of("i2", 1), BLACK_IS_ZERO),
        tiff(codes_of("u4", 1), BLACK_IS_ZERO),
        tiff(codes_of("f2", 3), RGB),
        tiff(codes_of("u1", 3), RGB, compression=JPEG_2000),
        tiff(codes_of("u2", 1), BLACK_IS_ZERO, compression=ZSTANDARD),
        tiff(codes_of("u1", 1), BLACK_IS_ZERO, compression=PACK_BITS, t317=2),
        tiff(codes_of("u1", 1), BLACK_IS_ZERO, t266=2),
    ],
)
def test_other_layouts_are_refused_with_a_way_out(tmp_path, data):
    path = tmp_path / "a.tif"
    path.write_bytes(data)
    with pytest.raises(FileError, match=rf"{path}: .*; save it as") as error:
        images.read(path)
    assert "\n" not in str(error.value)


def chunk(kind: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)


def png(codes: np.ndarray, depth: int, colour_type: int, *extras: bytes) -> bytes:
    """A PNG file of codes (h, w, channels), not interlaced."""
    h, w, _ = codes.shape
    rows = codes.reshape(h, -1).astype(int)
    bits = rows[..., None] >> np.arange(depth)[::-1] & 1
    packed = np.packbits(bits.reshape(h, -1).astype(np.uint8), axis=1)
    pixels = np.pad(packed, ((0, 0), (1, 0))).tobytes()
    head = struct.pack(">IIBBBBB", w, h, depth, colour_type, 0, 0, 0)
    return b"".join(
        [
            b"\x89PNG\r\n\x1a\n",
            chunk(b"IHDR", head),
            *extras,
            chunk(b"IDAT", zlib.compress(pixels)),
            chunk(b"IEND", b""),
        ]
    )


KINDS = [(0, depth) for depth in (1, 2, 4, 8, 16)] + [(2, 8), (2, 16)]


@pytest.mark.parametrize(("colour_type", "depth"), KINDS)
def test_a_transparent_colour_counts_where_it_is(tmp_path, colour_type, depth):
    channels = 3 if colour_type == 2 else 1
    white = (1 << depth) - 1
    codes = np.zeros((2, 3, channels), int)
    codes[0, 0] = white
    path = tmp_path / "a.png"
    for key, transparent in ((white, 1), (0, 5), (white // 2, 0)):
        if depth == 1 and transparent == 0:
            continue
        extra = chunk(b"tRNS", struct.pack(">H", key) * channels)
        path.write_bytes(png(codes, depth, colour_type, extra))
        if transparent:
            with pytest.raises(FileError, match=f"{transparent} transparent"):
                images.read(path)
        else:
            light = images.read(path)
            assert light.shape == ((2, 3, 3) if channels == 3 else (2, 3))
            np.testing.assert_array_equal(light, codes.squeeze() > 0)


@pytest.mark.parametrize("depth", [8, 16])
def test_grey_with_alpha_is_grey(tmp_path, depth):
    codes = random.integers(0, 1 << depth, (H, W, 2))
    codes[..., 1] = (1 << depth) - 1
    (tmp_path / "a.png").write_bytes(png(codes, depth, 4))
    np.testing.assert_array_equal(images.read_codes(tmp_path / "a.png"), codes[..., 0])


def gama(value: float) -> bytes:
    return chunk(b"gAMA", struct.pack(">I", round(1e5 * value)))


def cicp(curve: int) -> bytes:
    return chunk(b"cICP", bytes([9, curve, 0, 1]))


SRGB = chunk(b"sRGB", b"\0")
PROFILE = chunk(b"iCCP", b"x\0\0" + zlib.compress(b"a profile"))
CODES = np.array([[[0], [60], [128], [255]]])


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize(
    ("extras", "power"),  # None: sRGB; "refused": HDR
    [
        ([], None),
        ([SRGB, gama(1.0)], None),
        ([gama(0.45455)], None),
        ([gama(0.454)], None),
        ([gama(1.0)], 1.0),
        ([gama(0.5)], 2.0),
        ([PROFILE, gama(1.0)], 1.0),
        ([PROFILE], None),
        ([cicp(13), gama(1.0)], None),
        ([cicp(1)], None),
        ([cicp(8)], 1.0),
        ([cicp(4)], 2.2),
        ([cicp(16)], "refused"),
        ([SRGB, cicp(18)], "refused"),
        ([cicp(9)], "refused"),
    ],
)
def test_a_png_that_names_its_curve_is_read_by_it(tmp_path, depth, extras, power):
    path: Path = tmp_path / "a.png"
    white = (1 << depth) - 1
    path.write_bytes(png(CODES * (white // 255), depth, 0, *extras))
    share = CODES[..., 0] / 255
    srgb = images.from_srgb(share)
    if power == "refused":
        with pytest.raises(FileError, match=r"a\.png: .*cICP"):
            images.read(path)
    else:
        expected = srgb if power is None else share**power
        np.testing.assert_allclose(images.read(path), expected, rtol=1e-5)
    # What the caller says counts more.
    np.testing.assert_allclose(images.read(path, encoding="linear"), share, rtol=1e-6)
    np.testing.assert_allclose(images.read(path, encoding="srgb"), srgb, rtol=1e-5)
    np.testing.assert_array_equal(images.read_codes(path), CODES[..., 0] * (white // 255))


DEEP = png(codes_of("u2", 3), 16, 2)
HEAD = DEEP[:33]
END = chunk(b"IEND", b"")
ROWS = zlib.decompress(DEEP[41 : -len(END) - 4])


@pytest.mark.parametrize(
    ("data", "is_picture"),
    [
        (HEAD + chunk(b"IDAT", b"nothing that zlib wrote") + END, False),
        (HEAD + chunk(b"IDAT", zlib.compress(ROWS[:50])) + END, False),
        (HEAD + chunk(b"IDAT", zlib.compress(ROWS)[:-9]) + END, False),
        (HEAD + chunk(b"IDAT", zlib.compress(b"\x09" + ROWS[1:])) + END, False),
        (HEAD + chunk(b"IDAT", zlib.compress(ROWS + b"more")) + END, True),
        (HEAD + chunk(b"iCCP", b"x\0\0" + zlib.compress(b"no profile")) + DEEP[33:], True),
        (HEAD + chunk(b"tIME", bytes(7)) + gama(0.0) + gama(0.0) + DEEP[33:], True),
    ],
)
def test_libpng_says_nothing_of_damage_behind_right_checksums(tmp_path, capfd, data, is_picture):
    path = tmp_path / "a.png"
    path.write_bytes(data)
    if is_picture:
        assert images.read(path).shape == (H, W, 3)
    else:
        with pytest.raises(FileError, match=r"a\.png: "):
            images.read(path)
    assert capfd.readouterr() == ("", "")


def test_interlaced_pngs_of_16_bits_are_read(tmp_path):
    """Adam7 written by its definition; sizes that leave passes empty count."""
    starts = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2)]
    path = tmp_path / "a.png"
    for h, w in itertools.product((1, 2, 5, 9), repeat=2):
        codes = random.integers(0, 65536, (h, w)).astype(">u2")
        rows = []
        for x, y, x_step, y_step in [*starts, (0, 1, 1, 2)]:
            pixels = codes[y::y_step, x::x_step]
            if pixels.size:
                rows += [b"\0" + row.tobytes() for row in pixels]
        head = struct.pack(">IIBBBBB", w, h, 16, 0, 0, 0, 1)
        data = chunk(b"IDAT", zlib.compress(b"".join(rows)))
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + data + END)
        np.testing.assert_array_equal(images.read_codes(path), codes)
