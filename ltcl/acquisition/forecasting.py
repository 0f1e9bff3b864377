# SPDX-License-Identifier: BSD-3-Clause
"""How far pictures and bounces of a measured T are off by its noise, told before there is a truth.

Draws of E, the error of T (`scanning.again`), go to first order through what is done with T.
A picture T p is off by E p, and so is a picture that was compensated with T by p, where nothing clipped. Of
bounces (eq. 27), with F = diag(T) and D = diag(E) F^-1, X = S^-1 = F T^-1 is off by dX = D X - X E F^-1 X, so

    b_k = X l^(k),                            l^(k+1) = l^(k) - b_k
    db_k = X (dl^(k) - E F^-1 b_k) + D b_k,    dl^(k+1) = dl^(k) - db_k,    dl^(0) = 0

one product with E, which need not be formed, and one solve a bounce. The unit of light is in neither: bounces
do not depend on it.

A camera that is coarse or out of focus shows part of a pixel's light at its neighbours, q_y and q_x along the
axes (`Sharpness.errors`). A picture c is then off by about

    q_y (c - mean of c above and below) + q_x (c - mean of c beside),

which forecasts of pictures hold as well, and those of bounces do not.

Known limits: that is of the picture as it comes out, and too small where it is blurred already. The response
of the camera is taken for true; `Report.beside_white` shows where it is not. Light that an adaptive scan
leaves smooth is estimated by what a coarser one would lose of it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks, layout
from ltcl.acquisition.scanning import again
from ltcl.acquisition.scanning.pictures import Seen
from ltcl.errors import FileError
from ltcl.solvers import solve_each
from ltcl.store import BlockStore, load
from ltcl.transport import Transport

DRAWS = 16
_RTOL = 1e-3  # of solves: errors of T are larger


@dataclass(frozen=True, repr=False, eq=False)
class Forecast:
    """Result of `forecast_bounces`: standard deviations, in the unit of the image.

    Attributes
    ----------
    direct : array
        Of the direct part, as the image; float32.
    bounces : array, (bounces, ...)
        Of each indirect bounce.
    rms : array, (1 + bounces,)
        Root mean square over all pixels, the direct part first.
    draws : int
        That these are of: each has a relative error of about 1 / sqrt(2 draws).
    """

    direct: np.ndarray
    bounces: np.ndarray
    rms: np.ndarray
    draws: int

    def __repr__(self) -> str:
        told = ", ".join(f"{value:.2g}" for value in self.rms)
        return f"<ltcl Forecast of {self.draws} draws: direct and bounces off by {told} (rms)>"


def forecast_bounces(
    store: str | os.PathLike[str] | BlockStore,
    image: Any,
    bounces: int = 3,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    device: Any = None,
) -> Forecast:
    """How far `ltcl.separate` is off with the transport of a store, by the noise of its scan.

    Parameters
    ----------
    store : BlockStore or path
        Of a scan by `ltcl.acquire` that has ended.
    image : (h, w), (h, w, 3), or frames of these
        The picture to be separated, taken without noise; its first bounce is the diagonal of T.
    bounces : int
        As in `ltcl.separate`.
    draws : int
        Scans to draw; each takes about the time that decoding takes.
    seed : int
    device : Device or str, optional
        As in `ltcl.load`.

    Raises
    ------
    FileError
        The scan has not ended, or the store is none that `ltcl.acquire` made.
    InputError
        A picture of another shape, no draws.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> truth = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    >>> rig, path = VirtualRig(truth, truth.grid, bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=path)
    >>> told = forecast_bounces(path, truth @ np.ones(truth.grid), bounces=1)
    >>> told.bounces.shape, bool(0 < told.rms[0] < 0.02)
    ((1, 4, 8), True)
    """
    found, T = _ended(store, device)
    checks.count("bounces", bounces, least=0)
    checks.count("draws", draws)
    columns, shape = layout.unpack("image", image, T.grid, T.channels)
    b = _bounces(T, columns, bounces)
    F = np.atleast_2d(T.first_bounce)
    inverse = np.divide(1.0, F, out=np.zeros(F.shape), where=F > 0)
    W = [np.concatenate([inverse[c][:, None] * b_k[c] for b_k in b], axis=1) for c in range(T.channels)]
    drawn = again.errors(found, W, draws, seed)
    squares = _propagated(T, b, drawn, inverse)
    deviation = [shape.pack(parts, T.grid).astype(np.float32) for parts in squares]
    rms = np.array([np.sqrt(np.mean(np.square(part, dtype=np.float64))) for part in deviation])
    rest = np.stack(deviation[1:]) if bounces else np.empty((0, *deviation[0].shape), np.float32)
    return Forecast(deviation[0], rest, rms, draws)


def forecast_picture(
    store: str | os.PathLike[str] | BlockStore,
    pattern: Any,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    device: Any = None,
) -> np.ndarray:
    """How far T p is off by noise of the scan of T and by blur of its camera; float32, as the pattern.

    With the pattern that `ltcl.compensate` found it is how far the picture on the wall is off by these.

    Parameters
    ----------
    pattern : (h, w), (h, w, 3), or frames of these
    store, draws, seed, device
        As in `forecast_bounces`.

    Raises
    ------
    FileError, InputError
        As there.
    """
    found, T = _ended(store, device)
    checks.count("draws", draws)
    columns, shape = layout.unpack("pattern", pattern, T.grid, T.channels)
    if T.mixing is not None:
        columns = list(np.einsum("cd,dnk->cnk", T.mixing, np.stack(columns)))
    drawn = again.errors(found, columns, draws, seed)
    both = zip(drawn, _blurs(found, T, columns), strict=True)
    return shape.pack([np.hypot(_deviation(part.product), off) for part, off in both], T.grid).astype(
        np.float32
    )


def _blurs(found: BlockStore, T: Transport, columns: list[np.ndarray]) -> list[np.ndarray]:
    """What pictures (N, k) of each channel are off by the blur of the camera."""
    sharp = Seen.of(found).sharpness
    if sharp is None:
        return [np.zeros(part.shape) for part in columns]
    known = ~T.masked.reshape(*T.grid, 1)
    pictures = [(A @ p).reshape(*T.grid, -1) for A, p in zip(T.matrices, columns, strict=True)]
    y, x = sharp.errors
    return [
        (y * _beside(c, known, 0) + x * _beside(c, known, 1)).reshape(p.shape)
        for c, p in zip(pictures, columns, strict=True)
    ]


def _beside(c: np.ndarray, known: np.ndarray, axis: int) -> np.ndarray:
    """Pictures (h, w, k) less the mean of the two neighbours, of those that are known."""
    pad = [(1, 1) if k == axis else (0, 0) for k in range(3)]
    n, total, count = c.shape[axis], np.zeros(c.shape), np.zeros(known.shape)
    value, some = np.pad(np.where(known, c, 0.0), pad), np.pad(known.astype(float), pad)
    for part in (range(n), range(2, n + 2)):
        total += value.take(part, axis)
        count += some.take(part, axis)
    return np.where(known & (count > 0), c - total / np.maximum(count, 1.0), 0.0)


def _ended(store: str | os.PathLike[str] | BlockStore, device: Any) -> tuple[BlockStore, Transport]:
    found = store if isinstance(store, BlockStore) else BlockStore.open(store)
    if not found.final or "strategy" not in found.attributes:
        raise FileError(f"{found.path}: is not of a scan by ltcl.acquire that has ended; forecasts need one")
    return found, load(found.path, on_dark="mask", device=device)


def _bounces(T: Transport, columns: list[np.ndarray], bounces: int) -> list[list[np.ndarray]]:
    """b_0, b_1, ..., (N, k) of each channel."""
    left, found = [part.astype(np.float64) for part in columns], []
    for _ in range(bounces + 1):
        found.append([one.x.astype(np.float64) for one in solve_each(T.systems, left, rtol=_RTOL)])
        left = [l - b for l, b in zip(left, found[-1], strict=True)]
    return found


def _propagated(
    T: Transport, b: list[list[np.ndarray]], drawn: list[again.Errors], inverse: np.ndarray
) -> list[list[np.ndarray]]:
    """Standard deviation of each bounce, (N, k) of each channel."""
    N, k = b[0][0].shape
    draws, found = len(drawn[0].diagonal), []
    D = [one.diagonal * inverse[c] for c, one in enumerate(drawn)]
    left = [np.zeros((draws, N, k)) for _ in drawn]
    for number, b_k in enumerate(b):
        here = slice(number * k, (number + 1) * k)
        sides = [_flat(l - one.product[..., here]) for l, one in zip(left, drawn, strict=True)]
        solved = solve_each(T.systems, sides, rtol=_RTOL)
        db = [
            solved[c].x.reshape(N, draws, k).swapaxes(0, 1) + D[c][..., None] * b_k[c]
            for c in range(T.channels)
        ]
        left = [l - d for l, d in zip(left, db, strict=True)]
        found.append([_deviation(part) for part in db])
    return found


def _flat(parts: np.ndarray) -> np.ndarray:
    """(draws, N, k) as right-hand sides (N, draws k)."""
    return parts.swapaxes(0, 1).reshape(parts.shape[1], -1)


def _deviation(parts: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(parts**2, axis=0))
