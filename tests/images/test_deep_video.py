# SPDX-License-Identifier: BSD-3-Clause
"""Films of 10 and 12 bits, with alpha, and of no one rate, made by FFmpeg through PyAV."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from ltcl.errors import FileError
from ltcl.images.frames import open_frames

GRID = (16, 64)
# Finer steps than those of 8 bits.
RAMP = np.broadcast_to(np.linspace(0.0, 1.0, GRID[1]), GRID)


def write(path: Path, pixel_format: str, frames: list[np.ndarray], times: list[int]) -> None:
    """Write frames of 16 bits, losslessly, with time stamps in hundredths of a second."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("ffv1", rate=25)
        stream.pix_fmt = pixel_format
        stream.height, stream.width = frames[0].shape[:2]
        stream.codec_context.time_base = Fraction(1, 100)
        for codes, time in zip(frames, times, strict=True):
            kind = "rgba64le" if codes.shape[2] == 4 else "rgb48le"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(codes), format=kind)
            frame.pts = time
            frame.time_base = Fraction(1, 100)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def coded(light: np.ndarray, channels: int = 3) -> np.ndarray:
    return np.repeat(np.rint(65535 * light).astype(np.uint16)[..., None], channels, axis=2)


@pytest.mark.parametrize(("pixel_format", "bits"), [("gbrp10le", 10), ("gbrp12le", 12)])
def test_codes_keep_their_bits(tmp_path: Path, pixel_format: str, bits: int) -> None:
    path = tmp_path / "deep.mkv"
    write(path, pixel_format, [coded(RAMP), coded(RAMP[:, ::-1])], [0, 4])
    first, second = open_frames(path)
    codes = first.srgb()
    assert codes.dtype == np.uint16
    # To the step of the file, which is far finer than that of 8 bits.
    step = 1.0 / (2**bits - 1)
    np.testing.assert_allclose(codes / 65535.0, RAMP, atol=1.1 * step)
    assert len(np.unique(codes)) == GRID[1]
    light = second.picture()
    x = RAMP[:, ::-1]
    expected = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(light, expected, atol=3 * step)


def test_eight_bits_stay_eight(tmp_path: Path) -> None:
    path = tmp_path / "plain.mkv"
    write(path, "bgr0", [coded(RAMP)], [0])
    (frame,) = open_frames(path)
    assert frame.srgb().dtype == np.uint8


def test_time_stamps_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "uneven.mkv"
    times = [0, 4, 30, 34, 100]
    write(path, "gbrp10le", [coded(RAMP * k / 5) for k in range(1, 6)], times)
    found = np.array([frame.seconds for frame in open_frames(path)], float)
    np.testing.assert_allclose(found, np.array(times) / 100, atol=2e-3)


@pytest.mark.parametrize("least", [1.0, 0.5])
def test_alpha_of_ten_bits(tmp_path: Path, least: float) -> None:
    """Opaque is opaque with any number of bits; less is refused."""
    path = tmp_path / "alpha.mkv"
    codes = coded(RAMP, 4)
    codes[..., 3] = 65535
    codes[0, 0, 3] = round(65535 * least)
    write(path, "gbrap10le", [codes], [0])
    source = open_frames(path)
    if least == 1.0:
        (frame,) = source
        assert frame.srgb().dtype == np.uint16
        return
    with pytest.raises(FileError, match=r"1 transparent pixel"):
        list(source)
