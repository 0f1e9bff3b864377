# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that deviate from what is known of their light are named; noise and defects never are."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition.agreement import ROUGH, Record, Sensor, find_deviation
from ltcl.acquisition.radiometry import NoiseModel, Radiance, Response
from ltcl.errors import AcquisitionError

LINE = Response.identity()
TIMES = (0.5, 2.0, 8.0)
SENSOR = Sensor(LINE, NoiseModel(1000.0, 0.003, levels=256))


def photograph(light: np.ndarray, seconds: float, rng: Any, electrons: float = 1000.0) -> np.ndarray:
    """Of `light` a second, by a linear camera of 8 bits."""
    value = rng.poisson(light * seconds * electrons) / electrons + rng.normal(0, 0.003, light.shape)
    return np.rint(np.clip(0.02 + value, 0, 1) * 255) / 255


def check(images: Any, seconds: Any, numbers: Any, sensor: Sensor) -> None:
    """As in a calibration, where all are of one pattern."""
    record = Record()
    for image, t, number in zip(images, seconds, numbers, strict=True):
        record.add(np.ones((2, 2), np.float32), t, image, number)
    record.check(sensor)


def names(error: pytest.ExceptionInfo[AcquisitionError]) -> set[int]:
    return {int(number) for number in re.findall(r"photograph (\d+)", str(error.value))}


@pytest.mark.parametrize("shape", [(4, 4), (9, 13), (96, 130), (5, 6, 3)])
@pytest.mark.parametrize("most", [0.02, 0.3, 1.5])
def test_noise_deviates_from_nothing(shape: tuple[int, ...], most: float) -> None:
    """Of scenes with a few bright points, saturated here and there, from 8 bits and few electrons."""
    rng = np.random.default_rng(0)
    for electrons in (400.0, 20000.0):
        for _ in range(25):
            light = most * rng.random(shape) ** rng.choice([0.5, 1, 6])
            images = [photograph(light, t, rng, electrons) for t in TIMES]
            for noise in (ROUGH, NoiseModel(electrons, 0.003, levels=256)):
                check(images, TIMES, range(3), Sensor(LINE, noise, 0.02))


def test_defects_and_a_moth_deviate_from_nothing() -> None:
    rng = np.random.default_rng(1)
    images = [photograph(np.full((40, 40), 0.01), t, rng) for t in TIMES]
    images[0][3, 3] = images[1][3, 3] = 1.0  # stuck in two
    images[1][10:12, 20] = 0.8
    check(images, TIMES, range(3), SENSOR._replace(offset=0.02))


@pytest.mark.parametrize("wrong", [0, 1, 2])
@pytest.mark.parametrize("part", [0.4, 2 ** (1 / 3), 2.0])
def test_another_exposure_is_named(wrong: int, part: float) -> None:
    """A third of a stop, twice as much, less than half."""
    rng, times = np.random.default_rng(2), (0.5, 1.0, 2.0)
    light = 0.3 * rng.random((16, 16))
    images = [photograph(light * (part if k == wrong else 1.0), t, rng) for k, t in enumerate(times)]
    with pytest.raises(AcquisitionError, match="photograph") as raised:
        check(images, times, (11, 12, 13), SENSOR._replace(offset=0.02))
    assert 11 + wrong in names(raised)


CAUSES = {
    "exchanged": (lambda images: [*images[:2], images[3], images[2], images[4]], {13, 14}, "exchanged"),
    "moved": (
        lambda images: images[:3] + [np.roll(image, 2) for image in images[3:]],
        {14},
        "from photograph 14 on",
    ),
    "lamp": (lambda images: [images[0], images[1] + 0.1, *images[2:]], {12}, "another light was on"),
    "short": (lambda images: [*images[:4], 0.5 * images[4] + 0.01], {15}, "0.5 times as bright"),
}


@pytest.mark.parametrize("cause", CAUSES)
def test_likely_causes(cause: str) -> None:
    """Of five photographs, the last two for longer."""
    wrong, numbers, text = CAUSES[cause]
    rng, times = np.random.default_rng(3), (1.0, 1.0, 1.0, 2.0, 2.0)
    light = 0.3 * rng.random((20, 20))
    images = [photograph(light, t, rng) for t in times]
    if cause == "exchanged":
        times = (1.0, 1.0, 1.0, 2.0, 1.0)
        images = [photograph(light, t, rng) for t in times]
    with pytest.raises(AcquisitionError, match=text) as raised:
        check(wrong(images), times, range(11, 16), SENSOR._replace(offset=0.02))
    assert numbers <= names(raised)
    assert len(names(raised)) <= 3


def test_what_earlier_photographs_showed() -> None:
    rng = np.random.default_rng(4)
    light = 0.5 * (rng.random((16, 16)) < 0.5)
    known = Radiance(light, np.full(light.shape, 1e-6), np.ones(light.shape, bool))
    sensor = SENSOR._replace(offset=0.02)
    assert find_deviation([photograph(light, 1.0, rng)], [1.0], sensor, known=known) is None
    moved = find_deviation([photograph(np.roll(light, 1), 1.0, rng)], [1.0], sensor, known=known)
    assert moved is not None
    assert moved.describe([7], "photo_{}.png".format).startswith("photo_7.png ")


def test_a_pattern_and_its_inverse() -> None:
    rng, white, sensor = np.random.default_rng(5), np.full((12, 12), 0.6), SENSOR._replace(offset=0.02)
    codes = [part for p in (rng.random((4, 12, 12)) < 0.5).astype(float) for part in (p, 1 - p)]
    for wrong in (False, True):
        record = Record()
        for number, part in enumerate(codes, 1):
            image = photograph(white * part, 1.0, rng)
            record.add(part, 1.0, np.roll(image, 3) if wrong and number == 5 else image, number)
        if not wrong:
            record.check(sensor)
            continue
        with pytest.raises(AcquisitionError, match="photograph 5 or photograph 6"):
            record.check(sensor)


def test_a_record_names_what_deviates_first() -> None:
    """White before and after inverses, from one of which on everything has moved."""
    rng, white = np.random.default_rng(6), 0.5 * np.random.default_rng(6).random((20, 20))
    patterns = [(np.arange(20) // width % 2 * np.ones((20, 1))).astype(np.float32) for width in (1, 2, 4, 8)]
    codes = [np.ones((20, 20), np.float32), *(part for p in patterns for part in (p, 1 - p))] * 2
    for first in (None, 4, 10, 15):
        record = Record()
        for number, part in enumerate(codes, 1):
            image = photograph(white * part, 1.0, rng)
            moved = first is not None and number >= first
            record.add(part, 1.0, np.roll(image, 5) if moved else image, number)
        if first is None:
            record.check(SENSOR._replace(offset=0.02))
            continue
        with pytest.raises(AcquisitionError, match="photograph") as raised:
            record.check(SENSOR._replace(offset=0.02))
        assert min(abs(number - first) for number in names(raised)) <= 1
