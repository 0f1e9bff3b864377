# SPDX-License-Identifier: BSD-3-Clause
"""Pictures of large cameras go by strips of rows: what comes of it is that of the whole picture."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Calibration, VirtualRig, acquire, calibration, metering, scratch
from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.geometry import Correspondence, Resampling, footprints
from ltcl.acquisition.metering import hot_pixels, upper_quantile
from ltcl.acquisition.radiance import (
    StoredRadiance,
    difference,
    plane,
    valid_share,
    valid_values,
    values_at,
)
from ltcl.acquisition.radiometry import NoiseModel, Radiance, Response, merge
from ltcl.acquisition.rig import scale_codes
from ltcl.acquisition.scratch import ImageFile
from ltcl.acquisition.session import Photograph, merge_photographs

from .scanning.helpers import corner

random = np.random.default_rng(0)
SECONDS = (0.25, 1.0, 0.5)
CURVES = np.stack([np.linspace(0.0, 1.0, 65) ** power for power in (2.2, 1.8, 1.0)])


class Camera:
    """What a photograph knows of its camera."""

    def __init__(self, channels: int, bits: int | None, white_level: float | None) -> None:
        self.channels = channels
        self.bits = bits
        self.white_level = white_level


def photographs_of(light: np.ndarray, camera: Camera, dtype: Any) -> list[Photograph]:
    """Photographs of linear light at `SECONDS`."""
    file = ImageFile()
    photographs = []
    for number, seconds in enumerate(SECONDS):
        codes = np.clip(light * seconds, 0.0, 1.0)
        if np.dtype(dtype).kind == "u":
            largest = 255 if dtype == np.uint8 else (1 << (camera.bits or 16)) - 1
            codes = np.rint(codes * largest)
        image = codes.astype(dtype)
        stored = file.append(image)
        photographs.append(
            Photograph(stored=stored, rig=camera, seconds=seconds, number=number + 1)
        )
    return photographs


@pytest.mark.parametrize(
    ("dtype", "bits", "white_level", "levels"),
    [
        (np.uint8, None, None, 256),
        (np.uint16, 12, None, 4096),
        (np.uint16, 12, 3500, 3501),
        (np.float32, None, None, None),
    ],
)
@pytest.mark.parametrize("channels", [1, 3])
def test_merged_strips_are_the_merged_picture(
    monkeypatch: pytest.MonkeyPatch,
    dtype: Any,
    bits: int | None,
    white_level: int | None,
    levels: int | None,
    channels: int,
) -> None:
    monkeypatch.setattr("ltcl.acquisition.session.MERGED_VALUES", 400)
    shape = (53, 17) if channels == 1 else (53, 17, 3)
    camera = Camera(channels, bits, white_level)
    photographs = photographs_of(2.0 * random.random(shape), camera, dtype)
    response = Response(CURVES[:channels])
    model = CameraModel(response=response, noise=NoiseModel(5000.0, 0.003), offset=0.01)
    strips = merge_photographs(photographs, model, levels, ImageFile())
    whole = merge(
        [photograph.image for photograph in photographs],
        SECONDS,
        response,
        model.noise,
        levels=levels,
        black=0.01,
    )
    assert np.array_equal(strips.value, whole.value)
    assert np.array_equal(strips.variance, whole.variance)
    assert np.array_equal(strips.valid, whole.valid)


def stored(picture: Radiance) -> StoredRadiance:
    """The same picture in a file."""
    result = StoredRadiance.reserve(ImageFile(), picture.shape)
    result.write(0, picture)
    return result


@pytest.mark.parametrize("shape", [(53, 7), (53, 7, 3)])
def test_parts_of_a_stored_picture(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, ...]) -> None:
    monkeypatch.setattr(scratch.row_strips, "__defaults__", (40,))
    pictures = []
    for _ in range(2):
        valid = random.random(shape) < 0.8
        value = np.where(valid, random.random(shape), 0.0).astype(np.float32)
        variance = np.where(valid, random.random(shape), np.inf).astype(np.float32)
        pictures.append(Radiance(value, variance, valid))
    first, second = pictures
    expected = first - second
    result = difference(stored(first), stored(second), ImageFile())
    assert np.array_equal(result.value, expected.value)
    assert np.array_equal(result.variance, expected.variance)
    assert valid_share(result) == pytest.approx(expected.valid.mean())
    assert np.array_equal(valid_values(result), expected.value[expected.valid])
    pixels = np.array([0, 5, 6, 90, 53 * 7 - 1])
    flat = expected.variance.reshape(53 * 7, -1)
    assert np.array_equal(values_at(result, pixels, "variance"), flat[pixels])
    for channel in range(flat.shape[1]):
        is_valid = expected.valid.reshape(53, 7, -1)[..., channel]
        variance = expected.variance.reshape(53, 7, -1)[..., channel]
        known = np.where(is_valid, variance, 0.0)
        assert np.array_equal(plane(result, "variance", channel), known)
        assert np.array_equal(plane(result, "valid", channel), is_valid)


@pytest.mark.parametrize("method", ["linear", "higher"])
@pytest.mark.parametrize("quantile", [0.5, 0.99, 0.999])
@pytest.mark.parametrize("count", [1, 2, 1000, 30001])
def test_quantile_of_strips(count: int, quantile: float, method: Any) -> None:
    values = random.random(count).astype(np.float32)
    values[::3] = values[::3].round(2)
    expected = np.quantile(values, quantile, method=method)
    strips = np.array_split(values, 7)
    assert upper_quantile(strips, count, quantile, method) == pytest.approx(expected, rel=1e-6)


def test_hot_pixels_are_filled_from_the_strip_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first pixels of a strip are hot: their donor is the last one of the strip before."""
    monkeypatch.setattr(scratch.row_strips, "__defaults__", (12,))
    light = random.random((20, 6, 3))
    light[2, :2] = 100.0
    light[7, 3] = 100.0
    camera = Camera(3, None, None)
    photograph, *_ = photographs_of(light, camera, np.uint8)
    hot = hot_pixels([photograph])
    assert np.argwhere(hot).tolist() == [[2, 0], [2, 1], [7, 3]]

    class Session:
        def linear(self, photograph: Photograph) -> Any:
            return photograph.linear(Response.identity())

    session: Any = Session()
    filled = metering.fill_hot_pixels(scale_codes(photograph.stored.read(), camera), hot)
    expected = np.quantile(filled, metering.BRIGHT_QUANTILE, method="higher")
    assert metering.brightness(session, photograph, hot) == pytest.approx(expected)


