# SPDX-License-Identifier: BSD-3-Clause
"""Cameras and projectors that are not as simple as most: scanned rightly, or named with a cure."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Shots, VirtualRig, acquire, anchor, camera_map
from ltcl.acquisition.calibrate import measure
from ltcl.acquisition.metering import check_full_scale
from ltcl.errors import AcquisitionError, InputError
from ltcl.images import from_srgb, to_srgb

from .scanning.helpers import corner, dense, relative_error, rig

GRID = (8, 16)


class Wrapped:
    """A virtual rig whose codes or photographs are changed by a function."""

    def __init__(self, camera: VirtualRig, *, show: Any = None, shoot: Any = None) -> None:
        self.projector_grid = camera.projector_grid
        self.channels = camera.channels
        self.bits = camera.bits
        self.exposures = camera.exposures
        self.white_level: float | None = None
        self._camera = camera
        self._show = show
        self._shoot = shoot

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        if self._show is not None:
            codes = self._show(codes)
        image = self._camera.photograph(codes, seconds)
        if self._shoot is not None:
            image = self._shoot(image)
        return image


def white_segment(boost: float) -> Any:
    """Codes that a projector shows with a white segment: white stays, colours are darker."""

    def show(codes: np.ndarray) -> np.ndarray:
        light = np.asarray(from_srgb(codes), np.float64)
        if light.ndim == 3:
            light = (light + boost * light.min(axis=2, keepdims=True)) / (1 + boost)
        return np.clip(to_srgb(light), 0, 1)

    return show


@pytest.mark.parametrize("boost", [0.0, 0.05, 0.3, 1.0])
@pytest.mark.parametrize("response", ["srgb", "linear"])
def test_a_white_segment_is_named(
    boost: float, response: str, caplog: pytest.LogCaptureFixture
) -> None:
    mixing = np.array([[1.0, 0.1, 0.0], [0.1, 1.0, 0.1], [0.0, 0.2, 1.0]])
    walls = [corner(8, albedo) for albedo in (0.8, 0.6, 0.3)]
    camera = VirtualRig(walls, GRID, mixing=mixing, response=response, bits=12, ambient=0.01)
    measure(Shots(Wrapped(camera, show=white_segment(boost))), geometry="aligned")
    messages = [record.getMessage() for record in caplog.records]
    about_colours = [text for text in messages if "colour mode" in text]
    assert len(about_colours) == (boost > 0)
    if about_colours:
        [percent] = re.findall(r"(\d+) %", about_colours[0])
        assert int(percent) == pytest.approx(100 / (1 + boost), abs=1.5)


FULL_CAMERAS = [
    (12, "linear", 3330),
    (14, "srgb", 13314),
    (8, "srgb", 235),
    (16, "film", 15000),
    ("float", "linear", 0.8),
]


@pytest.mark.parametrize(("bits", "response", "level"), FULL_CAMERAS)
@pytest.mark.parametrize("is_cut", [True, False])
def test_a_camera_that_is_full_below_its_last_code_is_named(
    bits: int | str, response: str, level: float, is_cut: bool
) -> None:
    """Codes end there, or the curve reaches full scale there."""
    if is_cut:
        camera = rig(bits=bits, response=response)
        cut = Wrapped(camera, shoot=lambda image: np.minimum(image, image.dtype.type(level)))
        shots = Shots(cut)
    else:
        silent = Wrapped(rig(bits=bits, response=response, white_level=level))
        shots = Shots(silent)
    with pytest.raises(AcquisitionError, match=rf"full at .*white_level = {level}"):
        measure(shots, geometry="aligned")


@pytest.mark.slow
@pytest.mark.parametrize(("bits", "response", "level"), FULL_CAMERAS)
def test_a_camera_whose_white_level_is_given_is_scanned(
    bits: int | str, response: str, level: float
) -> None:
    camera = rig(bits=bits, response=response, white_level=level)
    T = acquire(camera, geometry="aligned", strategy="hadamard")
    assert relative_error(dense(T), corner(), GRID) < 0.02


def test_a_white_level_beyond_the_codes_is_refused() -> None:
    camera = Wrapped(rig(bits=12))
    for level in (5000, 0, 12.5):
        camera.white_level = level
        with pytest.raises(InputError, match=f"white_level is {level}"):
            Shots(camera).photograph(np.ones(GRID), 0.1)


STOPS = tuple(0.25 * 2.0**k for k in range(5))
HALF_STOPS = tuple(0.25 * 2.0 ** (k / 2) for k in range(9))
THIRDS = tuple(0.25 * 2.0 ** (k / 3) for k in range(13))


def test_noise_is_no_full_scale() -> None:
    """Its codes rise slowly through a power curve, and short exposures show nothing else."""
    shots = Shots(VirtualRig(np.eye(4), (2, 2)))
    noise = 0.16 * np.random.default_rng(0).random((32, 32))
    images = [noise, noise + 0.001, np.maximum(noise, 0.5)]
    check_full_scale(shots, [0.01, 0.03, 1.0], images)
    with pytest.raises(AcquisitionError, match="is full at"):
        check_full_scale(shots, [0.01, 0.03, 1.0], [images[0], images[2], images[2]])


@pytest.mark.slow
@pytest.mark.parametrize("exposures", [STOPS, HALF_STOPS, THIRDS, (0.25, 0.5, 1.0, 4.0)])
@pytest.mark.parametrize("level", [0.3, 0.45, 0.6, 0.85])
@pytest.mark.parametrize(("response", "ambient"), [("srgb", 0.01), ("film", 0.0)])
def test_a_camera_without_short_exposures_is_calibrated(
    exposures: tuple[float, ...], level: float, response: str, ambient: float
) -> None:
    """White has this level at the shortest exposure; nothing is refused, black is right."""
    grid = (6, 12)
    view = camera_map(lambda u, v: ((u - 22) / 3 + 5.7, (v - 11) / 3 + 2.4), (23, 45), grid)
    options: dict[str, Any] = {"response": response, "bits": 12, "exposures": exposures}
    T = ltcl.scenes.dihedral(6, albedo=0.6).transport()
    camera = VirtualRig(T, grid, camera_grid=(23, 45), camera_map=view, ambient=ambient, **options)
    camera.sensitivity = level / exposures[0] / camera.radiance(np.ones(grid)).max()
    calibration = measure(Shots(camera))
    black = camera.photograph(np.zeros(grid), exposures[0]) / 4095
    light = calibration.response.linear(black).mean() - float(np.mean(calibration.offset))
    expected = camera.radiance(np.zeros(grid)).mean() * camera.sensitivity * exposures[0]
    assert light == pytest.approx(expected, abs=0.001)


class Dimmed(VirtualRig):
    """A projector whose light is multiplied by gain(mean light of the picture, photographs)."""

    def __init__(self, gain: Any, **options: Any) -> None:
        super().__init__(corner(), GRID, **{"bits": 12, "ambient": 0.01, **options})
        self._gain = gain
        self._photographs = 0

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        self._photographs += 1
        self._last = None
        return super().photograph(codes, seconds)

    def _light(self, codes: np.ndarray) -> np.ndarray:
        light = super()._light(codes)
        return light * self._gain(light.mean(), self._photographs)


DEPENDING = {
    "iris": lambda mean, count: 0.9 if mean < 0.3 else 1.0,
    "dynamic contrast": lambda mean, count: 0.95 + 0.05 * mean,
    "limited power": lambda mean, count: 1.1 - 0.1 * mean,
}


@pytest.mark.parametrize("gain", DEPENDING.values(), ids=DEPENDING)
@pytest.mark.parametrize("response", ["srgb", "film"])
def test_light_that_depends_on_the_picture_is_refused(gain: Any, response: str) -> None:
    with pytest.raises(AcquisitionError, match=r"photograph \d+ .*deviates.*contrast"):
        measure(Shots(Dimmed(gain, response=response)), geometry="aligned")


def test_few_pixels_that_no_camera_sees_are_no_fault() -> None:
    """As of one of many projectors; noise must not choose the pixels that are compared."""
    grid = (24, 48)
    brightness = np.full(grid, 0.004, np.float32)
    brightness[4:8] = 1.0
    brightness[anchor.sparse_pattern(grid) > 0] = 0.0
    T = np.diag(brightness.ravel())
    calibration = measure(Shots(VirtualRig(T, grid, bits=12, ambient=0.01)), geometry="aligned")
    assert calibration.resampling.seen.mean() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["hadamard", "pixel", "adaptive"])
@pytest.mark.parametrize("fade", [0.1, -0.05])
def test_a_lamp_that_fades_is_corrected(strategy: str, fade: float) -> None:
    """It has changed by this part after 500 photographs; a scan takes that many."""
    lamp = Dimmed(lambda mean, count: 1.0 - fade * count / 500)
    T = acquire(lamp, geometry="aligned", strategy=strategy)
    assert relative_error(dense(T), corner(), GRID) < 0.012


@pytest.mark.slow
def test_a_lamp_that_changes_at_once_is_refused() -> None:
    lamp = Dimmed(lambda mean, count: 0.8 if count > 300 else 1.0)
    with pytest.raises(AcquisitionError, match="photographs"):
        acquire(lamp, geometry="aligned", strategy="hadamard")
