# SPDX-License-Identifier: BSD-3-Clause
"""Errors of pictures and bounces caused by the noise of a scan, from the variances that its store has.

A scan measures T + E. Entries have the stored variances v_ij; they are independent but for their sums, which
are those of white with its errors d, of variance u. With independent e_ij

    E_ij = e_ij - v_ij / V_i (sum_j e_ij - d_i),    V_i = sum_j v_ij

so that row i of E a, for several a, has the covariances

    q_ab + (u / V - 1) q_a1 q_b1 / V,    q_ab = sum_j v_ij a_j b_j

Cells of an adaptive scan count as entries, sums of a over them as a_j. To first order a picture T p has the
error E p, also one compensated by p if nothing is clipped. For bounces (eq. 27), with F = diag(T),
D = diag(E) F^-1 and X = S^-1 = F T^-1, the unit of light cancels:

    b_k = X l^(k),                            l^(k+1) = l^(k) - b_k
    db_k = X (dl^(k) - E F^-1 b_k) + D b_k,    dl^(k+1) = dl^(k) - db_k,    dl^(0) = 0

Known limits: response, black offset, projector curve, ambient light and what cells leave smooth are taken as
exact: errors are 0.5 to 1.6 times the forecast, of bounces up to 1.8 times (one of 8 x 16 pixels at a time),
or 3.4 times (cells, a camera almost without noise).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import correlate1d

from ltcl import checks, layout
from ltcl.acquisition.scanning.pictures import Seen
from ltcl.acquisition.scanning.report import finished_scan, membership, stored_variances
from ltcl.solvers import solve_each
from ltcl.store import BlockStore, load

_RTOL = 1e-3  # of solves: errors of T are larger


@dataclass(frozen=True, repr=False, eq=False)
class Forecast:
    """Result of `forecast_bounces`: standard deviations, in the unit of the image.

    `direct` as the image and `bounces` (bounces, ...) float32, each with a relative error of about
    1 / sqrt(2 draws); `rms` (1 + bounces,) over all pixels, the direct part first.
    """

    direct: np.ndarray
    bounces: np.ndarray
    rms: np.ndarray
    draws: int

    def __repr__(self) -> str:
        errors = ", ".join(f"{value:.2g}" for value in self.rms[:4]) + ", ..." * (len(self.rms) > 4)
        return f"<ltcl Forecast of {self.draws} draws: rms errors of direct part and bounces {errors}>"


def forecast_bounces(
    store: str | os.PathLike[str] | BlockStore,
    image: Any,
    bounces: int = 3,
    *,
    draws: int = 16,
    seed: int = 0,
    device: Any = None,
) -> Forecast:
    """Errors of `ltcl.separate` with the transport of a store, caused by the noise of its scan.

    Parameters
    ----------
    store : BlockStore or path, of a finished scan by `ltcl.acquire`, else FileError
    image : (h, w), (h, w, 3), or frames of these
        The picture to be separated, taken without noise; its first bounce is the diagonal of T.
    bounces, device : as in `ltcl.separate` and `ltcl.load`
    draws, seed : int, of E at random; each takes a solve for each bounce

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> truth = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    >>> rig, path = VirtualRig(truth, truth.grid, bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=path)
    >>> bool(forecast_bounces(path, truth @ np.ones(truth.grid)).rms.max() < 0.02)
    True
    """
    scan = finished_scan(store)
    T = load(scan.path, on_dark="mask", device=device)
    checks.count("bounces", bounces, least=0)
    checks.count("draws", draws)
    sides, shape = layout.unpack("image", image, T.grid, T.channels)
    F = np.atleast_2d(T.first_bounce)
    inverse = np.divide(1.0, F, out=np.zeros(F.shape), where=F > 0)[..., None]

    def X(light: np.ndarray) -> np.ndarray:  # of (channels, N, k)
        return np.stack([s.x.astype(np.float64) for s in solve_each(T.systems, list(light), rtol=_RTOL)])

    left, b = np.stack(sides).astype(np.float64), []
    for _ in range(bounces + 1):
        b.append(X(left))
        left = left - b[-1]
    weights = enumerate(inverse[..., None] * np.stack(b, axis=-1))
    values, vectors = np.linalg.eigh([_covariance(scan, c, W) for c, W in weights])
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    normal = np.random.default_rng(seed).standard_normal((draws, *values.shape))
    *E, diagonal = np.einsum("cnkab,dcnkb->acndk", roots, normal)  # each (channels, N, draws, k)
    dl, all_deviations = np.zeros(diagonal.shape), []
    for b_n, e in zip(b, E, strict=True):
        db = X((dl - e).reshape(*F.shape, -1)).reshape(dl.shape) + diagonal * (inverse * b_n)[:, :, None]
        dl -= db
        all_deviations.append(shape.pack(list(np.sqrt(np.mean(db**2, axis=2))), T.grid).astype(np.float32))
    deviations = np.stack(all_deviations)
    squares = np.square(deviations, dtype=np.float64).reshape(bounces + 1, -1)
    return Forecast(deviations[0], deviations[1:], np.sqrt(np.mean(squares, axis=1)), draws)


def forecast_picture(
    store: str | os.PathLike[str] | BlockStore, pattern: Any, *, device: Any = None
) -> np.ndarray:
    """Errors of T p caused by the noise of the scan and the blur of its camera; float32, as the pattern.

    `pattern` is (h, w), (h, w, 3), or frames of these; with that of `ltcl.compensate` it is the error of the
    picture on the wall. The rest is as in `forecast_bounces`.
    """
    scan = finished_scan(store)
    T = load(scan.path, on_dark="mask", device=device)
    light, shape = layout.unpack("pattern", pattern, T.grid, T.channels)
    if T.mixing is not None:
        light = list(np.einsum("cd,dnk->cnk", T.mixing, np.stack(light)))
    variances = [_covariance(scan, c, p[..., None])[..., 0, 0] for c, p in enumerate(light)]
    sharpness = Seen.of(scan).sharpness
    if sharpness is not None:
        for A, p, variance in zip(T.matrices, light, variances, strict=True):
            q = np.array(replace(sharpness, leak=_leak(A, T.grid)).errors)
            shown = (A @ p).reshape(*T.grid, -1)
            detail = [correlate1d(shown, [-0.5, 1.0, -0.5], axis, mode="nearest") for axis in (0, 1)]
            blur = np.einsum("a,a...", q / (1.0 - q), detail).reshape(variance.shape)
            variance += np.where(T.masked[:, None], 0.0, blur**2)
    return shape.pack([np.sqrt(np.maximum(v, 0.0)) for v in variances], T.grid).astype(np.float32)


def _leak(A: Any, grid: tuple[int, int]) -> tuple[float, float]:
    """q along y and x (`Sharpness`): the part of the light of a pixel and its neighbours that is theirs.

    A (N, N) shows patterns of every fifth pixel. Light of the scene is smooth: as much comes from pixels two
    away, and is subtracted.
    """
    place, leak = np.indices(grid).reshape(2, -1), []
    shown = np.asarray(A @ ([5, 1] @ (place % 5) == np.arange(25)[:, None]).T.astype(np.float32))
    for axis, n in enumerate(grid):
        inner = np.flatnonzero((place[axis] > 0) & (place[axis] < n - 1) & shown.any(axis=1))
        steps = np.multiply.outer(np.arange(-2, 3), np.eye(2, dtype=int)[axis])[..., None]
        far, before, own, after, other = shown[inner, [5, 1] @ ((place[:, inner] + steps) % 5)]
        near = before + after - 2 * np.minimum(far, other)
        q = near / np.maximum(near + own - np.minimum(far, other), 1e-30)
        leak.append(float(np.clip(np.median(q), 0.0, 0.5)) if len(q) else 0.0)
    return leak[0], leak[1]


def _covariance(store: BlockStore, c: int, A: np.ndarray) -> np.ndarray:
    """Covariances (N, k, n + 1, n + 1) of E A, and of diag(E) as the last, row by row; A is (N, k, n)."""
    (N, k, n), cells, white = A.shape, membership(store), Seen.of(store).white
    weights = cells.T @ np.concatenate([A, np.ones((N, k, 1))], axis=2).reshape(N, -1)
    sums = weights.reshape(-1, k, n + 1)
    a, b = np.triu_indices(n + 1)
    pairs = (sums[..., a] * sums[..., b]).reshape(len(sums), -1)
    q = np.zeros((N, k, n + 2, n + 2))  # of A, 1 and the diagonal
    for rows, V in stored_variances(store, c):
        V.data = np.nan_to_num(V.data)
        own = V.multiply(cells[rows])
        q[rows, :, a, b] = q[rows, :, b, a] = (V @ pairs).reshape(-1, k, len(a))
        q[rows, :, -1, :-1] = q[rows, :, :-1, -1] = (own @ weights).reshape(-1, k, n + 1)
        q[rows, :, -1, -1] = own.sum(axis=1)[:, None]
    V = np.maximum(q[:, 0, n, n], 1e-100)
    factor = np.where(white.known[c], (white.variance[c] / V - 1.0) / V, 0.0)[:, None, None, None]
    q += factor * q[:, :, n, :, None] * q[:, :, n, None, :]
    return np.delete(np.delete(q, n, axis=2), n, axis=3)
