# SPDX-License-Identifier: BSD-3-Clause
"""Exact transport against the equation it solves, on made-up scenes of unequal patches."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.scenes.exchange import transport as exchange


def made_up(size: int, seed: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reciprocal form factors with row sums below one, albedos (some 0) and areas."""
    rng = np.random.default_rng(seed)
    area = rng.uniform(0.5, 2.0, size)
    shared = rng.random((size, size))
    shared = np.triu(shared, 1) + np.triu(shared, 1).T
    F = shared / area[:, None]
    F *= 0.95 / max(F.sum(axis=1).max(), 1e-300)
    albedo = rng.uniform(0, 0.99, size)
    albedo[:: max(1, size // 3)] = 0
    return F, albedo, area


@pytest.mark.parametrize("size", [1, 2, 7, 512, 513, 1030])  # around the block size
def test_transport_solves_equation_4(size: int) -> None:
    F, albedo, area = made_up(size)
    T = exchange.transport(F, albedo, area)
    A = albedo[:, None] * F
    np.testing.assert_allclose(T - A @ T, np.diag(albedo), rtol=0, atol=1e-13)


def test_transport_is_reciprocal_too() -> None:
    """diag(area / albedo) A = A^T diag(area / albedo), so diag(area) T diag(1 / area) = T^T."""
    F, albedo, area = made_up(40)
    T = exchange.transport(F, albedo, area)
    assert area[:, None] * T == pytest.approx((area[:, None] * T).T, abs=1e-14)


def test_black_patches_show_nothing_and_give_nothing() -> None:
    F, albedo, area = made_up(9)
    T = exchange.transport(F, albedo, area)
    black = albedo == 0
    assert black.sum() == 3
    assert not T[black].any()
    assert not T[:, black].any()


def test_inputs_stay_as_they_were() -> None:
    F, albedo, area = made_up(6)
    before = [F.copy(), albedo.copy(), area.copy()]
    exchange.transport(F, albedo, area)
    assert all((a == b).all() for a, b in zip(before, (F, albedo, area), strict=True))


def test_gain_of_one_is_refused() -> None:
    F = np.array([[0.0, 1.0 + 5e-7], [1.0 + 5e-7, 0.0]])  # as far above 1 as `check` lets pass
    with pytest.raises(InputError, match="gain of 1 or more"):
        exchange.transport(F, np.full(2, 1 - 1e-9), np.ones(2))


def test_sound_form_factors_pass() -> None:
    for size in (1, 5, 600):
        F, _, area = made_up(size)
        exchange.check(F, area)


@pytest.mark.parametrize(
    ("spoil", "part"),
    [
        (lambda F, a: a.__setitem__(2, 0.0), "area has the value 0;"),
        (lambda F, a: F.__setitem__((0, 1), -0.5), "form_factors has the value -0.5;"),
        (lambda F, a: F.__imul__(1.2), "row that sums to 1.14"),
        (lambda F, a: F.__setitem__((599, 0), 0.0), "breaks reciprocity by"),
    ],
)
def test_unphysical_exchange_is_refused(spoil, part: str) -> None:
    F, _, area = made_up(600)
    spoil(F, area)
    with pytest.raises(InputError, match=part):
        exchange.check(F, area)