@pytest.mark.parametrize("size", [(60, 80), (13, 20)])
def test_resampling_in_strips(monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]) -> None:
    """Camera pixels smaller and larger than the projector's."""
    H, W = size
    v, u = np.mgrid[:H, :W].astype(float)
    x = u / W * 17.0 - 0.5 + 0.1 * np.sin(v / 7.0)
    y = v / H * 11.0 - 0.5 + 0.1 * np.cos(u / 9.0)
    valid = random.random(size) < 0.95
    mapping = Correspondence(x, y, valid, (11, 17))
    whole = Resampling.of(mapping)
    monkeypatch.setattr(footprints, "SHARES_PIXELS", 5 * W)
    strips = Resampling.of(mapping)
    assert np.array_equal(strips.weights.indices, whole.weights.indices)
    np.testing.assert_allclose(strips.weights.data, whole.weights.data, rtol=1e-5)
    np.testing.assert_allclose(strips.coverage, whole.coverage, rtol=1e-6)


@pytest.mark.rare
def test_a_calibration_in_parts_is_read_as_it_was(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Large arrays of a store are in parts, and its pictures in a file when they are read."""
    scene = [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)]
    calibrations = []
    for name, part_bytes in (("whole", 1 << 25), ("parts", 100)):
        monkeypatch.setattr(calibration, "PART_BYTES", part_bytes)
        rig = VirtualRig(scene, (4, 8), bits=12, ambient=0.01)
        acquire(rig, geometry="aligned", strategy="pixel", store=tmp_path / name)
        calibrations.append(Calibration.of(tmp_path / name))
    whole, parts = calibrations
    assert isinstance(whole.white, Radiance)
    assert isinstance(parts.white, StoredRadiance)
    for name in ("ambient", "white"):
        expected = getattr(whole, name)
        picture = getattr(parts, name)
        assert np.array_equal(picture.value, expected.value)
        assert np.array_equal(picture.variance, expected.variance)
        assert np.array_equal(picture.valid, expected.valid)
    assert np.array_equal(parts.resampling.weights.data, whole.resampling.weights.data)
    assert np.array_equal(parts.response.values, whole.response.values)


def test_merging_takes_memory_for_strips_only() -> None:
    """Three photographs of 1.5 megapixels in colour are 54 MB of floats, their radiance 40 MB."""
    camera = Camera(3, None, None)
    light = np.linspace(0.1, 1.0, 1000 * 1500 * 3, dtype=np.float32).reshape(1000, 1500, 3)
    photographs = photographs_of(light, camera, np.uint8)
    model = CameraModel(response=Response.identity())
    tracemalloc.start()
    merged = merge_photographs(photographs, model, 256, ImageFile())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert merged.shape == light.shape
    # Each core has a strip of half a million values, several times.
    assert peak < 20e6 * (1 + (os.cpu_count() or 1))
