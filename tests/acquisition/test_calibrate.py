# SPDX-License-Identifier: BSD-3-Clause
"""Measured set-ups are those that were made, in few photographs, at good exposures."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Shots, VirtualRig, camera_map
from ltcl.acquisition.calibrate import measure
from ltcl.acquisition.geometry import GrayCode
from ltcl.acquisition.metering import bracket
from ltcl.acquisition.radiometry import calibrate
from ltcl.errors import AcquisitionError, InputError

from .radiometry.cameras import Camera
from .radiometry.cameras import corner as scene
from .scanning.helpers import corner, rig
from .stopping import Unplugged

GRID = (8, 16)


def test_camera_and_projector() -> None:
    camera = rig(projector_response="gamma2.2", response="gamma2.2", bits=12, ambient=0.02)
    calibration = measure(Shots(camera), geometry="aligned")
    codes = np.linspace(0.1, 1.0, 10)
    np.testing.assert_allclose(calibration.projector.linear(codes), codes**2.2, atol=0.01)
    light = np.linspace(0.05, 0.9, 10)
    value = calibration.response.linear(0.004 + 0.996 * light ** (1 / 2.2))
    scale = float(np.mean(value / light))
    np.testing.assert_allclose(value / light, scale, rtol=0.02)
    assert calibration.noise.electrons == pytest.approx(10000.0 / scale, rel=0.2)
    np.testing.assert_allclose(calibration.ambient.value / scale, 0.02, rtol=0.05)
    row_sums = corner().sum(axis=1)
    np.testing.assert_allclose(calibration.white.value.ravel() / scale, row_sums, rtol=0.03)
    assert calibration.light.tolist() == [1.0]
    shortest = calibration.exposures[0]
    longest = calibration.exposures[-1]
    assert 0.3 < shortest * row_sums.max() < 0.95
    assert 0.1 < 0.02 * longest < 0.7


@pytest.mark.slow
def test_a_dark_room_around_the_picture_decides_no_exposure() -> None:
    """Three quarters of the camera's pixels show only noise, half of which is above 0."""
    grid = (6, 8)
    size = (48, 64)
    view = camera_map(lambda u, v: ((u - 20) / 3.2, (v - 14) / 3.2), size, grid)
    T = 0.4 * np.eye(48) + 0.002
    camera = VirtualRig(T, grid, camera_map=view, camera_grid=size, bits=12, ambient=0.01)
    measured = measure(Shots(camera))
    white = measured.resampling.apply(measured.white.value)[measured.resampling.seen]
    assert len(white) >= 44
    assert np.quantile(np.abs(white / np.median(white) - 1), 0.9) < 0.1
    with pytest.raises(InputError, match=r"saturates at 30 s"):
        measure(Shots(camera), exposures=[30.0])


@pytest.mark.slow
@pytest.mark.parametrize("response", ["srgb", "film"])
def test_colours_mix_and_have_one_unit(response: str) -> None:
    """Also a colour with an eighth of the light of another has that unit."""
    M = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]])
    walls = [corner(8, albedo) for albedo in (0.8, 0.7, 0.1)]
    camera = VirtualRig(walls, GRID, mixing=M, response=response, bits=12, ambient=0.01)
    calibration = measure(Shots(camera), geometry="aligned")
    assert calibration.mixing is not None
    np.testing.assert_allclose(calibration.mixing, M, atol=0.02)
    white = calibration.white.value.reshape(-1, 3)
    row_sums = np.stack([wall.sum(axis=1) for wall in walls], axis=1)
    units = np.mean(white / row_sums, axis=0) / M.sum(axis=1)
    np.testing.assert_allclose(units, np.mean(units), rtol=0.02)


def test_a_camera_with_few_exposures() -> None:
    offered = (0.01, 0.05, 0.2, 0.5, 2.0, 6.0)
    calibration = measure(Shots(rig(exposures=offered)), geometry="aligned")
    assert set(calibration.exposures) <= set(offered)


class SilentAboutBits:
    """A rig that does not say how many bits its photographs have."""

    projector_grid: tuple[int, int] = (4, 8)
    channels: int = 1

    def __init__(self, bits: int) -> None:
        self.photograph = rig(4, bits=bits).photograph


@pytest.mark.parametrize("bits", [10, 14])
def test_fewer_bits_than_a_file_has_are_named(bits: int) -> None:
    last_code = (1 << bits) - 1
    with pytest.raises(AcquisitionError, match=f"{last_code} of 65535.*must be {bits}"):
        measure(Shots(SilentAboutBits(bits)), geometry="aligned")


