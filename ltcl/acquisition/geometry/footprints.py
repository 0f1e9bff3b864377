# SPDX-License-Identifier: BSD-3-Clause
"""What a camera pixel covers in the projector's plane: the parallelogram that its neighbours span."""

from __future__ import annotations

import numpy as np

from ltcl.acquisition.geometry.correspondence import Correspondence

BREAK = 2.5  # times the other difference: one that crosses the border of an object
LARGEST = 6.0  # times the median: what no camera pixel spans


def jacobian(found: Correspondence) -> tuple[np.ndarray, np.ndarray]:
    """J = d(x, y) / d(u, v) of each camera pixel, (H, W, 2, 2) float64, and where it is known.

    Differences to both valid neighbours are averaged; where one is far larger than the other it leads across
    a border, and the smaller one counts. Where a row or a column of pixels stands alone, and on a side of 1
    of the projector's grid, camera pixels are taken for squares. Pixels without any valid neighbour have no
    footprint, nor have those that would span six times what the median one does.

    >>> J, known = jacobian(Correspondence.aligned((3, 4)))
    >>> J[0, 0].tolist(), bool(known.all())
    ([[1.0, 0.0], [0.0, 1.0]], True)
    """
    x = np.stack([found.x, found.y], axis=-1).astype(np.float64)  # NaN where not valid
    du, dv = _slope(x, 1), _slope(x, 0)
    turned = np.array([1.0, -1.0])
    du = np.where(np.isnan(du), dv[..., ::-1] * turned, du)
    dv = np.where(np.isnan(dv), du[..., ::-1] * -turned, dv)
    if found.valid.size == 1:
        du, dv = np.array([[[1.0, 0.0]]]), np.array([[[0.0, 1.0]]])
    J = np.stack([du, dv], axis=-1)
    for axis, n in enumerate(found.grid[::-1]):
        if n == 1:
            J[..., axis, :] = J[..., 1 - axis, ::-1] * turned
    known = found.valid & np.isfinite(J).all(axis=(2, 3))
    J = np.where(known[..., None, None], J, 0.0)
    span = np.abs(J).max(axis=(2, 3))
    return J, known & (span <= LARGEST * np.median(span[known])) if known.any() else known


def straddling(found: Correspondence, J: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W): 1 of pixels beside one that is not known or not next to them on the surface, 0 of others.

    Such a pixel may see two surfaces, in parts that nothing tells.
    """
    x = np.stack([found.x, found.y], axis=-1).astype(np.float64)
    odd = np.zeros(known.shape, bool)
    for axis, slope in ((0, J[..., 1]), (1, J[..., 0])):
        n = known.shape[axis]
        mean = (slope.take(range(n - 1), axis) + slope.take(range(1, n), axis)) / 2
        off, size = (np.linalg.norm(part, axis=-1) for part in (np.diff(x, axis=axis) - mean, mean))
        far = ~(off <= (BREAK - 1) * size)  # NaN, too
        none = np.zeros_like(odd.take([0], axis))
        odd |= np.concatenate([far, none], axis) | np.concatenate([none, far], axis)
    return (odd & known).astype(np.float64)


def _slope(x: np.ndarray, axis: int) -> np.ndarray:
    """(H, W, 2): from the next and the previous pixel along `axis`; NaN where neither is valid."""
    step = np.diff(x, axis=axis)
    none = np.full_like(np.take(x, [0], axis=axis), np.nan)
    ahead, behind = np.concatenate([step, none], axis=axis), np.concatenate([none, step], axis=axis)
    far, near = (np.linalg.norm(d, axis=-1, keepdims=True) for d in (ahead, behind))
    use_ahead = np.isfinite(far) & ~(far > BREAK * near)
    use_behind = np.isfinite(near) & ~(near > BREAK * far)
    total = np.where(use_ahead, ahead, 0.0) + np.where(use_behind, behind, 0.0)
    count = use_ahead.astype(float) + use_behind
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
