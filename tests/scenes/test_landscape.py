# SPDX-License-Identifier: BSD-3-Clause
"""The landscape asks much of a projector, is the same at any resolution, and never leaves [0, 1]."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.scenes import landscape


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    return landscape(120, 160)


def test_picture_is_linear_float32_in_range(picture: np.ndarray) -> None:
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.float32
    assert picture.min() >= 0
    assert picture.max() <= 1


def test_picture_holds_saturated_blue_and_orange_white_and_black(picture: np.ndarray) -> None:
    r, b = picture[..., 0], picture[..., 2]
    share = {
        "blue": (b > 2 * r) & (b > 0.15),
        "orange": (r > 2 * b) & (r > 0.3),
        "white": picture.min(axis=-1) > 0.5,
        "black": picture.max(axis=-1) < 0.02,
    }
    assert {name: bool(where.mean() > 0.01) for name, where in share.items()} == dict.fromkeys(share, True)


def test_sky_is_above_and_the_bank_below(picture: np.ndarray) -> None:
    assert picture[:30].mean() > 5 * picture[-6:].mean()


def test_resolution_changes_detail_only(picture: np.ndarray) -> None:
    small = landscape(30, 40)
    shrunk = cv2.resize(picture, (40, 30), interpolation=cv2.INTER_AREA)
    assert np.abs(small - shrunk).mean() < 0.02


def test_seed_decides_the_place(picture: np.ndarray) -> None:
    assert (landscape(120, 160, seed=7) == picture).all()
    assert np.abs(landscape(120, 160, seed=8) - picture).mean() > 0.02


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (200, 1), (2, 3)])
def test_odd_shapes(shape: tuple[int, int]) -> None:
    picture = landscape(*shape)
    assert picture.shape == (*shape, 3)
    assert np.isfinite(picture).all()


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ((0, 4), "h is 0"),
        ((4, 2.5), "w is 2.5"),
        ((40000, 4), "h is 40000; it must be a finite number at most 32766"),
        ((4, 4, -1), "seed is -1"),
    ],
)
def test_bad_sizes_are_refused(arguments: tuple[Any, ...], part: str) -> None:
    with pytest.raises(InputError, match=part):
        landscape(*arguments)
