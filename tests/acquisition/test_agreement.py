# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that deviate from known light are named; noise and defects never are."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import VirtualRig
from ltcl.acquisition.agreement import ROUGH_NOISE, AgreementRecord, CameraModel
from ltcl.acquisition.calibrate import measure
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import Shots

from .stopping import Unplugged

random = np.random.default_rng(0)
WHITE = np.ones((2, 2), np.float32)
BLACK_LEVEL = 0.02
READ_NOISE = 0.003
# Number of the first photograph of every record here.
FIRST = 11
CAMERA = CameraModel(
    response=Response.identity(),
    noise=NoiseModel(1000.0, READ_NOISE, levels=256),
    offset=BLACK_LEVEL,
)


def photograph(light: np.ndarray, seconds: float = 1.0, electrons: float = 1000.0) -> np.ndarray:
    """Photograph `light` a second with a linear camera of 8 bits."""
    photons = random.poisson(light * seconds * electrons) / electrons
    value = photons + random.normal(0, READ_NOISE, light.shape)
    return np.rint(np.clip(BLACK_LEVEL + value, 0, 1) * 255) / 255


def message(images: Any, seconds: Any, codes: Any = None, camera: CameraModel = CAMERA) -> str:
    """Message of a record about photographs 11, 12, ..., or "" if nothing deviates.

    They are of one pattern, or of `codes`.
    """
    if codes is None:
        codes = [WHITE] * len(images)
    record = AgreementRecord()
    numbers = range(FIRST, FIRST + len(images))
    for pattern, image, t, number in zip(codes, images, seconds, numbers, strict=True):
        record.add(pattern, t, image, number)
    finding = record.first_finding(camera)
    return "" if finding is None else finding.text


def named(text: str) -> set[int]:
    """Numbers of the photographs that a message names."""
    return {int(number) for number in re.findall(r"photograph (\d+)", text)}


@pytest.mark.parametrize("shape", [(4, 4), (9, 13), (96, 130), (5, 6, 3)])
@pytest.mark.parametrize("brightest", [0.02, 0.3, 1.5])
def test_noise_deviates_from_nothing(shape: tuple[int, ...], brightest: float) -> None:
    """Scenes have a few bright points, saturated here and there, and few electrons in 8 bits."""
    times = (0.5, 2.0, 8.0)
    for electrons in (400.0, 20000.0):
        for _ in range(25):
            exponent = random.choice([0.5, 1, 6])
            light = brightest * random.random(shape) ** exponent
            images = [photograph(light, t, electrons) for t in times]
            for noise in (ROUGH_NOISE, NoiseModel(electrons, READ_NOISE, levels=256)):
                assert not message(images, times, camera=replace(CAMERA, noise=noise))


def test_few_photons_deviate_from_nothing() -> None:
    """Dark pixels get no photon in most photographs, and hardly any other noise."""
    camera = CameraModel(response=Response.identity(), noise=NoiseModel(100.0, 1e-4))
    times = (0.25, 1.0, 1.0, 1.0, 4.0)
    for light in 0.2 * random.random((20, 32, 32)) ** 3:
        images = []
        for t in times:
            photons = random.poisson(100.0 * light * t)
            images.append(np.minimum(photons / 100.0, 1.0))
        assert not message(images, times, camera=camera)


@pytest.mark.slow
@pytest.mark.parametrize("by_hand", [False, True])
@pytest.mark.parametrize(
    ("gain", "albedo"), [(500.0, 0.6), *product([1000.0, 3000.0], [0.6, (0.8, 0.6, 0.4)])]
)
def test_a_clean_calibration_of_a_noisy_camera_agrees(
    gain: float, albedo: Any, by_hand: bool
) -> None:
    """The response has to be measured in that noise, which the camera clips at black.

    The few photographs of a person tell 500 electrons with a standard deviation of 9 %.
    """
    T = ltcl.scenes.dihedral(8, albedo=albedo).transport()
    rig = Unplugged(T, T.grid, bits=12, gain=gain, response="srgb", ambient=0.01)
    rig.keeps_photographs = by_hand
    calibration = measure(Shots(rig), geometry="aligned")
    tolerance = 0.25 if by_hand and gain < 1000.0 else 0.1
    assert calibration.noise.electrons == pytest.approx(gain, rel=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("bits", "read"), [(8, 0.0031), (10, 0.002), (12, 0.0035)])
def test_noise_clipped_by_a_power_curve_agrees(bits: int, read: float, seed: int) -> None:
    """A curve of 2.2 has no slope at black, where it is a guess, and clips much of the noise.

    In the sparing set-up of a sketch 12 of 72 such cameras were refused.
    """
    T = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    camera = VirtualRig(
        T, T.grid, bits=bits, gain=4000.0, read=read, response="gamma2.2", ambient=0.01, seed=seed
    )
    calibration = measure(Shots(camera), geometry="aligned", sparing=True)
    assert calibration.noise.read == pytest.approx(read, rel=0.5)


