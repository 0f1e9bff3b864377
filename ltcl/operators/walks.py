# SPDX-License-Identifier: BSD-3-Clause
"""Random walks over the rows of R: sums of powers of R times a vector (`kernels/walk.cl`).

    y_i = sum over k = 1 .. of c_k (R^k b)_i      (eq. 22 and 23 without the term of k = 0)

Steps are drawn from the alias tables of `ltcl.operators.walk_tables`. Results are the same to the
bit on every device, however launches are split, whatever pixels are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ltcl.device import Array
from ltcl.device.kernels import Kernel
from ltcl.operators.epilogue import widths
from ltcl.operators.walk_tables import (
    CHUNK,
    Linked,
    Tables,
    cached,
    linked,
    rows_of_R,
    squares,
    tables,
    tables_of_columns,
    walk_group,
)

__all__ = [
    "CHUNK",
    "Lengths",
    "Linked",
    "Sums",
    "Tables",
    "Walker",
    "cached",
    "linked",
    "rows_of_R",
    "squares",
    "tables",
    "tables_of_columns",
]

# Chances to go on are multiples of 1 / CERTAIN.
CERTAIN = 1 << 22
# Walks of a length whose chance is below 2^-64 are cut: nobody will see one.
NEVER_BITS = 64
# Chunks of one launch at most.
MAX_LAUNCH_CHUNKS = 1 << 18
# Samples of one launch of the adjoint at most.
MAX_LAUNCH_SAMPLES = 1 << 22
# Mean steps of one launch for each compute unit: half a second, between two reports of progress.
LAUNCH_STEPS_PER_UNIT = 1 << 23


@dataclass(frozen=True)
class Lengths:
    """The lengths of walks: coefficients c_1 .. c_L, (L,) float64, and the chance of one more step.

    Walks score at every step. Walks `from_b` have a step before, from the row of b to their start;
    they score at their end (eq. 26), one record a walk.
    """

    coefficients: np.ndarray
    go_on: float = 1.0
    from_b: bool = False

    @classmethod
    def geometric(cls, q: float, sign: float, from_b: bool = False) -> Lengths:
        """Lengths for the series sum of sign^k R^k: p(k) = (1 - q) q^(k-1).

        This is eq. 24 with q = m / (1 - m).
        """
        # Never 0, which would leave terms out.
        q = max(1, round(q * CERTAIN)) / CERTAIN
        longest = 1 + int(np.ceil(NEVER_BITS / -np.log2(q)))
        return cls(sign ** np.arange(1, longest + 1), q, from_b)

    def scores(self) -> tuple[np.ndarray, np.ndarray]:
        """The factor of each step's score, c_k over its chance, and the chance to go on, (L,)."""
        chances = np.full(len(self.coefficients), self.go_on)
        # The table of steps ends here.
        chances[-1] = 0.0
        scored = np.cumprod(np.append(1.0, chances[:-1]))
        if self.from_b:
            scored = scored * (1.0 - chances)
        factors = np.zeros_like(scored)
        np.divide(self.coefficients, scored, out=factors, where=scored > 0.0)
        return factors, chances

    def steps(self) -> np.ndarray:
        """The steps of `kernels/walk.cl`, (L, 2) or (L + 1, 2) uint32."""
        factors, chances = self.scores()
        if self.from_b:
            factors = np.append(0.0, factors)
            chances = np.append(1.0, chances)
        factor_bits = factors.astype(np.float32).view(np.uint32)
        chance_numbers = np.round(chances * CERTAIN).astype(np.uint32)
        return np.stack([factor_bits, chance_numbers], axis=1)


@dataclass(frozen=True)
class Sums:
    """Sums over `samples` samples of each pixel, and of their squares, (P,) or (P, k) float64."""

    samples: int
    total: np.ndarray
    squares: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """The estimate."""
        return self.total / self.samples

    @property
    def standard_error(self) -> np.ndarray:
        """Standard error of the mean, by the spread of samples; infinite for a single one."""
        if self.samples < 2:
            return np.full_like(self.total, np.inf)
        # Squares of some scores are beyond float32.
        with np.errstate(invalid="ignore", over="ignore"):
            spread = np.maximum(self.squares - self.total**2 / self.samples, 0.0)
        finite = np.nan_to_num(spread, nan=np.inf)
        return np.sqrt(finite / (self.samples * (self.samples - 1.0)))


def _nothing() -> None:
    """The default of `Walker.watch`."""


