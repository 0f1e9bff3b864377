# SPDX-License-Identifier: BSD-3-Clause
"""What an approximate inverse of I + sign C leaves to do, as an operator that is never formed."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl.device import Device
from ltcl.operators import Host
from ltcl.theory import TwoNorm, two_norm


class Residual(scipy.sparse.linalg.LinearOperator):
    """G = C - D (I + sign C), without forming it."""

    def __init__(self, C: Any, D: Any, sign: float) -> None:
        super().__init__(np.float64, C.shape)
        self.C, self.D, self.sign = C, D, sign
        self._CT, self._DT = C.T, D.T

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        Y = self.C @ X
        return Y - self.D @ (X + self.sign * Y)

    def _rmatmat(self, X: np.ndarray) -> np.ndarray:
        Y = X - self.sign * (self._DT @ X)
        return self._CT @ Y - self._DT @ X


def certify(G: Residual, device: Device, below: float) -> TwoNorm:
    """||G||_2 with its upper bound; `below` is what it matters to be below."""
    return two_norm(Host(device, G), below=below)
