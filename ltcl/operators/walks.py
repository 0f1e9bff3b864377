# SPDX-License-Identifier: BSD-3-Clause
"""Alias tables of the rows of R, and random walks over them: sums of powers of R times a vector.

    y_i = sum over k = 1 .. of c_k (R^k b)_i      (eq. 22 and 23 without the term of k = 0)

A step goes from i to j with chance p(j | i) = |R_ij| / |R_i|, |R_i| = sum_j |R_ij| (eq. 25), by alias tables
that `kernels/walk.cl` builds. `Linked` tables step by other chances p and multiply the weight by
R_ij / p(j | i), from a second load. So channels share a walk; of all p

    p(j | i) = P_ij / |P_i|,  P_ij^2 = mean over channels c of (R_cij / |R_ci|)^2

has the least sum of the second moments of a step, each in units of those that the channel has by
itself. Results are the same to the bit on every device, however launches are split, whatever pixels
are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import InputError
from ltcl.operators.base import Operator, widths
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.relaxation import host, readable

CHUNK = 64  # samples that are summed on the device
_COLUMNS = 1 << 22  # that an entry of 64 bits can tell apart
_PLAIN = {"CHANNELS": 1, "CHUNK": CHUNK, "WALKS": 1, "K": 1, "LINKED": 0}
_HOST_BYTES = 64  # an entry, while linked tables are made
_CERTAIN = 1 << 22  # chances to go on, of as many
_NEVER = 64  # walks of a length whose chance is below 2^-64 are cut: nobody will see one
_UNITS = 1 << 18  # chunks of one launch at most
_RECORDS = 1 << 22  # samples of one launch of the adjoint at most
_STEPS = (
    1 << 23
)  # mean steps of one launch for each compute unit: half a second, for who waits for progress


class Tables:
    """What walks over the rows of M need (`kernels/walk.cl`); with `spare` entries, of M^T and a row more."""

    channels = 1
    links: Array | None = None

    def __init__(self, M: CSR | Dense, spare: int = 0) -> None:
        self.device, self.shape, self.transposed = M.device, M.shape, spare > 0
        self.moments: dict[str, Any] = {}  # of these walks, by `ltcl.theory.walks`
        rows, columns = M.shape
        if columns > _COLUMNS:
            raise InputError(f"R has {columns} columns; walks take at most {_COLUMNS}")
        self._used = _count(M)
        self.device.require(
            8 * (self._used + spare), f"tables of the {self._used + spare} entries of R"
        )
        self.records = self.device.empty((rows + (spare > 0), 4), np.uint32)
        self.entries = self.device.empty((self._used + spare,), np.uint64)
        for slab in M.slabs:
            if isinstance(M, CSR):
                place, arrays = (int(M.pattern.indptr[slab.first]), 0), slab.arguments
            else:
                place, arrays = (slab.first * columns, columns), (None, None, slab.arguments[1])
            self._build(slab.rows, slab.first, *place, *arrays)
        self._refuse_overflow("R", slice(rows))

    def sums(self) -> np.ndarray:
        """|M_i| of each row, (rows,) float32."""
        return np.ascontiguousarray(self.records.get()[:, 3]).view(np.float32)

    def append(self, values: Array) -> None:
        """Build the one row behind those of M from `values`, dense, (columns,)."""
        self._build(1, self.shape[0], self._used, values.shape[0], None, None, values)
        self._refuse_overflow("b", slice(self.shape[0], None))

    def second_moments(self, R: CSR | Dense) -> list[Operator]:
        """Of each channel what a step makes of the second moments of weights: R_ij^2 / p(j | i), (N, N)."""
        rows = host(R).T if self.transposed else host(R)
        sums = scipy.sparse.diags_array(self.sums()[: self.shape[0]].astype(np.float64))
        return [_like(R, sums @ abs(rows))]

    def _build(self, *arguments: Any) -> None:
        kernel = self.device.kernel("walk", "walk_tables", **_PLAIN)
        kernel(
            arguments[0], 1 if self.device.is_cpu else 64, *arguments, self.records, self.entries
        )

    def _refuse_overflow(self, name: str, rows: slice) -> None:
        beyond = np.flatnonzero(~np.isfinite(self.sums()[rows]))
        if beyond.size:
            raise InputError(
                f"the absolute values of {beyond.size} row(s) of {name}, first of row {beyond[0]}, sum to "
                f"more than float32 holds, {np.finfo(np.float32).max:.3g}; rescale"
            )


class Linked(Tables):
    """What a walk over three matrices needs, by chances of its own; 24 bytes an entry of any channel.

    `links`, (entries, 4) uint32, hold the column of each entry and the bits of the factors R_cij / p(j | i).
    """

    def __init__(self, Rs: Sequence[CSR | Dense], signs: Sequence[float]) -> None:
        device = Rs[0].device
        checks.fits_host("tables of walks that channels share", _HOST_BYTES * max(map(_count, Rs)))
        channels: list[Any] = [scipy.sparse.csr_array(host(R)).astype(np.float64) for R in Rs]
        squares: Any = 0
        for R in channels:
            R.eliminate_zeros()
            sums = abs(R).sum(axis=1)
            share = scipy.sparse.diags_array(1.0 / np.where(sums > 0.0, sums, 1.0)) @ R
            squares = squares + share * share
        P: Any = scipy.sparse.csr_array(squares)
        device.require(16 * P.nnz, f"links of the {P.nnz} entries of R")
        row = np.repeat(np.arange(P.shape[0], dtype=np.int32), np.diff(P.indptr))
        values = np.sqrt(P.data / len(Rs))
        places = np.arange(P.nnz) - P.indptr[row]
        super().__init__(
            CSR(device, scipy.sparse.csr_array((values, places, P.indptr), shape=P.shape))
        )
        self._others = tuple(Rs[1:])  # kept alive, since their ids find these tables
        self.channels, self._pattern = len(Rs), (P.indices, P.indptr)
        self._chances = values.astype(np.float32) / self.sums()[row].astype(np.float64)
        links = np.zeros((P.nnz, 4), np.uint32)
        links[:, 0] = P.indices
        numbers = scipy.sparse.csr_array(
            (np.arange(1, P.nnz + 1), P.indices, P.indptr), shape=P.shape
        )
        for c, (sign, R) in enumerate(zip(signs, channels, strict=True)):
            here = (numbers * (R != 0)).data - 1  # the entries of this channel among all
            chances, factors = self._chances[here], np.zeros(R.nnz)
            np.divide(sign * R.data, chances, out=factors, where=chances > 0.0)
            with np.errstate(over="ignore"):  # then second moments overflow, too, and are refused
                links[here, 1 + c] = factors.astype(np.float32).view(np.uint32)
        self.links = device.upload(links, np.uint32)

    def second_moments(self, R: CSR | Dense) -> list[Operator]:
        """Of each channel R_ij^2 / p(j | i), (N, N); R is not looked at."""
        assert self.links is not None  # noqa: S101 - made with the tables
        factors = np.ascontiguousarray(self.links.get().T[1 : 1 + self.channels]).view(np.float32)
        Qs = (self._chances * factor.astype(np.float64) ** 2 for factor in factors)
        return [
            CSR(self.device, scipy.sparse.csr_array((Q, *self._pattern), shape=self.shape))
            for Q in Qs
        ]


def tables(M: CSR | Dense) -> Tables:
    """The alias tables of M, made at the first call and kept with it."""
    return cached(M, "alias", lambda: Tables(M))


def tables_of_columns(M: CSR | Dense) -> Tables:
    """Alias tables of M^T, with room for one more row of as many entries as M has rows; kept with M."""
    return cached(M, "columns", lambda: Tables(_like(M, host(M).T), spare=M.shape[0]))


def linked(Rs: Sequence[CSR | Dense], signs: Sequence[float]) -> Linked:
    """The tables of walks over sign R of three (N, N), made at the first call, kept with the first."""
    key = f"linked {tuple(signs)} {[id(R) for R in Rs]}"
    return cached(Rs[0], key, lambda: Linked(Rs, signs))


def squares(M: CSR | Dense) -> CSR | Dense:
    """M_ij^2, which carry variances; made at the first call and kept with M, as much memory again."""
    return cached(M, "squares", lambda: _like(M, host(M) * host(M)))


def rows_of_R(S: Operator, method: str) -> tuple[CSR | Dense, float]:
    """R with rows to read, and the sign in S = I + sign R; of an S that is stored whole R is kept with it.

    An S that does not give its rows is refused with an InputError that names `method`.
    """
    rows = readable(S, method)
    M = rows.M
    if rows.shift == 1.0:
        return M, rows.scale
    return cached(M, "R", lambda: _like(M, host(M) - scipy.sparse.eye_array(M.shape[0]))), 1.0


def cached(M: CSR | Dense, key: str, make: Callable[[], Any]) -> Any:
    """What `make` makes of M, at the first call with this key."""
    if key not in M.tables:
        M.tables[key] = make()
    return M.tables[key]


def _count(M: CSR | Dense) -> int:
    return M.nnz if isinstance(M, CSR) else M.shape[0] * M.shape[1]


def _like(M: CSR | Dense, host: Any) -> CSR | Dense:
    """A matrix on the device of M, in its format."""
    return CSR(M.device, host, M.pattern) if isinstance(M, CSR) else Dense(M.device, host)


@dataclass(frozen=True)
class Lengths:
    """How long walks are: coefficients c_1 .. c_L, (L,) float64, and the chance `go_on` of one more step.

    Walks score at every step; those `from_b`, which have a step before, from the row of b to where
    they start, score where they end (eq. 26), one record a walk.
    """

    coefficients: np.ndarray
    go_on: float = 1.0
    from_b: bool = False

    @classmethod
    def geometric(cls, q: float, sign: float, from_b: bool = False) -> Lengths:
        """Of the series sum of sign^k R^k: p(k) = (1 - q) q^(k-1), which is eq. 24 with q = m / (1 - m)."""
        q = max(1, round(q * _CERTAIN)) / _CERTAIN  # never 0, which would leave terms out
        return cls(sign ** np.arange(1, 2 + int(np.ceil(_NEVER / -np.log2(q)))), q, from_b)

    def scores(self) -> tuple[np.ndarray, np.ndarray]:
        """Of each step (L,) what a score is multiplied by, c_k over its chance, and the chance to go on."""
        chances = np.full(len(self.coefficients), self.go_on)
        chances[-1] = 0.0  # the table of steps ends here
        scored = np.cumprod(np.append(1.0, chances[:-1]))
        if self.from_b:
            scored = scored * (1.0 - chances)
        return np.divide(
            self.coefficients, scored, out=np.zeros_like(scored), where=scored > 0.0
        ), chances

    def steps(self) -> np.ndarray:
        """The steps of `kernels/walk.cl`, (L, 2) or (L + 1, 2) uint32."""
        worth, chances = self.scores()
        if self.from_b:
            worth, chances = np.append(0.0, worth), np.append(1.0, chances)
        bits = worth.astype(np.float32).view(np.uint32)
        return np.stack([bits, np.round(chances * _CERTAIN).astype(np.uint32)], axis=1)


@dataclass(frozen=True)
class Sums:
    """Of `samples` samples of each pixel: their sum and that of their squares, (P,) or (P, k) float64."""

    samples: int
    total: np.ndarray
    squares: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """The estimate."""
        return self.total / self.samples

    @property
    def standard_error(self) -> np.ndarray:
        """Of the mean, by the spread of samples; infinite of a single one, which tells nothing about it."""
        if self.samples < 2:
            return np.full_like(self.total, np.inf)
        with np.errstate(
            invalid="ignore", over="ignore"
        ):  # of scores whose squares are beyond float32
            spread = np.maximum(self.squares - self.total**2 / self.samples, 0.0)
        return np.sqrt(np.nan_to_num(spread, nan=np.inf) / (self.samples * (self.samples - 1.0)))


@dataclass(frozen=True)
class Walker:
    """Walks over the rows of a matrix; `watch` is called after each launch."""

    tables: Tables
    lengths: Lengths
    seed: int
    watch: Callable[[], object] = lambda: None

    def rows(self, b: Array, pixels: np.ndarray, samples: int, stream: int = 0) -> Sums:
        """`samples` samples of each of the `pixels`, (P,); those of another stream are independent of them.

        All right-hand sides b, (N,) or (N, k), share the walks; of three channels column j is of j
        % 3.
        """
        tables, device, channels = self.tables, self.tables.device, self.tables.channels
        steps = device.upload(self.lengths.steps(), np.uint32)
        sums = np.zeros((len(pixels), b.columns, 2))
        chunks, units = -(-samples // CHUNK), max(1, min(_UNITS, self._walks() // CHUNK))
        for some in _pieces(len(pixels), max(1, units // chunks)):
            place = device.upload(pixels[some], np.uint32)
            for piece in _pieces(chunks, max(1, units // place.size)):
                count = piece.stop - piece.start
                bounds = count, CHUNK * piece.start, min(CHUNK * piece.stop, samples)
                for offset, width in widths(b.columns // channels):
                    here = slice(channels * offset, channels * (offset + width))
                    out = device.empty((place.size * count, channels * width, 2))
                    numbers = (*bounds, self.seed, stream, b.columns, here.start)
                    arrays = (place, tables.records, tables.entries, tables.links, steps, b, out)
                    self._launch(
                        "walk_rows", place.size * count, channels * width, *numbers, *arrays
                    )
                    partial = out.get().reshape(place.size, count, -1, 2).astype(np.float64)
                    # One chunk after the other, so that no split changes a bit.
                    partial = np.concatenate([sums[some, None, here], partial], axis=1)
                    sums[some, here] = np.add.accumulate(partial, axis=1)[:, -1]
                    self.watch()
        total, squares = np.moveaxis(sums, -1, 0).reshape(2, len(pixels), *b.shape[1:])
        return Sums(samples, total, squares)

    def columns(self, samples: int, stream: int = 0) -> Sums:
        """Sums of every pixel, (N,), of walks from b, which was appended to `tables_of_columns`, `from_b`."""
        tables, device, n = self.tables, self.tables.device, self.tables.shape[0]
        steps = device.upload(self.lengths.steps(), np.uint32)
        total, squares = np.zeros((2, n))
        source = device.upload(np.array([n]), np.uint32)
        for piece in _pieces(samples, max(1, min(_RECORDS, self._walks()))):
            count = piece.stop - piece.start
            ends, scores = device.empty((count,), np.uint32), device.empty((count,))
            numbers = (piece.start, piece.stop, self.seed, stream)
            arrays = (source, tables.records, tables.entries, steps, ends, scores)
            self._launch("walk_columns", -(-count // CHUNK), 1, *numbers, *arrays)
            score = scores.get().astype(np.float64)
            where = np.where(
                score == 0.0, 0, ends.get()
            )  # a walk that died may stand in the row of b
            total += np.bincount(where, score, n)
            squares += np.bincount(where, score**2, n)
            self.watch()
        return Sums(samples, total, squares)

    def _walks(self) -> int:
        steps = np.sum(
            self.lengths.go_on ** np.arange(len(self.lengths.coefficients))
        )  # of a walk, mean
        return int(_STEPS * self.tables.device.compute_units / steps)

    def _launch(self, name: str, units: int, width: int, *arguments: object) -> None:
        """Many walks an item where few items run, so that their loads do not wait for each other."""
        device, walks, group = self.tables.device, 1, 64
        if device.is_cpu:
            walks, group = (32 if units >= 128 * device.compute_units else 4), 1
        if device.kind == "simulator":  # does not know the prefetch of several walks
            walks = 1
        defines = {"CHANNELS": self.tables.channels, "CHUNK": CHUNK, "WALKS": walks, "K": width}
        defines["LINKED"] = int(self.tables.links is not None)
        device.kernel("walk", name, **defines)(-(-units // walks), group, units, *arguments)


def _pieces(count: int, size: int) -> Iterator[slice]:
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
