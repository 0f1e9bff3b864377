# SPDX-License-Identifier: BSD-3-Clause
"""The noise of a transport from its entries alone.

Light is smooth between two small windows of pixels, one of the camera and one of the projector;
noise is not. The detail d of such a block of T, orthogonal to straight lines along each of its four
axes and scaled to unit gain, is noise where the scene has no edge, no gloss lobe and no first
bounce, and more where it has. So v = median(d^2) / 0.455 is an upper bound on the variance; another
one is that of T_ij / (F_i F_j), in which the wall has no texture. The smaller one counts. Blocks of
different mean light L agree on noise, and rarely on anything else: of v ~ floor^2 (1 + q L) the
dimmest blocks tell the floor, and those q are likely with which most blocks agree. Light off the
diagonal is dim and leaves a range of q, in which the detail of the diagonal decides. Factors of
rows are from the detail within a row, as far as its two halves agree; those of columns likewise.
Errors of a row that cancel show as row sums whose detail is below the noise of entries.

Known limits: smooth errors are not seen; where less than a third of the blocks is smooth the result
is an upper bound; entries that are exactly 0 were cut off by somebody and do not count; photon
noise that only a textured first bounce could show is left out. With fewer than 6 x 12 pixels, or
zeros all over, there are only neighbours in a row to compare, which gives an upper bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple, Self

import numpy as np
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators.interreflection import underlying_system
from ltcl.transport.noise.model import Noise, cancellation

_SQUARE = 0.4549  # median of the squares of standard normal values
_WINDOW = (
    (6, 2),
    (4, 2),
    (3, 1),
)  # side, order: the first of which enough blocks have no entry that is 0
_WINDOWS, _ENOUGH = 24, 12  # of camera and of projector at most; blocks at least
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-2, 1e4, 31)])  # q, times 1 / median light
_DIAGONAL = (4, 2), (4, 3), (6, 4)  # side of windows, order
_AGREE = 10.0  # width of log v of blocks that agree, times the root of their coefficients
_TRUSTED = 0.7  # share of blocks that agree: from there on, the detail of single rows is noise
_CHANCE = 2.0  # standard deviations of a count, or of a correlation, that mean nothing
_TEXTURE = 0.5  # of the variance: where texture leaves less than this, it is divided by
_ROWS, _AT_ONCE = 512, 4096  # rows: of pairs of neighbours at most; in memory
_LEAST, _ARRAYS = 1e-60, (np.ndarray, scipy.sparse.csr_array)


class Windows(NamedTuple):
    """Pixels (windows, p) with a weight 1 / texture, their detail (k, p), and its gain (windows, k)."""

    pixels: np.ndarray
    weight: np.ndarray
    detail: np.ndarray
    gain: np.ndarray

    @classmethod
    def of(
        cls,
        grid: tuple[int, int],
        side: int,
        order: int,
        texture: np.ndarray,
        overlap: bool = False,
    ) -> Self:
        """Of `side` pixels a side, detail beyond degree `order` - 1; all, or some that do not overlap."""
        sides = [min(side, n) for n in grid]
        counts = [n - k + 1 if overlap else n // k for n, k in zip(grid, sides, strict=True)]
        starts = [
            np.linspace(0, n - k, m).astype(int)
            for n, k, m in zip(grid, sides, counts, strict=True)
        ]
        corners = np.array(list(product(*starts)))
        if len(corners) > _WINDOWS and not overlap:
            random = np.random.default_rng(0)
            corners = corners[np.sort(random.choice(len(corners), _WINDOWS, replace=False))]
        y, x = (corners[:, [axis]] + np.arange(k) for axis, k in enumerate(sides))
        pixels = (y[:, :, None] * grid[1] + x[:, None, :]).reshape(len(corners), -1)
        polynomials = (
            np.linalg.qr(np.vander(np.arange(k) - (k - 1) / 2, increasing=True))[0] for k in sides
        )
        detail = np.kron(
            *(Q[:, min(order, k - 1) :].T for k, Q in zip(sides, polynomials, strict=True))
        )
        weight = 1.0 / texture[pixels]
        return cls(pixels, weight, detail, np.sqrt(weight**2 @ detail.T**2))


def estimate(matrices: Sequence[Any], grid: tuple[int, int], camera_grid: tuple[int, int]) -> Noise:
    """`Noise` of T (M, N) of 1 or 3 channels, without a further measurement.

    `matrices` are arrays, csr_arrays, rows of a store or operators (products for a sample of
    pixels). InputError for compressed ones, whose noise has no detail of its own, and what shows no
    entries.
    """
    for T in matrices:
        if underlying_system(T) is not None or not (
            isinstance(T, _ARRAYS) or hasattr(T, "between")
        ):
            text = "noise is None, but T is compressed, or an operator, and shows no entries with noise"
            raise InputError(
                f"{text}; give noise= (--noise) to what it was made from, which keeps it"
            )
    channels = [_channel(T, grid, camera_grid) for T in matrices]
    photons, floor, rows, columns, *others = (
        np.stack(values) for values in zip(*channels, strict=True)
    )
    return Noise(photons, floor, rows, columns, np.full(rows.shape, np.inf), "estimated", *others)


def _channel(T: Any, grid: tuple[int, int], camera_grid: tuple[int, int]) -> tuple[Any, ...]:
    """Photons, floor, rows (M,), columns (N,), direct and neighbours."""
    (M, N), own = T.shape, camera_grid == grid and hasattr(T, "diagonal")
    F, texture = np.asarray(T.diagonal() if own else [], np.float64), np.ones(max(M, N))
    rows, columns = np.ones(M), np.ones(N)
    for size in _WINDOW:
        camera, projector, v, light = _blocks(T, grid, camera_grid, size, texture)
        if np.isfinite(v).sum() >= _ENOUGH:
            break
    else:
        return 0.0, _of_neighbours(T), rows, columns, 1.0, 0.0
    first = _picture(F, grid, np.ones(N)) if own else None
    if first and first[0] > 0.0:
        other = _blocks(T, grid, camera_grid, size, np.maximum(F / first[0], 0.1))
        if np.nanmedian(other[2]) < _TEXTURE * np.nanmedian(v):
            (camera, projector, v, light), first = other, None
    width = _AGREE / (len(camera.detail) * len(projector.detail)) ** 0.5
    floor2, q, _ = _agreement(v, light, first, width)
    if isinstance(T, _ARRAYS) or hasattr(T, "row_blocks"):  # of an operator, N products
        r = _factors(lambda i: _entries(T, i, projector.pixels.ravel()), M, projector, q)
        c = _factors(lambda j: _entries(T, camera.pixels.ravel(), j).T, N, camera, q)
        mean = r[camera.pixels].mean(axis=1)[:, None] * c[projector.pixels].mean(axis=1)
        *other, share = _agreement(v / mean, light, first, width)
        if share >= _TRUSTED:
            (floor2, q), rows, columns = other, r, c
    direct = 1.0 if first is None else min(first[1] / (floor2 * (1.0 + q * first[0])), 1.0)
    white, weighted = (T @ np.stack([np.ones(N), columns], axis=1).astype(np.float32)).T
    V = columns.sum() + q * weighted
    if own:
        white, V = white - F, V - columns * (1.0 + q * F)
    sums = _picture(white, camera_grid, np.maximum(floor2 * rows * V, _LEAST))[1]
    return q * floor2, floor2**0.5, rows, columns, direct, cancellation(sums, M // 8)


def _blocks(
    T: Any,
    grid: tuple[int, int],
    camera_grid: tuple[int, int],
    size: tuple[int, int],
    texture: np.ndarray,
) -> tuple[Windows, Windows, np.ndarray, np.ndarray]:
    """Windows of camera and projector, v and L (camera windows, projector windows); NaN where not known."""
    camera, projector = (Windows.of(pixels, *size, texture) for pixels in (camera_grid, grid))
    (a, p), (b, q) = camera.pixels.shape, projector.pixels.shape
    X = _entries(T, camera.pixels.ravel(), projector.pixels.ravel()).reshape(a, p, b, q)
    out = (X == 0).any(axis=(1, 3))
    if camera_grid == grid:
        out |= (camera.pixels[:, None, :, None] == projector.pixels[:, None, :]).any(axis=(2, 3))
    scaled = X * camera.weight[:, :, None, None] * projector.weight
    d = np.einsum("ip,apbq,jq->abij", camera.detail, scaled, projector.detail, optimize=True)
    d /= camera.gain[:, None, :, None] * projector.gain[:, None, :]
    v = np.median(d**2, axis=(2, 3)) / _SQUARE
    return camera, projector, np.where(out, np.nan, v), np.maximum(X.mean(axis=(1, 3)), 0.0)


def _agreement(
    v: np.ndarray, light: np.ndarray, first: tuple[float, float] | None, width: float
) -> tuple[float, float, float]:
    """floor^2, q, and the share of blocks that agree; `first`: light and variance of the first bounce."""
    dim = np.argsort(light[np.isfinite(v)])
    v, light = (x[np.isfinite(v)][dim] for x in (np.maximum(v, _LEAST), light))
    ratios = _RATIOS / max(float(np.median(light)), _LEAST)
    dimmest = slice(0, max(len(v) // 4, _ENOUGH))

    def floor2(q: float) -> float:
        """On which most of the dimmest blocks agree."""
        u = np.sort(np.log(v[dimmest] / (1.0 + q * light[dimmest])))
        count = np.searchsorted(u, u + width, side="right") - np.arange(len(u))
        start = int(count.argmax())
        return float(np.exp(np.median(u[start : start + count[start]])))

    deviations = (np.abs(np.log(v / (floor2(q) * (1.0 + q * light)))) for q in ratios)
    counts = np.array([np.count_nonzero(deviation < width / 2) for deviation in deviations])
    likely = ratios[counts >= counts.max() - _CHANCE * counts.max() ** 0.5]
    likely[0] = 0.0 if counts.max() < _TRUSTED * len(v) else likely[0]
    q = float(np.sqrt(likely[0] * likely[-1]))  # 0 where light may make no difference
    if first is not None:
        own = (first[1] / floor2(q) - 1.0) / max(first[0], _LEAST)
        q = float(np.clip(own, likely[0], likely[-1])) if own <= 2.0 * likely[-1] else q
    return floor2(q), q, counts.max() / len(v)


def _picture(F: np.ndarray, grid: tuple[int, int], variance: np.ndarray) -> tuple[float, float]:
    """Median of a first bounce or other picture F (N,), and an upper bound on its noise over `variance`."""
    bounds = []
    for side, order in _DIAGONAL:
        window = Windows.of(grid, side, order, np.ones(len(F)), overlap=True)
        d2 = (F[window.pixels] @ window.detail.T) ** 2 / variance[window.pixels].mean(axis=1)[
            :, None
        ]
        bounds.append(np.median(d2) / _SQUARE)
    return max(float(np.median(F)), 0.0), float(min(bounds))


def _factors(
    entries: Callable[[np.ndarray], np.ndarray], n: int, window: Windows, q: float
) -> np.ndarray:
    """Of n rows, of which `entries` shows some in the pixels of windows; their mean is 1."""
    halves: list[Any] = []
    if len(window.pixels) < 2:
        return np.ones(n)
    for start in range(0, n, _AT_ONCE):
        i = np.arange(start, min(start + _AT_ONCE, n))
        X = entries(i).reshape(len(i), *window.pixels.shape)
        d = np.einsum("iwp,kp->iwk", X * window.weight, window.detail) / window.gain
        z = d**2 / (1.0 + q * np.maximum(X.mean(axis=2), 0.0))[:, :, None]
        out = (X == 0).any(axis=2) | (window.pixels == i[:, None, None]).any(axis=2)
        z[out] = np.nan
        z[out[:, ::2].all(axis=1) | out[:, 1::2].all(axis=1)] = np.inf
        halves.append([np.nanmedian(z[:, k::2], axis=(1, 2)) for k in (0, 1)])
    logs = np.log(np.maximum(np.concatenate(halves, axis=1), _LEAST))
    known = np.isfinite(logs).all(axis=0)
    if known.sum() < _ENOUGH or not logs[:, known].std(axis=1).all():
        return np.ones(n)
    r = float(np.corrcoef(logs[:, known])[0, 1])
    mean = np.where(known, logs.mean(axis=0), logs[:, known].mean())
    factors = np.exp((mean - mean.mean()) * (2.0 * r / (1.0 + r) if r > _CHANCE / n**0.5 else 0.0))
    return factors / factors.mean()


def _entries(T: Any, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """T[rows][:, columns], float64."""
    if not isinstance(T, _ARRAYS):
        order, back = np.unique(rows, return_inverse=True)  # a store reads rows in ascending order
        return np.asarray(T.between(order, columns), np.float64)[back]
    some: Any = T[rows][:, columns] if len(rows) < len(columns) else T[:, columns][rows]
    return np.asarray(some.toarray() if scipy.sparse.issparse(some) else some, np.float64)


def _of_neighbours(T: Any) -> float:
    """Of neighbours in a row that are both not 0."""
    rows = np.unique(np.linspace(0, T.shape[0] - 1, _ROWS).astype(int))
    X = _entries(T, rows, np.arange(T.shape[1]))
    d = np.diff(X)[(X[:, 1:] != 0) & (X[:, :-1] != 0)]
    return float(np.median(np.abs(d)) / _SQUARE**0.5 / 2**0.5) if len(d) >= _ENOUGH else 0.0