@dataclass(frozen=True)
class Walker:
    """Walks over the rows of a matrix; `watch` is called after each launch."""

    tables: Tables
    lengths: Lengths
    seed: int
    watch: Callable[[], object] = _nothing

    def rows(self, b: Array, pixels: np.ndarray, samples: int, stream: int = 0) -> Sums:
        """Sums over `samples` samples of each of the `pixels`, (P,).

        Samples of another `stream` are independent. All right-hand sides b, (N,) or (N, k), share
        the walks; with three channels column j belongs to channel j % 3.
        """
        steps = self.tables.device.upload(self.lengths.steps(), np.uint32)
        sums = np.zeros((len(pixels), b.columns, 2))
        chunks = -(-samples // CHUNK)
        launch_chunks = max(1, min(MAX_LAUNCH_CHUNKS, self._launch_walks() // CHUNK))
        for chunk_pixels in _slices(len(pixels), max(1, launch_chunks // chunks)):
            chosen = self.tables.device.upload(pixels[chunk_pixels], np.uint32)
            for chunk_range in _slices(chunks, max(1, launch_chunks // chosen.size)):
                for offset, width in widths(b.columns // self.tables.channels):
                    columns = slice(
                        self.tables.channels * offset, self.tables.channels * (offset + width)
                    )
                    partial = self._walk_rows(
                        b, chosen, steps, samples, chunk_range, columns, stream
                    )
                    # One chunk after the other, so that no split changes a bit.
                    terms = np.concatenate([sums[chunk_pixels, None, columns], partial], axis=1)
                    sums[chunk_pixels, columns] = np.add.accumulate(terms, axis=1)[:, -1]
                    self.watch()
        both = np.moveaxis(sums, -1, 0).reshape(2, len(pixels), *b.shape[1:])
        return Sums(samples, both[0], both[1])

    def _walk_rows(
        self,
        b: Array,
        pixels: Array,
        steps: Array,
        samples: int,
        chunk_range: slice,
        columns: slice,
        stream: int,
    ) -> np.ndarray:
        """Sums of scores and of squares by one launch, (pixels, chunks, columns, 2) float64."""
        tables = self.tables
        count = chunk_range.stop - chunk_range.start
        width = columns.stop - columns.start
        units = pixels.size * count
        out = tables.device.empty((units, width, 2))
        walks = self._walks_per_item(units)
        kernel = self._kernel("walk_rows", width, walks)
        kernel(
            -(-units // walks),
            walk_group(tables.device),
            units=units,
            chunks=count,
            first=CHUNK * chunk_range.start,
            end=min(CHUNK * chunk_range.stop, samples),
            seed=self.seed,
            stream=stream,
            stride=b.columns,
            offset=columns.start,
            pixels=pixels,
            rows=tables.records,
            entries=tables.entries,
            links=tables.links,
            steps=steps,
            b=b,
            out=out,
        )
        return out.get().reshape(pixels.size, count, width, 2).astype(np.float64)

    def columns(self, samples: int, stream: int = 0) -> Sums:
        """Sums of every pixel, (N,), by walks from b.

        The lengths are `from_b`, and b was appended to `tables_of_columns`.
        """
        n = self.tables.shape[0]
        steps = self.tables.device.upload(self.lengths.steps(), np.uint32)
        source = self.tables.device.upload(np.array([n]), np.uint32)
        total = np.zeros(n)
        squares = np.zeros(n)
        for launch in _slices(samples, max(1, min(MAX_LAUNCH_SAMPLES, self._launch_walks()))):
            ends, scores = self._walk_columns(source, steps, launch, stream)
            # A walk that died may stand in the row of b.
            pixels = np.where(scores == 0.0, 0, ends)
            total += np.bincount(pixels, scores, n)
            squares += np.bincount(pixels, scores**2, n)
            self.watch()
        return Sums(samples, total, squares)

    def _walk_columns(
        self, source: Array, steps: Array, samples: slice, stream: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The pixels where the walks of one launch end, and their scores in float64."""
        tables = self.tables
        count = samples.stop - samples.start
        ends = tables.device.empty((count,), np.uint32)
        scores = tables.device.empty((count,))
        units = -(-count // CHUNK)
        walks = self._walks_per_item(units)
        kernel = self._kernel("walk_columns", 1, walks)
        kernel(
            -(-units // walks),
            walk_group(tables.device),
            units=units,
            first=samples.start,
            end=samples.stop,
            seed=self.seed,
            stream=stream,
            pixel=source,
            rows=tables.records,
            entries=tables.entries,
            steps=steps,
            ends=ends,
            scores=scores,
        )
        scores_read = scores.get().astype(np.float64)
        return ends.get(), scores_read

    def _launch_walks(self) -> int:
        """Walks of one launch that take `LAUNCH_STEPS_PER_UNIT` steps for each compute unit."""
        lengths = np.arange(len(self.lengths.coefficients))
        mean_steps = np.sum(self.lengths.go_on**lengths)
        return int(LAUNCH_STEPS_PER_UNIT * self.tables.device.compute_units / mean_steps)

    def _walks_per_item(self, units: int) -> int:
        """Many walks an item if few items run, so that their loads do not wait for each other."""
        device = self.tables.device
        # The simulator does not know the prefetch of several walks.
        if device.kind == "simulator" or not device.is_cpu:
            return 1
        return 32 if units >= 128 * device.compute_units else 4

    def _kernel(self, name: str, width: int, walks: int) -> Kernel:
        tables = self.tables
        defines = {
            "CHANNELS": tables.channels,
            "CHUNK": CHUNK,
            "WALKS": walks,
            "K": width,
            "LINKED": int(tables.links is not None),
        }
        return tables.device.kernel("walk", name, **defines)


def _slices(count: int, size: int) -> Iterator[slice]:
    """Consecutive slices of `size` of a range."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
