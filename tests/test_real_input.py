# SPDX-License-Identifier: BSD-3-Clause
"""A transport traced by an independent renderer, with the true bounces: ../shared/data/transport-dihedral.

What may be expected of the bounces, from what is known of the file (README.md there):

- F is wrong by e: 0.93 % for diag(T), which also holds light that came back, 0.26 % for the exact one.
- ||A|| <= m = 0.7, the albedo of a corner whose form factors sum to less than one.
- Noise: n of the picture, in `bounces.npz`, and 0.15 % of T p.

With F' = (1 + d) F the solve gives b_0' = (1 + d) b_0, and to first order of d, X = S^-1 = I - A,

    b_k' - b_k = A^k d b_0 - sum_{j < k} A^j d (b_{k-1-j} - b_{k-j})

so that its norm is at most e (m^k |b_0| + sum m^j |b_{k-1-j} - b_{k-j}|). Noise is independent from pixel to
pixel: it passes the I of X as it is, A averages it away, and it adds to the bias as squares do.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import ltcl

ERROR_OF_F = {"diagonal": 0.0093, "exact": 0.0026}
ALBEDO = 0.7
NOISE_OF_T = 0.0015
BOUNCES = 4  # k = 0 .. 3


@dataclass(frozen=True)
class Truth:
    """Frames are patterns: `bounces` (k, frames, h, w), `pictures` (frames, h, w), `noise` (frames,)."""

    T: np.ndarray
    grid: tuple[int, int]
    names: list[str]
    patterns: np.ndarray
    bounces: np.ndarray
    noise: np.ndarray

    @property
    def pictures(self) -> np.ndarray:
        return self.bounces.sum(axis=0)

    def light(self, pattern: np.ndarray) -> np.ndarray:
        """T pattern in float64 on the host."""
        return (self.T.astype(np.float64) @ pattern.astype(np.float64).ravel()).reshape(self.grid)


@pytest.fixture(scope="session")
def truth(shared_data: Path) -> Truth:
    folder = shared_data / "transport-dihedral"
    with np.load(folder / "transport.npz") as file:
        T, grid = file["T"], tuple(int(n) for n in file["grid"])
    with np.load(folder / "bounces.npz") as file:
        bounces = np.moveaxis(file["bounces"].astype(np.float64), 1, 0)
        return Truth(
            T, (grid[0], grid[1]), [str(n) for n in file["names"]], file["patterns"], bounces, file["noise"]
        )


@pytest.fixture(scope="session")
def transports(truth: Truth, device: ltcl.Device) -> dict[str, ltcl.Transport]:
    return {how: ltcl.Transport(truth.T, truth.grid, how, device=device) for how in ERROR_OF_F}


def norm(pictures: np.ndarray) -> np.ndarray:
    """Of each frame (..., h, w)."""
    return np.linalg.norm(pictures, axis=(-2, -1))


@pytest.fixture(scope="session")
def errors(truth: Truth, transports: dict[str, ltcl.Transport]) -> dict[str, np.ndarray]:
    """Of bounce k in each picture, as a fraction of its direct part: (k, frames)."""
    found = {}
    for how, T in transports.items():
        b = ltcl.separate(T, truth.pictures, bounces=BOUNCES - 1, rtol=1e-4)
        bounces = np.concatenate([b.direct[None], b.bounces])
        found[how] = norm(bounces - truth.bounces[:BOUNCES]) / norm(truth.bounces[0])
    return found


def bound(truth: Truth, error_of_F: float) -> np.ndarray:
    """What the module's first lines promise, like `errors`."""
    size = norm(truth.bounces)
    steps = norm(truth.bounces[:-1] - truth.bounces[1:])  # |b_k - b_(k+1)|
    noise = np.hypot(truth.noise, NOISE_OF_T) * norm(truth.pictures)
    promised = []
    for k in range(BOUNCES):
        chain = sum(ALBEDO**j * steps[k - 1 - j] for j in range(k))
        promised.append(np.hypot(error_of_F * (ALBEDO**k * size[0] + chain), noise))
    return np.array(promised) / size[0]


@pytest.mark.parametrize("how", ERROR_OF_F)
def test_every_bounce_is_within_what_F_and_noise_allow(truth, errors, how):
    assert np.all(errors[how] <= bound(truth, ERROR_OF_F[how]))


def test_the_exact_first_bounce_is_better_where_bias_dominates(truth, errors):
    noise = bound(truth, 0.0)
    biased = errors["diagonal"] > 1.5 * noise
    assert biased[0].sum() >= 2  # the direct part of some pictures, and
    assert biased[1:].sum() >= 2  # bounces where little light of their own covers the bias
    assert np.all(errors["exact"][biased] < 0.5 * errors["diagonal"][biased])  # 0.26 / 0.93 = 0.28
    # Elsewhere it does no harm beyond noise.
    assert np.all(errors["exact"] <= errors["diagonal"] + 0.1 * noise)


def texture(grid: tuple[int, int]) -> np.ndarray:
    """Stripes, a disc and a ramp between 0.6 and 1."""
    y, x = np.mgrid[: grid[0], : grid[1]] / np.array(grid).reshape(2, 1, 1)
    stripes = 0.1 * np.sign(np.sin(40 * x + 20 * y))
    disc = 0.1 * ((x - 0.4) ** 2 + (y - 0.6) ** 2 < 0.06)
    return 0.7 + stripes + disc + 0.1 * x


@pytest.mark.parametrize("how", ERROR_OF_F)
def test_a_texture_within_reach_is_reproduced(truth, transports, how):
    """Half of what the fully lit wall shows, times a texture: p stays below 1, and above 0 in the stripes."""
    target = 0.5 * texture(truth.grid) * truth.light(np.ones(truth.grid))
    c = ltcl.compensate(transports[how], target, rtol=1e-3)
    assert c.clipped == 0.0
    assert np.std(target) > 0.1 * np.mean(target)
    shown = truth.light(c.pattern)
    assert np.linalg.norm(shown - target) <= 0.01 * np.linalg.norm(target)
    uncompensated = truth.light(target / transports[how].first_bounce.reshape(truth.grid))
    assert np.linalg.norm(uncompensated - target) > 0.1 * np.linalg.norm(target)  # there was something to do


def test_the_analysis_knows_this_corner(transports):
    """The README: rho(R) about 0.7 with the exact first bounce, diag(T) about 1 % above F."""
    diagonal, exact = (ltcl.analyze(transports[how]).channels[0] for how in ("diagonal", "exact"))
    assert exact.spectral_radius == pytest.approx(0.7, abs=0.05)
    assert diagonal.spectral_radius < exact.spectral_radius
    bias = transports["diagonal"].first_bounce / transports["exact"].first_bounce - 1
    assert np.all(bias > 0)
    assert 0.003 < np.sqrt(np.mean(bias**2)) < 0.03
    assert exact.products["chebyshev"] <= exact.products["jacobi"] < 20
