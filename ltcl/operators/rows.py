# SPDX-License-Identifier: BSD-3-Clause
"""Operators whose matrix lies on the device as slabs of rows: launches of products and of steps.

The kernels are those of `kernels/common/product.h`: they take its arguments, those of a slab, and
local memory.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, ahead, tuning, vectors
from ltcl.device.device import SPARE_BYTES
from ltcl.device.kernels import Kernel, Launch, Queued, in_order
from ltcl.errors import MemoryLimitError
from ltcl.operators.base import Operator
from ltcl.operators.epilogue import PLAIN, Epilogue, widths
from ltcl.operators.knowledge import Float64Form, NormBound, Norms
from ltcl.operators.stepper import Stepper

# The Frobenius norm up to which its square, a float32 sum on the device, is finite.
MAX_SQUARED_NORM = 1e18
# The square of a smaller entry is 0 on the device.
MIN_SQUARED_ENTRY = 2.0**-63
# Rounding of that sum.
NORM_MARGIN = 1.01
# Sub-groups of a work-group on a GPU, which has several short rows: no item is idle, and fewer
# groups start and leave fewer partial sums. Long rows have up to MAX_ROW_ITEMS.
SUBGROUPS_OF_GROUP = 4
MAX_ROW_ITEMS = 256
MIN_ROW_ITEMS = 4
# Turns of the loop of an item, in the order in which variants are tried.
TURNS_OF_ITEM = (2, 4, 1, 8)
# Kernels count the elements of a slab in 32 bits, also a work-group beyond the end of a row.
MAX_SLAB_ELEMENTS = (1 << 31) - 4096
# Bytes of a matrix beside whose upload programs are built.
MIN_BYTES_AHEAD = 1 << 20


@dataclass(frozen=True)
class Slab:
    """Rows first .. first + rows of the matrix; `arguments` of kernels of its format by name."""

    first: int
    rows: int
    arguments: dict[str, Any]

    @property
    def end(self) -> int:
        """The row behind the last."""
        return self.first + self.rows

    @property
    def arrays(self) -> list[Array]:
        """All its arrays on the device."""
        return [value for value in self.arguments.values() if isinstance(value, Array)]

    @property
    def nbytes(self) -> int:
        """Bytes of its buffers."""
        return sum(array.nbytes for array in self.arrays)


@dataclass(frozen=True)
class Variant:
    """A kernel over rows: work-groups of `group` items, which share rows or have one each.

    A group that shares has `rows` rows, of which each gets the same number of items.
    """

    suffix: str
    group: int
    shared: bool
    rows: int = 1

    @property
    def defines(self) -> dict[str, int]:
        """Defines of the program."""
        return {"ROWS": self.rows} if self.rows > 1 else {}

    def shape(self, kernel: Kernel, rows: int, width: int) -> tuple[int, int, Any]:
        """Work-items, work-group and local memory of a launch with `width` right-hand sides."""
        group = kernel.group(self.group)
        items = rows
        if self.shared:
            items = -(-rows // self.rows) * group
        return items, group, kernel.device.local(width * group)


@dataclass(frozen=True, kw_only=True)
class EntrySums:
    """Sums over the entries A_ij of a matrix in float64.

    `columns` are the sums of |A_ij| in each column, (N,), `largest_row` is the largest in a row;
    `lowest` is the lowest entry, or 0.
    """

    columns: np.ndarray
    largest_row: float
    squares: float
    lowest: float

    def norms(self) -> Norms:
        """Norms of the matrix."""
        return Norms(
            one=float(self.columns.max(initial=0.0)),
            inf=self.largest_row,
            frobenius=self.squares**0.5,
            lowest=self.lowest,
        )

    def joined(self, other_rows: EntrySums) -> EntrySums:
        """Sums over these rows and others of the same matrix."""
        return EntrySums(
            columns=self.columns + other_rows.columns,
            largest_row=max(self.largest_row, other_rows.largest_row),
            squares=self.squares + other_rows.squares,
            lowest=min(self.lowest, other_rows.lowest),
        )


class ReadableRows(Operator):
    """An operator whose entries the host can read; subclasses write `blocks`.

    Attributes
    ----------
    exact_form : Float64Form or None
        Its numbers as they were given, before they were rounded to float32.
    """

    exact_form: Float64Form | None = None

    @abc.abstractmethod
    def blocks(self) -> Iterator[tuple[int, Any]]:
        """(first row, rows): float64 arrays or csr_arrays (rows, N), in order."""

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64."""
        diagonal = np.zeros(min(self.shape))
        for first, rows in self.blocks():
            piece = rows.diagonal(first)
            diagonal[first : first + len(piece)] = piece
        return diagonal

    def norms(self) -> Norms:
        """Norms of the matrix, in float64."""
        return self.sums().norms()

    def sums(self) -> EntrySums:
        """Sums over all entries."""
        columns = np.zeros(self.shape[1])
        largest_row = 0.0
        squares = 0.0
        lowest = 0.0
        for _, rows in self.blocks():
            values = rows.data if scipy.sparse.issparse(rows) else rows
            squares += float(np.vdot(values, values))
            lowest = min(lowest, float(values.min(initial=0.0)))
            sizes = abs(rows)
            columns += sizes.sum(axis=0)
            row_sums = sizes.sum(axis=1)
            largest_row = max(largest_row, float(row_sums.max(initial=0.0)))
        return EntrySums(columns=columns, largest_row=largest_row, squares=squares, lowest=lowest)

    def _dense(self) -> np.ndarray:
        dense = np.empty(self.shape)
        for first, rows in self.blocks():
            block = rows.toarray() if scipy.sparse.issparse(rows) else rows
            dense[first : first + len(block)] = block
        return dense

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        if self.exact_form is None and reads_blocks:
            return Float64Form(matrix=self.to_dense())
        return self.exact_form


