# SPDX-License-Identifier: BSD-3-Clause
"""What is measured of a set-up is what it was made with, in few photographs, at good exposures."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Shots, VirtualRig, camera_map
from ltcl.acquisition.calibrate import measure
from ltcl.acquisition.exposure import bracket
from ltcl.acquisition.geometry import GrayCode
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
    np.testing.assert_allclose(value / light, np.mean(value / light), rtol=0.02)
    scale = float(np.mean(value / light))
    assert calibration.noise.electrons == pytest.approx(10000.0 / scale, rel=0.2)
    np.testing.assert_allclose(calibration.ambient.value / scale, 0.02, rtol=0.05)
    np.testing.assert_allclose(
        calibration.white.value.ravel() / scale, corner().sum(axis=1), rtol=0.03
    )
    assert calibration.light.tolist() == [1.0]
    short, *_, longest = calibration.exposures
    assert 0.3 < short * corner().sum(axis=1).max() < 0.95
    assert 0.1 < 0.02 * longest < 0.7


def test_a_dark_room_around_the_picture_decides_no_exposure() -> None:
    """Three quarters of what the camera sees: 0 but for noise, of which half is above it."""
    grid, size = (6, 8), (48, 64)
    sees = camera_map(lambda u, v: ((u - 20) / 3.2, (v - 14) / 3.2), size, grid)
    T = 0.4 * np.eye(48) + 0.002
    camera = VirtualRig(T, grid, camera_map=sees, camera_grid=size, bits=12, ambient=0.01)
    measured = measure(Shots(camera))
    white = measured.resampling.apply(measured.white.value)[measured.resampling.seen]
    assert len(white) >= 44
    assert np.quantile(np.abs(white / np.median(white) - 1), 0.9) < 0.1
    with pytest.raises(InputError, match=r"saturates at 30 s"):
        measure(Shots(camera), exposures=[30.0])


@pytest.mark.parametrize("response", ["srgb", "film"])
def test_colours_mix_and_have_one_unit(response: str) -> None:
    """Also that of a colour with an eighth of the light of another."""
    M = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]])
    walls = [corner(8, albedo) for albedo in (0.8, 0.7, 0.1)]
    calibration = measure(
        Shots(VirtualRig(walls, GRID, mixing=M, response=response, bits=12, ambient=0.01)),
        geometry="aligned",
    )
    assert calibration.mixing is not None
    np.testing.assert_allclose(calibration.mixing, M, atol=0.02)
    white = calibration.white.value.reshape(-1, 3)
    units = [np.mean(white[:, c] / wall.sum(axis=1)) / M[c].sum() for c, wall in enumerate(walls)]
    np.testing.assert_allclose(units, np.mean(units), rtol=0.02)


def test_a_camera_with_few_exposures() -> None:
    offered = (0.01, 0.05, 0.2, 0.5, 2.0, 6.0)
    assert set(measure(Shots(rig(exposures=offered)), geometry="aligned").exposures) <= set(offered)


@pytest.mark.parametrize("bits", [10, 14])
def test_fewer_bits_than_a_file_has_are_named(bits: int) -> None:
    camera = SimpleNamespace(
        projector_grid=(4, 8), channels=1, photograph=rig(4, bits=bits).photograph
    )
    with pytest.raises(AcquisitionError, match=f"{(1 << bits) - 1} of 65535.*must be {bits}"):
        measure(Shots(cast(Any, camera)), geometry="aligned")


@pytest.mark.parametrize(("response", "bits"), [("srgb", 8), ("film", 12), ("linear", 16)])
@pytest.mark.parametrize("sensitivity", [0.02, 1.0, 300.0])
def test_white_is_bright_but_not_saturated(response: str, bits: int, sensitivity: float) -> None:
    camera = rig(response=response, bits=bits, sensitivity=sensitivity)
    seconds = measure(Shots(camera), geometry="aligned").exposures[0]
    assert 0.05 < seconds * sensitivity * corner().sum(axis=1).max() < 0.95 or seconds in (
        1e-4,
        30.0,
    )


def test_a_bracket_determines_a_response_where_powers_of_four_do_not() -> None:
    camera, codes, errors = Camera("srgb", 4096, black=0.02), np.linspace(0.02, 0.9, 200), []
    for seconds in (bracket(0.1, 1.6, 4), (0.1, 0.4, 1.6)):
        random = np.random.default_rng(0)
        response = calibrate(
            [camera.shoot(scene(), t, random) for t in seconds], seconds, levels=4096
        )
        relative = response.linear(camera.codes(codes)) / codes
        errors.append(np.std(relative) / np.mean(relative))
    assert errors[0] < min(0.005, errors[1])


@pytest.mark.parametrize(
    ("first", "other", "text"),
    [
        (33, None, r"photograph 33, of black"),
        (42, None, r"photograph 42, of a uniform code"),
        *((a, b, rf"photograph ({a}|{b})\b") for a, b in [(46, 47), (48, 53), (50, 54)]),
    ],
)
def test_a_fault_in_uniform_codes_is_named(first: int, other: int | None, text: str) -> None:
    """Or in black: a lamp is on, or two are exchanged. They decide on the curve of the projector."""
    T = ltcl.scenes.dihedral(8, albedo=(0.8, 0.6, 0.4)).transport()
    camera, images = Unplugged(T, T.grid), []
    camera.keeps_photographs = True
    real = camera.photograph
    camera.photograph = lambda codes, seconds: images.append(real(codes, seconds)) or images[-1]
    measure(Shots(camera), geometry="aligned", frames=2)
    assert len(images) == 59
    if other is None:
        images[first - 1] = np.minimum(images[first - 1].astype(int) + 1000, 4095).astype(np.uint16)
    else:
        images[first - 1], images[other - 1] = images[other - 1], images[first - 1]
    again = iter(images)
    camera.photograph = lambda codes, seconds: next(again)
    with pytest.raises(AcquisitionError, match=f"^{text}"):
        measure(Shots(camera), geometry="aligned", frames=2)


@pytest.mark.parametrize("bit", range(7))
def test_gray_code_that_is_exchanged_with_its_inverse_is_named(bit: int) -> None:
    """Their map is mirrored in part, and as smooth as the right one."""
    seen = {
        "camera_grid": (27, 50),
        "camera_map": camera_map(lambda u, v: (u / 3.3, v / 3.5), (27, 50), (8, 16)),
    }
    camera, numbers = Unplugged(corner(), (8, 16), **seen), []
    stripes, real = GrayCode((8, 16)).patterns()[2 * bit : 2 * bit + 2], camera.photograph

    def photograph(codes: np.ndarray, seconds: float) -> np.ndarray:
        if any(np.array_equal(codes, stripe) for stripe in stripes):
            codes = 1 - codes
            numbers.append(camera.count + 1)
        return real(codes, seconds)

    camera.photograph = photograph
    with pytest.raises(AcquisitionError, match="exchanged") as caught:
        measure(Shots(camera), frames=2)
    named = [int(n) for n in re.findall(r"photograph (\d+)", str(caught.value))]
    assert named == numbers or "finest stripes" in str(caught.value)
