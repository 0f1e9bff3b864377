# SPDX-License-Identifier: BSD-3-Clause
"""S = T F^-1 on the host: products, and S^-1 in a block Krylov space, without a device."""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl.solvers.host_krylov import block_gmres
from ltcl.transport.covariance import EntryErrors, channel_matrices
from ltcl.transport.transport import Transport

# Steps of a solve: its errors are far below those of noise.
KRYLOV_STEPS = 8
# Right-hand sides of one solve.
BLOCK_SIZE = 8


class HostSystem:
    """S = T F^-1 of a channel, (N, N); the identity at pixels where F is 0.

    Attributes
    ----------
    T : (N, N) array, csr_array or LinearOperator
    F : (N,)
        First bounce.
    inverse_F : (N,)
        F^-1; 0 where F is 0.
    """

    def __init__(self, T: Any, F: np.ndarray) -> None:
        self.T = T
        self.F = F
        self.inverse_F = 1.0 / np.where(F > 0, F, np.inf)

    def matmat(self, x: np.ndarray) -> np.ndarray:
        """S x, (N, k) float64."""
        patterns = (self.inverse_F[:, None] * x).astype(np.float32)
        light = np.asarray(self.T @ patterns, np.float64)
        is_masked = (self.F == 0)[:, None]
        return light + is_masked * x

    def solve(self, b: np.ndarray) -> np.ndarray:
        """S^-1 b, (N, k), with the least residual in block Krylov spaces."""
        solutions = []
        for start in range(0, b.shape[1], BLOCK_SIZE):
            block = b[:, start : start + BLOCK_SIZE]
            solutions.append(block_gmres(self.matmat, block, steps=KRYLOV_STEPS))
        return np.hstack(solutions)


class HostErrors(EntryErrors):
    """The errors of the entries of T, by products and solves on the host."""

    def __init__(self, T: Transport, matrices: list[Any], systems: list[HostSystem]) -> None:
        super().__init__(T, T.noise)
        self.matrices = matrices
        self.systems = systems

    def products(self, channel: int, patterns: np.ndarray) -> Any:
        """T of a channel times float32 patterns (N, k), or (3 N, k) of blocks."""
        if self.T.blocks is not None:
            matrices = channel_matrices(self.T, channel)
            drives = np.split(patterns, len(matrices))
            return sum(A @ drive for A, drive in zip(matrices, drives, strict=True))
        if self.T.is_square:
            is_lit = self.systems[channel].F > 0
            patterns = np.where(is_lit[:, None], patterns, np.float32(0.0))
        return np.asarray(self.matrices[channel] @ patterns, np.float64)

    def solve(self, channel: int, light: np.ndarray) -> np.ndarray:
        """S^-1 of light (N, k, draws), float64."""
        b = light.reshape(len(light), -1)
        return self.systems[channel].solve(b).reshape(light.shape)
