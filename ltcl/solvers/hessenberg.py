# SPDX-License-Identifier: BSD-3-Clause
"""The small least-squares problems of GMRES, one for each right-hand side: min ||beta e_1 - H y||.

H (j + 1, j) is upper Hessenberg and grows by a column a step; Givens rotations keep it triangular, so that
the norm of the residual is known before y is. On the host, in float64.

Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., section 6.5.3.
"""

from __future__ import annotations

import numpy as np

from ltcl.solvers.columns import ratio

_SINGULAR = 2.0**-20  # of its length: what the rotations left of a column is the rounding of products


class Hessenberg:
    """k least-squares problems of up to m unknowns; `beta` (k,) are the norms of the first residuals."""

    def __init__(self, beta: np.ndarray, m: int) -> None:
        k = len(beta)
        self._triangle = np.zeros((k, m, m))
        self._rotations: list[tuple[np.ndarray, np.ndarray]] = []
        self._right = np.zeros((k, m + 1))
        self._right[:, 0] = beta
        self.residuals = np.array(beta, np.float64)
        self._columns: list[np.ndarray] = []

    def extend(self, h: np.ndarray) -> np.ndarray:
        """Append the columns h (k, j + 1); returns where they are a step, that is not 0 once rotated.

        A column that is 0 leaves its problem as it was: the right-hand side rests, or S is singular.
        """
        j = len(self._rotations)
        self._columns.append(h)
        h = h.copy()
        for i, (c, s) in enumerate(self._rotations):
            h[:, i], h[:, i + 1] = c * h[:, i] + s * h[:, i + 1], c * h[:, i + 1] - s * h[:, i]
        length = np.hypot(h[:, j], h[:, j + 1])
        step = ~(length <= _SINGULAR * np.linalg.norm(h, axis=1))  # NaN is a step; the residual will tell
        c, s = np.where(step, ratio(h[:, j], length, step), 1.0), ratio(h[:, j + 1], length, step)
        self._rotations.append((c, s))
        self._triangle[:, :j, j] = np.where(step[:, None], h[:, :j], 0.0)
        self._triangle[:, j, j] = np.where(step, length, 1.0)
        right = self._right[:, j].copy()
        self._right[:, j] = np.where(step, c * right, 0.0)
        self._right[:, j + 1] = np.where(step, -s * right, right)
        self.residuals = np.abs(self._right[:, j + 1])
        return step

    def solve(self) -> np.ndarray:
        """y (k, j), 0 in unknowns that were no step."""
        j = len(self._rotations)
        return np.linalg.solve(self._triangle[:, :j, :j], self._right[:, :j, None])[..., 0]

    def ritz_values(self) -> np.ndarray:
        """Eigenvalues of the square parts of all H, complex: estimates of those of S."""
        found = []
        for c in range(len(self.residuals)):
            steps = next((j for j, h in enumerate(self._columns) if not h[c].any()), len(self._columns))
            H = np.zeros((steps, steps))
            for j in range(steps):
                H[: j + 2, j] = self._columns[j][c, : min(j + 2, steps)]
            found.append(np.linalg.eigvals(H) if np.isfinite(H).all() else np.zeros(0))
        return np.concatenate(found)
