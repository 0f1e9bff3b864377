# SPDX-License-Identifier: BSD-3-Clause
"""The noise of a transport from its entries alone.

1. Light is smooth between two small windows of pixels, one of the camera and one of the projector;
   noise is not. The detail of such a block of T is an upper bound on its noise (`blocks`).
2. Another bound is that of T_ij / (F_i F_j), in which the wall has no texture. The smaller one
   counts.
3. Blocks of different light agree on noise, and rarely on anything else (`agreement`).
4. Factors of rows are from the detail within a row, as far as its two halves agree; those of
   columns likewise (`factors`).
5. Errors that neighbouring pixels share are larger than their detail (`correlation`).
6. Errors of a row that cancel show as row sums whose detail is below the noise of entries.

The noise is unknown, and at least what is stated, if fewer than 12 blocks hold light that no
blurred first bounce could be, or if errors are shared along the projector.

Known limits: smooth errors are not seen. If less than a third of the blocks is smooth the result is
an upper bound. Photon noise that only a textured first bounce could show is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # its subpackage stats is loaded at the first use

from ltcl.errors import InputError
from ltcl.operators.interreflection import underlying_system
from ltcl.transport.noise.agreement import (
    MIN_BLOCKS,
    Agreement,
    PictureDetail,
    find_agreement,
)
from ltcl.transport.noise.blocks import (
    ARRAYS,
    MEDIAN_SQUARE,
    MIN_VARIANCE,
    BlockReader,
    Blocks,
    read_entries,
)
from ltcl.transport.noise.correlation import Correlation, find_correlation
from ltcl.transport.noise.factors import find_factors
from ltcl.transport.noise.fit import ChannelNoise
from ltcl.transport.noise.model import Noise
from ltcl.transport.noise.neighbours import cancellation
from ltcl.transport.noise.windows import Windows

# Side and order of windows: the first pair for which enough blocks are known.
BLOCK_WINDOWS = ((6, 2), (4, 2), (3, 1))
# Side and order of windows of a first bounce, or of another picture.
PICTURE_WINDOWS = ((4, 2), (4, 3), (6, 4))
# Relative standard deviation of the median of n squares of normal values, times the root of n.
MEDIAN_SCATTER = 2.33
# Bounds on the variance below this share of others count in their place.
BETTER_SHARE = 0.5
# Correlation of detail of the first bounce and of bounced light, at most, without texture.
MAX_TEXTURE_CORRELATION = 0.3
# Factor of the spread of blocks, at most, by factors of rows and columns that are true.
MAX_WIDENING = 1.1


# Entries near the largest float32 overflow, and make the estimate infinite.
@np.errstate(over="ignore", invalid="ignore")
def estimate(matrices: Sequence[Any], grid: tuple[int, int], camera_grid: tuple[int, int]) -> Noise:
    """`Noise` of T (M, N) of 1 or 3 channels, without a further measurement.

    `matrices` are arrays, csr_arrays, rows of a store or operators (products for a sample of
    pixels). InputError for compressed ones, whose noise has no detail of its own, and for those
    whose entries cannot be read.
    """
    for T in matrices:
        _check_entries(T)
    channels = []
    origin = "estimated"
    for T in matrices:
        channel = _ChannelEstimator(T, grid, camera_grid).run()
        channels.append(channel)
        if not channel.is_known:
            origin = "unknown"
    return Noise.from_channels(channels, origin)


def _check_entries(T: Any) -> None:
    """InputError if T shows no entries with noise."""
    has_entries = isinstance(T, ARRAYS) or hasattr(T, "between")
    if underlying_system(T) is not None or not has_entries:
        raise InputError(
            "noise is None, but T is compressed, or an operator, and shows no entries with "
            "noise; give noise= (--noise) to what it was made from, which keeps it"
        )


class _ChannelEstimator:
    """Steps of the estimate for one channel T (M, N)."""

    def __init__(self, T: Any, grid: tuple[int, int], camera_grid: tuple[int, int]) -> None:
        self.T = T
        self.grid = grid
        self.camera_grid = camera_grid
        self.has_diagonal = camera_grid == grid and hasattr(T, "diagonal")
        # Operators would need N products.
        self.may_have_factors = isinstance(T, ARRAYS) or hasattr(T, "row_blocks")
        self.F = np.zeros(0)
        if self.has_diagonal:
            self.F = np.asarray(T.diagonal(), np.float64)

    def run(self) -> ChannelNoise:
        blocks = self._find_blocks()
        if blocks is None:
            rows, columns = map(np.ones, self.T.shape)
            return ChannelNoise(photons=0.0, floor=0.0, rows=rows, columns=columns, is_known=False)
        first: PictureDetail | None = None
        if self.has_diagonal and not self._has_texture():
            first = _picture_detail(self.F, self.grid, np.ones(len(self.F)))
        agreement, rows, columns = self._fit(blocks, first)
        correlation = Correlation()
        if blocks.is_smooth:
            is_noise = agreement.explains(blocks.with_factors(rows, columns))
            correlation = find_correlation(blocks, is_noise)
        q = agreement.q
        floor2 = agreement.floor2 * correlation.factor
        direct = 1.0
        if first is not None:
            direct = min(first.variance / (floor2 * (1.0 + q * first.light)), 1.0)
        neighbours = 0.0
        if correlation.is_white:
            neighbours = self._neighbours(agreement, rows, columns)
        return ChannelNoise(
            photons=q * floor2,
            floor=floor2**0.5,
            rows=rows,
            columns=columns,
            direct=direct,
            neighbours=neighbours,
            is_known=not correlation.projector > 1.0,
        )

    def _has_texture(self) -> bool:
        """True if the first bounce has detail that the picture under white has, too."""
        white = self.T @ np.ones(len(self.F), np.float32) - self.F
        side, order = PICTURE_WINDOWS[0]
        windows = Windows.from_grid(self.grid, side, order, overlap=True)
        details = [picture[windows.pixels] @ windows.detail.T for picture in (self.F, white)]
        ranks = [scipy.stats.rankdata(detail) for detail in details]
        correlation = np.corrcoef(ranks)[0, 1]
        return bool(correlation > MAX_TEXTURE_CORRELATION)

    def _find_blocks(self) -> Blocks | None:
        """Blocks of the largest windows that enough of them know, by the best kind of detail."""
        for side, order in BLOCK_WINDOWS:
            camera = Windows.from_grid(self.camera_grid, side, order)
            projector = Windows.from_grid(self.grid, side, order)
            best = None
            for blocks in BlockReader(self.T, camera, projector).kinds():
                if not blocks.are_enough(MIN_BLOCKS):
                    continue
                if best is None or _ratio(blocks, best) < BETTER_SHARE:
                    best = blocks
            if best is not None:
                return best
        return None

    def _fit(
        self, blocks: Blocks, first: PictureDetail | None
    ) -> tuple[Agreement, np.ndarray, np.ndarray]:
        """Factors of rows (M,) and columns (N,), and the agreement with them; 1 if not trusted."""
        M, N = self.T.shape
        agreement = find_agreement(blocks, first, may_have_factors=self.may_have_factors)
        none = agreement, np.ones(M), np.ones(N)
        if not self.may_have_factors:
            return none
        camera = blocks.camera
        projector = blocks.projector

        def read_rows(i: np.ndarray) -> np.ndarray:
            return read_entries(self.T, i, projector.pixels.ravel())

        def read_columns(j: np.ndarray) -> np.ndarray:
            return read_entries(self.T, camera.pixels.ravel(), j).T

        rows = find_factors(read_rows, M, projector, agreement)
        columns = find_factors(read_columns, N, camera, agreement)
        with_factors = find_agreement(blocks.with_factors(rows, columns), first)
        plain = find_agreement(blocks, first)
        if with_factors.spread > MAX_WIDENING * plain.spread:
            return none
        return with_factors, rows, columns

    def _neighbours(self, agreement: Agreement, rows: np.ndarray, columns: np.ndarray) -> float:
        """Share of neighbours that errors of a row lack, by the detail of row sums."""
        N = self.T.shape[1]
        q = agreement.q
        patterns = np.stack([np.ones(N), columns], axis=1).astype(np.float32)
        white, weighted = (self.T @ patterns).T
        # Variance of row sums of independent errors, over floor^2 and the factor of the row.
        variance = columns.sum() + q * weighted
        if self.has_diagonal:
            white = white - self.F
            variance = variance - columns * (1.0 + q * self.F)
        expected = np.maximum(agreement.floor2 * rows * variance, MIN_VARIANCE)
        shares = []
        for bound in _noise_bounds(white, self.camera_grid, expected):
            shares.append(cancellation(bound.variance, bound.scatter))
        return max(shares)


def _ratio(blocks: Blocks, best: Blocks) -> float:
    """Median of the bounds of some blocks over those of others."""
    logs = blocks.log_floors(0.0) - best.log_floors(0.0)
    is_known = blocks.is_known & best.is_known
    if np.count_nonzero(is_known) < MIN_BLOCKS:
        return 1.0
    return float(np.exp(np.median(logs[is_known])))


class NoiseBound(NamedTuple):
    """An upper bound on the variance of noise in a picture, and its relative standard deviation."""

    variance: float
    scatter: float


def _picture_detail(F: np.ndarray, grid: tuple[int, int], variance: np.ndarray) -> PictureDetail:
    """Median of a picture F (N,), and an upper bound on its noise over `variance`."""
    least = min(bound.variance for bound in _noise_bounds(F, grid, variance))
    return PictureDetail(light=max(float(np.median(F)), 0.0), variance=least)


def _noise_bounds(F: np.ndarray, grid: tuple[int, int], variance: np.ndarray) -> list[NoiseBound]:
    """Bounds on the noise of a picture F (N,) over `variance`, by windows of each kind."""
    bounds = []
    for side, order in PICTURE_WINDOWS:
        windows = Windows.from_grid(grid, side, order, overlap=True)
        expected = variance[windows.pixels].mean(axis=1)[:, None]
        squares = (F[windows.pixels] @ windows.detail.T) ** 2 / expected
        # Overlapping windows tell hardly more than those that tile the picture.
        independent = len(F) * len(windows.detail) / windows.pixels.shape[1]
        bounds.append(
            NoiseBound(
                variance=float(np.median(squares) / MEDIAN_SQUARE),
                scatter=MEDIAN_SCATTER / independent**0.5,
            )
        )
    return bounds
