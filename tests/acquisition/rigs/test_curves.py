# SPDX-License-Identifier: BSD-3-Clause
"""Response curves: ends, slopes, inverses, and functions that are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition.rigs import curves
from ltcl.errors import InputError, InputTypeError

X = np.linspace(0.0, 1.0, 4001)


@pytest.mark.parametrize("name", curves.NAMED)
def test_a_projector_undoes_a_camera_of_the_same_name(name: str) -> None:
    encode, decode = curves.camera(name, 1)[0], curves.projector(name, 1)[0]
    np.testing.assert_allclose(decode(encode(X)), X, atol=1e-12)
    np.testing.assert_allclose(encode(X[[0, -1]]), [0.0, 1.0], atol=1e-12)
    assert np.all(np.diff(encode(X)) > 0)


def test_film_is_a_logistic_in_log_light() -> None:
    c = curves.camera("film", 1)[0](X[1:]) / curves.camera("film", 1)[0](np.array(1e12))
    slopes = np.diff(np.log(c / (1 - c))) / np.diff(np.log(X[1:]))  # logit over log exposure: a straight line
    np.testing.assert_allclose(slopes, 1.2, rtol=1e-6)


def test_film_has_a_toe_and_a_shoulder() -> None:
    log_light = np.linspace(-4, 0, 401)
    slope = np.gradient(curves.camera("film", 1)[0](np.exp(log_light)), log_light)
    assert slope.argmax() not in (0, 400)  # steepest in the middle: an S


def test_three_curves_go_to_three_channels() -> None:
    found = curves.camera(["linear", "srgb", np.sqrt], 3)
    np.testing.assert_allclose([float(f(np.array(0.25))) for f in found], [0.25, 0.53710, 0.5], atol=1e-5)
    assert len(curves.camera("srgb", 3)) == 3


@pytest.mark.parametrize(
    ("given", "channels", "error", "part"),
    [
        ("sRGB", 1, InputError, "response is 'sRGB'; it must be one of linear, srgb, film, gamma2.2"),
        (["srgb", "srgb"], 3, InputError, "2 curves"),
        (2.2, 1, InputTypeError, "response is 2.2"),
        (lambda x: 1 - x, 1, InputError, "rise"),
        (lambda x: 2 * x, 1, InputError, "spans 0 to 2"),
        (lambda x: x - 0.1, 1, InputError, "rise"),
        (lambda x: x * np.nan, 1, InputError, "NaN"),
        (lambda x: 0.5, 1, InputError, "shape"),
    ],
)
def test_what_is_no_curve_is_refused(given: Any, channels: int, error: type[Exception], part: str) -> None:
    with pytest.raises(error, match=part):
        curves.camera(given, channels)
