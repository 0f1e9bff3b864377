# SPDX-License-Identifier: BSD-3-Clause
"""Transports from pairs of pictures and their photographs."""

from __future__ import annotations

from typing import Any, cast

import cv2
import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Correspondence
from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.estimation.view import find_view
from ltcl.errors import AcquisitionError, InputError, InputTypeError

GRID = (12, 24)
FRAMES = 90
# Of the camera, relative to the light of each pixel under white.
NOISE = 0.002
MIXING = np.array([[0.9, 0.1, 0.0], [0.05, 0.85, 0.1], [0.0, 0.1, 0.9]])
# From projector to camera coordinates: 3 camera pixels to a side, turned a little, in perspective.
VIEW = np.array([[3.0, 0.15, 9.0], [-0.1, 3.1, 8.0], [5e-4, 0.0, 1.0]])
CAMERA_GRID = (56, 92)


def pictures(count: int, seed: int = 0) -> np.ndarray:
    """Pictures with the spectrum of nature, 1/f, in [0, 1]."""
    random = np.random.default_rng(seed)
    h, w = GRID
    frequency = np.hypot(np.fft.fftfreq(h)[:, None], np.fft.fftfreq(w)[None])
    frequency[0, 0] = 1.0 / max(GRID)
    spectrum = np.fft.fft2(random.standard_normal((count, *GRID))) / frequency
    values = np.real(np.fft.ifft2(spectrum))
    values -= values.mean(axis=(1, 2), keepdims=True)
    values /= values.std(axis=(1, 2), keepdims=True)
    return np.clip(0.5 + 0.25 * values, 0.0, 1.0)


@pytest.fixture(scope="module")
def T(device):
    """A corner of two walls."""
    return ltcl.scenes.dihedral(12, albedo=0.7).transport(device=device)


@pytest.fixture(scope="module")
def colour_T(device):
    """A corner of two walls, of which one is red."""
    albedo = [(0.8, 0.3, 0.2), (0.6, 0.7, 0.7)]
    return ltcl.scenes.dihedral(12, albedo=albedo).transport(device=device)


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def photograph(T, patterns, mixing=None):
    """Noisy photographs of patterns, to which channel c answers by row c of a mixing."""
    random = np.random.default_rng(1)
    if mixing is not None:
        patterns = patterns @ mixing.T
    light = np.stack([T @ pattern for pattern in patterns])
    white = T @ np.ones(patterns.shape[1:])
    return light + NOISE * white * random.standard_normal(light.shape)


def error_of(T, fitted, patterns):
    """Relative error of T p for patterns that no fit has seen."""
    errors = [relative_error(fitted @ pattern, T @ pattern) for pattern in patterns]
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.fixture(scope="module")
def pairs(T):
    patterns = pictures(FRAMES)
    return patterns, photograph(T, patterns)


@pytest.fixture(scope="module")
def result(pairs, device):
    return ltcl.fit(*pairs, device=device)


def test_fewer_pictures_than_pixels_give_T(T, result):
    """90 pictures of 288 pixels; stated and true error are alike."""
    error = error_of(T, result.transport, pictures(20, seed=5))
    assert error < 0.006
    assert 0.7 * error < result.error < 2.0 * error
    assert len(result.errors) == len(result.held_out) == 20
    assert result.noise == pytest.approx(NOISE, rel=0.5)
    assert abs(result.drift) < 0.003


