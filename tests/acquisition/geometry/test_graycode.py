# SPDX-License-Identifier: BSD-3-Clause
"""Gray code: OpenCV's patterns, exact decoding, undecided bits, and bad input."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ltcl.acquisition.geometry import Correspondence, GrayCode, decode
from ltcl.errors import InputError
from tests.acquisition.geometry.scenes import Rig, homography

GRIDS = [(1, 1), (1, 2), (7, 1), (1, 53), (3, 5), (53, 7), (64, 64), (45, 100)]
random = np.random.default_rng()


@pytest.mark.parametrize("grid", [(16, 16), (45, 100), (768, 1024)])
def test_the_patterns_are_those_of_opencv(grid):
    _, theirs = cv2.structured_light.GrayCodePattern.create(grid[1], grid[0]).generate()
    ours = GrayCode(grid).patterns()
    assert len(ours) == len(theirs) + 2
    for a, b in zip(ours, theirs, strict=False):
        np.testing.assert_array_equal(a, b / 255)


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("narrow", [False, True])
@pytest.mark.parametrize("levels", [None, 200])
def test_its_own_patterns_decode_exactly(grid, narrow, levels):
    code = GrayCode(grid, narrow)
    images = [p if levels is None else (20 + levels * p).astype(np.uint8) for p in code.patterns()]
    assert len(images) == code.count
    y, x = np.mgrid[: grid[0], : grid[1]]
    for axis, exact in zip(code.decode(images), (x, y), strict=True):
        np.testing.assert_array_equal(axis.value, exact)
        np.testing.assert_array_equal(axis.width, 1)
        np.testing.assert_array_equal(axis.confidence, 1)


def test_every_narrow_stripe_is_narrow():
    for pattern in GrayCode((64, 64), high_frequency=True).patterns()[:-2]:
        line = pattern[0] if np.ptp(pattern[0]) else pattern[:, 0]
        assert np.diff(np.flatnonzero(np.diff(line))).max() <= 3  # 2 but at what the highest bit flips
        assert 0.4 < line.mean() < 0.6


@pytest.mark.parametrize("n", range(1, 16))
def test_a_pixel_on_an_edge_lies_between_its_two_columns(n):
    images = [(p[:, n - 1 : n] + p[:, n : n + 1]) / 2 for p in GrayCode((1, 16)).patterns()]
    x, _ = GrayCode((1, 16)).decode(images)
    assert (x.value[0, 0], x.width[0, 0], x.confidence[0, 0]) == (n - 0.5, 2, 0)


@pytest.mark.parametrize(("first", "length"), [(1, 8), (2, 4), (3, 2)])
def test_below_an_undecided_bit_a_coarse_interval_is_left(first, length):
    images = GrayCode((1, 16)).patterns()
    for k in range(first, 4):
        images[2 * k] = images[2 * k + 1] = np.full((1, 16), 0.5, np.float32)
    x, _ = GrayCode((1, 16)).decode(images)
    np.testing.assert_array_equal(x.width, length)
    np.testing.assert_array_equal(x.value[0], np.arange(16) // length * length + (length - 1) / 2)


@pytest.mark.parametrize("narrow", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_rows_do_not_continue_in_the_next_row(narrow, turned):
    """A camera of two columns: the last pixel of a row and the first of the next differ by one, too."""
    code = GrayCode((6, 2), narrow)
    x, y = code.decode([p[:, ::-1] if turned else p for p in code.patterns()], edges=True)
    assert x.edges is not None
    assert y.edges is not None
    np.testing.assert_array_equal(x.edges.right, [[0.5, np.nan]] * 6)
    np.testing.assert_array_equal(x.edges.below, np.full((6, 2), np.nan))
    np.testing.assert_array_equal(y.edges.right, np.full((6, 2), np.nan))
    np.testing.assert_array_equal(y.edges.below, [[0.5, 0.5]] * 5 + [[np.nan, np.nan]])


def test_a_grid_that_is_no_power_of_two_has_no_place_beyond_its_end():
    images = [np.full((1, 1), c, np.float32) for c in (1, 0, 0, 1, 1, 0, 1, 0)]  # 1 0 1, which is place 6
    x, _ = GrayCode((1, 5)).decode(images)
    assert np.isinf(x.width[0, 0])


def test_confidence_is_the_part_of_direct_light_that_the_weakest_bit_shows():
    images = GrayCode((1, 16)).patterns()
    images[0] = 0.5 + 0.3 * (images[0] - 0.5)
    images[1] = 1 - images[0]
    x, _ = GrayCode((1, 16)).decode(images)
    np.testing.assert_allclose(x.confidence, 0.3, rtol=1e-5)


def test_pixels_that_no_stripe_lights_are_not_valid():
    """Half of the picture sees indirect light alone, which depends on the pattern."""
    patterns = GrayCode((32, 32)).patterns()
    images = [p + 0.3 * p.mean() + 0.002 * random.standard_normal(p.shape) for p in patterns]
    for image, p in zip(images, patterns, strict=True):
        image[:, 16:] = 0.3 * p.mean() + 0.002 * random.standard_normal((32, 16))
    found = decode(images, (32, 32))
    assert found.valid[:, :16].all()
    assert not found.valid[:, 16:].any()


@pytest.mark.parametrize(("noise", "least"), [(0.003, 0.99), (0.03, 0.97)])
def test_few_pixels_are_wrong_however_much_noise_there_is(noise, least):
    grid = (64, 96)
    x, y = homography((150, 200), grid)
    rig = Rig(x, y, grid, noise=noise)
    found = decode([rig.photograph(p, 1 / 60) for p in GrayCode(grid).patterns()], grid, subpixel=False)
    assert found.decoded > least
    deviation = np.maximum(np.abs(found.x - x), np.abs(found.y - y))[found.valid]
    assert np.mean(deviation > 1.0) < 1e-3


def test_noise_alone_is_not_decoded():
    images = random.random((GrayCode((64, 64)).count, 80, 80))
    assert decode(list(images), (64, 64)).decoded < 0.001


@pytest.mark.parametrize("narrow", [False, True])
def test_narrow_stripes_are_certain_under_much_indirect_light_and_wide_ones_are_not(narrow):
    grid = (64, 64)
    rig = Rig(*homography((100, 110), grid), grid, noise=0.001, indirect=1.6, albedo=0.5, full=1 / 20)
    images = [rig.photograph(p, 1 / 60) for p in GrayCode(grid, narrow).patterns()]
    assert (decode(images, grid, high_frequency=narrow).decoded > 0.9) == narrow


def test_colour_photographs_are_averaged():
    images = [np.stack([p, 0 * p, 0.5 * p], axis=-1) for p in GrayCode((8, 8)).patterns()]
    assert decode(images, (8, 8)).decoded == 1.0


@pytest.mark.parametrize("narrow", [False, True])
def test_tall_pictures_are_decoded_as_their_parts(narrow) -> None:
    """They are decoded in strips of some hundred rows at once."""
    grid, camera = (400, 83), (700, 111)
    v, u = np.mgrid[: camera[0], : camera[1]].astype(float)
    rig = Rig(0.7 * u + 0.005 * v + 0.3, 0.55 * v + 0.02 * u + 0.2, grid, noise=0.0)
    images = [rig.photograph(p, 1 / 60) for p in GrayCode(grid, narrow).patterns()]
    whole, around = decode(images, grid, high_frequency=narrow), 40
    for top in (100, 230, 400, 540):
        part = slice(top, top + 150)
        alone = decode([image[part] for image in images], grid, high_frequency=narrow)
        inside = slice(around, 150 - around)
        for here, there in ((alone.x, whole.x), (alone.y, whole.y)):
            np.testing.assert_allclose(here[inside], there[part][inside], atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("spoil", "part"),
    [
        (lambda images: images[:-1], "photographs are 13; they must be 14"),
        (lambda images: [*images, images[0]], "photographs are 15; they must be 14"),
        (lambda images: [*images[:3], images[3][:-1], *images[4:]], "photographs[3] has shape (7, 8)"),
        (lambda images: [*images[:3], images[3][0], *images[4:]], "photographs[3] has shape (8,)"),
        (lambda images: [*images[:3], None, *images[4:]], "photographs[3] is None"),
        (lambda images: [*images[:3], images[3] * np.nan, *images[4:]], "photographs[3] has 64 NaN"),
        (lambda images: [0 * image for image in images], "photographs[12]"),
        (lambda images: [*images[:12], images[13], images[12]], "photographs[12]"),
        (lambda images: [image[:, :0] for image in images], "photographs[0] has shape (8, 0)"),
    ],
)
def test_bad_photographs_are_refused_in_one_line(spoil, part):
    with pytest.raises((InputError, TypeError)) as caught:
        decode(spoil(GrayCode((8, 8)).patterns()), (8, 8))
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("grid", [(0, 4), (4,), (4, 2.5), "ab"])
def test_bad_grids_are_refused(grid):
    with pytest.raises(InputError, match="grid is"):
        GrayCode(grid)


def test_a_correspondence_refuses_bad_arrays():
    one = np.ones((3, 4))
    with pytest.raises(InputError, match="y has shape"):
        Correspondence(one, one[:2], one, one > 0, (3, 4))
    with pytest.raises(InputError, match="NaN"):
        Correspondence(one * np.nan, one, one, one > 0, (3, 4))
    assert np.isnan(Correspondence(one * np.nan, one, one, one < 0, (3, 4)).x).all()