class RowOperator(ReadableRows):
    """An operator stored as slabs of rows.

    Subclasses set `file`, `numbers`, `defines` and `slabs`, and write `blocks` and
    `_bind_transpose`.

    Attributes
    ----------
    file : str
        Stem of the kernel file.
    numbers : str
        The argument of a slab that holds the entries.
    entries_of_turn : int
        Entries that an item of a group takes in one turn of its loop.
    unit : float
        Unit of the numbers in the slabs.
    """

    file: ClassVar[str]
    numbers: ClassVar[str]
    entries_of_turn: int = 4
    defines: dict[str, Any]
    unit: float = 1.0

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        super().__init__(device, shape)
        self.defines = {}
        self._slabs: list[Slab] | None = None
        self._fastest: dict[tuple[int, int], Variant] = {}

    @abc.abstractmethod
    def _bind_transpose(self, x: Array, out: Array, epilogue: Epilogue) -> Callable[[], object]:
        """A function that queues the product with A^T at each call."""

    @property
    def slabs(self) -> list[Slab]:
        """The slabs, which some formats upload at the first call."""
        if self._slabs is None:
            self._slabs = self._upload_later()
        return self._slabs

    @slabs.setter
    def slabs(self, slabs: list[Slab]) -> None:
        self._slabs = slabs

    def _upload_later(self) -> list[Slab]:
        """The slabs of a format that does not upload them when it is made."""
        return []

    @property
    def has_entries(self) -> bool:
        """True: its entries lie on one device, in rows."""
        return True

    def arrays(self) -> set[Array]:
        """The arrays of all slabs, as far as they are uploaded."""
        if self._slabs is None:
            return set()
        return {array for slab in self._slabs for array in slab.arrays}

    def norm_bound(self) -> NormBound:
        """The Frobenius norm, a bound on the 2-norm of |A|."""
        if self.known.norm_bound is None:
            norm = self._frobenius_norm()
            value = math.inf
            if norm < MAX_SQUARED_NORM:
                value = NORM_MARGIN * norm + MIN_SQUARED_ENTRY * max(self.shape)
            self.known.norm_bound = NormBound(value, is_bound=True)
        return self.known.norm_bound

    def _frobenius_norm(self) -> float:
        """The Frobenius norm of the numbers on the device."""
        squares = []
        for slab in self.slabs:
            values = slab.arguments[self.numbers]
            if values.size:
                flat = dataclasses.replace(values, shape=(values.size,))
                squares.append(float(vectors.dot(flat, flat)[0]))
        return math.sqrt(math.fsum(squares))

    # Kernels and their variants.

    @classmethod
    def build_ahead(
        cls, device: Device, shape: tuple[int, int], nbytes: int, defines: Mapping[str, Any]
    ) -> None:
        """Begin to build the programs of a product and of a solve, beside an upload of `nbytes`."""
        if nbytes >= MIN_BYTES_AHEAD:
            of_product = {"K": 1, "PACKED": 1, **defines}
            ahead.begin(device, cls.file, of_product, solves=shape[0] == shape[1])

    def kernel(self, name: str, width: int, columns: int, **defines: int) -> Kernel:
        """The kernel `name` for `width` of `columns` right-hand sides."""
        packed = {"PACKED": 1} if width == columns else {}
        return self.device.kernel(self.file, name, K=width, **packed, **defines, **self.defines)

    def variants(self) -> dict[str, Variant]:
        """The kernels and work-groups that can make a product here, the default first."""
        if self.device.is_cpu:
            return {"item": Variant("", 16, shared=False)}
        limit = power_of_two(min(MAX_ROW_ITEMS, self.device.max_group))
        group = min(limit, power_of_two(SUBGROUPS_OF_GROUP * self.device.subgroup))
        numbers = sum(slab.arguments[self.numbers].size for slab in self.slabs)
        row_turns = numbers // max(1, self.shape[0]) // self.entries_of_turn
        variants = {}
        for turns in TURNS_OF_ITEM:
            items = min(limit, max(MIN_ROW_ITEMS, power_of_two(row_turns // turns)))
            rows = max(1, group // items)
            variants[f"{rows} rows by {items}"] = Variant("_group", rows * items, True, rows)
        variants["item"] = Variant("", 64, shared=False)
        return variants

    def fastest(self, x: Array, width: int) -> Variant:
        """The variant for products with `width` of the right-hand sides `x`, timed once."""
        key = (width, x.columns)
        if key not in self._fastest:
            variants = self.variants()
            if len(variants) == 1:
                self._fastest[key] = next(iter(variants.values()))
            else:
                self._fastest[key] = variants[self._fastest_name(variants, x, width)]
        return self._fastest[key]

    def _fastest_name(self, variants: dict[str, Variant], x: Array, width: int) -> str:
        """Time the variants on the largest slab, once per device and kind of problem."""
        slab = max(self.slabs, key=lambda slab: slab.nbytes)
        # The result goes into a spare array: `out` may be an operand.
        spare = self.device.empty((self.shape[0], *x.shape[1:]))
        trials = {}
        for name, variant in variants.items():
            trials[name] = self._bind_slab(slab, (0, width), x, spare, PLAIN, variant)
        row_bytes = slab.nbytes // max(slab.rows, 1)
        settings = " ".join(f"{name}={value}" for name, value in sorted(self.defines.items()))
        problem = (
            f"{settings} k={width} of {x.columns}, rows of about 2^{row_bytes.bit_length()} bytes"
        )
        return tuning.choose(self.device, self.file, problem, trials)

    # Products.

    def _bind_slab(
        self,
        slab: Slab,
        piece: tuple[int, int],
        x: Array,
        out: Array,
        epilogue: Epilogue,
        variant: Variant,
    ) -> Launch:
        """The launch for one slab and one piece (offset, width) of right-hand sides."""
        offset, width = piece
        name = f"{self.file}_matvec{variant.suffix}"
        kernel = self.kernel(name, width, x.columns, **variant.defines)
        items, group, local = variant.shape(kernel, slab.rows, width)
        return kernel.bind(
            items,
            group,
            rows=slab.rows,
            first=slab.first,
            stride=x.columns,
            offset=offset,
            a=epilogue.a * self.unit,
            b=epilogue.b,
            c=epilogue.c,
            x=x,
            y=epilogue.operand(out),
            out=out,
            scratch=local,
            **slab.arguments,
        )

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self._bind_product(x, out, epilogue, transpose)()

    def _bind_product(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        if transpose:
            return self._bind_transpose(x, out, epilogue)
        return self.bind_rows(0, x, out, epilogue)

    def bind_rows(self, start: int, x: Array, out: Array, epilogue: Epilogue) -> Queued:
        """A function that queues the product into the rows of `out` from `start` on.

        These are then rows of a larger matrix; x, y and `out` belong to all of it.
        """
        launches = []
        for offset, width in widths(x.columns):
            variant = self.fastest(x, width)
            for slab in self.slabs:
                moved = dataclasses.replace(slab, first=start + slab.first)
                launch = self._bind_slab(moved, (offset, width), x, out, epilogue, variant)
                launches.append(launch)
        return in_order(launches)

    def stepper(
        self, x: Array, r: Array, slots: int = 8, a: float = 1.0, c: float = 0.0
    ) -> Stepper:
        """Steps of one launch each; see `Operator.stepper`."""
        return RowStepper(self, x, r, slots, a * self.unit, c)


class SparseRows(RowOperator):
    """Slabs of sparse rows, whose transposed products use A^T in rows of its own."""

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        super().__init__(device, shape)
        self._transposed: RowOperator | None = None

    @abc.abstractmethod
    def _transposed_rows(self) -> RowOperator:
        """A^T in rows, in the same format."""

    def transposed_copy(self) -> RowOperator:
        """A^T in rows of its own, made at the first call and kept."""
        if self._transposed is None:
            self._transposed = self._transposed_rows()
        return self._transposed

    def arrays(self) -> set[Array]:
        """The arrays of all slabs, and of the transpose once it was asked for."""
        arrays = super().arrays()
        if self._transposed is not None:
            arrays |= self._transposed.arrays()
        return arrays

    def _bind_transpose(self, x: Array, out: Array, epilogue: Epilogue) -> Callable[[], object]:
        return self.transposed_copy()._bind_product(x, out, epilogue, False)


@dataclass(frozen=True, kw_only=True)
class StepPiece:
    """A launch of a step: a slab, a piece of right-hand sides, and the groups before its own."""

    kernel: Kernel
    items: int
    group: int
    local: Any
    slab: Slab
    offset: int
    first_group: int

    @property
    def end_group(self) -> int:
        """The group behind its last."""
        return self.first_group + -(-self.items // self.group)


class RowStepper(Stepper):
    """Steps of one launch for each slab and each eight right-hand sides.

    A is all of the matrix, or its rows from `start` on: the step then changes these rows alone of
    x, r and d.
    """

    A: RowOperator

    def __init__(
        self,
        A: RowOperator,
        x: Array,
        r: Array,
        slots: int,
        a: float,
        c: float,
        *,
        start: int = 0,
    ) -> None:
        self._start = start
        super().__init__(A, x, r, slots, a, c)

    def _prepare(self) -> None:
        pieces = self._step_pieces()
        columns = self.x.columns
        self._groups = max((piece.end_group for piece in pieces), default=1)
        self._partials = self.A.device.empty((self.slots, self._groups, columns))
        if len({self._column_end(pieces, piece.offset) for piece in pieces}) > 1:
            # Some pieces of right-hand sides have fewer groups than others.
            vectors.fill(self._partials, 0.0)
        # Many rows read the direction while the next one is written: the two take turns.
        self._turns = [
            self._bind_turn(pieces, self.d, self.spare),
            self._bind_turn(pieces, self.spare, self.d),
        ]

    def _step_pieces(self) -> list[StepPiece]:
        A = self.A
        columns = self.x.columns
        pieces = []
        for offset, width in widths(columns):
            variant = A.fastest(self.x, width)
            name = f"{A.file}_matvec{variant.suffix}"
            kernel = A.kernel(name, width, columns, STEP=1, **variant.defines)
            first_group = 0
            for slab in A.slabs:
                items, group, local = variant.shape(kernel, slab.rows, width)
                piece = StepPiece(
                    kernel=kernel,
                    items=items,
                    group=group,
                    local=local,
                    slab=slab,
                    offset=offset,
                    first_group=first_group,
                )
                pieces.append(piece)
                first_group = piece.end_group
        return pieces

    @staticmethod
    def _column_end(pieces: list[StepPiece], offset: int) -> int:
        """The groups of all slabs, for the right-hand sides from `offset` on."""
        return max(piece.end_group for piece in pieces if piece.offset == offset)

    def _bind_turn(
        self, pieces: list[StepPiece], d: Array, next_d: Array
    ) -> list[tuple[Launch, int]]:
        """The launches of a step along d that write the next direction, with their first groups."""
        turn = []
        for piece in pieces:
            launch = piece.kernel.bind(
                piece.items,
                piece.group,
                rows=piece.slab.rows,
                first=self._start + piece.slab.first,
                stride=self.x.columns,
                offset=piece.offset,
                a=self._a,
                c=self._c,
                keep=0.0,
                gain=0.0,
                first_group=piece.first_group,
                x=d,
                iterate=self.x,
                r=self.r,
                next_x=next_d,
                partials=self._partials,
                scratch=piece.local,
                **piece.slab.arguments,
            )
            turn.append((launch, piece.first_group))
        return turn

    def step(self, keep: float, gain: float) -> None:
        """Queue one step; see `Stepper.step`."""
        for launch, first_group in self._turns[0]:
            waiting_groups = self.waiting * self._groups
            launch.set(keep=keep, gain=gain, first_group=waiting_groups + first_group)
            launch()
        self._turns.reverse()
        self.d, self.spare = self.spare, self.d
        self.waiting += 1


def power_of_two(n: int) -> int:
    """The largest power of two up to n, at least 1.

    >>> [power_of_two(n) for n in (0, 1, 63, 64)]
    [1, 1, 32, 64]
    """
    return 1 << (max(1, n).bit_length() - 1)


def cut(
    device: Device, row_bytes: np.ndarray, matrix_name: str, itemsize: int = 4
) -> list[tuple[int, int]]:
    """Rows (start, stop) of as few slabs as possible, each in one buffer that the device takes.

    `row_bytes` (M,) are the bytes of each row; `matrix_name` names it in a refusal.
    """
    # Pointers are one more than rows.
    limit = min(device.max_allocation - SPARE_BYTES - 4, itemsize * MAX_SLAB_ELEMENTS)
    ends = np.concatenate([[0], np.cumsum(row_bytes, dtype=np.int64)])
    pieces = []
    start = 0
    while start < len(row_bytes):
        stop = int(np.searchsorted(ends, ends[start] + limit, side="right")) - 1
        if stop == start:
            row = checks.size(int(row_bytes[start]))
            raise MemoryLimitError(
                f"row {start} of {matrix_name} has {row}, the largest buffer of this device "
                f"{checks.size(limit)}"
            )
        pieces.append((start, stop))
        start = stop
    return pieces or [(0, 0)]
