# SPDX-License-Identifier: BSD-3-Clause
"""gain="auto" where no gain is exact, on systems too large for active sets on the host.

The gain is within one percent of the largest one, by solves within bounds in float64, and takes few
products.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize_scalar

import ltcl
from ltcl.errors import InputError
from tests.problems import lambertian

GRID = (10, 20)
N = 200
RTOL = 1e-2
# Products of a system that any of these pictures may take; trials of single gains took up to 240.
MAX_PRODUCTS = 60


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A matrix per channel, frames of desired (k, N, channels), and arguments of `compensate`."""

    matrices: list[np.ndarray]
    desired: np.ndarray
    camera: tuple[int, int] = GRID
    bounds: tuple[float, float] = (0.0, 1.0)
    background: float = 0.0
    weights: np.ndarray = field(default_factory=lambda: np.ones(N))
    loss: float | None = None

    def compensate(self, device: Any, **settings: Any) -> ltcl.Compensation:
        frames, _, channels = self.desired.shape
        T = ltcl.Transport(self.matrices, GRID, camera_grid=self.camera, device=device)
        shape = (frames, *self.camera, channels) if channels == 3 else (frames, *self.camera)
        weights = None
        if not np.all(self.weights == 1.0):
            weights = self.weights.reshape(self.camera)
        return ltcl.compensate(
            T,
            self.desired.reshape(shape),
            gain="auto",
            bounds=self.bounds,
            background=self.background,
            weights=weights,
            loss=self.loss,
            **settings,
        )

    def least_error(self, gain: float) -> float:
        """The least relative error at this gain over all frames and colours."""
        square = 0.0
        norm = 0.0
        for frame in self.desired:
            for matrix, d in zip(self.matrices, frame.T, strict=True):
                target = self.weights * (gain * d - self.background)
                weighted = self.weights[:, None] * matrix
                solution = lsq_linear(weighted, target, self.bounds, method="bvls", tol=1e-13)
                square += 2.0 * solution.cost
                norm += float(np.sum(np.square(self.weights * d)))
        return float(np.sqrt(square / norm) / gain)

    def allowed_loss(self) -> float:
        if self.loss is not None:
            return self.loss

        def error_at(logarithm: float) -> float:
            return self.least_error(np.exp(logarithm))

        least = minimize_scalar(error_at, bounds=(-3.0, 2.0), options={"xatol": 0.02}).fun
        return max(RTOL, 1.1 * float(least))


def corner(*albedos: float) -> list[np.ndarray]:
    matrices = []
    for albedo in albedos:
        scene = ltcl.scenes.dihedral(GRID[0], albedo=albedo)
        matrices.append(scene.transport().to_numpy().astype(np.float64))
    return matrices


def with_black(frames: int = 1, channels: int = 1) -> np.ndarray:
    """A landscape whose dark parts are black; each frame is rolled on."""
    picture = np.asarray(ltcl.scenes.landscape(*GRID), np.float64).mean(axis=-1)
    picture = np.where(picture < 0.3, 0.0, picture)
    rolled = [np.roll(picture, 3 * frame, axis=1).ravel() for frame in range(frames)]
    tones = np.linspace(1.0, 0.7, channels)
    return np.array(rolled)[:, :, None] * tones


def some_weights() -> np.ndarray:
    return np.random.default_rng(5).uniform(0.2, 1.0, N)


CASES = {
    "black parts": Case(matrices=corner(0.6), desired=with_black()),
    "colour": Case(matrices=corner(0.6, 0.5, 0.4), desired=with_black(channels=3)),
    "frames": Case(matrices=corner(0.6), desired=with_black(frames=3)),
    "background": Case(matrices=corner(0.6), desired=with_black(), background=0.05),
    "weights": Case(matrices=corner(0.6), desired=with_black(), weights=some_weights()),
    "lowest light": Case(matrices=corner(0.6), desired=with_black(), bounds=(0.1, 0.7)),
    "a small loss": Case(matrices=corner(0.6), desired=with_black(), loss=0.08),
    "a large loss": Case(matrices=corner(0.6), desired=with_black(), loss=0.3),
    "bright scene": Case(matrices=corner(0.9), desired=with_black()),
    "random scene": Case(matrices=[lambertian(N, 1.0, seed=7).T], desired=with_black()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_few_products_reach_the_gain(device, name):
    case = CASES[name]
    c = case.compensate(device, rtol=RTOL)
    allowed = case.allowed_loss()
    assert case.least_error(c.gain) <= c.error * (1 + 1e-4) <= 1.011 * allowed
    assert case.least_error(1.0101 * c.gain) > 0.999 * allowed
    assert c.clipped > 0.0
    for solve in c.limited:
        assert solve.products <= MAX_PRODUCTS


@pytest.mark.slow
def test_no_S_has_the_same_gain(device):
    """A camera with more pixels than the projector: no light without bounds to start from."""
    rng = np.random.default_rng(3)
    rows = 12 * 20
    matrix = np.concatenate([corner(0.5)[0], rng.uniform(0, 0.002, (rows - N, N))])
    desired = np.zeros((1, rows, 1))
    desired[0, :N] = with_black()[0]
    case = Case(
        matrices=[matrix], desired=desired, camera=(12, 20), weights=np.ones(rows), loss=0.3
    )
    c = case.compensate(device)
    assert case.least_error(c.gain) <= c.error * (1 + 1e-4) <= 0.3 * (1 + 1e-3)
    assert case.least_error(1.0101 * c.gain) > 0.3 * 0.999
    assert c.limited[0].products <= MAX_PRODUCTS


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-20, 1e15])
def test_units_do_not_change_the_light(device, unit):
    case = CASES["black parts"]
    expected = case.compensate(device)
    scaled = Case(matrices=[unit * case.matrices[0]], desired=unit * case.desired)
    c = scaled.compensate(device)
    assert c.gain == pytest.approx(expected.gain, rel=1e-3)
    np.testing.assert_allclose(c.pattern, expected.pattern, atol=1e-2)


@pytest.mark.slow
def test_a_loss_below_the_least_is_refused(device):
    case = CASES["black parts"]
    impossible = Case(matrices=case.matrices, desired=case.desired, loss=0.005)
    with pytest.raises(InputError, match=r"loss.*0\.005"):
        impossible.compensate(device)