def test_defects_and_a_moth_deviate_from_nothing() -> None:
    times = (0.5, 2.0, 8.0)
    images = [photograph(np.full((40, 40), 0.01), t) for t in times]
    for stuck in images[:2]:
        stuck[3, 3] = 1.0
    images[1][10:12, 20] = 0.8
    assert not message(images, times)


@pytest.mark.parametrize("wrong", [0, 1, 2])
@pytest.mark.parametrize("gain", [0.4, 2 ** (1 / 3), 2.0])
def test_another_exposure_is_named(wrong: int, gain: float) -> None:
    """The exposure is less than half, a third of a stop more, or twice as long."""
    light = 0.3 * random.random((16, 16))
    times = (0.5, 1.0, 2.0)
    gains = np.ones(3)
    gains[wrong] = gain
    images = [photograph(light * g, t) for g, t in zip(gains, times, strict=True)]
    assert FIRST + wrong in named(message(images, times))


@pytest.mark.parametrize(("gain", "expected"), [(1.0, set()), (2 ** (1 / 3), {11, 12})])
def test_an_exposure_that_dim_pixels_alone_show(gain: float, expected: set[int]) -> None:
    """Exposures are 64 times apart: a pixel good in one is dim or saturated in the other."""
    camera = CameraModel(response=Response.identity(), noise=NoiseModel(20000.0, 0.001))
    light = random.random((60, 60)) ** 4
    short = gain * light + random.normal(0, 0.001, light.shape)
    long = np.minimum(64 * light, 1.0) + random.normal(0, 0.001, light.shape)
    assert named(message([short, long], (1.0, 64.0), camera=camera)) == expected


def exchange(images: list[np.ndarray]) -> list[np.ndarray]:
    return [*images[:2], images[3], images[2], images[4]]


def move(images: list[np.ndarray]) -> list[np.ndarray]:
    return images[:3] + [np.roll(image, 2) for image in images[3:]]


def light_a_lamp(images: list[np.ndarray]) -> list[np.ndarray]:
    return [images[0], images[1] + 0.1, *images[2:]]


def shorten(images: list[np.ndarray]) -> list[np.ndarray]:
    return [*images[:4], 0.5 * images[4] + BLACK_LEVEL / 2]


@pytest.mark.parametrize(
    ("change", "last_seconds", "wrong", "cause"),
    [
        (exchange, 1.0, {13, 14}, "exchanged"),
        (move, 2.0, {14}, "moved"),
        (light_a_lamp, 2.0, {12}, "another light was on"),
        (shorten, 2.0, {15}, "0.5 times as bright"),
    ],
)
def test_likely_causes(
    change: Callable[[list[np.ndarray]], list[np.ndarray]],
    last_seconds: float,
    wrong: set[int],
    cause: str,
) -> None:
    """Five photographs, one or two of which have twice the seconds."""
    times = (1.0, 1.0, 1.0, 2.0, last_seconds)
    light = 0.3 * random.random((20, 20))
    images = change([photograph(light, t) for t in times])
    text = message(images, times)
    assert cause in text
    assert wrong <= named(text)
    assert len(named(text)) <= 3


def stripes_with_inverses() -> list[np.ndarray]:
    """White, and stripes of four widths with their inverses."""
    codes = [np.ones((20, 20), np.float32)]
    for width in (1, 2, 4, 8):
        line = np.arange(20) // width % 2
        stripes = np.broadcast_to(line, (20, 20)).astype(np.float32)
        codes += [stripes, 1 - stripes]
    return codes


@pytest.mark.parametrize("first", [14, 20, 25])
def test_the_first_that_deviates_is_named(first: int) -> None:
    """Everything has moved from one photograph on."""
    codes = 2 * stripes_with_inverses()
    light = 0.5 * random.random((20, 20))
    images = [photograph(light * pattern) for pattern in codes]
    times = np.ones(len(codes))
    assert not message(images, times, codes)
    moved = [np.roll(image, 5) for image in images[first - FIRST :]]
    numbers = named(message([*images[: first - FIRST], *moved], times, codes))
    assert min(abs(number - first) for number in numbers) <= 1


def test_a_pattern_and_its_inverse() -> None:
    """Each is photographed once, and all of them add up to white."""
    codes = []
    for pattern in (random.random((4, 12, 12)) < 0.5).astype(float):
        codes += [pattern, 1 - pattern]
    images = [photograph(0.6 * pattern) for pattern in codes]
    assert not message(images, np.ones(8), codes)
    images[4] = np.roll(images[4], 3)
    assert named(message(images, np.ones(8), codes)) == {15, 16}
