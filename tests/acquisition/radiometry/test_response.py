# SPDX-License-Identifier: BSD-3-Clause
"""Responses, and their estimates against the camera's own."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import Response, calibrate
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import CURVES, Camera, corner, shoot_channels

SECONDS = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2]
USED = np.linspace(0.02, 0.9, 400)  # linear values
random = np.random.default_rng()


def test_a_table_is_linear_between_and_beyond_its_codes():
    response = Response(np.array([[-0.1, 0.3, 1.0]]))
    codes = np.array([-0.5, 0.0, 0.25, 0.5, 0.75, 1.0, 1.5])
    np.testing.assert_allclose(
        response.linear(codes), [-0.5, -0.1, 0.1, 0.3, 0.65, 1.0, 1.7], rtol=1e-6
    )
    np.testing.assert_allclose(
        response.derivative(codes), [0.8, 0.8, 0.8, 1.4, 1.4, 1.4, 1.4], rtol=1e-6
    )
    np.testing.assert_allclose(Response.identity().linear(codes), codes, rtol=1e-6)


def test_channels_have_their_own_tables():
    response = Response(np.stack([np.linspace(0, 1, 4097) ** power for power in (1, 2, 3)]))
    codes = random.random((5, 7, 3))
    np.testing.assert_allclose(response.linear(codes), codes ** [1, 2, 3], atol=1e-6)
    np.testing.assert_allclose(
        response.derivative(codes), [1, 2, 3] * codes ** [0, 1, 2], atol=1e-3
    )
    np.testing.assert_allclose(response.codes(response.linear(codes)), codes, atol=1e-3)
    with pytest.raises(InputError, match=r"image has shape \(5, 7\)"):
        response.linear(np.zeros((5, 7)))


@pytest.mark.parametrize(
    ("values", "part"),
    [
        ([[0.0]], r"values has shape \(1, 1\)"),
        (np.zeros((2, 5)), r"values has shape \(2, 5\)"),
        ([[0.0, np.nan, 1.0]], "values has 1 NaN"),
        ([[0.0, 0.6, 0.5]], "values falls"),
        ([[0.5, 0.5, 0.5]], "values falls"),
    ],
)
def test_bad_tables_are_refused(values, part):
    with pytest.raises(InputError, match=part):
        Response(values)


def bracket(camera: Camera, seconds=SECONDS) -> list[np.ndarray]:
    return camera.bracket(corner(), seconds, random)


def error(response: Response, camera: Camera) -> float:
    """Root mean square of the relative error over the range, at the best scale."""
    ratio = response.linear(camera.codes(USED)).astype(np.float64) / USED
    return float(np.std(ratio) / np.mean(ratio))


@pytest.mark.parametrize("levels", [256, 4096, 0])
@pytest.mark.parametrize("curve", CURVES)
def test_the_response_is_estimated_to_half_a_percent(curve, levels):
    """Also the black offset of the codes: no light is 0."""
    camera = Camera(curve, levels)
    response = calibrate(bracket(camera), SECONDS, levels=levels or None)
    assert error(response, camera) < 0.005
    assert np.all(np.diff(response.values) > 0)
    assert response.values[0, -1] == pytest.approx(1.0)
    if curve in ("srgb", "film"):
        assert abs(response.linear(camera.codes(np.zeros(1)))[0]) < 2 * camera.read


@pytest.mark.parametrize("seconds", [[0.1, 0.3, 0.6, 1.8], [0.9, 0.3]])
def test_few_exposures_suffice_in_any_order(seconds):
    camera = Camera("srgb", 4096)
    assert error(calibrate(bracket(camera, seconds), seconds, levels=4096), camera) < 0.01


def test_channels_have_curves_of_their_own_and_moving_objects_do_not_count():
    cameras = [Camera("srgb"), Camera("gamma2.2"), Camera("film")]
    shots = shoot_channels(cameras, corner(), SECONDS)
    shots[2][60:90, 60:120] = 200  # somebody walked by
    for camera, values in zip(cameras, calibrate(shots, SECONDS).values, strict=True):
        assert error(Response(values), camera) < 0.005


@pytest.mark.parametrize(
    ("images", "seconds", "part"),
    [
        ([], [], "images holds no photograph"),
        (np.zeros((2, 4, 4)), [1.0, 1.0], "two different exposures"),
        ([np.zeros((4, 4)), np.zeros((4, 5))], [1, 2], r"images\[1\] has shape \(4, 5\).*\(4, 4\)"),
        ([np.zeros((4, 4), np.uint8), np.zeros((4, 4))], [1, 2], r"images\[1\] holds float64"),
        ([np.zeros((4, 4), np.int32)], [1], r"images\[0\] holds int32"),
        ([np.full((4, 4), np.nan), np.ones((4, 4))], [1, 2], "NaN"),
        (np.zeros((2, 4, 4)), [1.0, -1.0], "seconds"),
        (np.zeros((2, 20, 20)), [1.0, 2.0], "images are black, with 0.0%"),
        (np.full((2, 20, 20), 255, np.uint8), [1.0, 2.0], "images have 0 "),  # all saturated
        (np.full((2, 20, 20), 4096, np.uint16), [1.0, 2.0], "levels is 4096"),
    ],
)
def test_photographs_without_a_response_are_refused(images, seconds, part):
    with pytest.raises(InputError, match=part):
        calibrate(images, seconds, levels=4096 if "levels" in part else None)
