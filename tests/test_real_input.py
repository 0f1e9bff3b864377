# SPDX-License-Identifier: BSD-3-Clause
"""A transport traced by an independent renderer, with its true bounces.

The file is ../shared/data/transport-dihedral. Bounds of the errors follow from its README.md: F is
wrong by e, 0.93 % for diag(T) and 0.26 % for the exact one; ||A|| <= m = 0.7, the albedo of a
corner whose form factors sum to less than one; noise is n of the picture, in `bounces.npz`, and
0.15 % of T p.

With F' = (1 + d) F the solve gives b_0' = (1 + d) b_0, and to first order of d, X = S^-1 = I - A,

    b_k' - b_k = A^k d b_0 - sum_{j < k} A^j d (b_{k-1-j} - b_{k-j})

so that its norm is at most e (m^k |b_0| + sum m^j |b_{k-1-j} - b_{k-j}|). Noise is independent from
pixel to pixel: it passes the I of X as it is, A averages it away, and it adds to the bias as
squares do.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltcl

pytestmark = pytest.mark.slow

ERROR_OF_F = {"diagonal": 0.0093, "exact": 0.0026}
ALBEDO = 0.7
NOISE_OF_T = 0.0015
BOUNCES = 4  # k = 0 .. 3


def norm(pictures: np.ndarray) -> np.ndarray:
    """Norm of each frame (..., h, w)."""
    return np.linalg.norm(pictures, axis=(-2, -1))


@pytest.fixture(scope="module")
def transports(shared_data: Path, device: ltcl.Device) -> dict[str, ltcl.Transport]:
    with np.load(shared_data / "transport-dihedral" / "transport.npz") as file:
        T = file["T"]
        h, w = file["grid"].tolist()
    return {how: ltcl.Transport(T, (h, w), how, device=device) for how in ERROR_OF_F}


@pytest.fixture(scope="module")
def truth(shared_data: Path) -> tuple[np.ndarray, np.ndarray]:
    """Bounces (k, frames, h, w), and the noise of the picture of each frame as a norm (frames,)."""
    with np.load(shared_data / "transport-dihedral" / "bounces.npz") as file:
        bounces = np.moveaxis(file["bounces"].astype(np.float64), 1, 0)
        return bounces, np.hypot(file["noise"], NOISE_OF_T) * norm(bounces.sum(axis=0))


@pytest.fixture(scope="module")
def errors(truth, transports) -> dict[str, np.ndarray]:
    """Error of bounce k in each picture, as a fraction of its direct part: (k, frames)."""
    bounces, _ = truth
    result = {}
    for how, T in transports.items():
        b = ltcl.separate(T, bounces.sum(axis=0), bounces=BOUNCES - 1, rtol=1e-4)
        deviation = np.concatenate([b.direct[None], b.bounces]) - bounces[:BOUNCES]
        result[how] = norm(deviation) / norm(bounces[0])
    return result


def bound(truth: tuple[np.ndarray, np.ndarray], error_of_F: float) -> np.ndarray:
    """The bound in the docstring of this module, (k, frames) like `errors`."""
    bounces, noise = truth
    size = norm(bounces)
    steps = norm(bounces[:-1] - bounces[1:])  # |b_k - b_(k+1)|
    promised = []
    for k in range(BOUNCES):
        chain = sum(ALBEDO**j * steps[k - 1 - j] for j in range(k))
        promised.append(np.hypot(error_of_F * (ALBEDO**k * size[0] + chain), noise))
    return np.array(promised) / size[0]


@pytest.mark.parametrize("how", ERROR_OF_F)
def test_every_bounce_is_within_what_F_and_noise_allow(truth, errors, how):
    assert np.all(errors[how] <= bound(truth, ERROR_OF_F[how]))


@pytest.mark.slow
def test_the_exact_first_bounce_is_better_where_bias_dominates(truth, errors):
    noise = bound(truth, 0.0)
    biased = errors["diagonal"] > 1.5 * noise
    assert biased[0].sum() >= 2  # the direct part of some pictures, and
    assert biased[1:].sum() >= 2  # bounces where little light of their own covers the bias
    assert np.all(errors["exact"][biased] < 0.5 * errors["diagonal"][biased])  # 0.26 / 0.93 = 0.28
    # Elsewhere it does no harm beyond noise.
    assert np.all(errors["exact"] <= errors["diagonal"] + 0.1 * noise)


@pytest.mark.parametrize("how", ERROR_OF_F)
def test_a_texture_within_reach_is_reproduced(transports, how):
    """Half of the fully lit wall, times stripes, a disc and a ramp: p stays within 0 and 1."""
    T = transports[how]
    matrix = T.matrices[0].astype(np.float64)
    y, x = np.mgrid[: T.grid[0], : T.grid[1]] / np.array(T.grid).reshape(2, 1, 1)
    disc = (x - 0.4) ** 2 + (y - 0.6) ** 2 < 0.06
    texture = 0.7 + 0.1 * np.sign(np.sin(40 * x + 20 * y)) + 0.1 * disc + 0.1 * x
    target = 0.5 * texture.ravel() * matrix.sum(axis=1)
    c = ltcl.compensate(T, target, rtol=1e-3)
    assert c.clipped == 0.0
    assert np.linalg.norm(matrix @ c.pattern - target) <= 0.01 * np.linalg.norm(target)
    uncompensated = matrix @ (target / T.first_bounce)
    # The compensation had an effect.
    assert np.linalg.norm(uncompensated - target) > 0.1 * np.linalg.norm(target)
