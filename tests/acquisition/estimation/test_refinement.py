# SPDX-License-Identifier: BSD-3-Clause
"""Transports of many pixels: far light at few nodes, near light at every pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition.estimation import refinement
from ltcl.acquisition.estimation.estimator import Estimator
from ltcl.acquisition.estimation.near import NearFunctions
from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.estimation.refinement import (
    RefinedEstimator,
    make_estimator,
    stage_levels,
)
from ltcl.acquisition.estimation.windows import check_memory, hat_levels
from ltcl.acquisition.scanning import sketch
from ltcl.errors import MemoryLimitError
from ltcl.transport.noise import Noise

GRID = (24, 48)
PIXELS = 24 * 48
# Noise of a picture, relative to the mean of white.
NOISE = 0.002
UNSEEN = 700
COARSE_NODES = 400


@pytest.fixture(scope="module")
def T() -> np.ndarray:
    """A corner of two walls with a pattern of bricks, (N, N)."""
    smooth = np.asarray(ltcl.scenes.dihedral(24, albedo=0.6).transport().matrices[0], np.float64)
    row, column = np.indices(GRID).reshape(2, -1)
    bricks = np.where((row // 3 + column // 5) % 2 == 0, 1.0, 0.5)
    return bricks[:, None] * smooth


def shown() -> np.ndarray:
    """White, the patterns of a sketch, and pictures that judge it, (frames, N)."""
    pictures = [np.ones(GRID), *sketch.patterns(GRID), *sketch.judges(GRID)]
    return np.stack(pictures).reshape(len(pictures), -1)


def make_pairs(T: np.ndarray, channels: int = 1, seed: int = 3) -> Pairs:
    """Noisy photographs; one pixel is not seen in any."""
    patterns = shown()
    light = patterns @ T.T
    scale = NOISE * light[0].mean()
    random = np.random.default_rng(seed)
    noisy = light + scale * random.standard_normal(light.shape)
    variance = np.full(light.shape, scale**2)
    noisy[:, UNSEEN] = 0.0
    variance[:, UNSEEN] = 1e12
    factors = np.array([1.0, 0.5, 0.3])[:channels]
    return Pairs(
        grid=GRID,
        camera_grid=GRID,
        patterns=np.repeat(patterns[:, :, None], channels, axis=2),
        photographs=noisy[:, :, None] * factors,
        variance=variance[:, :, None] * factors**2,
    )


def estimate(estimator: Any, pairs: Pairs) -> Any:
    is_judge = np.arange(len(pairs)) >= len(pairs) - sketch.JUDGES
    estimator.learn(pairs.select(~is_judge))
    return estimator


def judged(estimator: Any, T: np.ndarray, channel: int = 0) -> float:
    """The relative error of T p for the judges."""
    pictures = shown()[-sketch.JUDGES :]
    expected = pictures @ T.T
    channels = estimator.channels
    explained = estimator.explain(np.repeat(pictures[:, :, None], channels, axis=2))[:, :, channel]
    explained[:, UNSEEN] = expected[:, UNSEEN]
    return float(np.linalg.norm(explained - expected) / np.linalg.norm(expected))


@pytest.fixture(scope="module")
def refined(T: np.ndarray) -> RefinedEstimator:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refinement, "MAX_COARSE_NODES", COARSE_NODES)
        return estimate(RefinedEstimator(GRID, 1, np.eye(1), None), make_pairs(T))


def test_it_is_as_good_as_rows_estimated_whole(T: np.ndarray, refined: RefinedEstimator) -> None:
    assert len(refined.levels) > 1
    whole = estimate(Estimator(GRID, 1, np.eye(1), None), make_pairs(T))
    assert judged(refined, T) < 1.5 * judged(whole, T)
    assert judged(refined, T) < 0.012


def test_the_transport_is_what_explains(T: np.ndarray, refined: RefinedEstimator) -> None:
    found = ltcl.Transport.from_arrays(refined.arrays(np.ones(1)))
    picture = np.random.default_rng(5).random(GRID).astype(np.float32)
    explained = refined.explain(picture.reshape(1, -1, 1))[0, :, 0]
    np.testing.assert_allclose((found @ picture).ravel(), explained, rtol=0, atol=2e-6)
    assert found.is_compressed
    # The diagonal is stored, and that of an unseen pixel is 0.
    pixels = np.array([0, 5, 333, PIXELS - 1])
    for pixel in pixels.tolist():
        lit = np.zeros(PIXELS)
        lit[pixel] = 1.0
        column = refined.explain(lit.reshape(1, -1, 1))[0, :, 0]
        assert refined._diagonal(0)[pixel] == pytest.approx(column[pixel], abs=1e-9)
    assert found.first_bounce.ravel()[UNSEEN] == 0.0
    seen = np.arange(PIXELS) != UNSEEN
    error = np.abs(found.first_bounce.ravel() - np.diagonal(T))[seen] / np.diagonal(T)[seen]
    assert np.median(error) < 0.01


def test_stated_noise_adds_up_to_what_rows_say(refined: RefinedEstimator) -> None:
    """The variance of the picture under white, by the noise and by all coefficients."""
    scales = np.array([2.0])
    noise = Noise.from_arrays(refined.arrays(scales))
    assert noise is not None
    lit = np.eye(PIXELS)[:, :, None]
    entries = np.concatenate([refined.explain(lit[k : k + 64]) for k in range(0, PIXELS, 64)])
    stated = noise.variance(entries[:, :, 0].T)
    np.fill_diagonal(stated, 0.0)
    hats = refined.hats.at_pixels(np.arange(PIXELS)).toarray()
    variance = refined._rows([stage.variance[0] for stage in refined.stages], np.arange(PIXELS))
    of_entries = refined.light**2 * (variance @ (hats**2).T)
    np.fill_diagonal(of_entries, 0.0)
    assert stated.sum() == pytest.approx(2.0 * of_entries.sum(), rel=0.02)


def test_channels_of_the_same_light_are_alike(T: np.ndarray) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refinement, "MAX_COARSE_NODES", COARSE_NODES)
        colour = estimate(RefinedEstimator(GRID, 3, np.eye(3), None), make_pairs(T, channels=3))
        single = estimate(RefinedEstimator(GRID, 1, np.eye(1), None), make_pairs(T))
    assert judged(colour, T) == pytest.approx(judged(single, T), rel=1e-6)
    pictures = shown()[-3:, :, None] * np.ones(3)
    explained = colour.explain(pictures)
    np.testing.assert_allclose(explained[..., 1], 0.5 * explained[..., 0], rtol=0, atol=1e-8)


def test_rows_of_the_mixing_need_not_add_up_to_one(T: np.ndarray) -> None:
    mixing = np.array([[0.7, 0.1, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.2]])
    pairs = make_pairs(T, channels=3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refinement, "MAX_COARSE_NODES", COARSE_NODES)
        mixed = estimate(RefinedEstimator(GRID, 3, mixing, None), pairs)
        plain = estimate(RefinedEstimator(GRID, 3, np.eye(3), None), pairs)
    pictures = shown()[-3:, :, None] * np.ones(3)
    explained = plain.explain(pictures)
    # Priors begin with the light of the patterns.
    assert np.linalg.norm(mixed.explain(pictures) - explained) < 1e-3 * np.linalg.norm(explained)


def test_colours_whose_patterns_differ_are_solved_one_by_one(T: np.ndarray) -> None:
    """The same pictures, of which one channel sees the complement."""
    grey = make_pairs(T)
    patterns = shown()
    inverse = 1.0 - patterns
    inverse[0] = 1.0
    colours = np.stack([patterns, inverse, patterns], axis=2)
    light = np.stack([colours[:, :, c] @ T.T for c in range(3)], axis=2)
    pairs = Pairs(grid=GRID, camera_grid=GRID, patterns=colours, photographs=light)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refinement, "MAX_COARSE_NODES", COARSE_NODES)
        estimator = estimate(RefinedEstimator(GRID, 3, np.eye(3), None), pairs)
    assert len(grey) == len(pairs)
    for channel in range(3):
        assert judged(estimator, T, channel) < 0.012


def test_functions_of_a_node_are_there_once(refined: RefinedEstimator) -> None:
    near = NearFunctions(refined.hats, 0, 1, np.ones((1, *GRID)))
    numbers = np.arange(PIXELS)
    columns = near.columns(numbers)
    np.testing.assert_array_equal(columns[:, 0], numbers)
    for row in columns:
        there = row[row >= 0]
        assert len(np.unique(there)) == len(there)
    sums = near.sums(numbers)[:, :, 0]
    assert np.all(sums[columns < 0] == 0.0)
    assert np.all(sums[columns >= 0] > 0.0)


def test_large_grids_are_refined_and_small_ones_are_not() -> None:
    assert isinstance(make_estimator((64, 64), 1, np.eye(1), None), Estimator)
    assert isinstance(make_estimator((65, 128), 1, np.eye(1), None), RefinedEstimator)
    assert stage_levels((8, 8)) == [0]


def test_a_grid_beyond_the_memory_is_refused() -> None:
    with pytest.raises(MemoryLimitError, match="100000 x 100000"):
        check_memory((100000, 100000), 3)


@pytest.mark.parametrize("of_many_pixels", [False, True])
def test_light_is_unknown_at_fine_scales_beside_the_crease(
    refined: RefinedEstimator, T: np.ndarray, of_many_pixels: bool
) -> None:
    estimator: Any = refined
    if not of_many_pixels:
        estimator = estimate(Estimator(GRID, 1, np.eye(1), None), make_pairs(T))
    unknown = estimator.unknown_light()
    assert unknown.shape == (len(hat_levels(GRID)), *GRID)
    assert unknown.min() >= 0.0
    fine = unknown[:2].sum(axis=(0, 1))
    assert fine[22:26].mean() > 2.0 * fine[:8].mean()
