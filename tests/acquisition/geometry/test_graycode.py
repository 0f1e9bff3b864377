# SPDX-License-Identifier: BSD-3-Clause
"""Gray code: OpenCV's patterns, exact decoding, undecided bits, and bad input."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ltcl.acquisition.geometry import Correspondence, GrayCode, decode
from ltcl.errors import InputError
from tests.acquisition.geometry.scenes import homography, photographs, places

random = np.random.default_rng()


def test_the_patterns_are_those_of_opencv():
    _, theirs = cv2.structured_light.GrayCodePattern.create(100, 45).generate()
    ours = GrayCode((45, 100)).patterns()
    assert len(ours) == len(theirs) + 2
    np.testing.assert_array_equal(ours[:-2], np.array(theirs) / 255)


@pytest.mark.parametrize("grid", [(1, 1), (1, 2), (7, 1), (3, 5), (53, 7), (45, 100)])
@pytest.mark.parametrize("levels", [None, 200])
def test_its_own_patterns_decode_exactly_also_in_colour(grid, levels):
    code = GrayCode(grid)
    images = code.patterns()
    if levels is not None:
        images = [(20 + levels * pattern).astype(np.uint8) for pattern in images]
    assert len(images) == code.count
    colour = [np.stack([image, image // 2, image], axis=-1) for image in images]
    exact_y, exact_x = np.mgrid[: grid[0], : grid[1]]
    for pictures in (images, colour):
        x, y = code.decode(pictures)
        np.testing.assert_array_equal(x.value, exact_x)
        np.testing.assert_array_equal(y.value, exact_y)
        np.testing.assert_array_equal(x.width, 1)
        np.testing.assert_array_equal(y.width, 1)


@pytest.mark.parametrize("n", range(1, 16))
def test_a_pixel_on_an_edge_lies_between_its_two_columns(n):
    """A second undecided bit leaves no coordinate."""
    images = [(p[:, n - 1 : n] + p[:, n : n + 1]) / 2 for p in GrayCode((1, 16)).patterns()]
    x, _ = GrayCode((1, 16)).decode(images)
    assert (x.value[0, 0], x.width[0, 0]) == (n - 0.5, 2)
    certain = 2 * (n == 8)  # the first bit, but there it is undecided
    images[certain] = images[certain + 1] = np.full((1, 1), 0.5, np.float32)
    assert np.isinf(GrayCode((1, 16)).decode(images)[0].width)


@pytest.mark.parametrize("turned", [False, True])
def test_rows_do_not_continue_in_the_next_row(turned):
    """The last pixel of a row and the first of the next differ by one, too, in two columns."""
    code = GrayCode((6, 2))
    x, y = code.decode([p[:, ::-1] if turned else p for p in code.patterns()])
    np.testing.assert_array_equal(x.right, [[0.5, np.nan]] * 6)
    np.testing.assert_array_equal(x.below, np.full((6, 2), np.nan))
    np.testing.assert_array_equal(y.right, np.full((6, 2), np.nan))
    np.testing.assert_array_equal(y.below, [[0.5, 0.5]] * 5 + [[np.nan, np.nan]])


def test_pixels_that_no_stripe_lights_are_not_valid():
    """The right half sees indirect light alone, which depends on the pattern, or noise alone."""
    patterns = np.array(GrayCode((64, 64)).patterns())
    even = 0.3 * patterns.mean(axis=(1, 2), keepdims=True)
    images = patterns + even + 0.002 * random.standard_normal(patterns.shape)
    images[:, :32, 32:] -= patterns[:, :32, 32:]
    images[:, 32:, 32:] = random.random((len(images), 32, 32))
    mapping = decode(list(images), (64, 64))
    assert mapping.valid[:, :32].mean() > 0.98
    assert not mapping.valid[:32, 33:].any()
    assert mapping.valid[32:, 33:].mean() < 0.002


@pytest.mark.parametrize(
    ("grid", "noise", "indirect", "least"),
    [((64, 96), 0.003, 0.0, 0.99), ((64, 96), 0.03, 0.0, 0.97), ((64, 64), 0.001, 0.9, 0.99)],
)
def test_hardly_a_pixel_is_wrong_with_noise_and_with_light_from_elsewhere(
    grid, noise, indirect, least
):
    """Direct light is 0.6 of full scale; bits are certain up to nearly twice as much indirect."""
    camera = (150, 200)
    place = homography(camera, grid)
    images = list(photographs(place, camera, grid, noise, random, indirect))
    mapping = decode(images, grid, subpixel=False)
    x, y = places(place, camera)
    assert mapping.decoded > least
    deviation = np.maximum(np.abs(mapping.x - x), np.abs(mapping.y - y))[mapping.valid]
    assert np.mean(deviation > 1.0) < 1e-3


def test_with_three_times_as_much_light_from_elsewhere_nothing_is_decoded():
    """The pattern no longer decides which photograph of a pair is brighter."""
    images = photographs(homography((100, 110), (64, 64)), (100, 110), (64, 64), 0.001, random, 1.8)
    with pytest.raises(InputError, match="photographs: no pixel"):
        decode(list(images), (64, 64))


def test_tall_pictures_are_decoded_as_their_parts() -> None:
    """They are decoded in strips of some hundred rows at once."""

    def place(u, v):
        return 0.7 * u + 0.005 * v + 0.3, 0.55 * v + 0.02 * u + 0.2

    images = list(photographs(place, (700, 111), (400, 83), 0.0, random))
    whole = decode(images, (400, 83))
    inside = slice(40, 110)
    for top in (100, 230, 400, 540):
        rows = slice(top, top + 150)
        alone = decode([image[rows] for image in images], (400, 83))
        for here, there in ((alone.x, whole.x), (alone.y, whole.y)):
            np.testing.assert_allclose(here[inside], there[rows][inside], atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda images: images[:-1], "photographs are 13; they must be 14"),
        (
            lambda images: [*images[:3], images[3][:-1], *images[4:]],
            "photographs[3] has shape (7, 8)",
        ),
        (lambda images: [*images[:3], None, *images[4:]], "photographs[3] is None"),
        (
            lambda images: [*images[:3], images[3] * np.nan, *images[4:]],
            "photographs[3] has 64 NaN",
        ),
        (lambda images: [0 * image for image in images], "photographs[12]"),
        (lambda images: [*images[:12], images[13], images[12]], "photographs[12]"),
        (lambda images: [image[:, :0] for image in images], "photographs[0] has shape (8, 0)"),
    ],
)
def test_bad_photographs_are_refused_in_one_line(spoil, message):
    with pytest.raises((InputError, TypeError)) as caught:
        decode(spoil(GrayCode((8, 8)).patterns()), (8, 8))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_grids_and_arrays_are_refused():
    for grid in ((0, 4), (4,), (4, 2.5), "ab"):
        with pytest.raises(InputError, match="grid is"):
            GrayCode(grid)  # pyright: ignore[reportArgumentType]
    ones = np.ones((3, 4))
    with pytest.raises(InputError, match="y has shape"):
        Correspondence(ones, ones[:2], ones > 0, (3, 4))
    with pytest.raises(InputError, match="NaN"):
        Correspondence(ones * np.nan, ones, ones > 0, (3, 4))
    assert np.isnan(Correspondence(ones * np.nan, ones, ones < 0, (3, 4)).x).all()
