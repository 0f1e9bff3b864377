# SPDX-License-Identifier: BSD-3-Clause
"""The noise on which most blocks agree.

Blocks of different mean light L agree on noise, and rarely on anything else. In the model

    v_ab ~ rows_a columns_b floor^2 (1 + q L_ab)

the dimmest blocks tell the floor, and those q are likely for which most blocks agree. Light off the
diagonal is dim and leaves a range of q, in which the detail of the first bounce decides. Factors of
windows are fitted only where many more blocks agree with them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ltcl.transport.noise.blocks import MIN_VARIANCE, Blocks

# Fewest blocks that tell a noise.
MIN_BLOCKS = 12
# q, times 1 / median light.
RATIOS = np.concatenate([[0.0], np.geomspace(1e-2, 1e4, 31)])
# Width of log v of blocks that agree, times the root of the number of their coefficients.
AGREEMENT_WIDTH = 10.0
# Share of blocks that agree: from there on, the detail of single rows is noise.
TRUSTED_SHARE = 0.7
# Part of the blocks that agree best, above which those that agree without photon noise may be all.
MAX_CHANCE_SHARE = 0.5
# Standard deviations of a count, or of a correlation, that may be chance.
CHANCE_SIGMAS = 2.0
# Passes that take medians of rows and columns out of a table (Tukey's median polish).
POLISH_PASSES = 4


@dataclass(frozen=True, kw_only=True)
class PictureDetail:
    """Median light of a picture, and an upper bound on the variance of its noise."""

    light: float
    variance: float


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """floor^2 and q on which blocks agree, the share of them that do, and the spread of all.

    The spread is the median deviation of logarithms.
    """

    floor2: float
    q: float
    share: float
    spread: float

    @property
    def is_trusted(self) -> bool:
        """True if so many blocks agree that the detail of single rows is noise, too."""
        return self.share >= TRUSTED_SHARE

    def explains(self, blocks: Blocks) -> np.ndarray:
        """True for the blocks whose variance is this noise."""
        deviation = np.abs(blocks.log_floors(self.q) - np.log(max(self.floor2, MIN_VARIANCE)))
        return deviation < agreement_width(blocks) / 2


def find_agreement(
    blocks: Blocks, first: PictureDetail | None, may_have_factors: bool = False
) -> Agreement:
    """The floor and q on which most blocks agree; `first` is the detail of the first bounce.

    Factors of windows are taken out if they may be there, and make many more blocks agree.
    """
    scan = _Scan(blocks, has_factors=False)
    if may_have_factors:
        scan_with_factors = _Scan(blocks, has_factors=True)
        factors = sum(blocks.variance.shape)
        if scan_with_factors.counts.max() > scan.counts.max() + factors:
            scan = scan_with_factors
    return scan.agreement(first)


class _Scan:
    """Numbers of blocks that agree for each q of `ratios`."""

    def __init__(self, blocks: Blocks, has_factors: bool) -> None:
        self.blocks = blocks
        self.has_factors = has_factors
        self.width = agreement_width(blocks)
        light = (blocks.light / blocks.scale)[blocks.is_known]
        dim_count = max(len(light) // 4, MIN_BLOCKS)
        self.dimmest = np.argsort(light)[:dim_count]
        self.ratios = RATIOS / max(float(np.median(light)), MIN_VARIANCE)
        self.counts = np.array([self._count(q) for q in self.ratios])

    def agreement(self, first: PictureDetail | None) -> Agreement:
        most = self.counts.max()
        total = len(self.blocks.light[self.blocks.is_known])
        likely = self.ratios[self.counts >= most - CHANCE_SIGMAS * most**0.5]
        if most < TRUSTED_SHARE * total and self.counts[0] > MAX_CHANCE_SHARE * most:
            # Light that is not smooth may look like photon noise.
            likely[0] = 0.0
        lowest = likely[0]
        highest = likely[-1]
        # 0 if light may make no difference.
        q = float(np.sqrt(lowest * highest))
        if first is not None:
            direct_q = (first.variance / self._floor2(q) - 1.0) / max(first.light, MIN_VARIANCE)
            if direct_q <= 2.0 * highest:
                q = float(np.clip(direct_q, lowest, highest))
        floor2 = self._floor2(q)
        deviation = np.abs(self._log_floors(q) - np.log(floor2))
        spread = float(np.median(deviation))
        return Agreement(floor2=floor2, q=q, share=most / total, spread=spread)

    def _count(self, q: float) -> int:
        """Number of blocks that agree with the dimmest ones on the floor."""
        logs = self._log_floors(q)
        floor = _densest(logs[self.dimmest], self.width)
        return int(np.count_nonzero(np.abs(logs - floor) < self.width / 2))

    def _floor2(self, q: float) -> float:
        return float(np.exp(_densest(self._log_floors(q)[self.dimmest], self.width)))

    def _log_floors(self, q: float) -> np.ndarray:
        """log of v / (1 + q L) of the known blocks, over factors of their windows."""
        logs = self.blocks.log_floors(q)
        if self.has_factors:
            logs = _polish(logs)
        return logs[self.blocks.is_known]


def agreement_width(blocks: Blocks) -> float:
    """Width of log v of blocks that agree."""
    return AGREEMENT_WIDTH / blocks.coefficients**0.5


def _polish(table: np.ndarray) -> np.ndarray:
    """`table` without the medians of its rows and columns (Tukey's median polish); NaN stays."""
    rows = np.zeros((len(table), 1))
    columns = np.zeros(table.shape[1])
    with warnings.catch_warnings():
        # Rows without a known block have the median NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(POLISH_PASSES):
            rows = np.nanmedian(table - columns, axis=1, keepdims=True)
            columns = np.nanmedian(table - rows, axis=0)
    return table - (rows - np.nanmean(rows)) - (columns - np.nanmean(columns))


def _densest(logs: np.ndarray, width: float) -> float:
    """The value around which most `logs` lie within `width`: their median."""
    u = np.sort(logs)
    counts = np.searchsorted(u, u + width, side="right") - np.arange(len(u))
    start = int(counts.argmax())
    return float(np.median(u[start : start + counts[start]]))
