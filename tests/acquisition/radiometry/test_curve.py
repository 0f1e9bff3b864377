# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import curve

CODES = np.linspace(0, 1, 801)


def fitted(values: np.ndarray, anchor: float = 0.7) -> np.ndarray:
    """Least squares through values at CODES, of a given height at the anchor; scaled to end at 1."""
    B = curve.design(CODES)
    at = np.array([anchor])
    theta = curve.fit(B.T @ B, -B.T @ values, at, float(np.interp(anchor, CODES, values)))
    return curve.tabulate(theta, len(CODES))


def test_coefficients_at_their_places_are_the_identity():
    np.testing.assert_allclose(curve.tabulate(curve.PLACES, 801), CODES, atol=1e-14)
    np.testing.assert_allclose(curve.bends(curve.PLACES) @ curve.PLACES, 0.0, atol=1e-12)


@pytest.mark.parametrize("power", [1, 2, 3])
def test_a_cubic_is_met_exactly(power):
    values = -0.05 + 1.05 * CODES**power
    np.testing.assert_allclose(fitted(values), values, atol=1e-5)


def test_a_curve_never_falls():
    values = CODES + 0.2 * np.sin(20 * CODES)  # falls three times
    found = fitted(values)
    assert np.all(np.diff(found) > 0)
    assert found[-1] == pytest.approx(1.0)


def test_the_height_is_that_of_the_end():
    """A scale is free: the same shape, whatever height the anchor has."""
    values = CODES**2
    B, at = curve.design(CODES), np.array([0.5])
    for height in (0.25, 2.5):
        scaled = values * height / 0.25
        theta = curve.fit(B.T @ B, -B.T @ scaled, at, height)
        np.testing.assert_allclose(curve.tabulate(theta, 801), values, atol=1e-5)
