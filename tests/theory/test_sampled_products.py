# SPDX-License-Identifier: BSD-3-Clause
"""The least samples of a sampled product, against the map of all N^2 covariances, and the noise itself."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.alias import tables
from ltcl.operators.links import links
from ltcl.theory import sampled_products
from ltcl.theory.sampled_products import least_samples
from ltcl.theory.walks import Moments, second_moment_radius
from tests import gallery
from tests.problems import lambertian


def _normal(n: int, rho: float, power: int = 1) -> np.ndarray:
    R = np.random.default_rng(n).standard_normal((n, n)) ** power
    return R * (rho / np.abs(np.linalg.eigvals(R)).max())


def _empty_rows() -> np.ndarray:
    R = gallery.sparse(13, 13, 0.5, seed=8).toarray().astype(float)
    R[[0, 7, 12]] = 0
    return R * (0.9 / np.abs(np.linalg.eigvals(R)).max())


SIGNED = {
    "normal": _normal(11, 0.8),
    "cubes": _normal(12, 0.6, 3),
    "empty rows": _empty_rows(),
    "1x1": np.array([[-0.5]]),
    "turn": np.array([[0.0, 0.9], [-0.9, 0.0]]),
}


def moments(R: np.ndarray, sampler: str) -> np.ndarray:
    if sampler == "uniform":
        return R.shape[1] * R**2
    return np.abs(R).sum(axis=1)[:, None] * np.abs(R)


def growth(R: np.ndarray, Q: np.ndarray, s: float) -> float:
    """Of C' = R C R^T + diag(Q diag C - diag(R C R^T)) / s, as a matrix of N^2 x N^2."""
    n, both = len(R), np.kron(R, R)
    own = np.arange(n) * (n + 1)
    L = both.copy()
    L[own] -= both[own] / s
    L[np.ix_(own, own)] += Q / s
    return float(np.abs(np.linalg.eigvals(L)).max())


@pytest.mark.parametrize("sampler", ["alias", "uniform"])
@pytest.mark.parametrize("name", SIGNED)
def test_noise_dies_away_from_the_least_samples_on_and_not_below(device, name, sampler):
    R = SIGNED[name].astype(np.float32).astype(float)
    M, Q = Dense(device, R), moments(R, sampler)
    least = least_samples(M, Moments(M, tables(M, sampler)))
    assert growth(R, Q, least) < 1
    if least > 1:
        assert growth(R, Q, 0.97 * (least - 1)) > 1  # the one below, less what is kept in reserve
    if second_moment_radius(M, tables(M, sampler)) < 1:
        assert least == 1.0
        assert growth(R, Q, 1) < 1


def test_of_shared_columns_each_channel_has_its_least(device):
    """Q_ij = R_ij^2 / p_ij, p by the mean square of what the rows of three channels are of their sums."""
    Rs = [
        _normal(11, rho, power).astype(np.float32).astype(float)
        for rho, power in ((0.8, 1), (0.6, 3), (0.5, 1))
    ]
    rows = [np.abs(R) / np.abs(R).sum(axis=1)[:, None] for R in Rs]
    P = np.sqrt(np.mean(np.square(rows), axis=0))
    p = P / P.sum(axis=1)[:, None]
    Ms = [Dense(device, R) for R in Rs]
    for R, M, moments in zip(Rs, Ms, links(Ms, (1.0,) * 3).moments(), strict=True):
        least = least_samples(M, moments)
        assert least >= least_samples(M, Moments(M, tables(M))) - 1
        assert growth(R, R**2 / p, least) < 1
        assert least == 1 or growth(R, R**2 / p, 0.97 * (least - 1)) > 1


def test_random_probes_come_close(device, monkeypatch):
    R = _normal(200, 0.7)
    M = Dense(device, R)
    exact = least_samples(M, Moments(M, tables(M)))
    monkeypatch.setattr(sampled_products, "_EXACT", 0)
    assert exact <= least_samples(M, Moments(M, tables(M))) <= 1.2 * exact + 1


def test_powers_that_do_not_fall_need_infinitely_many(device):
    M = Dense(device, _normal(9, 1.05))
    assert least_samples(M, Moments(M, tables(M))) == np.inf


@pytest.mark.parametrize("form", ["csr", "dense"])
def test_hybrid_takes_the_least_samples_and_refuses_one_less(device, form):
    R = _normal(31, 0.75)
    A = CSR(device, scipy.sparse.csr_array(R)) if form == "csr" else Dense(device, R)
    least = int(least_samples(A, Moments(A, tables(A))))
    b = np.random.default_rng(0).standard_normal(31)
    assert least > 5
    says = (
        rf"samples is {least - 1}; .* must be {least} at least, which leave noise of .*, or use method='auto'"
    )
    with pytest.raises(InputError, match=says):
        ltcl.solve(IdentityPlus(A), b, "hybrid", samples=least - 1)
    for samples in (1, least - 1):
        with pytest.raises(InputError, match="noise grows from one product to the next"):
            ltcl.solve(IdentityPlus(A), b, "hybrid", samples=samples, iterations=200)
    assert np.isfinite(ltcl.solve(IdentityPlus(A), b, "hybrid", samples=least, iterations=200).x).all()


def test_the_noise_of_hybrid_is_what_the_recursion_says(device):
    """Above the limit, after many iterations, in the mean over columns of the same b and over runs."""
    R, samples = _normal(31, 0.75), 64
    b = np.random.default_rng(0).standard_normal(31)
    m, C, Q = b, np.zeros((31, 31)), moments(R, "alias")
    for _ in range(30):
        passed = R @ C @ R.T
        C = passed + np.diag(Q @ (np.diag(C) + m**2) - np.diag(passed) - (R @ m) ** 2) / samples
        m = b - R @ m
    S = IdentityPlus(Dense(device, R))
    runs = [ltcl.solve(S, b, "hybrid", samples=samples, iterations=30, seed=s).x for s in range(50)]
    spread = np.mean((np.stack(runs) - m) ** 2)
    assert spread == pytest.approx(np.trace(C) / 31, rel=0.2)


def test_light_of_one_sign_needs_one_sample(device):
    """R >= 0 of a scene: rho(Q) is about rho(R)^2, and nothing is to be refused."""
    scene = lambertian(43, rho=0.9)
    b = np.random.default_rng(1).random(43)
    found = ltcl.solve(scene.S, b, "hybrid", samples=1, iterations=100)
    assert np.sqrt(np.mean((found.x - np.linalg.solve(scene.S, b)) ** 2)) < 10 * np.abs(b).max()
    assert found.standard_error is None
    assert found.reason.startswith("Jacobi, 1 columns of each row drawn in each of 100 iterations; try more")
