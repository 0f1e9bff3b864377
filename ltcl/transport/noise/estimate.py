# SPDX-License-Identifier: BSD-3-Clause
"""The noise of a transport from its entries alone.

1. Light is smooth between two small windows of pixels, one of the camera and one of the projector;
   noise is not. The detail d of such a block of T, orthogonal to straight lines along each of its
   four axes and scaled to unit gain, is noise if the scene has no edge, gloss lobe or first bounce
   there, and more if it has. So v = median(d^2) / 0.455 is an upper bound on the variance.
2. Another bound is that of T_ij / (F_i F_j), in which the wall has no texture. The smaller one
   counts.
3. Blocks of different mean light L agree on noise, and rarely on anything else. In the model

       v ~ floor^2 (1 + q L)

   the dimmest blocks tell the floor, and those q are likely for which most blocks agree. Light off
   the diagonal is dim and leaves a range of q, in which the detail of the diagonal decides.
4. Factors of rows are from the detail within a row, as far as its two halves agree; those of
   columns likewise.
5. Errors of a row that cancel show as row sums whose detail is below the noise of entries.

Known limits: smooth errors are not seen. If less than a third of the blocks is smooth the result is
an upper bound. Entries that are exactly 0 were cut off and do not count. Photon noise that only a
textured first bounce could show is left out. With fewer than 6 x 12 pixels, or zeros all over, only
neighbours in a row are compared, which gives an upper bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators.interreflection import underlying_system
from ltcl.transport.noise.fit import ChannelNoise
from ltcl.transport.noise.model import Noise
from ltcl.transport.noise.neighbours import cancellation
from ltcl.transport.noise.windows import Windows

# Types of matrices whose entries are read.
ARRAYS = (np.ndarray, scipy.sparse.csr_array)
# Median of the squares of standard normal values.
MEDIAN_SQUARE = 0.4549
# Least variance, so that logarithms exist.
MIN_VARIANCE = 1e-60

# Side and order of windows: the first pair for which enough blocks have no entry that is 0.
BLOCK_WINDOWS = ((6, 2), (4, 2), (3, 1))
MIN_BLOCKS = 12
# Side and order of windows of a first bounce, or of another picture.
PICTURE_WINDOWS = ((4, 2), (4, 3), (6, 4))
# Share of the variance that is left without texture: below, T is divided by the first bounce.
TEXTURE_SHARE = 0.5
MIN_TEXTURE = 0.1

# q, times 1 / median light.
RATIOS = np.concatenate([[0.0], np.geomspace(1e-2, 1e4, 31)])
# Width of log v of blocks that agree, times the root of the number of their coefficients.
AGREEMENT_WIDTH = 10.0
# Share of blocks that agree: from there on, the detail of single rows is noise.
TRUSTED_SHARE = 0.7
# Standard deviations of a count, or of a correlation, that may be chance.
CHANCE_SIGMAS = 2.0

# Rows that are read at once.
ROWS_PER_STEP = 4096
# Rows whose neighbouring entries are compared.
NEIGHBOUR_ROWS = 512


def estimate(matrices: Sequence[Any], grid: tuple[int, int], camera_grid: tuple[int, int]) -> Noise:
    """`Noise` of T (M, N) of 1 or 3 channels, without a further measurement.

    `matrices` are arrays, csr_arrays, rows of a store or operators (products for a sample of
    pixels). InputError for compressed ones, whose noise has no detail of its own, and for those
    whose entries cannot be read.
    """
    for T in matrices:
        has_entries = isinstance(T, ARRAYS) or hasattr(T, "between")
        if underlying_system(T) is not None or not has_entries:
            raise InputError(
                "noise is None, but T is compressed, or an operator, and shows no entries with "
                "noise; give noise= (--noise) to what it was made from, which keeps it"
            )
    channels = [_ChannelEstimator(T, grid, camera_grid).run() for T in matrices]
    return Noise.from_channels(channels, "estimated")


@dataclass(frozen=True, kw_only=True)
class PictureDetail:
    """Median light of a picture, and an upper bound on the variance of its noise."""

    light: float
    variance: float


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Variances v and mean light L of blocks, (camera windows, projector windows).

    v is NaN if it is unknown.
    """

    camera: Windows
    projector: Windows
    variance: np.ndarray
    light: np.ndarray

    def known_count(self) -> int:
        """Number of blocks whose variance is known."""
        return int(np.isfinite(self.variance).sum())


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """floor^2 and q on which blocks agree, and the share of them that do."""

    floor2: float
    q: float
    share: float


