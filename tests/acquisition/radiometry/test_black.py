# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, black, merge
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import corner

SECONDS = [0.25, 0.5, 1.0, 1.0, 1.0, 1.0]
MODEL = NoiseModel(10000.0, 0.001)
random = np.random.default_rng()


def shots(ambient: np.ndarray, offset: Any) -> list[np.ndarray]:
    light = [random.poisson(ambient * t * MODEL.electrons) / MODEL.electrons for t in SECONDS]
    return [offset + part + random.normal(0, MODEL.read, part.shape) for part in light]


def test_offset_and_ambient_light_are_separated_without_bias():
    """The offset has its standard error, the ambient light its variance."""
    ambient, deviations = 0.05 * corner(100), []
    for _ in range(16):
        result = black.measure(shots(ambient, 0.004), SECONDS, noise=MODEL)
        deviations.append((result.offset[0] - 0.004) / result.error[0])
        z = (result.ambient.value - ambient) / np.sqrt(result.ambient.variance)
        assert z.std() == pytest.approx(1.0, abs=0.05)
    assert np.abs(deviations).max() < 4.0
    assert abs(np.mean(deviations)) < 4.0 / 4.0
    assert 0.4 < np.std(deviations) < 1.8


def test_channels_have_offsets_of_their_own():
    offset = np.array([0.002, 0.01, 0.03])
    ambient = 0.1 * np.stack([corner(64)] * 3, axis=-1) * [1.0, 0.5, 0.1]
    result = black.measure(shots(ambient, offset), SECONDS, noise=MODEL)
    assert np.all(np.abs(result.offset - offset) < 4 * result.error)
    assert result.error.max() < 1e-4


def test_the_projectors_light_is_the_difference():
    """Offset and ambient light are there with and without the projector, and gone from the difference."""
    ambient, light = 0.05 * corner(100), 0.5 * corner(100)[::-1]
    dark = black.measure(shots(ambient, 0.02), SECONDS, noise=MODEL)
    lit = merge(shots(ambient + light, 0.02), SECONDS, noise=MODEL, black=dark.offset) - dark.ambient
    z = (lit.value - light) / np.sqrt(lit.variance)
    assert abs(z.mean()) < 0.06
    assert z.std() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("images", "seconds", "part"),
    [
        (np.zeros((2, 4, 4)), [1.0, 1.0], "seconds"),
        (np.ones((2, 4, 4)), [1.0, 2.0], "images .* saturated"),
        ([], [], "images"),
    ],
)
def test_photographs_without_an_offset_are_refused(images, seconds, part):
    with pytest.raises(InputError, match=part):
        black.measure(images, seconds)
