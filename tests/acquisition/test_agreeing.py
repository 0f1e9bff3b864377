# SPDX-License-Identifier: BSD-3-Clause
"""Photographs in each other's places are noticed by a calibration; noise and hot pixels are not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import VirtualRig, acquire, camera_map
from ltcl.acquisition.agreeing import Complements, refuse_unlike
from ltcl.acquisition.measuring import measure
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import Shots
from ltcl.errors import AcquisitionError

LINE = Response.identity()
TIMES = (0.5, 2.0, 8.0)


def photograph(light: np.ndarray, seconds: float, rng: Any, electrons: float = 1000.0) -> np.ndarray:
    """Of `light` a second, by a linear camera of 8 bits."""
    value = rng.poisson(light * seconds * electrons) / electrons + rng.normal(0, 0.003, light.shape)
    return np.rint(np.clip(value, 0, 1) * 255) / 255


@pytest.mark.parametrize("shape", [(4, 4), (9, 13), (96, 130), (5, 6, 3)])
@pytest.mark.parametrize("most", [0.02, 0.3, 1.5])
def test_noise_contradicts_nothing(shape: tuple[int, ...], most: float) -> None:
    """Of scenes with a few bright points, saturated here and there, from 8 bits and few electrons."""
    rng = np.random.default_rng(0)
    for electrons in (400.0, 20000.0):
        for _ in range(25):
            light = most * rng.random(shape) ** rng.choice([0.5, 1, 6])
            images = [photograph(light, t, rng, electrons) for t in TIMES]
            for noise in ({}, {"noise": NoiseModel(electrons, 0.003, levels=256)}):
                refuse_unlike(images, TIMES, range(3), LINE, **noise)


def test_hot_pixels_and_a_moth_contradict_nothing() -> None:
    rng = np.random.default_rng(1)
    images = [photograph(np.full((40, 40), 0.01), t, rng) for t in TIMES]
    images[0][3, 3] = images[1][3, 3] = 1.0
    images[1][10:13, 20:22] = 0.8
    refuse_unlike(images, TIMES, range(3), LINE)


@pytest.mark.parametrize("wrong", [0, 1, 2])
@pytest.mark.parametrize("part", [0.4, 2.0])
def test_other_light_is_named(wrong: int, part: float) -> None:
    """Twice as much, less than half: as of another exposure, or another code of the projector."""
    rng, times = np.random.default_rng(2), (0.5, 1.0, 2.0)
    light = 0.4 * rng.random((16, 16))
    images = [photograph(light * (part if k == wrong else 1.0), t, rng) for k, t in enumerate(times)]
    with pytest.raises(AcquisitionError, match=r"photographs .* are of one pattern") as told:
        refuse_unlike(images, times, (11, 12, 13), LINE, NoiseModel(1000.0, 0.003))
    assert f"{11 + wrong} ({times[wrong]:g} s)" in str(told.value)


def test_white_among_black_is_named() -> None:
    frames = [np.full((8, 8), x) for x in (0.004, 0.004, 1.0, 0.004)]
    with pytest.raises(AcquisitionError, match=r"photographs 2 \(1 s\) and 3 \(1 s\)"):
        refuse_unlike(frames, [1.0] * 4, (1, 2, 3, 4), LINE)


@pytest.mark.parametrize("lit", [0.0, 0.1])
def test_what_a_camera_gives_without_light_is_no_contradiction(lit: float) -> None:
    rng, light = np.random.default_rng(3), np.zeros((24, 36))
    light[:, :4] = lit
    images = [0.125 + 0.875 * photograph(light, t, rng) for t in TIMES]
    refuse_unlike(images, TIMES, range(3), LINE, offset=np.array([0.125]))
    with pytest.raises(AcquisitionError, match="other light"):
        refuse_unlike(images, TIMES, range(3), LINE)


@pytest.mark.parametrize("black", [0.0, 0.06, 0.125])
def test_a_known_response_and_a_black_level_are_no_contradiction(black: float) -> None:
    """The scan as well as the calibration, in a dark room."""
    T = 0.5 * np.eye(16) + 0.01
    made = VirtualRig(T, (4, 4), response="linear", bits=14, black=black)
    found = acquire(made, geometry="aligned", strategy="pixel", response=LINE)
    p = np.linspace(0, 1, 16).reshape(4, 4)
    light, truth = np.asarray(found @ p), (T @ p.ravel()).reshape(4, 4)
    scale = float(np.vdot(light, truth) / np.vdot(truth, truth))
    assert np.linalg.norm(light - scale * truth) < 0.03 * np.linalg.norm(light)


def test_patterns_without_inverses_say_nothing() -> None:
    told = Complements()
    for n, codes in enumerate((1.0, 0.3, 0.3, 0.2)):
        told.add(np.full((2, 2), codes), np.full((2, 2), 0.1 * n), n)
    told.refuse()


class Exchanged:
    """The photographs of two numbers in each other's place, as files that were misnamed."""

    channels, bits = 1, 12

    def __init__(self, make: Callable[[], VirtualRig], one: int, other: int) -> None:
        self._rig, self.projector_grid = make(), make().projector_grid
        shots = Recorded(make())
        measure(Shots(shots))
        self._asked, self._other, self.count = shots.asked, {one: other, other: one}, 0

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        self.count += 1
        if self.count in self._other:
            codes, seconds = self._asked[self._other[self.count] - 1]
        return self._rig.photograph(codes, seconds)


class Recorded:
    """A rig that remembers what it was asked for."""

    channels, bits = 1, 12

    def __init__(self, rig: VirtualRig) -> None:
        self._rig, self.projector_grid = rig, rig.projector_grid
        self.asked: list[tuple[np.ndarray, float]] = []

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        self.asked.append((np.array(codes), seconds))
        return self._rig.photograph(codes, seconds)


def corner() -> VirtualRig:
    y, x = np.mgrid[:8, :8].reshape(2, -1)
    T = 0.5 * np.eye(64) + 0.004 * np.exp(-np.hypot(x[:, None] - x, y[:, None] - y) / 3)
    sees = camera_map(lambda u, v: (u / 3 - 1 / 3, v / 3 - 1 / 3), (24, 24), (8, 8))
    camera: Any = {"camera_map": sees, "camera_grid": (24, 24), "bits": 12, "response": "film"}
    return VirtualRig(T, (8, 8), ambient=0.01, **camera)


REFUSED = [(20, 27), (24, 29), (36, 60), (45, 47), (62, 70), (90, 130), (115, 170), (181, 182)]
HARMLESS = [(62, 63), (80, 81), (130, 140)]


@pytest.mark.parametrize(("one", "other"), REFUSED)
def test_two_photographs_of_a_calibration_exchanged(one: int, other: int) -> None:
    with pytest.raises(AcquisitionError, match="photographs"):
        measure(Shots(Exchanged(corner, one, other)))


@pytest.mark.parametrize(("one", "other"), HARMLESS)
def test_photographs_of_one_pattern_exchanged(one: int, other: int) -> None:
    found, good = measure(Shots(Exchanged(corner, one, other))), measure(Shots(corner()))
    np.testing.assert_allclose(found.projector.values, good.projector.values, atol=0.01)
    np.testing.assert_allclose(found.response.values, good.response.values, atol=0.01)