class _ChannelEstimator:
    """Steps of the estimate for one channel T (M, N)."""

    def __init__(self, T: Any, grid: tuple[int, int], camera_grid: tuple[int, int]) -> None:
        self.T = T
        self.grid = grid
        self.camera_grid = camera_grid
        self.has_diagonal = camera_grid == grid and hasattr(T, "diagonal")
        self.F = np.zeros(0)
        if self.has_diagonal:
            self.F = np.asarray(T.diagonal(), np.float64)

    def run(self) -> ChannelNoise:
        M, N = self.T.shape
        blocks, size = self._find_blocks()
        if blocks is None:
            floor = _noise_of_neighbours(self.T)
            return ChannelNoise(photons=0.0, floor=floor, rows=np.ones(M), columns=np.ones(N))
        first: PictureDetail | None = None
        if self.has_diagonal:
            first = _picture_detail(self.F, self.grid, np.ones(N))
        if first is not None and first.light > 0.0:
            flat = self._blocks_without_texture(blocks, size, first.light)
            if flat is not None:
                # Its texture hides the noise of the first bounce.
                blocks = flat
                first = None
        agreement = _find_agreement(blocks.variance, blocks.light, first, _agreement_width(blocks))
        agreement, rows, columns = self._fit_factors(blocks, first, agreement)
        q = agreement.q
        floor2 = agreement.floor2
        direct = 1.0
        if first is not None:
            direct = min(first.variance / (floor2 * (1.0 + q * first.light)), 1.0)
        return ChannelNoise(
            photons=q * floor2,
            floor=floor2**0.5,
            rows=rows,
            columns=columns,
            direct=direct,
            neighbours=self._neighbours(agreement, rows, columns),
        )

    def _find_blocks(self) -> tuple[Blocks | None, tuple[int, int]]:
        """Blocks of the largest windows that enough of them know, and side and order of these."""
        texture = np.ones(max(self.T.shape))
        for size in BLOCK_WINDOWS:
            blocks = self._read_blocks(size, texture)
            if blocks.known_count() >= MIN_BLOCKS:
                return blocks, size
        return None, BLOCK_WINDOWS[-1]

    def _read_blocks(self, size: tuple[int, int], texture: np.ndarray) -> Blocks:
        side, order = size
        camera = Windows.from_grid(self.camera_grid, side, order, texture)
        projector = Windows.from_grid(self.grid, side, order, texture)
        shape = (*camera.pixels.shape, *projector.pixels.shape)
        X = _read_entries(self.T, camera.pixels.ravel(), projector.pixels.ravel()).reshape(shape)
        is_unknown = (X == 0).any(axis=(1, 3))
        if self.camera_grid == self.grid:
            # A block with direct light is not smooth.
            is_same = camera.pixels[:, None, :, None] == projector.pixels[:, None, :]
            is_unknown |= is_same.any(axis=(2, 3))
        scaled = X * camera.weight[:, :, None, None] * projector.weight
        d = np.einsum("ip,apbq,jq->abij", camera.detail, scaled, projector.detail, optimize=True)
        d /= camera.gain[:, None, :, None] * projector.gain[:, None, :]
        variance = np.median(d**2, axis=(2, 3)) / MEDIAN_SQUARE
        return Blocks(
            camera=camera,
            projector=projector,
            variance=np.where(is_unknown, np.nan, variance),
            light=np.maximum(X.mean(axis=(1, 3)), 0.0),
        )

    def _blocks_without_texture(
        self, blocks: Blocks, size: tuple[int, int], median_F: float
    ) -> Blocks | None:
        """Blocks of T_ij / (F_i F_j), if their bound is much smaller."""
        texture = np.maximum(self.F / median_F, MIN_TEXTURE)
        flat = self._read_blocks(size, texture)
        limit = TEXTURE_SHARE * np.nanmedian(blocks.variance)
        if np.nanmedian(flat.variance) < limit:
            return flat
        return None

    def _fit_factors(
        self, blocks: Blocks, first: PictureDetail | None, agreement: Agreement
    ) -> tuple[Agreement, np.ndarray, np.ndarray]:
        """Factors of rows (M,) and columns (N,), and the agreement with them; 1 if not trusted."""
        M, N = self.T.shape
        none = agreement, np.ones(M), np.ones(N)
        # Operators would need N products.
        if not (isinstance(self.T, ARRAYS) or hasattr(self.T, "row_blocks")):
            return none
        camera = blocks.camera
        projector = blocks.projector
        rows = _find_factors(
            lambda i: _read_entries(self.T, i, projector.pixels.ravel()), M, projector, agreement.q
        )
        columns = _find_factors(
            lambda j: _read_entries(self.T, camera.pixels.ravel(), j).T, N, camera, agreement.q
        )
        mean_rows = rows[camera.pixels].mean(axis=1)[:, None]
        mean_columns = columns[projector.pixels].mean(axis=1)
        variance = blocks.variance / (mean_rows * mean_columns)
        scaled = _find_agreement(variance, blocks.light, first, _agreement_width(blocks))
        if scaled.share < TRUSTED_SHARE:
            return none
        return scaled, rows, columns

    def _neighbours(self, agreement: Agreement, rows: np.ndarray, columns: np.ndarray) -> float:
        """Share of neighbours that errors of a row lack, by the detail of row sums."""
        M, N = self.T.shape
        q = agreement.q
        patterns = np.stack([np.ones(N), columns], axis=1).astype(np.float32)
        white, weighted = (self.T @ patterns).T
        # Variance of row sums of independent errors, over floor^2 and the factor of the row.
        variance = columns.sum() + q * weighted
        if self.has_diagonal:
            white = white - self.F
            variance = variance - columns * (1.0 + q * self.F)
        expected = np.maximum(agreement.floor2 * rows * variance, MIN_VARIANCE)
        sums = _picture_detail(white, self.camera_grid, expected)
        return cancellation(sums.variance, M // 8)


def _agreement_width(blocks: Blocks) -> float:
    """Width of log v of blocks that agree."""
    coefficients = len(blocks.camera.detail) * len(blocks.projector.detail)
    return AGREEMENT_WIDTH / coefficients**0.5


def _find_agreement(
    variance: np.ndarray, light: np.ndarray, first: PictureDetail | None, width: float
) -> Agreement:
    """The floor and q on which most blocks agree; `first` is the detail of the first bounce."""
    is_known = np.isfinite(variance)
    dim_first = np.argsort(light[is_known])
    v = np.maximum(variance[is_known], MIN_VARIANCE)[dim_first]
    L = light[is_known][dim_first]
    dimmest = slice(0, max(len(v) // 4, MIN_BLOCKS))

    def floor2(q: float) -> float:
        return _densest(np.log(v[dimmest] / (1.0 + q * L[dimmest])), width)

    ratios = RATIOS / max(float(np.median(L)), MIN_VARIANCE)
    counts = np.zeros(len(ratios), int)
    for number, q in enumerate(ratios):
        deviation = np.abs(np.log(v / (floor2(q) * (1.0 + q * L))))
        counts[number] = np.count_nonzero(deviation < width / 2)
    most = counts.max()
    likely = ratios[counts >= most - CHANCE_SIGMAS * most**0.5]
    if most < TRUSTED_SHARE * len(v):
        likely[0] = 0.0
    lowest = likely[0]
    highest = likely[-1]
    # 0 if light may make no difference.
    q = float(np.sqrt(lowest * highest))
    if first is not None:
        direct_q = (first.variance / floor2(q) - 1.0) / max(first.light, MIN_VARIANCE)
        if direct_q <= 2.0 * highest:
            q = float(np.clip(direct_q, lowest, highest))
    return Agreement(floor2=floor2(q), q=q, share=most / len(v))


def _densest(logs: np.ndarray, width: float) -> float:
    """The value around which most have logarithms within `width`: exp of their median."""
    u = np.sort(logs)
    counts = np.searchsorted(u, u + width, side="right") - np.arange(len(u))
    start = int(counts.argmax())
    return float(np.exp(np.median(u[start : start + counts[start]])))


def _picture_detail(F: np.ndarray, grid: tuple[int, int], variance: np.ndarray) -> PictureDetail:
    """Median of a picture F (N,), and an upper bound on its noise over `variance`."""
    bounds = []
    for side, order in PICTURE_WINDOWS:
        windows = Windows.from_grid(grid, side, order, np.ones(len(F)), overlap=True)
        expected = variance[windows.pixels].mean(axis=1)[:, None]
        squares = (F[windows.pixels] @ windows.detail.T) ** 2 / expected
        bounds.append(np.median(squares) / MEDIAN_SQUARE)
    return PictureDetail(light=max(float(np.median(F)), 0.0), variance=float(min(bounds)))


def _find_factors(
    read: Callable[[np.ndarray], np.ndarray], n: int, windows: Windows, q: float
) -> np.ndarray:
    """Factors of n rows, whose mean is 1; `read` gives entries of rows in pixels of `windows`."""
    if len(windows.pixels) < 2:
        return np.ones(n)
    halves = []
    for start in range(0, n, ROWS_PER_STEP):
        rows = np.arange(start, min(start + ROWS_PER_STEP, n))
        X = read(rows).reshape(len(rows), *windows.pixels.shape)
        halves.append(_half_variances(X, rows, windows, q))
    logs = np.log(np.maximum(np.concatenate(halves, axis=1), MIN_VARIANCE))
    is_known = np.isfinite(logs).all(axis=0)
    if is_known.sum() < MIN_BLOCKS or not logs[:, is_known].std(axis=1).all():
        return np.ones(n)
    # Two halves of equal noise correlate by r; their mean has 2 r / (1 + r) of signal.
    r = float(np.corrcoef(logs[:, is_known])[0, 1])
    signal = 0.0
    if r > CHANCE_SIGMAS / n**0.5:
        signal = 2.0 * r / (1.0 + r)
    mean = np.where(is_known, logs.mean(axis=0), logs[:, is_known].mean())
    factors = np.exp((mean - mean.mean()) * signal)
    return factors / factors.mean()


def _half_variances(X: np.ndarray, rows: np.ndarray, windows: Windows, q: float) -> np.ndarray:
    """Median squares (2, rows) of detail in every second window; infinite if unknown."""
    d = np.einsum("iwp,kp->iwk", X * windows.weight, windows.detail) / windows.gain
    light = np.maximum(X.mean(axis=2), 0.0)
    z = d**2 / (1.0 + q * light)[:, :, None]
    is_unknown = (X == 0).any(axis=2)
    is_unknown |= (windows.pixels == rows[:, None, None]).any(axis=2)
    z[is_unknown] = np.nan
    has_empty_half = is_unknown[:, ::2].all(axis=1) | is_unknown[:, 1::2].all(axis=1)
    z[has_empty_half] = np.inf
    even = np.nanmedian(z[:, ::2], axis=(1, 2))
    odd = np.nanmedian(z[:, 1::2], axis=(1, 2))
    return np.stack([even, odd])


def _read_entries(T: Any, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """T[rows][:, columns], float64."""
    if not isinstance(T, ARRAYS):
        # A store reads rows in ascending order.
        ascending, order = np.unique(rows, return_inverse=True)
        return np.asarray(T.between(ascending, columns), np.float64)[order]
    # The smaller selection first.
    entries: Any = T[rows][:, columns] if len(rows) < len(columns) else T[:, columns][rows]
    if scipy.sparse.issparse(entries):
        entries = entries.toarray()
    return np.asarray(entries, np.float64)


def _noise_of_neighbours(T: Any) -> float:
    """Standard deviation by differences of neighbours in a row that are both not 0."""
    rows = np.unique(np.linspace(0, T.shape[0] - 1, NEIGHBOUR_ROWS).astype(int))
    X = _read_entries(T, rows, np.arange(T.shape[1]))
    is_known = (X[:, 1:] != 0) & (X[:, :-1] != 0)
    differences = np.diff(X)[is_known]
    if len(differences) < MIN_BLOCKS:
        return 0.0
    return float(np.median(np.abs(differences)) / MEDIAN_SQUARE**0.5 / 2**0.5)
