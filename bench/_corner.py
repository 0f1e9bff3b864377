# SPDX-License-Identifier: BSD-3-Clause
"""R of a right-angled corner of one albedo, dense, with a sixteenth of the work of one inverse.

The corner has two mirrors, from left to right and from top to bottom. Light that is even or odd under each of
them stays so at every bounce: four kinds that never mix. A quarter of the corner, N / 4 pixels, tells all of
such light, and A there is the sum of its four mirror images with the signs of the kind.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg

from ltcl.scenes import CornerRows
from ltcl.scenes.scene import transport


def interreflection(n: int, albedo: float, progress: Callable[[str], object]) -> np.ndarray:
    """R = (I - A)^-1 - I of `ltcl.scenes.dihedral(n, albedo)` for even n, (N, N) float32."""
    A, half, size = CornerRows(n, albedo), n // 2, n * n // 2
    upper = A.rows(0, A.shape[0] // 2).reshape(half, 2 * n, n, 2 * n)[:, :n]
    down, right = slice(None, half - 1, -1), slice(None, n - 1, -1)
    quarters = [(v, h) for v in (slice(half), down) for h in (slice(n), right)]
    images = np.stack([upper[:, :, v, h].reshape(size, size) for v, h in quarters]) / albedo
    signs = scipy.linalg.hadamard(4)
    kinds = np.empty(images.shape)
    for number, kind in enumerate(kinds):
        progress(f"  bounces of light, kind {number + 1} of 4")
        form_factors = np.tensordot(signs[number], images, 1)
        kind[:] = transport(form_factors, np.full(size, albedo), np.ones(size)) / albedo - np.eye(size)
    R = np.empty((n, 2 * n, n, 2 * n), np.float32)
    for image, of_kinds in enumerate(signs):
        block = np.tensordot(of_kinds / 4, kinds, 1).reshape(half, n, half, n)
        for seen in range(4):
            R[(*quarters[seen], *quarters[seen ^ image])] = block
    return R.reshape(A.shape)
