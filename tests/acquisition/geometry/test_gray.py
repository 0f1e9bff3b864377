# SPDX-License-Identifier: BSD-3-Clause
"""Gray code: OpenCV's patterns, exact decoding, undecided bits, and what is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ltcl.acquisition.geometry import Correspondence, GrayCode, classification, decode, gray, subpixel
from ltcl.errors import InputError
from tests.acquisition.geometry.scenes import MAPS, Rig, homography

GRIDS = [(1, 1), (1, 2), (7, 1), (1, 53), (3, 5), (16, 16), (53, 7), (64, 64), (45, 100)]


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
    found = code.decode(images)
    for axis, wanted in zip(found, (x, y), strict=True):
        np.testing.assert_array_equal(axis.value, wanted)
        np.testing.assert_array_equal(axis.width, 1)
        np.testing.assert_array_equal(axis.confidence, 1)


def test_every_narrow_stripe_is_narrow():
    for pattern in GrayCode((64, 64), high_frequency=True).patterns()[:-2]:
        line = pattern[0] if np.ptp(pattern[0]) else pattern[:, 0]
        assert np.diff(np.flatnonzero(np.diff(line))).max() <= 3  # 2 but at what the highest bit flips
        assert 0.4 < line.mean() < 0.6


@pytest.mark.parametrize("n", range(1, 16))
def test_a_pixel_on_an_edge_lies_between_its_two_columns(n):
    patterns = GrayCode((1, 16)).patterns()
    images = [(p[:, n - 1 : n] + p[:, n : n + 1]) / 2 for p in patterns]  # half of each column
    x, _ = GrayCode((1, 16)).decode(images)
    assert x.value[0, 0] == n - 0.5
    assert x.width[0, 0] == 2
    assert x.confidence[0, 0] == 0


@pytest.mark.parametrize("first", [1, 2, 3])
def test_below_an_undecided_bit_a_coarse_interval_is_left(first):
    images = GrayCode((1, 16)).patterns()
    for k in range(first, 4):
        images[2 * k] = images[2 * k + 1] = np.full((1, 16), 0.5, np.float32)
    x, _ = GrayCode((1, 16)).decode(images)
    length = 16 >> first
    if first == 3:  # the finest bit alone: two columns, which is an edge like any other
        length = 2
    np.testing.assert_array_equal(x.width, length)
    np.testing.assert_array_equal(x.value[0], np.arange(16) // length * length + (length - 1) / 2)


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


def test_what_no_stripe_lights_is_not_valid():
    """Half of the picture sees indirect light alone, which depends on the pattern."""
    rng = np.random.default_rng(3)
    patterns = GrayCode((32, 32)).patterns()
    images = [p + 0.3 * p.mean() + 0.002 * rng.standard_normal(p.shape) for p in patterns]
    for image, p in zip(images, patterns, strict=True):
        image[:, 16:] = 0.3 * p.mean() + 0.002 * rng.standard_normal((32, 16))
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
    off = np.maximum(np.abs(found.x - x), np.abs(found.y - y))[found.valid]
    assert np.mean(off > 1.0) < 1e-3


def test_noise_alone_is_not_decoded():
    rng = np.random.default_rng(0)
    images = rng.random((GrayCode((64, 64)).count, 80, 80))
    assert decode(list(images), (64, 64)).decoded < 0.001


def test_undecided_wide_stripes_are_coarse_and_narrow_ones_certain_under_much_indirect_light():
    grid = (64, 64)
    x, y = homography((100, 110), grid)
    for narrow, certain in ((False, False), (True, True)):
        rig = Rig(x, y, grid, noise=0.001, indirect=1.6, albedo=0.5, full=1 / 20)
        images = [rig.photograph(p, 1 / 60) for p in GrayCode(grid, narrow).patterns()]
        assert (decode(images, grid, high_frequency=narrow).decoded > 0.9) == certain


def test_colour_photographs_are_averaged():
    patterns = GrayCode((8, 8)).patterns()
    found = decode([np.stack([p, 0 * p, 0.5 * p], axis=-1) for p in patterns], (8, 8))
    assert found.decoded == 1.0


@pytest.mark.parametrize(
    ("spoil", "part"),
    [
        (lambda images: images[:-1], "photographs are 13; they must be 14"),
        (lambda images: [*images, images[0]], "photographs are 15; they must be 14"),
        (lambda images: [*images[:3], images[3][:-1], *images[4:]], "photographs[3] has shape (7, 8)"),
        (lambda images: [*images[:3], images[3][0], *images[4:]], "photographs[3] has shape (8,)"),
        (lambda images: [*images[:3], None, *images[4:]], "photographs[3] is None"),
        (lambda images: [*images[:3], images[3] * np.nan, *images[4:]], "photographs[3] has 64 NaN"),
        (lambda images: [0 * image for image in images], "photographs[12] is of the white pattern"),
        (lambda images: [*images[:12], images[13], images[12]], "photographs[12] is of the white pattern"),
        (lambda images: [image[:, :0] for image in images], "photographs[0] has shape (8, 0)"),
    ],
)
def test_bad_photographs_are_refused_in_one_line(spoil, part):
    images = GrayCode((8, 8)).patterns()
    with pytest.raises((InputError, TypeError)) as caught:
        decode(spoil(images), (8, 8))
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("grid", [(0, 4), (4,), (4, 2.5), "ab"])
def test_bad_grids_are_refused(grid):
    with pytest.raises(InputError, match="grid is"):
        GrayCode(grid)


def test_a_correspondence_refuses_what_does_not_fit():
    one = np.ones((3, 4))
    with pytest.raises(InputError, match="y has shape"):
        Correspondence(one, one[:2], one, one > 0, (3, 4))
    with pytest.raises(InputError, match="NaN"):
        Correspondence(one * np.nan, one, one, one > 0, (3, 4))
    assert np.isnan(Correspondence(one * np.nan, one, one, one < 0, (3, 4)).x).all()
    with pytest.raises(InputError, match="tell no homography"):
        Correspondence(one, one, one, one > 0, (3, 4)).homography()


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_noise_is_known_without_more_photographs(gamma):
    """Also from raw pictures, where a half-lit pair sums to something else."""
    rng, sigma = np.random.default_rng(6), 0.01
    lit = rng.choice([0.0, 0.02, 0.98, 1.0], (20, 5000))
    lit[:2] = 0.5
    pairs = [share ** (1 / gamma) + sigma * rng.standard_normal(lit.shape) for share in (lit, 1 - lit)]
    if gamma == 1.0:
        assert np.mean(classification.noise(*pairs)) == pytest.approx(sigma**2, rel=0.05)
    ends = [(share > 0.5) + sigma * rng.standard_normal(lit.shape) for share in (lit, 1 - lit)]
    for pair, full in zip(pairs, ends, strict=True):
        pair[2:] = full[2:]
    assert np.mean(classification.noise(*pairs)) == pytest.approx(sigma**2, rel=0.1)


@pytest.mark.parametrize("narrow", [False, True])
def test_it_is_the_same_map_wherever_strips_of_rows_end(monkeypatch, narrow) -> None:
    grid, camera = (60, 83), (97, 111)
    rig = Rig(*MAPS["fold"](camera, grid), grid, noise=0.01, indirect=0.1, bits=8)
    images = [rig.photograph(p, 1 / 60) for p in GrayCode(grid, narrow).patterns()]
    whole = decode(images, grid, high_frequency=narrow)
    monkeypatch.setattr(gray, "STRIP", 1)
    monkeypatch.setattr(subpixel, "STRIP", 1)
    strips = decode(images, grid, high_frequency=narrow)
    assert np.array_equal(strips.valid, whole.valid)
    assert np.array_equal(strips.confidence, whole.confidence)
    for found, all_at_once in ((strips.x, whole.x), (strips.y, whole.y)):
        assert np.allclose(found, all_at_once, atol=1e-4, rtol=0, equal_nan=True)
