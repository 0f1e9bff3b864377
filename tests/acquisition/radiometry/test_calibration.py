# SPDX-License-Identifier: BSD-3-Clause
"""The estimated response against the camera's own, and against OpenCV's estimates of it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ltcl.acquisition.radiometry import Response, calibrate, consistency
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import CURVES, Camera, corner

SECONDS = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2]
USED = np.linspace(0.02, 0.9, 400)  # linear values


def bracket(camera: Camera, seconds=SECONDS, seed: int = 1) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [camera.shoot(corner(), t, rng) for t in seconds]


def error(response: Response, camera: Camera) -> float:
    """Root mean square of the relative error over the range, at the best scale."""
    found = response.linear(camera.codes(USED)).astype(np.float64)
    ratio = found / USED
    return float(np.std(ratio) / np.mean(ratio))


@pytest.mark.parametrize("levels", [256, 4096, 65536, 0])
@pytest.mark.parametrize("curve", CURVES)
def test_the_response_is_found_to_half_a_percent(curve, levels):
    camera = Camera(curve, levels)
    found = calibrate(bracket(camera), SECONDS, levels=levels or None)
    assert error(found, camera) < 0.005
    assert np.all(np.diff(found.values) > 0)
    assert found.values[0, -1] == pytest.approx(1.0)


@pytest.mark.parametrize("curve", ["srgb", "film"])
def test_no_light_is_zero(curve):
    """A black offset of the codes is found with the curve; known dark frames pin it."""
    camera = Camera(curve, 4096)
    rng = np.random.default_rng(5)
    dark = [camera.shoot(np.zeros((256, 256)), t, rng) for t in (0.1, 3.2)]
    shots = bracket(camera)
    at = camera.codes(np.zeros(1))
    assert abs(calibrate(shots, SECONDS, levels=4096).linear(at)[0]) < 2 * camera.read
    assert abs(calibrate(shots, SECONDS, levels=4096, dark=dark).linear(at)[0]) < 0.2 * camera.read


@pytest.mark.parametrize("seconds", [[0.1, 0.3, 0.6, 1.8], [0.3, 0.9]])
def test_few_exposures_suffice(seconds):
    camera = Camera("srgb", 4096)
    assert error(calibrate(bracket(camera, seconds), seconds, levels=4096), camera) < 0.01


def test_the_order_of_the_photographs_does_not_matter():
    shots = bracket(Camera())
    there, back = calibrate(shots, SECONDS), calibrate(shots[::-1], SECONDS[::-1])
    np.testing.assert_array_equal(there.values, back.values)


def test_channels_have_curves_of_their_own_or_share_one():
    cameras = [Camera("srgb"), Camera("gamma2.2"), Camera("film")]
    rng = np.random.default_rng(2)
    shots = [np.stack([camera.shoot(corner(), t, rng) for camera in cameras], axis=-1) for t in SECONDS]
    found = calibrate(shots, SECONDS)
    for camera, values in zip(cameras, found.values, strict=True):
        assert error(Response(values), camera) < 0.005
    alike = [np.repeat(shot[..., :1], 3, axis=-1) for shot in shots]
    one = calibrate(alike, SECONDS, shared=True)
    assert one.channels == 1
    assert error(one, cameras[0]) < 0.005


def test_what_moved_does_not_count():
    camera = Camera("srgb")
    shots = bracket(camera)
    shots[2][60:90, 60:120] = 200  # somebody walked by
    assert error(calibrate(shots, SECONDS), camera) < 0.005


@pytest.mark.parametrize("curve", CURVES)
def test_no_worse_than_opencv(curve):
    camera = Camera(curve)
    shots = bracket(camera)
    ours = error(calibrate(shots, SECONDS), camera)
    times = np.array(SECONDS, np.float32)
    colour = [np.repeat(shot[..., None], 3, axis=-1) for shot in shots]
    for theirs in (cv2.createCalibrateDebevec(samples=300), cv2.createCalibrateRobertson()):
        table = np.maximum.accumulate(theirs.process(colour, times=times)[:, 0, 0].astype(np.float64))
        table -= np.interp(camera.codes(np.zeros(1)) * 255, np.arange(256), table)  # we find black ourselves
        assert ours < error(Response(table), camera)


def test_light_of_consistent_exposures_has_the_ratio_of_the_seconds():
    camera = Camera("srgb", 4096)
    shots = bracket(camera)
    off = consistency(shots, SECONDS, calibrate(shots, SECONDS, levels=4096), levels=4096)
    assert off.shape == (5, 1, 3)
    assert np.abs(off[..., 0]).max() < 0.01
    wrong = consistency(shots, [*SECONDS[:3], 1.0, 2.0, 4.0], camera.response, levels=4096)
    assert wrong[2, 0, 0] == pytest.approx(-np.log(1.25), abs=0.01)


@pytest.mark.parametrize(
    ("images", "seconds", "part"),
    [
        ([], [], "no photograph"),
        (np.zeros((1, 4, 4)), [1.0], "two different exposures"),
        (np.zeros((2, 4, 4)), [1.0, 1.0], "two different exposures"),
        (
            [np.zeros((4, 4)), np.zeros((4, 5))],
            [1, 2],
            r"images\[1\] has shape \(4, 5\); it must be \(4, 4\)",
        ),
        ([np.zeros((4, 4), np.uint8), np.zeros((4, 4))], [1, 2], r"images\[1\] holds float64"),
        ([np.zeros((4, 4), np.int32)], [1], "uint8, uint16 or float"),
        ([np.full((4, 4), np.nan), np.ones((4, 4))], [1, 2], "NaN"),
        (np.zeros((2, 4, 4)), [1.0, -1.0], "seconds"),
        (np.zeros((2, 4, 4)), [1.0], "seconds"),
        (np.zeros((2, 20, 20)), [1.0, 2.0], "images are black, with 0.0% of full scale at most"),  # all black
        (
            np.full((2, 20, 20), 255, np.uint8),
            [1.0, 2.0],
            "0 sampled pixel",
        ),  # all saturated
    ],
)
def test_what_tells_no_response_is_refused(images, seconds, part):
    with pytest.raises(InputError, match=part):
        calibrate(images, seconds, levels=256 if len(images) and images[0].dtype == np.uint8 else None)


@pytest.mark.parametrize("swapped", [(0, 1), (2, 3), (4, 5), (0, 5)])
def test_photographs_in_the_wrong_order_are_named(swapped):
    shots, (a, b) = bracket(Camera()), swapped
    shots[a], shots[b] = shots[b], shots[a]
    with pytest.raises(InputError, match=rf"images\[\d\] has {SECONDS[b] if b - a == 1 else '.*'}"):
        calibrate(shots, SECONDS)


def test_the_same_photograph_twice_is_not_two_exposures():
    shots = bracket(Camera())
    shots[3] = shots[2]
    with pytest.raises(InputError, match=r"images\[3\] has 0.8 s and is not brighter than images\[2\]"):
        calibrate(shots, SECONDS)


def test_levels_that_the_photographs_exceed_are_refused():
    shots = bracket(Camera(levels=65536))
    with pytest.raises(InputError, match="levels is 4096, but images hold"):
        calibrate(shots, SECONDS, levels=4096)
