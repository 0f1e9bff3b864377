# SPDX-License-Identifier: BSD-3-Clause
"""Gray code by real set-ups: blur, flicker, few codes, curved responses; and without inverses."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from ltcl.acquisition.geometry import Correspondence, GrayCode, decode
from ltcl.acquisition.geometry.photographs import PhotographFile

GRID = (48, 64)
SAMPLES = 5  # along each side of a camera pixel

FAULTS: dict[str, dict[str, Any]] = {
    "raw": {},
    "wide camera pixels": {"width": 0.7},
    "wider than the projector's": {"width": 1.3, "noise": 1.0},
    "flicker of 15 %": {"flicker": 0.15},
    "blurred": {"blur": 2.0, "noise": 3.0},
    "dark, blurred, flicker": {"blur": 2.2, "noise": 3.0, "white": 60.0, "flicker": 0.1},
    "linear, dark": {"gamma": 1.0, "noise": 3.0, "white": 80.0},
    "light from elsewhere": {"indirect": 0.3},
    "saturated": {"white": 330.0},
    "colours of a wheel": {"wheel": 0.3, "noise": 3.0},
}


def place(width: float, u: Any, v: Any) -> tuple[Any, Any]:
    x = 0.5 + width * (u + 0.03 * v + 0.8 * np.sin(v / 30))
    y = 0.7 + width * (v - 0.02 * u)
    return x, y


class Camera:
    """A camera of 8 bits before a wavy wall; every pixel sees the projector."""

    def __init__(self, width: float) -> None:
        h, w = GRID
        H = int((h - 2) / width / 1.05)
        W = int((w - 2) / width / 1.1)
        v, u = (np.mgrid[: H * SAMPLES, : W * SAMPLES] + 0.5) / SAMPLES - 0.5
        x, y = place(width, u, v)
        self.column = np.clip(np.rint(x), 0, w - 1).astype(int)
        self.row = np.clip(np.rint(y), 0, h - 1).astype(int)
        self.x, self.y = place(width, *np.mgrid[:H, :W].astype(float)[::-1])
        self.shape = (H, W)

    def light(self, pattern: np.ndarray) -> np.ndarray:
        H, W = self.shape
        return pattern[self.row, self.column].reshape(H, SAMPLES, W, SAMPLES).mean((1, 3))


def photographs(
    width: float = 0.35,
    gamma: float = 2.2,
    noise: float = 2.0,
    white: float = 200.0,
    flicker: float = 0.0,
    blur: float = 0.0,
    indirect: float = 0.0,
    wheel: float = 0.0,
) -> tuple[list[np.ndarray], Camera]:
    rng = np.random.default_rng(1)
    camera = Camera(width)
    H, W = camera.shape
    coarse = rng.uniform(0.3, 1.0, (H // 8 + 1, W // 8 + 1)).astype(np.float32)
    albedo = cv2.resize(coarse, (W, H))[..., None]
    images = []
    for pattern in GrayCode(GRID).patterns():
        lit = camera.light(pattern)
        if blur:
            lit = cv2.GaussianBlur(lit, (0, 0), blur)
        lit = (1 - indirect) * lit + indirect * pattern.mean()
        gain = 1 + flicker * rng.uniform(-1, 1) + wheel * rng.uniform(-1, 1, 3)
        codes = 10 + white * (gain * albedo * lit[..., None]) ** (1 / gamma)
        codes += noise * rng.standard_normal(codes.shape)
        if not wheel:
            codes = codes[..., 0]
        images.append(np.clip(np.rint(codes), 0, 255).astype(np.uint8))
    return images, camera


def right_share(mapping: Correspondence, camera: Camera) -> float:
    """Part of the valid pixels within one projector pixel of the truth."""
    deviation = np.hypot(mapping.x - camera.x, mapping.y - camera.y)[mapping.valid]
    return float(np.mean(deviation < 1.0))


def opencv_share(images: list[np.ndarray]) -> float:
    """Part of the pixels that OpenCV decodes."""
    peer = cv2.structured_light.GrayCodePattern.create(GRID[1], GRID[0])
    if images[0].ndim == 3:
        images = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
    H, W = images[0].shape
    rows = range(0, H, 5)
    failed = [peer.getProjPixel(images[:-2], u, v)[0] for v in rows for u in range(W)]
    return 1.0 - float(np.mean(failed))


@pytest.mark.parametrize("fault", FAULTS)
def test_right_pixels_are_kept_where_photographs_do_not_add_up(fault: str) -> None:
    images, camera = photographs(**FAULTS[fault])
    mapping = decode(images, GRID)
    assert mapping.decoded > max(0.95, opencv_share(images))
    assert right_share(mapping, camera) > 0.998


@pytest.mark.parametrize("fault", FAULTS)
def test_photographs_without_inverses_are_decoded(fault: str) -> None:
    images, camera = photographs(**FAULTS[fault])
    mapping = decode([*images[:-2:2], *images[-2:]], GRID)
    assert mapping.decoded > (0.1 if "dark" in fault or "blurred" in fault else 0.5)
    assert right_share(mapping, camera) > 0.98


@pytest.mark.parametrize("fault", FAULTS)
def test_inverses_of_fine_bits_are_enough_for_linear_photographs(fault: str) -> None:
    images, camera = photographs(**FAULTS[fault] | {"gamma": 1.0})
    sparing = GrayCode(GRID, has_few_inverses=True)
    full = GrayCode(GRID)
    places = {pattern.tobytes(): number for number, pattern in enumerate(full.patterns())}
    chosen = [images[places[pattern.tobytes()]] for pattern in sparing.patterns()]
    assert len(chosen) < len(images)
    mapping = decode(chosen, GRID)
    assert mapping.decoded > 0.95
    assert right_share(mapping, camera) > 0.998
    every = decode(images, GRID)
    both = mapping.valid & every.valid
    few_error = np.hypot(mapping.x - camera.x, mapping.y - camera.y)[both]
    error = np.hypot(every.x - camera.x, every.y - camera.y)[both]
    assert np.median(few_error) < 1.5 * np.median(error)


def test_flicker_does_not_move_the_edges() -> None:
    steady, camera = photographs(gamma=1.0, noise=0.5)
    flickering, _ = photographs(gamma=1.0, noise=0.5, flicker=0.15)
    for images in (steady, flickering):
        mapping = decode(images, GRID)
        deviation = np.hypot(mapping.x - camera.x, mapping.y - camera.y)
        assert np.median(deviation[mapping.valid]) < 0.02


@pytest.mark.parametrize("shape", [(40, 50), (40, 50, 3)])
def test_photographs_in_a_file_are_decoded_as_those_in_memory(shape: tuple[int, ...]) -> None:
    patterns = [cv2.resize(pattern, (50, 40)) for pattern in GrayCode(GRID).patterns()]
    if len(shape) == 3:
        patterns = [np.repeat(pattern[..., None], 3, axis=2) for pattern in patterns]
    images = [0.1 + 0.7 * pattern for pattern in patterns]
    expected = decode(images, GRID)
    file = PhotographFile()
    for image in images:
        file.append(image)
    mapping = decode(file, GRID)
    np.testing.assert_array_equal(mapping.valid, expected.valid)
    np.testing.assert_allclose(mapping.x, expected.x, atol=1e-2)
    np.testing.assert_allclose(mapping.y, expected.y, atol=1e-2)