@pytest.mark.parametrize("kind", ["patch", "edge", "checkerboard"])
def test_other_patterns_than_those_of_the_fit(T, result, kind):
    y, x = np.indices(GRID)
    patterns = {
        "patch": (y // 4 == 1) & (x // 4 == 2),
        "edge": x > y,
        "checkerboard": (y // 3 + x // 3) % 2 == 0,
    }
    assert error_of(T, result.transport, [patterns[kind].astype(float)]) < 0.02


def test_the_pattern_makes_the_wall_look_as_desired(T, result):
    desired = 0.1 + 0.1 * pictures(1, seed=7)[0]
    c = ltcl.compensate(result.transport, desired, gain="auto")
    assert relative_error(T @ c.pattern / c.gain, desired) < 0.02


def test_standard_deviations_are_those_of_the_errors(T, result):
    """Errors of pictures, not of entries, which go together."""
    assert result.transport.measured_noise.source == "acquired"
    entries = result.transport.to_numpy()
    variance = result.transport.noise.variance(entries)
    ratios = []
    for pattern in pictures(20, seed=5):
        deviation = np.sqrt(variance @ pattern.ravel() ** 2)
        error = result.transport @ pattern - T @ pattern
        ratios.append(error.ravel() / deviation)
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_the_first_bounce_is_that_of_the_scene(T, result):
    np.testing.assert_allclose(result.transport.first_bounce, T.first_bounce, rtol=0.03)


@pytest.mark.slow
def test_more_pairs_are_added(T, pairs, result):
    patterns = pictures(60, seed=3)
    more = result.add(patterns, photograph(T, patterns))
    assert len(more.pairs) == FRAMES + 60
    unseen = pictures(20, seed=5)
    assert error_of(T, more.transport, unseen) < error_of(T, result.transport, unseen)


def test_a_single_pair_is_added(device):
    patterns = pictures(12)
    photographs = 0.5 * patterns + np.random.default_rng(1).normal(0.0, 1e-3, patterns.shape)
    fitted = ltcl.fit(patterns[:11], photographs[:11], device=device)
    assert len(fitted.add(patterns[11:], photographs[11:]).pairs) == 12


@pytest.mark.slow
def test_a_lamp_that_fades_is_corrected(T, pairs, device, caplog):
    patterns, photographs = pairs
    lamp = np.linspace(1.025, 0.975, FRAMES)
    fitted = ltcl.fit(patterns, photographs * lamp[:, None, None], device=device)
    assert fitted.drift == pytest.approx(-0.05, abs=0.005)
    assert "over the pairs: corrected" in caplog.text
    assert error_of(T, fitted.transport, pictures(20, seed=5)) < 0.007


@pytest.mark.slow
def test_colours_that_mix_are_told_apart(colour_T, device):
    patterns = np.stack([pictures(FRAMES, seed) for seed in (0, 1, 2)], axis=-1)
    fitted = ltcl.fit(patterns, photograph(colour_T, patterns, MIXING), device=device)
    mixing = np.asarray(fitted.transport.mixing)
    np.testing.assert_allclose(mixing, MIXING, rtol=0, atol=0.01)
    unseen = np.stack([pictures(10, seed) for seed in (5, 6, 7)], axis=-1)
    # The fitted transport mixes by itself.
    errors = []
    for pattern in unseen:
        errors.append(relative_error(fitted.transport @ pattern, colour_T @ (pattern @ MIXING.T)))
    assert np.mean(errors) < 0.006


@pytest.mark.slow
def test_grey_patterns_light_all_channels(colour_T, device):
    patterns = pictures(40)
    in_colour = np.repeat(patterns[..., None], 3, axis=3)
    fitted = ltcl.fit(patterns, photograph(colour_T, in_colour), device=device)
    mixing = np.asarray(fitted.transport.mixing)
    np.testing.assert_allclose(mixing, np.eye(3), rtol=0, atol=1e-9)
    assert fitted.error < 0.01


def seen_by_camera(photographs):
    height, width = CAMERA_GRID
    images = [
        cv2.warpPerspective(image.astype(np.float32), VIEW, (width, height))
        for image in photographs
    ]
    return np.stack(images)


def true_map():
    """Projector coordinates of all camera pixels."""
    row, column = np.indices(CAMERA_GRID)
    x, y, w = np.tensordot(np.linalg.inv(VIEW), np.stack([column, row, np.ones_like(row)]), 1)
    return x / w, y / w


def test_pairs_show_where_the_camera_looks(pairs):
    patterns, photographs = pairs
    found = find_view(Pairs.of(patterns, seen_by_camera(photographs)))
    x, y = true_map()
    height, width = GRID
    is_inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    assert np.mean(found.valid[is_inside]) > 0.97
    distance = np.hypot(found.x - x, found.y - y)[is_inside & found.valid]
    assert np.median(distance) < 0.05
    assert np.quantile(distance, 0.95) < 0.3


@pytest.mark.slow
def test_geometry_from_the_pairs_or_given(T, pairs, device):
    patterns, photographs = pairs
    seen = seen_by_camera(photographs)
    x, y = true_map()
    height, width = GRID
    is_inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    given = Correspondence(x=x, y=y, valid=is_inside, grid=GRID)
    for geometry in ("pairs", given):
        fitted = ltcl.fit(patterns, seen, geometry=geometry, device=device)
        assert fitted.error < 0.02
        assert np.mean(fitted.transport.masked) < 0.05


def test_pairs_that_do_not_show_it_are_refused(pairs):
    patterns, photographs = pairs
    smooth = np.stack([np.full(GRID, pattern.mean()) for pattern in patterns])
    with pytest.raises(AcquisitionError, match="give geometry"):
        ltcl.fit(smooth, seen_by_camera(photographs), geometry="pairs")


@pytest.mark.parametrize(("late", "words"), [(1, "1 frame.* late"), (-2, "2 frame.* early")])
def test_photographs_of_other_patterns_are_named(pairs, late, words):
    patterns, photographs = pairs
    with pytest.raises(AcquisitionError, match=words):
        ltcl.fit(patterns, np.roll(photographs, late, axis=0))


@pytest.mark.slow
def test_two_photographs_that_are_swapped_are_named(pairs):
    patterns, photographs = pairs
    swapped = photographs.copy()
    swapped[[5, 40]] = photographs[[40, 5]]
    with pytest.raises(AcquisitionError, match="photograph 6 shows pattern 41"):
        ltcl.fit(patterns, swapped)


@pytest.mark.parametrize("order", ["shuffled", "flipped"])
def test_photographs_without_the_light_of_their_patterns_are_refused(pairs, order):
    patterns, photographs = pairs
    if order == "shuffled":
        photographs = photographs[np.random.default_rng(4).permutation(len(photographs))]
    else:
        photographs = photographs[:, :, ::-1]
    with pytest.raises(AcquisitionError, match="the light of their own pattern"):
        ltcl.fit(patterns, photographs)


def test_black_frames_of_a_film_judge_nothing(T, device):
    """Their photographs are noise, of which T p explains nothing."""
    patterns = pictures(FRAMES)
    patterns[5:25] = 0.0
    fitted = ltcl.fit(patterns, photograph(T, patterns), device=device)
    assert not np.isin(np.arange(5, 25), fitted.held_out).any()
    error = error_of(T, fitted.transport, pictures(20, seed=5))
    assert 0.5 * error < fitted.error < 2.0 * error
    assert abs(fitted.drift) < 0.01


ONES = np.ones((20, 4, 4))
NOISE_PICTURES = np.random.default_rng(0).random((20, 4, 4))


@pytest.mark.parametrize(
    ("patterns", "photographs", "options", "words"),
    [
        (ONES[0], ONES, {}, r"patterns has shape \(4, 4\)"),
        (ONES, np.ones((20, 4, 4, 2)), {}, r"photographs has shape"),
        (NOISE_PICTURES, NOISE_PICTURES[:15], {}, "photographs has 15 frames, patterns 20"),
        (NOISE_PICTURES[:5], NOISE_PICTURES[:5], {}, "at least 10"),
        (NOISE_PICTURES * np.nan, NOISE_PICTURES, {}, "patterns has 320 NaN"),
        (NOISE_PICTURES, NOISE_PICTURES.repeat(2, 1), {}, r"\(8, 4\) pixels"),
        (ONES, NOISE_PICTURES, {}, "patterns are all the same"),
        (NOISE_PICTURES[:, :0], NOISE_PICTURES[:, :0], {}, r"patterns has shape \(20, 0, 4\)"),
        (NOISE_PICTURES - 0.5, NOISE_PICTURES, {}, "patterns has values down to -0.4"),
        (NOISE_PICTURES, NOISE_PICTURES - 0.6, {}, "darker than black"),
        (NOISE_PICTURES, 0 * ONES, {}, "photographs is black"),
        (NOISE_PICTURES, np.minimum(NOISE_PICTURES, 0.8), {}, "saturated"),
        (np.stack([NOISE_PICTURES] * 3, -1), NOISE_PICTURES, {}, "patterns has colours"),
        (NOISE_PICTURES, NOISE_PICTURES, {"held_out": 0.7}, "held_out is 0.7"),
        (NOISE_PICTURES, NOISE_PICTURES, {"geometry": "near"}, "geometry is 'near'"),
        (NOISE_PICTURES, NOISE_PICTURES, {"mixing": np.eye(3)}, "mixing is given"),
        (
            NOISE_PICTURES,
            NOISE_PICTURES,
            {"geometry": Correspondence.aligned((5, 5))},
            r"geometry is of \(5, 5\)",
        ),
    ],
)
def test_bad_input_is_refused_by_name(patterns, photographs, options, words):
    with pytest.raises(InputError, match=words):
        ltcl.fit(patterns, photographs, **options)


def test_progress_must_be_a_function_and_counts_rows(T, device):
    with pytest.raises(InputTypeError, match="progress is 3"):
        ltcl.fit(NOISE_PICTURES, NOISE_PICTURES, progress=cast(Any, 3))
    calls = []
    patterns = pictures(12)
    ltcl.fit(patterns, photograph(T, patterns), device=device, progress=lambda *c: calls.append(c))
    assert {name for name, _, _ in calls} == {"fit"}
    assert all(done <= total for _, done, total in calls)
    assert calls[-1][1] == calls[-1][2]
