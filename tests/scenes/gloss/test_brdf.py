# SPDX-License-Identifier: BSD-3-Clause
"""The lobe: energy, reciprocity, isotropy, and where it shines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.scenes.gloss import directions
from ltcl.scenes.gloss.brdf import lobe

VECTORS = directions.from_square(np.random.default_rng(0).random((40, 2)))


@pytest.mark.parametrize(("k", "exponent"), [(2, 1), (4, 20), (8, 0.5), (8, 60), (8, 512)])
def test_all_light_comes_back_and_reciprocity_holds(k: int, exponent: float) -> None:
    shine = lobe(exponent, k)
    assert shine.between.mean(axis=1) == pytest.approx(1, rel=1e-12)
    assert (shine.between == shine.between.T).all()
    assert shine.towards(VECTORS).mean(axis=1) == pytest.approx(1, rel=1e-12)
    assert (shine.between > 0).all()


def test_pairs_of_directions_are_reciprocal() -> None:
    shine, other = lobe(30, 8), VECTORS[::-1]
    assert shine.direct(VECTORS, other) == pytest.approx(shine.direct(other, VECTORS), rel=1e-12)


def test_means_of_single_directions_over_bins_approach_what_the_bins_say() -> None:
    """They differ by the change of s over a bin, which falls with the bins' size."""
    errors = []
    for k in (4, 8, 12):
        shine = lobe(10, k)
        means = shine.towards(shine.places.reshape(-1, 3)).reshape(k * k, -1, k * k).mean(axis=1)
        errors.append(np.linalg.norm(means - shine.between) / np.linalg.norm(shine.between))
    assert errors[0] > 1.5 * errors[1]
    assert errors[1] > 1.2 * errors[2]
    assert errors[2] < 0.1


def test_light_of_a_fine_sky_comes_back_without_bins() -> None:
    """The mean of `direct` over the hemisphere is 1: an integral that the bins did not take part in."""
    shine = lobe(12, 12)
    sky = directions.lattice(60, 2).reshape(-1, 3)
    for v in directions.from_square(np.array([[0.5, 0.5], [0.8, 0.6], [0.1, 0.5]])):
        assert shine.direct(np.broadcast_to(v, sky.shape), sky).mean() == pytest.approx(1, abs=0.02)


def test_turning_both_directions_changes_little() -> None:
    """The material is isotropic; what is left is the lattice of the bins."""
    shine, angle = lobe(10, 10), 0.4
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    u, v = VECTORS, VECTORS[::-1]
    assert shine.direct(u @ turn, v @ turn) == pytest.approx(shine.direct(u, v), rel=0.05)


def test_most_light_goes_near_the_mirror_direction() -> None:
    shine = lobe(200, 10)
    sky = directions.lattice(20, 3).reshape(-1, 3)
    for v in directions.from_square(np.array([[0.5, 0.5], [0.7, 0.5], [0.3, 0.35]])):
        brightest = sky[np.argmax(shine.direct(np.broadcast_to(v, sky.shape), sky))]
        assert brightest @ (v * (-1, -1, 1)) > np.cos(0.1)


@pytest.mark.parametrize(
    ("exponent", "part"),
    [
        (0, "exponent is 0; it must be a finite number above 0"),
        (-3, "exponent is -3"),
        (np.inf, "exponent is inf"),
        (129, "exponent is 129; it must be at most 128 for 16 directions"),
    ],
)
def test_bad_exponents_are_refused(exponent: Any, part: str) -> None:
    with pytest.raises(InputError, match=part):
        lobe(exponent, 4)
