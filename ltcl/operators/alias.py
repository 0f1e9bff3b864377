# SPDX-License-Identifier: BSD-3-Clause
"""Tables from which random walks draw the entries of each row of R, built by `kernels/alias.cl`.

    p(j | i) = |R_ij| / |R_i|,  |R_i| = sum_j |R_ij|   (eq. 25)

The sign of R_ij is kept with its column. A table takes 8 bytes an entry and lives as long as its matrix.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.device.device import SPARE_BYTES
from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.rows import Slab

SAMPLERS = {"alias": 0, "cdf": 1, "uniform": 2}  # the TABLE of kernels/common/table.h
_COLUMNS = 1 << 22  # that an entry of 64 bits can tell apart


class Tables:
    """What a walk over the rows of M needs; made by `tables`, which keeps it.

    Parameters
    ----------
    M : CSR or Dense, (rows, columns)
    sampler : str
        "alias": in proportion to |M_ij|, one load a step. "cdf": the same by binary search in cumulative
        sums, for reference. "uniform": all entries of a row alike, the baseline.
    behind : int
        Room for one more row of so many entries behind those of M; see `append`.

    Attributes
    ----------
    records : Array, (rows, 4) or (rows + 1, 4) uint32
        Of each row: place of its first entry, low word first; entries, 0 for a row of zeros; the bits of its
        sum of absolute values.
    entries : Array, (entries,) uint64
    channels : int
        Weights of a walk; with more than one also `links`, see `Links`.
    radius : float, optional
        See `ltcl.theory.walks.second_moment_radius`, which keeps it here.
    weights : optional
        See `ltcl.theory.unmet.weights`, which keeps them here.
    least : float, optional
        Samples of `ltcl.solvers.hybrid`, which keeps it here.

    Raises
    ------
    InputError
        More columns than an entry can tell apart, rows whose sum is beyond float32.
    MemoryLimitError
        More entries than the device's largest buffer holds.
    """

    channels = 1

    def __init__(self, M: CSR | Dense, sampler: str = "alias", behind: int = 0) -> None:
        checks.one_of("sampler", sampler, SAMPLERS)
        self.sampler, self.device, self.shape = sampler, M.device, M.shape
        rows, columns = M.shape
        if columns > _COLUMNS:
            raise InputError(f"R has {columns} columns; walks take at most {_COLUMNS}")
        self._used = M.nnz if isinstance(M, CSR) else rows * columns
        self._check_room(self._used + behind)
        self.records = self.device.empty((rows + (behind > 0), 4), np.uint32)
        self.entries = self.device.empty((self._used + behind,), np.uint64)
        self.links = self.records  # no kernel reads it
        self.radius: float | None = None
        self.weights: Any = None
        self.least: float | None = None
        for slab in M.slabs:
            self._build(M.file, slab, slab.first, self._base(M, slab))
        self._refuse_overflow(self.sums()[:rows])

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return self.records.nbytes + self.entries.nbytes

    def counts(self) -> np.ndarray:
        """Entries of each row, (rows,); 0 for a row of zeros."""
        return self.records.get()[:, 2].astype(np.int64)

    def sums(self) -> np.ndarray:
        """|M_i| of each row, (rows,) float32."""
        return np.ascontiguousarray(self.records.get()[:, 3]).view(np.float32)

    def append(self, values: Array) -> None:
        """Build the one row behind those of M from `values`, dense, (behind,)."""
        width = values.shape[0]
        self._build("dense", Slab(0, 1, (width, values)), self.shape[0], self._used)
        self._refuse_overflow(self.sums()[self.shape[0] :], "b")

    def _build(self, form: str, slab: Slab, first: int, base: int) -> None:
        kernel = self.device.kernel("alias", f"alias_{form}", TABLE=SAMPLERS[self.sampler])
        group = 1 if self.device.is_cpu else 64
        kernel(slab.rows, group, slab.rows, first, base, *slab.arguments, self.records, self.entries)

    def _base(self, M: CSR | Dense, slab: Slab) -> int:
        return int(M.pattern.indptr[slab.first]) if isinstance(M, CSR) else slab.first * M.shape[1]

    def _check_room(self, entries: int, size: int = 8) -> None:
        needed, most = size * entries, self.device.max_allocation - SPARE_BYTES
        if needed > most:
            raise MemoryLimitError(
                f"tables of the {entries} entries of R need {checks.size(needed)} in one buffer; "
                f"{self.device.name} allows {checks.size(most)}: threshold R"
            )
        self.device.require(needed, f"tables of the {entries} entries of R")

    def _refuse_overflow(self, sums: np.ndarray, name: str = "R") -> None:
        beyond = np.flatnonzero(~np.isfinite(sums))
        if beyond.size:
            raise InputError(
                f"the absolute values of {beyond.size} row(s) of {name}, first of row {beyond[0]}, sum to "
                f"more than float32 holds, {np.finfo(np.float32).max:.3g}; rescale"
            )


def tables(M: CSR | Dense, sampler: str = "alias") -> Tables:
    """The tables of M for a sampler, made at the first call and kept with it.

    >>> import ltcl
    >>> made = tables(Dense(ltcl.open_device(), [[0.0, -0.5], [0.25, 0.25]]))
    >>> made.sums().tolist(), made.counts().tolist()
    ([0.5, 0.5], [2, 2])
    """
    return _kept(M, sampler, lambda: Tables(M, sampler))


def tables_of_columns(M: CSR | Dense) -> Tables:
    """Alias tables of M^T, with room for one more row of as many entries as M has rows; kept with M."""
    return _kept(M, "columns", lambda: Tables(_transposed(M), "alias", behind=M.shape[0]))


def _kept(M: CSR | Dense, key: str, make: Any) -> Tables:
    if key not in M.tables:
        M.tables[key] = make()
    return M.tables[key]


def _transposed(M: CSR | Dense) -> CSR | Dense:
    if isinstance(M, CSR):
        return M.transposed_copy()
    turned = np.empty(M.shape[::-1], np.float32)
    for slab in M.slabs:
        turned[:, slab.first : slab.first + slab.rows] = slab.arguments[1].get().T
    return Dense(M.device, turned)
