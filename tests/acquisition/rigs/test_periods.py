# SPDX-License-Identifier: BSD-3-Clause
"""Which exposures see whole periods of a projector."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.rigs import periods
from ltcl.errors import InputError


def ripple(seconds: float, period: float) -> float:
    """Relative spread of the light of a colour that is shown in the first third of each period."""
    begins = np.linspace(0, 1, 3001)

    def since_zero(moments: np.ndarray) -> np.ndarray:
        return np.floor(moments) / 3 + np.minimum(moments % 1, 1 / 3)

    light = since_zero(begins + seconds / period) - since_zero(begins)
    return np.ptp(light) / np.mean(light)


@pytest.mark.parametrize("period", [1 / 24, 1 / 60, 1 / 144])
def test_light_of_what_is_kept_hardly_depends_on_when_it_begins(period: float) -> None:
    offered = tuple(np.geomspace(1 / 4000, 8, 200))
    kept = periods.exposures(offered, period)
    assert kept
    for seconds in offered:
        if seconds in kept:
            assert ripple(seconds, period) < 3 * 0.02 + 0.001
        else:
            assert ripple(seconds, period) > 2 * 0.02 - 0.001


def test_a_camera_with_any_exposure_is_offered_multiples() -> None:
    kept = periods.exposures(None, 1 / 60)
    assert kept is not None
    counts = np.array(kept) * 60
    np.testing.assert_allclose(counts, np.rint(counts), rtol=1e-12)
    assert counts[0] == pytest.approx(1)
    assert kept[-1] <= 30
    assert np.all(np.diff(kept) > 0)
    assert np.max(counts[1:] / counts[:-1]) <= 2


def test_multiples_stay_within_the_limits() -> None:
    kept = periods.exposures(None, 1 / 60, (0.02, 0.1))
    assert kept == pytest.approx((2 / 60, 3 / 60, 4 / 60, 6 / 60))
    with pytest.raises(InputError, match=r"0\.001 to 0\.016 s, hold no multiple"):
        periods.exposures(None, 1 / 60, (0.001, 0.016))


def test_steady_light_takes_any_exposure() -> None:
    assert periods.exposures(None, None) is None
    assert periods.exposures((0.1, 0.123), None) == (0.1, 0.123)


def test_none_left_is_refused() -> None:
    with pytest.raises(InputError, match=r"0\.001 to 0\.02 s, hold no multiple .* 0\.01667 s; period=None"):
        periods.exposures((0.001, 0.02), 1 / 60)
