# SPDX-License-Identifier: BSD-3-Clause
"""Noise of a sensor against the distributions it is drawn from; saturation, offset and levels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.stats

from ltcl.acquisition.rigs.curves import camera
from ltcl.acquisition.rigs.sensor import Sensor
from ltcl.errors import InputError

PIXELS = 40_000


def sensor(**change: Any) -> Sensor:
    settings: dict[str, Any] = {"bits": "float", "black": 0.0, "electrons": None, "read": 0.0}
    return Sensor(**{"curves": camera("linear", 1), **settings, **change})


def expose(made: Sensor, value: float, seed: int = 3) -> np.ndarray:
    return made.expose(np.full((200, PIXELS // 200), value), np.random.default_rng(seed)).astype(np.float64)


@pytest.mark.parametrize("value", [0.001, 0.02, 0.4])
def test_photons_are_poisson(value: float) -> None:
    counts = expose(sensor(electrons=1000.0), value).ravel() * 1000.0
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-3)  # whole electrons
    law = scipy.stats.poisson(1000.0 * value)
    low, high = int(law.ppf(0.002)), int(law.ppf(0.998))
    edges = np.unique(np.linspace(low, high, min(30, high - low + 1)).astype(int))
    cut = np.concatenate([[-np.inf], edges + 0.5, [np.inf]])
    observed = np.histogram(counts, cut)[0]
    expected = np.diff(law.cdf(cut)) * counts.size
    keep = expected >= 5
    statistic = np.sum((observed[keep] - expected[keep]) ** 2 / expected[keep])
    assert scipy.stats.chi2.sf(statistic, keep.sum() - 1) > 1e-3


def test_read_noise_is_normal() -> None:
    x = expose(sensor(read=0.01), 0.5).ravel()
    assert scipy.stats.kstest(x, scipy.stats.norm(0.5, 0.01).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    ("value", "electrons", "read"), [(0.1, 500.0, 0.002), (0.6, 8000.0, 0.004), (0.0, 50.0, 0.01)]
)
def test_mean_and_variance_are_those_of_the_model(value: float, electrons: float, read: float) -> None:
    x = expose(sensor(electrons=electrons, read=read), value)
    variance = value / electrons + read**2
    assert abs(x.mean() - value) < 4 * np.sqrt(variance / PIXELS)
    # The standard error of a sample variance follows from the kurtosis; 1 / count of it is the photons'.
    kurtosis = 3 + (value / electrons**3) / variance**2
    assert abs(x.var(ddof=1) / variance - 1) < 4 * np.sqrt((kurtosis - 1) / PIXELS)


def test_neighbours_are_independent() -> None:
    x = expose(sensor(electrons=500.0, read=0.002), 0.3)
    z = (x - x.mean()) / x.std()
    for pairs in (z[:, 1:] * z[:, :-1], z[1:] * z[:-1]):
        assert abs(pairs.mean()) < 4 / np.sqrt(pairs.size)


def test_full_pixels_hold_no_more() -> None:
    full = sensor(bits=8, electrons=1000.0, read=0.01, curves=camera("srgb", 1))
    assert np.all(expose(full, 1.5) == 255)
    assert np.all(expose(full, 1e18) == 255)


@pytest.mark.parametrize(
    ("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (12, np.uint16), (16, np.uint16)]
)
def test_levels(bits: int, dtype: type) -> None:
    value = np.linspace(0, 1.2, 5000).reshape(50, 100)
    codes = sensor(bits=bits, black=0.1).expose(value, np.random.default_rng(1))
    assert codes.dtype == dtype
    most = 2**bits - 1
    np.testing.assert_array_equal(codes, np.rint((0.1 + 0.9 * np.minimum(value, 1)) * most))
    assert codes.max() == most


def test_curves_go_by_channel_and_offset_comes_after_them() -> None:
    three = sensor(curves=camera(["linear", "srgb", np.sqrt], 3), black=0.2)
    codes = three.expose(np.full((1, 1, 3), 0.25), np.random.default_rng(1))
    assert codes.dtype == np.float32
    np.testing.assert_allclose(codes[0, 0], 0.2 + 0.8 * np.array([0.25, 0.53709873, 0.5]), rtol=1e-6)


def test_noise_below_zero_is_kept_above_the_offset() -> None:
    x = expose(sensor(read=0.01, black=0.1), 0.0)
    assert abs(x.mean() - 0.1) < 4 * 0.009 / np.sqrt(PIXELS)
    assert (x < 0.1).mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(PIXELS))
    clipped = expose(sensor(read=0.01, black=0.0, bits=16), 0.0)
    assert clipped.min() == 0


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"bits": 7}, 'bits is 7; it must be 8 to 16, or "float"'),
        ({"bits": "double"}, "bits"),
        ({"black": 1.0}, "black"),
        ({"black": -0.1}, "black"),
        ({"read": -1e-3}, "read"),
        ({"electrons": 0.0}, "gain"),
        ({"electrons": float("inf")}, "gain"),
    ],
)
def test_impossible_sensors_are_refused(change: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        sensor(**change)
