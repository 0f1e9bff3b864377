# SPDX-License-Identifier: BSD-3-Clause
"""Methods that read the rows of S = shift I + scale M: Gauss-Seidel, SOR and Southwell's.

Sweeps are those of `kernels/relax.cl`, steps those of `kernels/southwell.cl`.

A sweep is a blocked forward substitution, x_B += P_BB^-1 (b - S x)_B with the x of the moment: a
CPU takes many small blocks in one launch and substitutes by rows; a GPU takes two launches a block
and keeps P_BB^-1, of blocks that are as large as pays (`ltcl.operators.triangles`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl.device import Array, Device
from ltcl.device.kernels import Kernel
from ltcl.errors import InputError
from ltcl.operators import triangles
from ltcl.operators.base import Operator
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.epilogue import widths
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.rows import Slab

# Rows of a block whose inverse is kept, unless they are given: small beside the matrix.
DEFAULT_BLOCK_ROWS = 128
# Bytes of M in a strip and in a panel: many beside the cost of starting one.
STRIP_BYTES = 1 << 17
PANEL_BYTES = 1 << 23
# The fewest panels on a CPU: 1 / (2 panels) of each row waits for the rows before it, which is
# little beside the share of a core.
MIN_PANELS = 8
# Work-items that share a row on a GPU.
GROUP_ITEMS = 64


@dataclass(frozen=True)
class RelaxationRows:
    """S = shift I + scale M, with M whose rows can be read."""

    M: CSR | Dense
    shift: float
    scale: float

    def inverse_diagonal(self, method: str) -> np.ndarray:
        """1 / S_ii, (N,) float64; a zero is refused, naming its first row and `method`."""
        diagonal = self.shift + self.scale * self.M.diagonal()
        zeros = np.flatnonzero(diagonal.astype(np.float32) == 0.0)
        if zeros.size:
            raise InputError(
                f"method={method!r} divides by the diagonal of S, which is 0 in {zeros.size} "
                f"row(s), first in row {zeros[0]}; use method='direct'"
            )
        return 1.0 / diagonal

    def inverse_blocks(self, size: int, omega: float | None, method: str) -> np.ndarray:
        """P_BB^-1 below each other, (N, size).

        P_BB is the lower triangle of S_BB with D / omega, or all of S_BB without omega.
        """
        n = self.M.shape[0]
        count = -(-n // size)
        self.M.device.require(4 * n * size, f"method={method!r} with inverses of {count} blocks")
        if omega is not None:
            # Refuses zeros.
            self.inverse_diagonal(method)
        matrix = self.M.matrix()
        inverses = np.zeros((n, size))
        for start in range(0, n, size):
            rows = slice(start, start + size)
            P = self._block(matrix, rows, omega)
            inverse = _inverse(P) if omega is None else _inverse_triangle(P)
            if inverse is None:
                raise InputError(
                    f"method={method!r} inverts blocks of S; that of rows {start} to "
                    f"{start + len(P) - 1} is singular: choose another block= or use "
                    "method='direct'"
                )
            inverses[rows, : len(P)] = inverse
        return inverses

    def _block(self, matrix: Any, rows: slice, omega: float | None) -> np.ndarray:
        """P_BB of the block of some rows."""
        block = matrix[rows, rows]
        if scipy.sparse.issparse(block):
            block = block.toarray()
        S_BB = self.shift * np.eye(len(block)) + self.scale * block.astype(np.float64)
        if omega is None:
            return S_BB
        return np.tril(S_BB, -1) + np.diag(S_BB.diagonal() / omega)


def _inverse(P: np.ndarray) -> np.ndarray | None:
    """P^-1; None if P is singular to working precision."""
    try:
        inverse = np.linalg.inv(P)
    except np.linalg.LinAlgError:
        return None
    condition = np.linalg.norm(P, 1) * np.linalg.norm(inverse, 1)
    # NaN is not below it.
    return inverse if condition < 1.0 / np.finfo(np.float64).eps else None


def _inverse_triangle(P: np.ndarray) -> np.ndarray:
    """P^-1 of a lower triangle whose diagonal has no zeros.

    It is not judged by its condition: like substitution on a CPU, a sweep with it may overflow,
    which the solve reports as divergence.
    """
    with np.errstate(all="ignore"):
        return scipy.linalg.solve_triangular(P, np.eye(len(P)), lower=True, check_finite=False)


def readable(S: Operator, method: str) -> RelaxationRows:
    """The rows of S; operators that do not give them are refused, naming `method`."""
    if isinstance(S, IdentityPlus):
        rows = S.R
        shift = 1.0
        scale = S.sign
    else:
        rows = S
        shift = 0.0
        scale = 1.0
    if isinstance(rows, CSR | Dense):
        return RelaxationRows(rows, shift, scale)
    # The columns of Parts may be scaled.
    unscaled = getattr(rows, "A", rows)
    where = getattr(unscaled, "where", "")
    if where:
        problem = f"but they are {where}"
    else:
        problem = f"which {type(rows).__name__} does not allow"
    raise InputError(
        f"method={method!r} reads S row by row, {problem}; give a dense or sparse matrix on one "
        "device, or use method='chebyshev'"
    )


def relaxation(
    S: Operator, method: str, block: int | None = None, omega: float | None = 1.0
) -> Relaxation:
    """Gauss-Seidel and SOR, or block Gauss-Seidel without omega; kept with the matrix of S.

    One omega is kept.
    """
    rows = readable(S, method)
    relaxations = rows.M.known.relaxations
    key = (rows.shift, rows.scale, block, omega is None)
    if key not in relaxations or relaxations[key].omega != omega:
        relaxations[key] = Relaxation(rows, method, block, omega)
    return relaxations[key]


class Relaxation:
    """The sweeps over S with one block size; made by `relaxation`, which keeps it with the matrix.

    It refers to the slabs of the matrix, not to the matrix that keeps it.

    Attributes
    ----------
    block : int
        Rows that are substituted together.
    panel : int
        Rows of one launch.
    inverses : bool
        Whether `weights` are inverses of blocks, else 1 / S_ii.
    weights : Array
        (n, block) inverses of blocks below each other, or (n,).
    windows : list
        One for each slab: the places where `kernels/relax.cl` splits its sparse rows.
    """

    def __init__(
        self, rows: RelaxationRows, method: str, block: int | None, omega: float | None
    ) -> None:
        M = rows.M
        self.device: Device = M.device
        self.n = M.shape[0]
        self.slabs = M.slabs
        self.is_dense = isinstance(M, Dense)
        self.shift = rows.shift
        self.scale = rows.scale
        self.omega = omega
        self.inverses = omega is None or not self.device.is_cpu
        self.is_triangle = omega is not None
        self.is_joined = self.inverses and self.is_triangle and not block
        self.block = self._block_rows(M.nbytes, block)
        self.panel = self._panel_rows(M.nbytes)
        self.weights = self._upload_weights(rows, method)
        if self.is_dense:
            self.windows = [slab.arguments["matrix"] for slab in self.slabs]
        else:
            self.windows = [self._split_windows(slab) for slab in self.slabs]

    def _block_rows(self, nbytes: int, block: int | None) -> int:
        n = max(1, self.n)
        if self.is_joined:
            return triangles.best_block(self.device, n, min(DEFAULT_BLOCK_ROWS, n))
        if not block and self.inverses:
            block = DEFAULT_BLOCK_ROWS
        elif not block:
            block = STRIP_BYTES * n // max(1, nbytes)
        return max(1, min(block, n))

    def _panel_rows(self, nbytes: int) -> int:
        """Rows of a panel: whole blocks; a GPU takes one block."""
        n = max(1, self.n)
        if self.device.is_cpu:
            panels = max(MIN_PANELS, 2 * self.device.compute_units, nbytes // PANEL_BYTES)
        else:
            panels = n
        return self.block * -(-n // (self.block * panels))

    def _upload_weights(self, rows: RelaxationRows, method: str) -> Array:
        size = min(DEFAULT_BLOCK_ROWS, self.block) if self.is_joined else self.block
        # A sweep with Inf ends as divergence, and says so.
        with np.errstate(over="ignore"):
            if self.inverses:
                weights = rows.inverse_blocks(size, self.omega, method)
            else:
                weights = rows.inverse_diagonal(method)
            weights = self.device.upload(weights.astype(np.float32))
        if not self.is_joined:
            return weights
        entries = [entry_arguments(slab, weights) for slab in self.slabs]
        return triangles.join(
            weights, self.block, self.slabs, entries, self.scale, is_dense=self.is_dense
        )

    def _split_windows(self, slab: Slab) -> Array:
        """The entries at which sparse rows of a slab are split, (rows, 2), by binary searches."""
        pointers = slab.arguments["pointers"].get().astype(np.int64)
        columns = slab.arguments["columns"].get()
        row = slab.first + np.arange(slab.rows, dtype=np.int32)
        window_begin = row - row % self.panel
        window_end = row - row % self.block if self.inverses else row
        split = np.stack([window_begin, window_end], axis=1)
        low = np.stack([pointers[:-1], pointers[:-1]], axis=1)
        high = np.stack([pointers[1:], pointers[1:]], axis=1)
        longest_row = int(np.diff(pointers).max(initial=0))
        for bit in reversed(range(longest_row.bit_length())):
            # Taken if the row goes on so far, left of the split.
            last = low + ((1 << bit) - 1)
            is_left = (last < high) & (columns.take(last, mode="clip") < split)
            low += is_left * (1 << bit)
        return self.device.upload(low, np.int32)

    def kernel(self, name: str, **defines: int) -> Kernel:
        """A kernel of `kernels/relax.cl` for the format of M."""
        return _kernel(self.device, "relax", name, self.is_dense, **defines)


def _kernel(device: Device, file: str, name: str, is_dense: bool, **defines: int) -> Kernel:
    if is_dense:
        defines["DENSE"] = 1
    return device.kernel(file, name, **defines)


def entry_arguments(slab: Slab, unread: Array) -> dict[str, Any]:
    """The entries of a slab of either format; `unread` stands for the arrays that it lacks."""
    arguments = slab.arguments
    if "pointers" in arguments:
        return {"width": 0, **arguments}
    return {
        "width": arguments["width"],
        "pointers": unread,
        "columns": unread,
        "values": arguments["matrix"],
    }


class Sweeps:
    """Sweeps of a solve: the iterate `x`, the one `before`, and from the second on its residual."""

    def __init__(self, relaxation: Relaxation, x: Array, b: Array, r: Array) -> None:
        self.relaxation = relaxation
        self.x = x
        self.b = b
        self.r = r
        self.group = GROUP_ITEMS
        self.before = x.like()
        self.s = x.like()
        # The residual that the first sweep tells from it is not read.
        self.carry = x.like().copy_from(b)
        strips = relaxation.panel // relaxation.block
        self._arrivals = x.device.upload(np.zeros(strips + 1), np.int32)

    def sweep(self) -> None:
        """Queue one sweep."""
        n, k = self.x.shape[0], self.x.columns
        if not self.x.device.is_cpu:
            self.before.copy_from(self.x)
        for offset, width in widths(k):
            defines = {"K": width}
            if width == k:
                defines["PACKED"] = 1
            for start in range(0, n, self.relaxation.panel):
                if self.x.device.is_cpu:
                    self._queue_strips(start, offset, defines)
                else:
                    self._queue_block(start, offset, defines)

    def _panel_slabs(self, start: int) -> list[tuple[int, int, int]]:
        """(number, begin, end) of the slabs with rows in the panel from `start` on."""
        panel_end = start + self.relaxation.panel
        slabs = []
        for number, slab in enumerate(self.relaxation.slabs):
            begin = max(start, slab.first)
            end = min(panel_end, slab.end)
            if begin < end:
                slabs.append((number, begin, end))
        return slabs

    def _arguments(
        self, number: int, begin: int, end: int, start: int, offset: int
    ) -> dict[str, Any]:
        """The arguments that both kernels share, for some rows of a slab."""
        relaxation = self.relaxation
        slab = relaxation.slabs[number]
        windows = relaxation.windows[number]
        return {
            "begin": begin,
            "end": end,
            "first": slab.first,
            "panel_start": start,
            "stride": self.x.columns,
            "offset": offset,
            "shift": relaxation.shift,
            "scale": relaxation.scale,
            "windows": windows,
            "x": self.x,
            "b": self.b,
            "s": self.s,
            "r": self.r,
            "carry": self.carry,
            **entry_arguments(slab, windows),
        }

    def _queue_strips(self, start: int, offset: int, defines: dict[str, int]) -> None:
        """Queue a panel of many blocks on a CPU: a work-item takes a block of rows, a strip."""
        relaxation = self.relaxation
        kernel = relaxation.kernel("relax_strips", **defines)
        block = relaxation.block
        omega = 1.0 if relaxation.omega is None else relaxation.omega
        for number, begin, end in self._panel_slabs(start):
            strips = -(-end // block) - begin // block
            kernel(
                strips,
                1,
                strips=strips,
                n=self.x.shape[0],
                block=block,
                by_inverses=int(relaxation.inverses),
                omega=omega,
                weights=relaxation.weights,
                arrivals=self._arrivals,
                before=self.before,
                **self._arguments(number, begin, end, start, offset),
            )

    def _queue_block(self, start: int, offset: int, defines: dict[str, int]) -> None:
        """Queue one block on a GPU: s_B, then x_B += P_BB^-1 s_B."""
        relaxation = self.relaxation
        sums = relaxation.kernel("relax_rows", **defines)
        correct = relaxation.kernel("relax_correct", **defines)
        group = min(sums.group(self.group), correct.group(self.group))
        local = self.x.device.local(2 * defines["K"] * group)
        for number, begin, end in self._panel_slabs(start):
            arguments = self._arguments(number, begin, end, start, offset)
            sums((end - begin) * group, group, scratch=local, **arguments)
        rows = min(relaxation.block, self.x.shape[0] - start)
        correct(
            rows * group,
            group,
            rows=rows,
            start=start,
            block=relaxation.block,
            is_triangle=int(relaxation.is_triangle),
            stride=self.x.columns,
            offset=offset,
            weights=relaxation.weights,
            s=self.s,
            x=self.x,
            scratch=local,
        )


class Steps:
    """Steps of Southwell's relaxation on an iterate `x` and its residual `r`, `parts` rows each."""

    def __init__(self, S: Operator, method: str, x: Array, r: Array, parts: int) -> None:
        rows = readable(S, method)
        device = S.device
        self.rows = rows
        self.x = x
        self.r = r
        self.parts = parts
        self._pending = 0
        self._inverse = device.upload(rows.inverse_diagonal(method))
        # A step reads columns of M.
        columns = rows.M
        if isinstance(rows.M, CSR):
            columns = rows.M.transposed_copy()
        self._slabs = columns.slabs
        shape = (parts, x.columns)
        self._picked = (device.empty(shape, np.int32), device.empty(shape))
        self._next = (device.empty(shape, np.int32), device.empty(shape))
        # Each item looks its rows up in all columns picked: few do on a CPU, where an item is a
        # stream.
        if device.is_cpu:
            self.groups = 2 * device.compute_units
            self.group = 1
        else:
            self.groups = GROUP_ITEMS
            self.group = GROUP_ITEMS

    def step(self, *, picks: bool = True) -> None:
        """Queue one step; `r` learns of its picks at the next, or at one that picks nothing."""
        n, k = self.x.shape[0], self.x.columns
        is_dense = isinstance(self.rows.M, Dense)
        kernel = _kernel(self.x.device, "southwell", "southwell_step", is_dense)
        group = kernel.group(self.group)
        groups = min(self.groups, self.parts)
        picked, delta = self._picked
        next_picked, next_delta = self._next
        for slab in self._slabs:
            is_last = slab is self._slabs[-1]
            kernel(
                (groups * group, k),
                (group, 1),
                n=n,
                parts=self.parts,
                pending=self._pending,
                picks=int(picks and is_last),
                k=k,
                shift=self.rows.shift,
                scale=self.rows.scale,
                rows=slab.rows,
                first=slab.first,
                inverse=self._inverse,
                x=self.x,
                r=self.r,
                picked=picked,
                delta=delta,
                next_picked=next_picked,
                next_delta=next_delta,
                places=self.x.device.local(group),
                **entry_arguments(slab, self._inverse),
            )
        self._picked, self._next = self._next, self._picked
        self._pending = self.parts if picks else 0
