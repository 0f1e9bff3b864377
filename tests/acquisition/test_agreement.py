# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that deviate from what is known of their light are named; noise and defects never are."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition.agreement import ROUGH_NOISE, AgreementRecord, CameraModel
from ltcl.acquisition.calibrate import measure
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import Shots
from ltcl.errors import AcquisitionError

from .stopping import Unplugged

random = np.random.default_rng(0)
WHITE = np.ones((2, 2), np.float32)
SENSOR = CameraModel(Response.identity(), NoiseModel(1000.0, 0.003, levels=256), 0.02)


def photograph(light: np.ndarray, seconds: float = 1.0, electrons: float = 1000.0) -> np.ndarray:
    """Of `light` a second, by a linear camera of 8 bits."""
    value = random.poisson(light * seconds * electrons) / electrons + random.normal(
        0, 0.003, light.shape
    )
    return np.rint(np.clip(0.02 + value, 0, 1) * 255) / 255


def deviating(images: Any, seconds: Any, codes: Any = None, sensor: CameraModel = SENSOR) -> str:
    """What a calibration says of photographs 11, 12, ..., of one pattern or of `codes`; "" if nothing."""
    record = AgreementRecord()
    for number, (image, t) in enumerate(zip(images, seconds, strict=True), 11):
        record.add(WHITE if codes is None else codes[number - 11], t, image, number)
    try:
        record.check(sensor)
    except AcquisitionError as error:
        return str(error)
    return ""


def numbers(text: str) -> set[int]:
    return {int(number) for number in re.findall(r"photograph (\d+)", text)}


@pytest.mark.parametrize("shape", [(4, 4), (9, 13), (96, 130), (5, 6, 3)])
@pytest.mark.parametrize("most", [0.02, 0.3, 1.5])
def test_noise_deviates_from_nothing(shape: tuple[int, ...], most: float) -> None:
    """Of scenes with a few bright points, saturated here and there, from 8 bits and few electrons."""
    times = (0.5, 2.0, 8.0)
    for electrons in (400.0, 20000.0):
        for _ in range(25):
            light = most * random.random(shape) ** random.choice([0.5, 1, 6])
            images = [photograph(light, t, electrons) for t in times]
            for noise in (ROUGH_NOISE, NoiseModel(electrons, 0.003, levels=256)):
                assert not deviating(images, times, sensor=SENSOR._replace(noise=noise))


def test_few_photons_deviate_from_nothing() -> None:
    """Dark pixels get no photon in most photographs, and hardly any other noise."""
    sensor, times = (
        CameraModel(Response.identity(), NoiseModel(100.0, 1e-4)),
        (0.25, 1.0, 1.0, 1.0, 4.0),
    )
    for light in 0.2 * random.random((20, 32, 32)) ** 3:
        images = [np.minimum(random.poisson(100.0 * light * t) / 100.0, 1.0) for t in times]
        assert not deviating(images, times, sensor=sensor)


@pytest.mark.parametrize("by_hand", [False, True])
@pytest.mark.parametrize(
    ("gain", "albedo"), [(500.0, 0.6), *product([1000.0, 3000.0], [0.6, (0.8, 0.6, 0.4)])]
)
def test_a_clean_calibration_of_a_noisy_camera_agrees(
    gain: float, albedo: Any, by_hand: bool
) -> None:
    """Its response has to be measured in that noise, which the camera clips at black."""
    T = ltcl.scenes.dihedral(8, albedo=albedo).transport()
    rig = Unplugged(T, T.grid, bits=12, gain=gain, response="srgb", ambient=0.01)
    rig.keeps_photographs = by_hand
    measured = measure(Shots(rig), geometry="aligned").noise.electrons
    assert measured == pytest.approx(gain, rel=0.1)


