# SPDX-License-Identifier: BSD-3-Clause
"""Alias tables of the rows of R, from which random walks draw their steps.

A step goes from i to j with chance p(j | i) = |R_ij| / |R_i|, |R_i| = sum_j |R_ij| (eq. 25), by
alias tables that `kernels/walk.cl` builds. `Linked` tables step by other chances p and multiply the
weight by R_ij / p(j | i), from a second load. So channels share a walk; of all p

    p(j | i) = P_ij / |P_i|,  P_ij^2 = mean over channels c of (R_cij / |R_ci|)^2

has the least sum of the second moments of a step, each in units of those that the channel has by
itself. Tables are made at the first call and kept with the matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.relaxation import readable

# Samples that are summed on the device.
CHUNK = 64
# Columns that a table entry of 64 bits can tell apart.
MAX_COLUMNS = 1 << 22
# Bytes of the host for each entry, while linked tables are made.
LINKED_BYTES_PER_ENTRY = 64
# Defines of the kernel that builds tables, which reads none of them.
TABLE_DEFINES = {"CHANNELS": 1, "CHUNK": CHUNK, "WALKS": 1, "K": 1, "LINKED": 0}


class Tables:
    """Alias tables of the rows of M (`kernels/walk.cl`).

    With `spare` entries the rows are those of M^T, and there is room for one row more.
    """

    channels = 1
    links: Array | None = None

    def __init__(self, M: CSR | Dense, spare: int = 0) -> None:
        self.device = M.device
        self.shape = M.shape
        self.transposed = spare > 0
        # Second moments of these walks, kept here by `ltcl.theory.walks`.
        self.moments: dict[str, Any] = {}
        rows, columns = M.shape
        if columns > MAX_COLUMNS:
            raise InputError(f"R has {columns} columns; walks take at most {MAX_COLUMNS}")
        self._used = _count_entries(M)
        count = self._used + spare
        self.device.require(8 * count, f"tables of the {count} entries of R")
        all_rows = rows + 1 if self.transposed else rows
        self.records = self.device.empty((all_rows, 4), np.uint32)
        self.entries = self.device.empty((count,), np.uint64)
        for slab in M.slabs:
            if isinstance(M, CSR):
                base = int(M.pattern.indptr[slab.first])
                self._build(slab.rows, slab.first, base, 0, **slab.arguments)
            else:
                base = slab.first * columns
                self._build(slab.rows, slab.first, base, columns, slab.arguments["matrix"])
        self._check_sums("R", slice(rows))

    def sums(self) -> np.ndarray:
        """|M_i| of each row, (rows,) float32."""
        return np.ascontiguousarray(self.records.get()[:, 3]).view(np.float32)

    def append(self, values: Array) -> None:
        """Build the one row behind those of M from `values`, dense, (columns,)."""
        rows = self.shape[0]
        self._build(1, rows, self._used, values.shape[0], values)
        self._check_sums("b", slice(rows, None))

    def second_moments(self, R: CSR | Dense) -> list[Operator]:
        """The step of second moments of weights, for each channel: R_ij^2 / p(j | i), (N, N)."""
        rows = R.matrix()
        if self.transposed:
            rows = rows.T
        row_sums = self.sums()[: self.shape[0]].astype(np.float64)
        return [_in_format(R, scipy.sparse.diags_array(row_sums) @ abs(rows))]

    def _build(
        self,
        rows: int,
        first: int,
        base: int,
        width: int,
        values: Array,
        pointers: Array | None = None,
        columns: Array | None = None,
    ) -> None:
        """Build rows whose entries begin at `base`; dense ones have a `width` and no pointers."""
        kernel = self.device.kernel("walk", "walk_tables", **TABLE_DEFINES)
        kernel(
            rows,
            walk_group(self.device),
            rows=rows,
            first=first,
            base=base,
            width=width,
            pointers=pointers,
            columns=columns,
            values=values,
            records=self.records,
            entries=self.entries,
        )

    def _check_sums(self, name: str, rows: slice) -> None:
        """Refuse rows whose sums are beyond float32."""
        beyond = np.flatnonzero(~np.isfinite(self.sums()[rows]))
        if beyond.size:
            raise InputError(
                f"the absolute values of {beyond.size} row(s) of {name}, first of row {beyond[0]}, "
                f"sum to more than float32 holds, {np.finfo(np.float32).max:.3g}; rescale"
            )


class Linked(Tables):
    """Tables of walks over three matrices, by chances of their own; 24 bytes for each entry.

    `links`, (entries, 4) uint32, hold the column of each entry and the bits of the factors
    R_cij / p(j | i).
    """

    def __init__(self, Rs: Sequence[CSR | Dense], signs: Sequence[float]) -> None:
        device = Rs[0].device
        largest = max(_count_entries(R) for R in Rs)
        checks.fits_host("tables of walks that channels share", LINKED_BYTES_PER_ENTRY * largest)
        channels: list[Any] = []
        for R in Rs:
            matrix: Any = scipy.sparse.csr_array(R.matrix()).astype(np.float64)
            matrix.eliminate_zeros()
            channels.append(matrix)
        P = _mean_squares(channels)
        device.require(16 * P.nnz, f"links of the {P.nnz} entries of R")
        row = np.repeat(np.arange(P.shape[0], dtype=np.int32), np.diff(P.indptr))
        values = np.sqrt(P.data / len(Rs))
        # Tables draw the number of an entry in its row; its column is in the links.
        places = np.arange(P.nnz) - P.indptr[row]
        numbered = scipy.sparse.csr_array((values, places, P.indptr), shape=P.shape)
        super().__init__(CSR(device, numbered))
        # Kept alive, since their ids find these tables; the first keeps the tables.
        self._others = [R for R in Rs if R is not Rs[0]]
        self.channels = len(Rs)
        self._pattern = (P.indices, P.indptr)
        self._chances = values.astype(np.float32) / self.sums()[row].astype(np.float64)
        self.links = device.upload(self._link_entries(P, channels, signs), np.uint32)

    def _link_entries(self, P: Any, channels: Sequence[Any], signs: Sequence[float]) -> np.ndarray:
        """Columns and the bits of factors, (entries, 4) uint32."""
        links = np.zeros((P.nnz, 4), np.uint32)
        links[:, 0] = P.indices
        numbers = np.arange(1, P.nnz + 1)
        numbered = scipy.sparse.csr_array((numbers, P.indices, P.indptr), shape=P.shape)
        for channel, (sign, R) in enumerate(zip(signs, channels, strict=True)):
            # The entries of this channel among all.
            entries = (numbered * (R != 0)).data - 1
            chances = self._chances[entries]
            factors = np.zeros(R.nnz)
            np.divide(sign * R.data, chances, out=factors, where=chances > 0.0)
            # Second moments overflow as well then, and are refused.
            with np.errstate(over="ignore"):
                links[entries, 1 + channel] = factors.astype(np.float32).view(np.uint32)
        return links

    def second_moments(self, R: CSR | Dense) -> list[Operator]:
        """The same for each channel of the links, (N, N); R is not looked at."""
        assert self.links is not None  # noqa: S101 - made with the tables
        bits = self.links.get().T[1 : 1 + self.channels]
        moments: list[Operator] = []
        for factors in np.ascontiguousarray(bits).view(np.float32):
            values = self._chances * factors.astype(np.float64) ** 2
            matrix = scipy.sparse.csr_array((values, *self._pattern), shape=self.shape)
            moments.append(CSR(self.device, matrix))
        return moments


def walk_group(device: Device) -> int:
    """Work-items of a group: a CPU runs one walk or row after the other."""
    return 1 if device.is_cpu else 64


def _mean_squares(channels: Sequence[Any]) -> Any:
    """The sum over channels of (R_cij / |R_ci|)^2, a csr_array (N, N)."""
    squares: Any = 0
    for R in channels:
        row_sums = abs(R).sum(axis=1)
        divisors = np.where(row_sums > 0.0, row_sums, 1.0)
        share = scipy.sparse.diags_array(1.0 / divisors) @ R
        squares = squares + share * share
    return scipy.sparse.csr_array(squares)


def tables(M: CSR | Dense) -> Tables:
    """The alias tables of M."""
    return cached(M, "alias", lambda: Tables(M))


def tables_of_columns(M: CSR | Dense) -> Tables:
    """Alias tables of M^T, with room for one more row of as many entries as M has rows."""
    return cached(M, "columns", lambda: Tables(_in_format(M, M.matrix().T), spare=M.shape[0]))


def linked(Rs: Sequence[CSR | Dense], signs: Sequence[float]) -> Linked:
    """The tables of walks over sign R of three (N, N), kept with the first."""
    key = f"linked {tuple(signs)} {[id(R) for R in Rs]}"
    return cached(Rs[0], key, lambda: Linked(Rs, signs))


def squares(M: CSR | Dense) -> CSR | Dense:
    """M_ij^2, which carry variances: as much memory again."""
    return cached(M, "squares", lambda: _in_format(M, M.matrix() * M.matrix()))


def rows_of_R(S: Operator, method: str) -> tuple[CSR | Dense, float]:
    """R with rows to read, and the sign in S = I + sign R; from an S stored whole R is made.

    An S that does not give its rows is refused with an InputError that names `method`.
    """
    rows = readable(S, method)
    if rows.shift == 1.0:
        return rows.M, rows.scale
    return cached(rows.M, "R", lambda: _without_identity(rows.M)), 1.0


def cached(M: CSR | Dense, key: str, make: Callable[[], Any]) -> Any:
    """The result of `make`, made at the first call with this key and kept with M."""
    if key not in M.known.walk_tables:
        M.known.walk_tables[key] = make()
    return M.known.walk_tables[key]


def _without_identity(S: CSR | Dense) -> CSR | Dense:
    return _in_format(S, S.matrix() - scipy.sparse.eye_array(S.shape[0]))


def _count_entries(M: CSR | Dense) -> int:
    if isinstance(M, CSR):
        return M.nnz
    rows, columns = M.shape
    return rows * columns


def _in_format(M: CSR | Dense, matrix: Any) -> CSR | Dense:
    """A matrix on the device of M, in its format."""
    if isinstance(M, CSR):
        return CSR(M.device, matrix, M.pattern)
    return Dense(M.device, matrix)
