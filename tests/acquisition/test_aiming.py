# SPDX-License-Identifier: BSD-3-Clause
"""Brightness, focus and coverage before a scan."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ltcl.acquisition.aiming import Aim, read_patterns, read_white

GRID = (24, 32)
CAMERA = (80, 120)


class Rig:
    """A projector of 24 x 32 pixels in a photograph of 80 x 120, three camera pixels each."""

    projector_grid = GRID
    channels = 3

    def __init__(self, top: int = 4, left: int = 12, blur: float = 0.0, light: float = 20.0):
        self.top = top
        self.left = left
        self.blur = blur
        self.light = light

    def photograph(self, codes, seconds):
        pattern = np.asarray(codes, np.float32)
        if pattern.ndim == 2:
            pattern = np.repeat(pattern[..., None], 3, axis=-1)
        shown = np.zeros((*CAMERA, 3), np.float32)
        large = np.kron(pattern, np.ones((3, 3, 1), np.float32))
        part = shown[self.top : self.top + 72, self.left : self.left + 96]
        part[:] = large[: part.shape[0], : part.shape[1]]
        if self.blur:
            shown = cv2.GaussianBlur(shown, (0, 0), self.blur)
        codes = (self.light * shown + 0.2) * seconds
        return np.rint(255 * np.clip(codes, 0.0, 1.0)).astype(np.uint8)


def settle(rig: Rig):
    aim = Aim(rig)
    return [aim.look() for _ in range(8)][-1]


def test_good_aim_has_no_advice():
    reading = settle(Rig())
    assert 0.3 < reading.brightness < 0.95
    assert reading.lit == pytest.approx(72 * 96 / (80 * 120), rel=0.05)
    assert reading.focus is not None
    assert reading.focus > 0.95
    assert reading.sides == ()
    assert reading.advice == []


def test_exposure_follows_light():
    assert settle(Rig(light=2000.0)).brightness < 0.95
    assert settle(Rig(light=0.5)).brightness > 0.3
    # A camera with few exposures stays too dark, and says so.
    rig = Rig(light=0.5)
    rig.exposures = (0.001, 0.01)  # pyright: ignore[reportAttributeAccessIssue]
    assert any("expose longer" in line for line in settle(rig).advice)


def test_blur_lowers_focus():
    sharp, soft, none = (settle(Rig(blur=blur)).focus or 0.0 for blur in (0.0, 2.0, 8.0))
    assert sharp > soft + 0.1
    # Noise of 8 bits is all that is left.
    assert none < 0.4 < soft
    assert any("focus projector" in line for line in settle(Rig(blur=8.0)).advice)


def test_cut_off_picture_names_sides():
    reading = settle(Rig(top=30, left=60))
    assert reading.sides == ("right", "bottom")
    assert any("right and bottom" in line for line in reading.advice)


def test_single_photograph():
    sharp = Rig().photograph(np.random.default_rng(0).random(GRID), 0.04) / 255.0
    soft = cv2.GaussianBlur(sharp, (0, 0), 2.0)
    white = Rig().photograph(np.ones(GRID), 0.04) / 255.0
    reading = read_white(white)
    assert reading.focus is None
    assert reading.lit == pytest.approx(0.72, abs=0.02)
    assert read_white(sharp).sharpness > 2 * read_white(soft).sharpness
    dark = read_patterns([np.zeros(CAMERA, np.float32)] * 4)
    assert dark.lit == 0.0
    assert dark.advice
