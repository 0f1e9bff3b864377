# SPDX-License-Identifier: BSD-3-Clause
"""Pictures that contradict all others: found where they stand alone, and nowhere else."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition.estimation import refinement
from ltcl.acquisition.estimation.contradiction import Comparison, find_wrong_pictures
from ltcl.acquisition.estimation.estimator import Estimator
from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.estimation.refinement import RefinedEstimator
from ltcl.acquisition.scanning import sketch

GRID = (12, 24)
PIXELS = 12 * 24
# Noise of a picture, relative to the mean of white.
NOISE = 0.002
ESTIMATORS = [Estimator, RefinedEstimator]
FINE_PATTERN = 30


@cache
def corner() -> np.ndarray:
    return np.asarray(ltcl.scenes.dihedral(12, albedo=0.6).transport().matrices[0], np.float64)


def make_pairs(T: np.ndarray, channels: int = 1, noise: float = NOISE) -> Pairs:
    """White, the patterns of a sketch and its judges, with noisy photographs."""
    pictures = [np.ones(GRID), *sketch.patterns(GRID), *sketch.judges(GRID)]
    patterns = np.stack(pictures).reshape(len(pictures), PIXELS)
    light = patterns @ T.T
    noise = noise * light[0].mean()
    noisy = light + noise * np.random.default_rng(3).standard_normal(light.shape)
    return Pairs(
        grid=GRID,
        camera_grid=GRID,
        patterns=np.repeat(patterns[:, :, None], channels, axis=2),
        photographs=np.repeat(noisy[:, :, None], channels, axis=2),
        variance=np.full((*light.shape, channels), noise**2),
    )


def with_lamp(pairs: Pairs, numbers: list[int], strength: float = 0.05) -> Pairs:
    """Another light in some pictures, which grows from left to right."""
    column = np.indices(GRID)[1].ravel()
    lamp = strength * pairs.photographs[0] * (0.5 + column / column.max())[:, None]
    photographs = pairs.photographs.copy()
    photographs[numbers] += lamp
    return replace(pairs, photographs=photographs)


def find(pairs: Pairs, kind: Any = Estimator, error: float = 0.01) -> list[int]:
    """Numbers of wrong pictures, if T p of the others errs by `error`."""
    first_judge = len(pairs) - sketch.JUDGES

    def learn(wrong: list[int]) -> Any:
        estimator = kind(GRID, pairs.channels, np.eye(pairs.channels), None)
        fitted = pairs.select(slice(0, first_judge))
        estimator.learn(fitted.without([number for number in wrong if number < first_judge]))
        return estimator

    wrong, _ = find_wrong_pictures(pairs, learn, lambda wrong, estimator: error)
    return wrong


@pytest.fixture(autouse=True)
def few_coarse_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement, "MAX_COARSE_NODES", 200)


@pytest.mark.parametrize("kind", ESTIMATORS)
@pytest.mark.parametrize("channels", [1, 3])
def test_a_clean_scan_has_none_and_another_light_is_found(kind: Any, channels: int) -> None:
    pairs = make_pairs(corner(), channels)
    assert find(pairs, kind) == []
    assert find(with_lamp(pairs, [FINE_PATTERN]), kind) == [FINE_PATTERN]


@pytest.mark.parametrize("factor", [0.8, 1.26])
@pytest.mark.parametrize("number", [1, FINE_PATTERN, len(sketch.patterns(GRID)) + 2])
def test_another_exposure_is_found(factor: float, number: int) -> None:
    pairs = make_pairs(corner())
    pairs.photographs[number] *= factor
    assert find(pairs) == [number]


def test_two_are_found() -> None:
    wrong = [FINE_PATTERN, FINE_PATTERN - 5]
    assert sorted(find(with_lamp(make_pairs(corner()), wrong))) == sorted(wrong)


def test_unknown_pixels_do_not_count() -> None:
    pairs = with_lamp(make_pairs(corner()), [FINE_PATTERN])
    assert pairs.variance is not None
    unseen = slice(40, 80)
    pairs.photographs[:, unseen] = 0.0
    pairs.variance[:, unseen] = 1e12
    assert find(pairs) == [FINE_PATTERN]


def test_where_light_jumps_no_picture_stands_alone() -> None:
    """A mirror sends light of each pixel to the other side of the picture."""
    mirror = np.eye(PIXELS)[::-1]
    assert find(make_pairs(0.5 * np.eye(PIXELS) + 0.2 * mirror)) == []


def test_a_light_must_be_stronger_than_the_error_of_the_sketch() -> None:
    """Behind a block the coarsest patterns err as if another light were on."""
    comparison = Comparison(
        strength=np.full(2, 0.1),
        share=np.array([0.3, 0.7]),
        surprise=np.full(2, 10.0),
        pixels=PIXELS,
    )
    assert (comparison.contradiction(error=0.05) > 1.0).all()
    assert (comparison.contradiction(error=0.2) < 1.0).all()


def test_what_is_weaker_than_the_error_of_the_sketch_is_kept() -> None:
    pairs = make_pairs(corner(), noise=0.02)
    pairs = with_lamp(pairs, [FINE_PATTERN], strength=0.05)
    assert find(pairs, error=0.03) == [FINE_PATTERN]
    assert find(pairs, error=0.1) == []
