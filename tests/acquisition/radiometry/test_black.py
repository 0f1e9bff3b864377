# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, black, merge
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import corner

SECONDS = [0.25, 0.5, 1.0, 1.0, 1.0, 1.0]
MODEL = NoiseModel(10000.0, 0.001)


def shots(ambient: np.ndarray, offset, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    light = [rng.poisson(ambient * t * MODEL.electrons) / MODEL.electrons for t in SECONDS]
    return [offset + part + rng.normal(0, MODEL.read, part.shape) for part in light]


def test_offset_and_ambient_light_are_told_apart():
    """The offset is within four of its standard errors and unbiased; ambient light has its variance."""
    ambient, off = 0.05 * corner(100), []
    for seed in range(16):
        found = black.measure(shots(ambient, 0.004, seed), SECONDS, noise=MODEL)
        off.append((found.offset[0] - 0.004) / found.error[0])
        z = (found.ambient.value - ambient) / np.sqrt(found.ambient.variance)
        assert z.std() == pytest.approx(1.0, abs=0.05)
    assert np.abs(off).max() < 4.0
    assert abs(np.mean(off)) < 4.0 / 4.0
    assert 0.4 < np.std(off) < 1.8


def test_channels_have_offsets_of_their_own():
    offset = np.array([0.002, 0.01, 0.03])
    ambient = 0.1 * np.stack([corner(64)] * 3, axis=-1) * [1.0, 0.5, 0.1]
    found = black.measure(shots(ambient, offset, 0), SECONDS, noise=MODEL)
    assert np.all(np.abs(found.offset - offset) < 4 * found.error)
    assert found.error.max() < 1e-4


def test_the_projectors_light_is_what_is_left():
    """Offset and ambient light are there with and without the projector, and gone from the difference."""
    ambient, light = 0.05 * corner(100), 0.5 * corner(100)[::-1]
    dark = black.measure(shots(ambient, 0.02, 1), SECONDS, noise=MODEL)
    lit = merge(shots(ambient + light, 0.02, 2), SECONDS, noise=MODEL, black=dark.offset)
    z = (lit - dark.ambient).value - light
    z /= np.sqrt((lit - dark.ambient).variance)
    assert abs(z.mean()) < 0.06
    assert z.std() == pytest.approx(1.0, abs=0.05)


def test_dark_frames_average_in_linear_light():
    rng = np.random.default_rng(0)
    frames = [np.rint(4095 * (0.01 + 0.002 * rng.random((20, 30, 3)))).astype(np.uint16) for _ in range(9)]
    found = black.average(frames, levels=4096)
    np.testing.assert_allclose(found, np.mean(frames, axis=0) / 4095, rtol=1e-5)
    picture = merge([np.full((20, 30, 3), 200, np.uint16)], [2.0], levels=4096, black=found)
    np.testing.assert_allclose(picture.value, (200 / 4095 - found) / 2, rtol=1e-4)


@pytest.mark.parametrize(
    ("images", "seconds", "part"),
    [
        (np.zeros((2, 4, 4)), [1.0, 1.0], "two different exposures"),
        (np.ones((2, 4, 4)), [1.0, 2.0], "saturated at every pixel"),
        ([], [], "no photograph"),
    ],
)
def test_what_tells_no_black_is_refused(images, seconds, part):
    with pytest.raises(InputError, match=part):
        black.measure(images, seconds)
    with pytest.raises(InputError, match="no photograph"):
        black.average([])
