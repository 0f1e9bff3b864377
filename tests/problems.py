# SPDX-License-Identifier: BSD-3-Clause
"""Light transports whose answers are known in float64, made without ltcl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Scene:
    """A bounce A (N, N), first bounce F (N,), and the operators that follow; all float64.

    `weights` (N,), area / albedo, make A and S self-adjoint: diag(weights) A is symmetric.
    """

    A: np.ndarray
    F: np.ndarray
    weights: np.ndarray

    @property
    def n(self) -> int:
        return len(self.F)

    @property
    def S(self) -> np.ndarray:
        """All bounces (eq. 4)."""
        return np.linalg.inv(np.eye(self.n) - self.A)

    @property
    def R(self) -> np.ndarray:
        return self.S - np.eye(self.n)

    @property
    def T(self) -> np.ndarray:
        return self.S * self.F

    def bounce(self, k: int, pattern: np.ndarray) -> np.ndarray:
        """A^k F p."""
        return np.linalg.matrix_power(self.A, k) @ (self.F * pattern)


def lambertian(n: int, rho: float, seed: int = 0, density: float = 1.0) -> Scene:
    """Random diffuse surfaces that do not see themselves, scaled to rho(R) = `rho`.

    A = diag(albedo / area) G with G = G^T >= 0: self-adjoint in the area / albedo inner product.
    """
    rng = np.random.default_rng(seed)
    G = np.triu(rng.random((n, n)) * (rng.random((n, n)) < density), 1)
    weight = rng.uniform(0.5, 1.5, n)
    A = (G + G.T) * weight[:, None]
    largest = np.abs(np.linalg.eigvals(A)).max()
    return Scene(A * (rho / (1 + rho) / (largest or 1.0)), rng.uniform(0.2, 0.9, n), 1.0 / weight)


def enclosure(n: int, albedo: float, seed: int = 0) -> Scene:
    """Closed room of equal patches of albedo m: A = m G with G = G^T, row sums 1, no self-view.

    Hence rho(A) = m, rho(R) = m / (1 - m), row sums of S are 1 / (1 - m), and S is symmetric.
    """
    G = np.triu(np.random.default_rng(seed).uniform(0.1, 1.0, (n, n)), 1)
    G += G.T
    for _ in range(200):  # Sinkhorn, symmetric
        d = 1.0 / np.sqrt(G.sum(axis=1))
        G = d[:, None] * G * d
    return Scene(albedo * G, np.full(n, albedo), np.ones(n))


def residual(S: np.ndarray, x: np.ndarray, b: np.ndarray) -> float:
    """Largest relative residual over the columns, in float64."""
    x = np.asarray(x, np.float64)
    b = np.asarray(b, np.float64)
    norms = np.linalg.norm(b, axis=0)
    return float(np.max(np.linalg.norm(b - S @ x, axis=0) / np.where(norms > 0, norms, 1.0)))
