# SPDX-License-Identifier: BSD-3-Clause
"""Bases of any size made of dense matrices, and operators compressed in them."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from ltcl.device import Array, Device
from ltcl.device.kernels import Queued
from ltcl.operators import CSR, Compressed, Dense, Epilogue
from ltcl.operators.bases import Basis


class MatrixBasis(Basis):
    """A basis W from any matrix (M, N)."""

    def __init__(self, device: Device, matrix: np.ndarray) -> None:
        self._on_device = Dense(device, matrix)
        super().__init__(device, (1, matrix.shape[1]), "given", len(matrix), self._on_device)
        self.matrix = matrix.astype(np.float32).astype(np.float64)  # as it lies on the device
        self.orthonormal = bool(np.allclose(matrix.T @ matrix, np.eye(matrix.shape[1]), atol=1e-5))
        self.isometric = bool(np.allclose(matrix @ matrix.T, np.eye(len(matrix)), atol=1e-5))

    def _bind_transform(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        return self._on_device._bind_product(x, out, epilogue, transpose)


def rotation(n: int, seed: int = 0) -> np.ndarray:
    """A random orthonormal matrix (n, n)."""
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0]


def two_sided(device: Device, R: np.ndarray, keep: float = 1.0, seed: int = 0) -> Compressed:
    """R in a random orthonormal basis, of whose coefficients a share `keep` stays."""
    W = MatrixBasis(device, rotation(len(R), seed))
    C = W.matrix @ R @ W.matrix.T
    C[np.abs(C) < np.quantile(np.abs(C), 1.0 - keep)] = 0.0
    return Compressed(CSR(device, scipy.sparse.csr_array(C)), W, W)


def stands_for(R: Compressed) -> np.ndarray:
    """The float64 matrix (M, N) of it, from which its products are rounded."""
    matrix = R.core.to_dense()
    if isinstance(R.out, MatrixBasis):
        matrix = R.out.matrix.T @ matrix
    if isinstance(R.into, MatrixBasis):
        matrix = matrix @ R.into.matrix
    return matrix