@pytest.mark.parametrize(("response", "bits"), [("srgb", 8), ("film", 12), ("linear", 16)])
@pytest.mark.parametrize("sensitivity", [0.02, 1.0, 300.0])
def test_white_is_bright_but_not_saturated(response: str, bits: int, sensitivity: float) -> None:
    camera = rig(response=response, bits=bits, sensitivity=sensitivity)
    seconds = measure(Shots(camera), geometry="aligned").exposures[0]
    if seconds not in (1e-4, 30.0):
        assert 0.05 < seconds * sensitivity * corner().sum(axis=1).max() < 0.95


def response_error(seconds: tuple[float, ...]) -> float:
    """Relative error of a response that is measured at some exposures."""
    camera = Camera("srgb", 4096, black=0.02)
    images = []
    for t in seconds:
        images.append(camera.shoot(scene(), t, np.random.default_rng(0)))
    response = calibrate(images, seconds, levels=4096)
    light = np.linspace(0.02, 0.9, 200)
    relative = response.linear(camera.codes(light)) / light
    return float(np.std(relative) / np.mean(relative))


def test_a_bracket_determines_a_response_where_powers_of_four_do_not() -> None:
    error = response_error(bracket(0.1, 1.6, 4))
    assert error < 0.005
    assert error < response_error((0.1, 0.4, 1.6))


class Replaying(Unplugged):
    """A rig that records its photographs, and can give them again, changed."""

    keeps_photographs = True

    def __init__(self, T: Any, grid: tuple[int, int]) -> None:
        super().__init__(T, grid)
        self.images: list[np.ndarray] = []
        self.replayed: Any = None

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        if self.replayed is not None:
            return next(self.replayed)
        self.images.append(super().photograph(codes, seconds))
        return self.images[-1]


@pytest.fixture(scope="module")
def coloured_calibration() -> Replaying:
    """A rig of three colours after its calibration."""
    T = ltcl.scenes.dihedral(8, albedo=(0.8, 0.6, 0.4)).transport()
    camera = Replaying(T, T.grid)
    measure(Shots(camera), geometry="aligned", frames=2)
    assert len(camera.images) == 51
    return camera


@pytest.mark.parametrize(
    ("first", "text"), [(33, "photograph 33, of black"), (42, "photograph 42, of a uniform code")]
)
def test_a_lamp_in_black_or_uniform_codes_is_named(
    coloured_calibration: Replaying, first: int, text: str
) -> None:
    images = list(coloured_calibration.images)
    brighter = np.minimum(images[first - 1].astype(int) + 1000, 4095)
    images[first - 1] = brighter.astype(np.uint16)
    check_refused(coloured_calibration, images, f"^{text}")


@pytest.mark.slow
@pytest.mark.parametrize(("a", "b"), [(40, 41), (41, 43), (42, 44)])
def test_exchanged_uniform_codes_are_named(coloured_calibration: Replaying, a: int, b: int) -> None:
    """They decide on the curve of the projector."""
    images = list(coloured_calibration.images)
    images[a - 1], images[b - 1] = images[b - 1], images[a - 1]
    check_refused(coloured_calibration, images, rf"^photograph ({a}|{b})\b")


def check_refused(camera: Replaying, images: list[np.ndarray], text: str) -> None:
    camera.replayed = iter(images)
    with pytest.raises(AcquisitionError, match=text):
        measure(Shots(camera), geometry="aligned", frames=2)


class Inverting(Unplugged):
    """A rig that exchanges some stripes of Gray code with their inverses."""

    def __init__(self, stripes: list[np.ndarray], **options: Any) -> None:
        super().__init__(corner(), GRID, **options)
        self.stripes = stripes
        self.exchanged: list[int] = []

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        if any(np.array_equal(codes, pattern) for pattern in self.stripes):
            codes = 1 - codes
            self.exchanged.append(self.count + 1)
        return super().photograph(codes, seconds)


@pytest.mark.slow
@pytest.mark.parametrize("bit", range(7))
def test_gray_code_that_is_exchanged_with_its_inverse_is_named(bit: int) -> None:
    """Their map is mirrored in part, and as smooth as the right one."""
    size = (27, 50)
    view = camera_map(lambda u, v: (u / 3.3, v / 3.5), size, GRID)
    stripes = GrayCode(GRID).patterns()[2 * bit : 2 * bit + 2]
    camera = Inverting(list(stripes), camera_grid=size, camera_map=view)
    with pytest.raises(AcquisitionError, match="exchanged") as caught:
        measure(Shots(camera), frames=2)
    named = [int(n) for n in re.findall(r"photograph (\d+)", str(caught.value))]
    assert named == camera.exchanged or "finest stripes" in str(caught.value)
