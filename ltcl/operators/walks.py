# SPDX-License-Identifier: BSD-3-Clause
"""Random walks over the rows of R, by `kernels/walk.cl`: estimates of sums of powers times a vector.

    y_i = sum over k = 1 .. of c_k (R^k b)_i      (eq. 22 and 23 without the term of k = 0)

Sample s of pixel i has random numbers of its own, which the seed, i and s determine alone. So results are the
same to the bit for any work-group size, device or split of the samples into launches, and a pixel costs the
same and gets the same estimate whether others are asked for or not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ltcl.device import Array, Device
from ltcl.operators.alias import SAMPLERS, Tables
from ltcl.operators.base import widths

ESTIMATORS = {"endpoint": 0, "collision": 1}  # the ESTIMATOR of kernels/walk.cl
CHUNK = 64  # samples that are summed on the device
_CERTAIN = 1 << 22  # chances to go on, of as many
_NEVER = 64  # walks of a length whose chance is below 2^-64 are cut: nobody will see one
_UNITS = 1 << 18  # chunks of one launch at most
_RECORDS = 1 << 22  # samples of one launch of the adjoint at most
_STEPS = 1 << 23  # steps of one launch for each compute unit, in the mean: half a second
_ALIKE = 2.0**-20  # spread over sum of squares, which float32 rounds


@dataclass(frozen=True)
class Lengths:
    """How long walks are, and what they estimate.

    Attributes
    ----------
    coefficients : (L,) float64
        c_1 .. c_L.
    chances : (L,) uint32
        After step k a walk goes on with chance ``chances[k - 1] / 2^22``; the last is 0.
    """

    coefficients: np.ndarray
    chances: np.ndarray

    def steps(self, estimator: str) -> np.ndarray:
        """The steps of `kernels/walk.cl`, (L, 2) uint32: c_k by the chance to be scored, chance to go on."""
        _, worth = self.scores(estimator)
        return np.stack([worth.astype(np.float32).view(np.uint32), self.chances], axis=1)

    def scores(self, estimator: str) -> tuple[np.ndarray, np.ndarray]:
        """Of each step the chance to be scored, and c_k by it, 0 where that is never; (L,) float64."""
        going = self.chances / _CERTAIN
        scored = np.concatenate([[1.0], np.cumprod(going[:-1])])
        if estimator == "endpoint":
            scored = scored * (1.0 - going)
        return scored, np.divide(self.coefficients, scored, out=np.zeros_like(scored), where=scored > 0.0)

    @property
    def are_one(self) -> bool:
        """Whether all walks are of the same length."""
        return bool(np.all(self.chances[:-1] == _CERTAIN))

    @property
    def mean(self) -> float:
        """Steps of a walk in the mean, where no row is empty."""
        return 1.0 + float(np.sum(np.cumprod(self.chances[:-1] / _CERTAIN)))

    def after_start(self) -> Lengths:
        """The same for walks whose first step goes from the row of b to where they start."""
        return Lengths(np.append(0.0, self.coefficients), np.append(np.uint32(_CERTAIN), self.chances))


def geometric(q: float, sign: float) -> Lengths:
    """Lengths of the series sum of sign^k R^k: p(k) = (1 - q) q^(k-1), which is eq. 24 with q = m / (1 - m).

    >>> lengths = geometric(0.5, -1.0)
    >>> lengths.coefficients[:3].tolist(), (lengths.chances[:3] / 2**22).tolist()
    ([-1.0, 1.0, -1.0], [0.5, 0.5, 0.5])
    """
    chance = max(1, round(q * _CERTAIN))  # never 0, which would leave terms out
    count = 1 + int(np.ceil(_NEVER / -np.log2(chance / _CERTAIN)))
    chances = np.full(count, chance, np.uint32)
    chances[-1] = 0
    return Lengths(sign ** np.arange(1, count + 1), chances)


def whole(coefficients: np.ndarray) -> Lengths:
    """Lengths of a polynomial in R, all walks as long as its degree; c_1 .. c_L."""
    chances = np.full(len(coefficients), _CERTAIN, np.uint32)
    chances[-1] = 0
    return Lengths(np.asarray(coefficients, np.float64), chances)


@dataclass(frozen=True)
class Sums:
    """Of `samples` samples of each pixel: their sum and that of their squares, (P,) or (P, k) float64.

    `fourths` sums the squares of what each chunk of `CHUNK` samples adds to `squares`.
    """

    samples: int
    total: np.ndarray
    squares: np.ndarray
    fourths: np.ndarray | None = None

    @property
    def mean(self) -> np.ndarray:
        """The estimate."""
        return self.total / self.samples

    @property
    def standard_error(self) -> np.ndarray:
        """Of the mean; infinite of a single sample, which tells nothing about it."""
        if self.samples < 2:
            return np.full_like(self.total, np.inf)
        return np.sqrt(self._spread() / (self.samples * (self.samples - 1.0)))

    @property
    def alike(self) -> np.ndarray:
        """Where all samples scored the same up to rounding: they do not tell how others would differ."""
        return self._spread() <= _ALIKE * self.squares

    @property
    def doubt(self) -> np.ndarray:
        """Relative standard error of `squares`, by how chunks differ; infinite where that cannot be told.

        Where few samples carry the squares it is near 1, and the standard error of the mean worth little.
        """
        chunks = -(-self.samples // CHUNK)
        if self.fourths is None or chunks < 2:
            return np.full_like(self.total, np.inf)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            share = self.fourths / self.squares**2  # 1 over the chunks that carry them
            return np.nan_to_num(np.sqrt(np.maximum(chunks * share - 1.0, 0.0) / (chunks - 1.0)), nan=np.inf)

    def _spread(self) -> np.ndarray:
        with np.errstate(invalid="ignore", over="ignore"):
            spread = np.maximum(self.squares - self.total**2 / self.samples, 0.0)
        return np.where(np.isnan(spread), np.inf, spread)  # of scores whose squares are beyond float32


@dataclass(frozen=True)
class Launching:
    """How work is spread over a device: `walks` at a time in a work-item. It changes no result."""

    walks: int
    group: int

    @classmethod
    def best(cls, device: Device, units: int) -> Launching:
        """Many walks an item where few items run, so that their loads do not wait for each other."""
        if not device.is_cpu:
            return cls(1, 64)
        return cls(32 if units >= 128 * device.compute_units else 4, 1)


@dataclass(frozen=True)
class Walker:
    """Walks over the rows of a matrix.

    Parameters
    ----------
    tables : Tables
    lengths : Lengths
    estimator : str
        "endpoint", the paper's: a walk scores where it ends (eq. 26). "collision": it scores at every step.
    seed : int
        Below 2^64.
    launching : Launching, optional
    watch : callable, optional
        Called after each launch.
    """

    tables: Tables
    lengths: Lengths
    estimator: str
    seed: int
    launching: Launching | None = None
    watch: Callable[[], object] = lambda: None

    def rows(self, b: Array, pixels: np.ndarray, first: int, samples: int, stream: int = 0) -> Sums:
        """Samples first .. first + samples of each pixel.

        Parameters
        ----------
        b : Array, (N,) or (N, k)
            All right-hand sides share the walks. Of walks with three weights column j is of channel j % 3,
            and there are as many of each.
        pixels : (P,) integers
        first, samples : int
            Below 2^32 together.
        stream : int
            Samples of another stream are independent of these.
        """
        steps = self.tables.device.upload(self.lengths.steps(self.estimator), np.uint32)
        shape = (len(pixels), b.columns)
        total, squares, fourths = np.zeros((3, *shape))
        units = max(1, min(_UNITS, self._walks() // CHUNK))
        for some in _pieces(len(pixels), max(1, units // -(-samples // CHUNK))):
            place = self.tables.device.upload(pixels[some], np.uint32)
            for part in _pieces(samples, max(CHUNK, units * CHUNK // place.size)):
                bounds = (first + part.start, first + part.stop)
                for offset, width in self._widths(b):
                    found = self._row_sums(b, place, bounds, stream, steps, offset, width)
                    here = (some, slice(offset, offset + width))
                    total[here] = _added(total[here], found[..., 0], found[..., 1])
                    squares[here] = _added(squares[here], found[..., 2], found[..., 3])
                    fourths[here] = _added(fourths[here], _squared(found[..., 2:].sum(axis=-1)), 0.0)
                    self.watch()
        shape = (len(pixels), *b.shape[1:])
        return Sums(samples, *(found.reshape(shape) for found in (total, squares, fourths)))

    def _widths(self, b: Array) -> list[tuple[int, int]]:
        """Launches of as many right-hand sides of each channel: (offset, width) pairs."""
        channels = self.tables.channels
        return [(channels * offset, channels * width) for offset, width in widths(b.columns // channels)]

    def _row_sums(
        self,
        b: Array,
        pixels: Array,
        bounds: tuple[int, int],
        stream: int,
        steps: Array,
        offset: int,
        width: int,
    ) -> np.ndarray:
        """Sums of each chunk with what rounding took, and of the squares, (pixels, chunks, width, 4)."""
        first, end = bounds
        chunks = -(-(end - first) // CHUNK)
        out = b.device.empty((pixels.size * chunks, width, 4))
        tables = (self.tables.records, self.tables.entries, self.tables.links, steps)
        place = (out.shape[0], chunks, first, end, self.seed, stream, b.columns, offset)
        self._launch("walk_rows", self.estimator, width, *place, pixels, *tables, b, out)
        return out.get().reshape(pixels.size, chunks, width, 4)

    def columns(self, first: int, samples: int, stream: int = 0) -> Sums:
        """Samples first .. first + samples of walks from b, by `tables_of_columns`, which b was appended to.

        The sums are those of every pixel, (N,). A sample adds to one of them; it counts as 0 to the others.
        """
        device, n = self.tables.device, self.tables.shape[0]
        steps = device.upload(self.lengths.after_start().steps("endpoint"), np.uint32)
        total, squares = np.zeros(n), np.zeros(n)
        source = device.upload(np.array([n]), np.uint32)
        for part in _pieces(samples, max(1, min(_RECORDS, self._walks()))):
            count = part.stop - part.start
            ends, scores = device.empty((count,), np.uint32), device.empty((count,))
            tables = (source, self.tables.records, self.tables.entries, steps)
            place = (-(-count // CHUNK), first + part.start, first + part.stop, self.seed, stream)
            self._launch("walk_columns", "endpoint", 1, *place, *tables, ends, scores)
            score = scores.get().astype(np.float64)
            where = np.where(score == 0.0, 0, ends.get())  # a walk that died may stand in the row of b
            total += np.bincount(where, score, n)
            squares += np.bincount(where, score**2, n)
            self.watch()
        return Sums(samples, total, squares)

    def _walks(self) -> int:
        """Of one launch, so that none takes long: whoever waits wants to hear that there is progress."""
        return int(_STEPS * self.tables.device.compute_units / self.lengths.mean)

    def _launch(self, name: str, estimator: str, width: int, units: int, *arguments: object) -> None:
        how = self.launching or Launching.best(self.tables.device, units)
        kernel = self.tables.device.kernel(
            "walk",
            name,
            TABLE=SAMPLERS[self.tables.sampler],
            ESTIMATOR=ESTIMATORS[estimator],
            CHANNELS=self.tables.channels,
            CHUNK=CHUNK,
            WALKS=how.walks,
            K=width,
        )
        kernel(-(-units // how.walks), how.group, units, *arguments)


def _squared(sums: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return sums.astype(np.float64) ** 2


def _added(start: np.ndarray, sums: np.ndarray, low: np.ndarray | float) -> np.ndarray:
    """start + all chunks, (pixels, chunks, width), one after the other, so that no split changes a bit."""
    parts = sums.astype(np.float64) + low
    return np.add.accumulate(np.concatenate([start[:, None], parts], axis=1), axis=1)[:, -1]


def _pieces(count: int, size: int) -> Iterator[slice]:
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
