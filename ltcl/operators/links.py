# SPDX-License-Identifier: BSD-3-Clause
"""Tables of walks that three colour channels share: one walk, three weights.

    p(j | i) = P_ij / |P_i|,  P_ij^2 = mean over channels c of (R_cij / |R_ci|)^2

A step from i to j multiplies the weight of channel c by R_cij / p(j | i): no channel is biased, whatever P.
Of all P this one gives the least sum over channels of the second moments of a step, each in units of those
that the channel has by itself (eq. 25); none has more than three times those. Where channels are equal the
walk is that of each by itself, to the bit.

The tables are those of P, but tell the place of an entry in its row; `links` tells where it leads and its
three factors. That is 24 bytes an entry that any channel has, as much as three tables, and one load more a
step.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.operators.alias import Tables
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense

_BYTES = 64  # of the host, an entry, while links are made
_LARGEST = float(np.finfo(np.float32).max)


class Links(Tables):
    """What a walk over the rows of three matrices needs; made by `links`, which keeps it.

    Parameters
    ----------
    Rs : three CSR or Dense, (N, N)
        Of one device.
    signs : three of +1 or -1
        Of S = I + sign R; the walk is over sign R.
    sampler : str
        See `Tables`; "uniform" draws alike from all entries that any channel has in a row.

    Attributes
    ----------
    links : Array, (entries, 4) uint32
        Of each entry: column, bits of the three factors.
    indptr : (N + 1,)
        Where rows begin among the entries.
    others : tuple
        All of Rs but the first.
    """

    channels = 3

    def __init__(self, Rs: Sequence[CSR | Dense], signs: Sequence[float], sampler: str = "alias") -> None:
        self.device, self.others = Rs[0].device, tuple(Rs[1:])
        entries = max(R.nnz if isinstance(R, CSR) else R.shape[0] * R.shape[1] for R in Rs)
        checks.fits_host("links of walks that channels share", _BYTES * entries)
        pattern, values = _together([_in_rows(R) for R in Rs])
        self._check_room(pattern.nnz, 16)
        self.indptr, self._P = pattern.indptr, _pooled(pattern.indptr, values)
        places = np.arange(pattern.nnz) - _per_entry(pattern.indptr, pattern.indptr[:-1])
        super().__init__(CSR(self.device, _with(pattern, self._P, places)), sampler)
        self.links = self.device.upload(self._linked(pattern.indices, signs, values), np.uint32)

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return super().nbytes + self.links.nbytes

    def moments(self, power: int = 2) -> Iterator[CSR]:
        """Of each channel p(j | i) (R_cij / p(j | i))^power, what a step makes of moments of weights."""
        columns, inverse = self.links.get()[:, 0].astype(np.int32), self._inverse_chances()
        for factor in self.factors():
            powers = factor**power
            Q = np.divide(powers, inverse, out=np.zeros_like(powers), where=inverse > 0.0)
            Q = np.minimum(Q, _LARGEST)
            yield CSR(self.device, scipy.sparse.csr_array((Q, columns, self.indptr), shape=self.shape))

    def factors(self) -> Iterator[np.ndarray]:
        """Of each channel what an entry multiplies weights by, absolute, (entries,) float64."""
        for bits in self.links.get().T[1:]:
            yield np.abs(bits.view(np.float32).astype(np.float64))

    def drawn(self) -> np.ndarray:
        """Entries of each row that a walk may draw, (rows,)."""
        if self.sampler == "uniform":
            return self.counts()
        rows = _per_entry(self.indptr, np.arange(self.shape[0]))
        return np.bincount(rows, self._P > 0.0, self.shape[0])

    def _inverse_chances(self) -> np.ndarray:
        """1 / p(j | i) of each entry, float64; 0 where it is never drawn."""
        if self.sampler == "uniform":
            return _per_entry(self.indptr, self.counts().astype(np.float64))
        total = _per_entry(self.indptr, self.sums().astype(np.float64))
        return np.divide(total, self._P, out=np.zeros_like(total), where=self._P > 0.0)

    def _linked(self, columns: np.ndarray, signs: Sequence[float], values: list[np.ndarray]) -> np.ndarray:
        made, inverse = np.zeros((len(columns), 4), np.uint32), self._inverse_chances()
        made[:, 0] = columns
        with np.errstate(over="ignore"):  # then their moments overflow, too
            for c, (sign, R) in enumerate(zip(signs, values, strict=True)):
                made[:, 1 + c] = (sign * R * inverse).astype(np.float32).view(np.uint32)
        return made


def links(Rs: Sequence[CSR | Dense], signs: Sequence[float], sampler: str = "alias") -> Links:
    """The tables of walks over three matrices, made at the first call and kept with the first of them.

    >>> import ltcl
    >>> device = ltcl.open_device()
    >>> Rs = [Dense(device, [[0.0, value], [0.0, 0.0]]) for value in (0.5, -0.25, 0.0)]
    >>> links(Rs, (1, 1, 1)).links.get()[1, 1:].view(np.float32).tolist()
    [0.5, -0.25, 0.0]
    """
    kept, key = Rs[0].tables, f"links, {sampler}, {tuple(signs)}"
    if key not in kept or any(a is not b for a, b in zip(kept[key].others, Rs[1:], strict=True)):
        kept[key] = Links(Rs, signs, sampler)
    return kept[key]


def _in_rows(R: CSR | Dense) -> scipy.sparse.csr_array:
    """R on the host; of a dense one with all entries, zeros too, as its own tables have them."""
    if isinstance(R, CSR):
        return scipy.sparse.csr_array((R.data, R.pattern.indices, R.pattern.indptr), shape=R.shape)
    rows, width = R.shape
    values = np.concatenate([slab.arguments[1].get().ravel() for slab in R.slabs])
    columns = np.tile(np.arange(width, dtype=np.int32), rows)
    return scipy.sparse.csr_array((values, columns, np.arange(rows + 1) * width), shape=R.shape)


def _together(parts: list[Any]) -> tuple[Any, list[np.ndarray]]:
    """A matrix with the entries that any of `parts` has, and the values of each there."""
    first = parts[0]
    if all(np.array_equal(first.indptr, part.indptr) for part in parts) and all(
        np.array_equal(first.indices, part.indices) for part in parts
    ):
        return first, [part.data for part in parts]
    rows, width = first.shape
    places = [_per_entry(part.indptr, width * np.arange(rows)) + part.indices for part in parts]
    union = functools.reduce(np.union1d, places)
    values = [np.zeros(union.size, np.float32) for _ in parts]
    for found, place, part in zip(values, places, parts, strict=True):
        found[np.searchsorted(union, place)] = part.data
    indptr = np.searchsorted(union, width * np.arange(rows + 1))
    return scipy.sparse.csr_array((values[0], union % width, indptr), shape=first.shape), values


def _pooled(indptr: np.ndarray, values: list[np.ndarray]) -> np.ndarray:
    """P in units of the largest |R_ci| of its row, so that that of equal channels is |R_c| to the bit."""
    rows = _per_entry(indptr, np.arange(len(indptr) - 1))
    sums = np.stack([np.bincount(rows, np.abs(v), len(indptr) - 1) for v in values])
    times = np.divide(sums.max(axis=0), sums, out=np.zeros(sums.shape), where=sums > 0.0)
    squares = np.zeros(len(rows))
    for v, factor in zip(values, times, strict=True):
        squares += np.square(factor[rows] * v)
    return np.sqrt(squares / len(values)).astype(np.float32)


def _per_entry(indptr: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.repeat(values, np.diff(indptr))


def _with(pattern: scipy.sparse.csr_array, values: np.ndarray, columns: np.ndarray) -> scipy.sparse.csr_array:
    return scipy.sparse.csr_array((values, columns, pattern.indptr), shape=pattern.shape)