def test_defects_and_a_moth_deviate_from_nothing() -> None:
    images = [photograph(np.full((40, 40), 0.01), t) for t in (0.5, 2.0, 8.0)]
    images[0][3, 3] = images[1][3, 3] = 1.0  # stuck in two
    images[1][10:12, 20] = 0.8
    assert not deviating(images, (0.5, 2.0, 8.0))


@pytest.mark.parametrize("wrong", [0, 1, 2])
@pytest.mark.parametrize("gain", [0.4, 2 ** (1 / 3), 2.0])
def test_another_exposure_is_named(wrong: int, gain: float) -> None:
    """A third of a stop, twice as much, less than half."""
    light, times = 0.3 * random.random((16, 16)), (0.5, 1.0, 2.0)
    images = [photograph(light * (gain if k == wrong else 1.0), t) for k, t in enumerate(times)]
    assert 11 + wrong in numbers(deviating(images, times))


@pytest.mark.parametrize("gain", [1.0, 2 ** (1 / 3)])
def test_an_exposure_that_dim_pixels_alone_show(gain: float) -> None:
    """Of two, 64 times apart: what one shows well the other does not, or it is saturated."""
    light, sensor = (
        random.random((60, 60)) ** 4,
        CameraModel(Response.identity(), NoiseModel(20000.0, 0.001)),
    )
    codes = [
        x + random.normal(0, 0.001, x.shape) for x in (gain * light, np.minimum(64 * light, 1.0))
    ]
    assert numbers(deviating(codes, (1.0, 64.0), sensor=sensor)) == (
        {11, 12} if gain > 1.0 else set()
    )


FAULTS: dict[str, tuple[Callable[[list[np.ndarray]], list[np.ndarray]], set[int], str]] = {
    "exchanged": (
        lambda images: [*images[:2], images[3], images[2], images[4]],
        {13, 14},
        "exchanged",
    ),
    "moved": (
        lambda images: images[:3] + [np.roll(image, 2) for image in images[3:]],
        {14},
        "moved",
    ),
    "lamp": (
        lambda images: [images[0], images[1] + 0.1, *images[2:]],
        {12},
        "another light was on",
    ),
    "short": (lambda images: [*images[:4], 0.5 * images[4] + 0.01], {15}, "0.5 times as bright"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_likely_causes(fault: str) -> None:
    """Of five photographs, one or two of which are of twice the seconds."""
    change, wrong, cause = FAULTS[fault]
    times = (1.0, 1.0, 1.0, 2.0, 1.0 if fault == "exchanged" else 2.0)
    light = 0.3 * random.random((20, 20))
    text = deviating(change([photograph(light, t) for t in times]), times)
    assert cause in text
    assert wrong <= numbers(text)
    assert len(numbers(text)) <= 3


@pytest.mark.parametrize("first", [None, 14, 20, 25])
def test_the_first_that_deviates_is_named(first: int | None) -> None:
    """White and stripes with their inverses, twice; from one photograph on everything has moved."""
    patterns = [
        (np.arange(20) // width % 2 * np.ones((20, 1))).astype(np.float32) for width in (1, 2, 4, 8)
    ]
    codes = [np.ones((20, 20), np.float32), *(half for p in patterns for half in (p, 1 - p))] * 2
    light = 0.5 * random.random((20, 20))
    images = [photograph(light * pattern) for pattern in codes]
    moved = [np.roll(im, 5) if first and k >= first else im for k, im in enumerate(images, 11)]
    text = deviating(moved, np.ones(len(codes)), codes)
    assert bool(text) == (first is not None)
    assert first is None or min(abs(number - first) for number in numbers(text)) <= 1


def test_a_pattern_and_its_inverse() -> None:
    """Each photographed once: all of them add up to white."""
    codes = [half for p in (random.random((4, 12, 12)) < 0.5).astype(float) for half in (p, 1 - p)]
    images = [photograph(0.6 * pattern) for pattern in codes]
    assert not deviating(images, np.ones(8), codes)
    images[4] = np.roll(images[4], 3)
    assert numbers(deviating(images, np.ones(8), codes)) == {15, 16}
