# SPDX-License-Identifier: BSD-3-Clause
"""Methods that read the rows of S = shift I + scale M: sweeps (`kernels/relax.cl`), steps (`southwell.cl`).

A sweep is a blocked forward substitution, x_B += P_BB^-1 (b - S x)_B with the x of the moment: a
CPU takes many small blocks in one launch and substitutes by rows; a GPU takes two launches a block
and keeps P_BB^-1.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Array
from ltcl.errors import InputError
from ltcl.operators.base import Operator, widths
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.rows import Slab

INVERTED = 128  # rows of a block whose inverse is kept: small beside the matrix
_STRIP, _PANEL = (
    1 << 17,
    1 << 23,
)  # bytes of M in a strip and a panel: many beside what starting one costs
_GROUP = 64  # items that share a row on a GPU


@dataclass(frozen=True)
class Rows:
    """S = shift I + scale M, where M has rows to read."""

    M: CSR | Dense
    shift: float
    scale: float

    def kernel(self, file: str, name: str, **defines: int) -> Any:
        """A kernel for the format of M."""
        dense = {"DENSE": 1} if isinstance(self.M, Dense) else {}
        return self.M.device.kernel(file, name, **dense, **defines)

    def inverse_diagonal(self, method: str) -> np.ndarray:
        """1 / S_ii, (N,) float64; a zero is refused, naming its first row and `method`."""
        diagonal = self.shift + self.scale * self.M.diagonal()
        zeros = np.flatnonzero(diagonal.astype(np.float32) == 0.0)
        if zeros.size:
            raise InputError(
                f"method={method!r} divides by the diagonal of S, which is 0 in {zeros.size} row(s), "
                f"first in row {zeros[0]}; use method='direct'"
            )
        return 1.0 / diagonal

    def inverse_blocks(self, size: int, omega: float | None, method: str) -> np.ndarray:
        """P_BB^-1 below each other, (N, size), of triangles with D / omega; of all of S_BB without omega."""
        n, whole = self.M.shape[0], host(self.M)
        self.M.device.require(
            4 * n * size, f"method={method!r} with inverses of {-(-n // size)} blocks"
        )
        if omega is not None:
            self.inverse_diagonal(method)
        inverses = np.zeros((n, size))
        for start in range(0, n, size):
            B = slice(start, start + size)
            P = whole[B, B] if isinstance(whole, np.ndarray) else whole[B, B].toarray()
            P = self.shift * np.eye(len(P)) + self.scale * P.astype(np.float64)
            if omega is not None:
                P = np.tril(P, -1) + np.diag(P.diagonal() / omega)
            with contextlib.suppress(np.linalg.LinAlgError):
                inverse = inverses[B, : len(P)] = np.linalg.inv(P)
                if (
                    np.linalg.norm(P, 1) * np.linalg.norm(inverse, 1)
                    < 1.0 / np.finfo(np.float64).eps
                ):
                    continue  # NaN is not
            raise InputError(
                f"method={method!r} inverts blocks of S; that of rows {start} to {start + len(P) - 1} is "
                "singular: choose another block= or use method='direct'"
            )
        return inverses


def host(M: CSR | Dense) -> Any:
    """M on the host, float32 as on the device: a csr_array or an array."""
    return (
        M.matrix()
        if isinstance(M, CSR)
        else np.concatenate([slab.arguments[1].get() for slab in M.slabs])
    )


def entries(slab: Slab, unread: Array) -> tuple[Any, ...]:
    """(width, pointers, columns, values) of a slab of either format; `unread` stands for what it lacks."""
    if len(slab.arguments) == 3:
        return 0, *slab.arguments
    width, values = slab.arguments
    return width, unread, unread, values


class Relaxation:
    """How S is swept with one block size; made by `relaxation`, which keeps it with the matrix."""

    def __init__(self, rows: Rows, method: str, block: int | None, omega: float | None) -> None:
        M, device, n = rows.M, rows.M.device, max(1, rows.M.shape[0])
        self.rows, self.omega = rows, omega
        self.inverses = omega is None or not device.is_cpu
        size = block or (INVERTED if self.inverses else _STRIP * n // max(1, M.nbytes))
        self.block = max(1, min(size, n))
        # 1 / (2 panels) of each row waits for the rows before it: little beside the share of a
        # core.
        panels = max(8, 2 * device.compute_units, M.nbytes // _PANEL) if device.is_cpu else n
        self.panel = self.block * -(-n // (self.block * panels))
        with np.errstate(over="ignore"):  # a sweep with Inf ends as divergence, and says so
            if self.inverses:
                weights = rows.inverse_blocks(self.block, omega, method)
            else:
                weights = rows.inverse_diagonal(method)
            weights = weights.astype(np.float32)
        # A CPU reads them as one array, a GPU block by block.
        runs = np.split(weights, 1 if device.is_cpu else range(self.block, n, self.block))
        self.weights = [device.upload(run[..., : len(run)]) for run in runs]
        self.windows = [
            s.arguments[1] if isinstance(M, Dense) else self._windows(s) for s in M.slabs
        ]

    def _windows(self, slab: Slab) -> Array:
        """Where `kernels/relax.cl` splits the sparse rows of a slab, (rows, 2), by binary searches."""
        pointers, columns = slab.arguments[0].get().astype(np.int64), slab.arguments[1].get()
        row = slab.first + np.arange(slab.rows, dtype=np.int32)
        split = np.stack(
            [row - row % self.panel, row - row % self.block if self.inverses else row], axis=1
        )
        low, high = (np.stack([ends, ends], axis=1) for ends in (pointers[:-1], pointers[1:]))
        for bit in reversed(range(int(np.diff(pointers).max(initial=0)).bit_length())):
            last = low + ((1 << bit) - 1)  # taken if the row goes on so far, left of the split
            low += ((last < high) & (columns.take(last, mode="clip") < split)) * (1 << bit)
        return self.rows.M.device.upload(low, np.int32)


class Sweeps:
    """Sweeps of a solve: the iterate `x`, the one `before`, and from the second on its residual `r`."""

    def __init__(self, relaxation: Relaxation, x: Array, b: Array, r: Array) -> None:
        self.relaxation, self.x, self.b, self.r, self.group = relaxation, x, b, r, _GROUP
        self.before, self.s, self.carry = x.like(), x.like(), x.like()
        self._arrivals = x.device.upload(
            np.zeros(relaxation.panel // relaxation.block + 1), np.int32
        )

    def sweep(self) -> None:
        """Queue one sweep."""
        how, (n, k) = self.relaxation, (self.x.shape[0], self.x.columns)
        rows, in_strips = how.rows, self.x.device.is_cpu
        if not in_strips:
            self.before.copy_from(self.x)
        for offset, width in widths(k):
            defines = {"K": width, "PACKED": 1} if width == k else {"K": width}
            sums = rows.kernel("relax", "relax_strips" if in_strips else "relax_rows", **defines)
            correct = (
                sums
                if in_strips
                else sums.device.kernel("dense", "dense_matvec_group", STRIP=1, **defines)
            )
            group = min(sums.group(self.group), correct.group(self.group))
            local = self.x.device.local(2 * width * group)
            vectors = (self.x, self.b, self.s, self.r, self.carry)
            for start in range(0, n, how.panel):
                for slab, windows in zip(rows.M.slabs, how.windows, strict=True):
                    begin, end = (
                        max(start, slab.first),
                        min(start + how.panel, slab.first + slab.rows),
                    )
                    place = (begin, end, slab.first, start, k, offset, rows.shift, rows.scale)
                    arguments = (*place, *entries(slab, windows), windows, *vectors)
                    if begin < end and in_strips:
                        strips = -(-end // how.block) - begin // how.block
                        more = (strips, n, how.block, int(how.inverses), how.omega or 1.0)
                        sums(
                            strips, 1, *arguments, *more, *how.weights, self._arrivals, self.before
                        )
                    elif begin < end:
                        sums((end - begin) * group, group, *arguments, local)
                if not in_strips:
                    rest = min(how.block, n - start)
                    place = (
                        rest,
                        0,
                        k,
                        start * k + offset,
                        1.0,
                        1.0,
                        0.0,
                        self.s,
                        self.x,
                        self.x,
                        rest,
                    )
                    correct(rest * group, group, *place, how.weights[start // how.block], local)


def relaxation(
    S: Operator, method: str, block: int | None = None, omega: float | None = 1.0
) -> Relaxation:
    """Gauss-Seidel and SOR, or block Gauss-Seidel without omega; kept with the matrix of S, for one omega."""
    rows = readable(S, method)
    relaxations, key = rows.M.relaxations, (rows.shift, rows.scale, block, omega is None)
    if key not in relaxations or relaxations[key].omega != omega:
        relaxations[key] = Relaxation(rows, method, block, omega)
    return relaxations[key]


def readable(S: Operator, method: str) -> Rows:
    """The rows of S; operators that do not give them are refused, naming `method`."""
    shift, scale, M = (1.0, S.sign, S.R) if isinstance(S, IdentityPlus) else (0.0, 1.0, S)
    if not isinstance(M, CSR | Dense):
        where = getattr(getattr(M, "A", M), "where", "")  # of Parts, whose columns may be scaled
        problem = f"but they are {where}" if where else f"which {type(M).__name__} does not allow"
        raise InputError(
            f"method={method!r} reads S row by row, {problem}; give a dense or sparse matrix on one device, "
            "or use method='chebyshev'"
        )
    return Rows(M, shift, scale)


class Steps:
    """Steps of Southwell's relaxation on an iterate `x` and its residual `r`, with `parts` rows a step."""

    def __init__(self, S: Operator, method: str, x: Array, r: Array, parts: int) -> None:
        rows, device = readable(S, method), S.device
        self.rows, self.x, self.r, self.parts, self._pending = rows, x, r, parts, 0
        self._inverse = device.upload(rows.inverse_diagonal(method))
        self._slabs = (rows.M.transposed_copy() if isinstance(rows.M, CSR) else rows.M).slabs
        shape = (parts, x.columns)
        self._picked, self._next = (
            (device.empty(shape, np.int32), device.empty(shape)) for _ in range(2)
        )
        # Each item looks its rows up in all columns picked: few do on a CPU, where an item is a
        # stream.
        self.groups, self.group = (
            (2 * device.compute_units, 1) if device.is_cpu else (_GROUP, _GROUP)
        )

    def step(self, *, picks: bool = True) -> None:
        """Queue one step; `r` learns of its picks at the next, or at one that picks nothing."""
        n, k, kernel = (
            self.x.shape[0],
            self.x.columns,
            self.rows.kernel("southwell", "southwell_step"),
        )
        group, groups = kernel.group(self.group), min(self.groups, self.parts)
        vectors = (
            self._inverse,
            self.x,
            self.r,
            *self._picked,
            *self._next,
            self.x.device.local(group),
        )
        for slab in self._slabs:
            last = picks and slab is self._slabs[-1]
            place = (n, self.parts, self._pending, int(last), k, self.rows.shift, self.rows.scale)
            arguments = (*place, slab.rows, slab.first, *entries(slab, self._inverse), *vectors)
            kernel((groups * group, k), (group, 1), *arguments)
        self._picked, self._next, self._pending = (
            self._next,
            self._picked,
            self.parts if picks else 0,
        )
