# SPDX-License-Identifier: BSD-3-Clause
"""Transports of three colours between hat functions, as a sketch of many pixels has them, as one.

Each colour of a sketch is T = I + diag(w) W^T K W with the sums W under hats; its interreflection
S = T F^-1 is one more diagonal away. The K of the three colours have their entries mostly in the
same places, so a product of all takes each place once, with three numbers beside each other:

    A = diag(outer) (W^T K W + diag(own)) diag(inner),    (3 N, 3 N), colour below colour,

or A M diag(columns), where M mixes the colours of a pixel. `own` holds the diagonals of K at
pixels, which are direct light and keep all of their digits. An entry in the row of a pixel takes 8
bytes where all numbers have 8 significant bits, as those of a scan do, and nodes are near; else 16
(`kernels/colour_hats.cl`).
"""

from __future__ import annotations

import operator
import os
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.device import Array, Device
from ltcl.device.kernels import Kernel, Queued, in_order
from ltcl.operators.base import Operator
from ltcl.operators.bases import ScaledBasis
from ltcl.operators.compressed import Compressed
from ltcl.operators.coupled import Coupled
from ltcl.operators.csr import CSR
from ltcl.operators.epilogue import PLAIN, Epilogue
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.pyramid import Hats
from ltcl.operators.scaled_columns import ScaledColumns

COLOURS = 3
# Work-items of a group, and pixels that an item of a CPU takes at a time, channel by channel.
GROUP = 64
CPU_BLOCK = 64
# Nodes behind the one of a narrow entry's base, on either side.
MAX_DISTANCE = 1 << 14
# Bits of a real that narrow entries do not have.
LOWER_BITS = np.uint32(0xFFFF)
# Where bits begin that say that there is an entry, above those of three halves.
PRESENCE = 48
# Rows that are joined at once.
ROWS_AT_ONCE = 1 << 15
# Wide entries that are uploaded at once.
ENTRIES_AT_ONCE = 1 << 17
ALL_HALVES = np.uint64((1 << PRESENCE) - 1)
ALL_BITS = (1 << 32) - 1
# Values of the define MIXED: colours of the operand are mixed, or those of the result.
MIXED_OPERAND = 1
MIXED_RESULT = 2
# Reals of a node: one for each colour, and a spare one.
NODE_VALUES = 4
WIDE_BYTES = 16
# Rounding of a diagonal of float32 numbers.
ROUNDING = 2.0**-21


@dataclass(frozen=True, eq=False, kw_only=True)
class JointEntries:
    """The entries of the K of three colours, each place once, row by row.

    Attributes
    ----------
    pixels : int
        The first rows and columns are those of pixels; their diagonal is not among the entries.
    indptr, indices : (nodes + 1,), (entries,)
    numbers : (entries,) uint64 or (entries, 3) uint32
        The upper halves of the bits of three reals, from the lowest bits on, where the lower halves
        are 0, below 16 bits that are free; or all bits.
    """

    pixels: int
    indptr: np.ndarray
    indices: np.ndarray
    numbers: np.ndarray

    @classmethod
    def of(cls, cores: Sequence[Any], own: np.ndarray) -> JointEntries:
        """The entries of K (nodes, nodes) of each colour, float32 in ascending columns.

        `own` (3, N) are the diagonals at pixels.
        """
        nodes = cores[0].shape[0]
        pixels = own.shape[1]
        join = _join_halves
        if not all(map(_has_few_bits, cores, own)):
            join = _join_reals

        def join_rows(rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            indptr, indices, numbers = join([_rows_of_core(K, rows) for K in cores])
            row = np.repeat(np.arange(rows.start, rows.stop, dtype=np.int32), np.diff(indptr))
            is_kept = (row >= pixels) | (indices != row)
            before = np.concatenate([[0], np.cumsum(is_kept)])
            return np.diff(before[indptr]), indices[is_kept], numbers[is_kept]

        counts, indices, numbers = zip(*_in_threads(join_rows, nodes), strict=True)
        return cls(
            pixels=pixels,
            indptr=np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int32),
            indices=np.concatenate(indices),
            numbers=np.concatenate(numbers),
        )

    @property
    def are_halves(self) -> bool:
        """True if the upper halves of all bits suffice."""
        return self.numbers.ndim == 1

    def transposed(self) -> JointEntries:
        """The entries of the K^T."""
        nodes = len(self.indptr) - 1
        if self.are_halves:
            moved = self.numbers.view(np.int64)
        else:
            moved = np.arange(len(self.indices), dtype=np.int32)
        matrix = scipy.sparse.csr_array((moved, self.indices, self.indptr), shape=(nodes, nodes))
        by_column: Any = matrix.tocsc()
        numbers = by_column.data
        if self.are_halves:
            numbers = numbers.view(np.uint64)
        else:
            numbers = self.numbers[numbers]
        return replace(self, indptr=by_column.indptr, indices=by_column.indices, numbers=numbers)


def _in_threads(work: Callable[[slice], Any], rows: int) -> list[Any]:
    """The results for blocks of rows, or of entries, which fit the caches, in order."""
    blocks = [slice(i, min(i + ROWS_AT_ONCE, rows)) for i in range(0, rows, ROWS_AT_ONCE)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, blocks))


def _rows_of_core(K: Any, rows: slice) -> Any:
    """Some rows of a csr_array, whose numbers are not copied, with indices of 32 bits."""
    indptr = K.indptr[rows.start : rows.stop + 1]
    entries = slice(indptr[0], indptr[-1])
    indices = K.indices[entries].astype(np.int32, copy=False)
    parts = (K.data[entries], indices, (indptr - indptr[0]).astype(np.int32))
    return scipy.sparse.csr_array(parts, shape=(rows.stop - rows.start, K.shape[1]))


def _has_few_bits(K: Any, own: np.ndarray) -> bool:
    """True if all but the diagonal at pixels, `own` (N,), have 8 significant bits."""

    def count(entries: slice) -> int:
        return _count_lower_bits(K.data[entries])

    return sum(_in_threads(count, len(K.data))) == _count_lower_bits(own.astype(np.float32))


def _count_lower_bits(values: np.ndarray) -> int:
    """Number of float32 values with more than 8 significant bits."""
    return int(np.count_nonzero(values.view(np.uint32) & LOWER_BITS))


def _join_halves(cores: Sequence[Any]) -> tuple[np.ndarray, ...]:
    """Pointers, columns and upper halves of the bits of three matrices in all their places."""
    total: Any = 0
    for colour, K in enumerate(cores):
        numbers = (K.data.view(np.uint32) >> np.uint32(16)).astype(np.int64)
        numbers <<= 16 * colour
        # Zeros would not count as entries.
        numbers |= 1 << (PRESENCE + colour)
        total = total + scipy.sparse.csr_array((numbers, K.indices, K.indptr), shape=K.shape)
    return total.indptr, total.indices, total.data.view(np.uint64) & ALL_HALVES


def _join_reals(cores: Sequence[Any]) -> tuple[np.ndarray, ...]:
    """Pointers, columns and bits of three matrices in all their places."""
    places: Any = 0
    for K in cores:
        ones = np.full(len(K.data), 1 << PRESENCE)
        places = places + scipy.sparse.csr_array((ones, K.indices, K.indptr), shape=K.shape)
    joint = np.empty((len(places.data), COLOURS), np.uint32)
    for colour, K in enumerate(cores):
        numbers = K.data.view(np.uint32).astype(np.int64)
        total = places + scipy.sparse.csr_array((numbers, K.indices, K.indptr), shape=K.shape)
        joint[:, colour] = total.data & ALL_BITS
    return places.indptr, places.indices, joint


class DeviceRows:
    """The entries of rows on the device: those of pixels, and those of coarser nodes."""

    def __init__(self, device: Device, entries: JointEntries) -> None:
        pixels = entries.pixels
        count = entries.indptr[pixels]
        self.nodes = len(entries.indptr) - 1
        self.pixels = pixels
        of_pixels = _narrow_entries(entries)
        self.is_narrow = of_pixels is not None
        if of_pixels is None:
            self.bases = device.upload(np.zeros(1), np.int32)
            self.entries = _upload_wide(device, entries, slice(0, count))
        else:
            self.bases = device.upload(of_pixels[0], np.int32)
            self.entries = device.upload(of_pixels[1], np.uint16)
        self.pointers = device.upload(entries.indptr[: pixels + 1], np.int32)
        self.coarse_entries = _upload_wide(device, entries, slice(count, entries.indptr[-1]))
        self.coarse_pointers = device.upload(entries.indptr[pixels:] - count, np.int32)

    @property
    def arrays(self) -> list[Array]:
        """All arrays on the device."""
        return [
            self.bases,
            self.entries,
            self.pointers,
            self.coarse_entries,
            self.coarse_pointers,
        ]


def _upload_wide(device: Device, entries: JointEntries, chosen: slice) -> Array:
    """Wide entries on the device; the host never holds all of them."""
    count = int(chosen.stop - chosen.start)
    uploaded = device.empty((count, COLOURS + 1), np.uint32)
    for first in range(0, count, ENTRIES_AT_ONCE):
        size = min(ENTRIES_AT_ONCE, count - first)
        start = int(chosen.start) + first
        block = _wide_entries(entries, slice(start, start + size))
        uploaded.set_rows(first, device.upload(block, np.uint32))
    return uploaded


def _wide_entries(entries: JointEntries, chosen: slice) -> np.ndarray:
    """Wide entries, (count, 4) uint32."""
    numbers = entries.numbers[chosen]
    wide = np.empty((len(numbers), COLOURS + 1), np.uint32)
    if entries.are_halves:
        halves = numbers.view(np.uint16).reshape(-1, COLOURS + 1)
        wide[:, :COLOURS] = halves[:, :COLOURS]
        wide[:, :COLOURS] <<= np.uint32(16)
    else:
        wide[:, :COLOURS] = numbers
    wide[:, COLOURS] = entries.indices[chosen]
    return wide


def _narrow_entries(entries: JointEntries) -> tuple[np.ndarray, np.ndarray] | None:
    """The base of each pixel's row, and narrow entries, (count, 4) uint16; None if too wide.

    Entries become narrow where they are, as their numbers leave room for the nodes.
    """
    if not entries.are_halves:
        return None
    pixels = entries.pixels
    bases = np.zeros(pixels, np.int32)
    narrow = entries.numbers[: entries.indptr[pixels]]

    def narrow_rows(rows: slice) -> bool:
        """Write the bases and entries of some rows; returns whether all nodes are near."""
        indptr = entries.indptr[rows.start : rows.stop + 1]
        own = slice(indptr[0], indptr[-1])
        indptr = indptr - indptr[0]
        columns = entries.indices[own]
        is_far = columns >= pixels
        # Columns ascend: those that are far are the last of a row.
        far_before = np.concatenate([[0], np.cumsum(is_far)])
        far_count = np.diff(far_before[indptr])
        has_far = far_count > 0
        bases[rows][has_far] = columns[(indptr[1:] - far_count)[has_far]]
        counts = np.diff(indptr)
        near_bases = np.repeat(np.arange(rows.start, rows.stop, dtype=np.int32), counts)
        distance = columns - np.where(is_far, np.repeat(bases[rows], counts), near_bases)
        code = (2 * distance + is_far) & 0xFFFF
        narrow[own] &= ALL_HALVES
        narrow[own] |= code.astype(np.uint64) << np.uint64(PRESENCE)
        return not np.any((distance < -MAX_DISTANCE) | (distance >= MAX_DISTANCE))

    if not all(_in_threads(narrow_rows, pixels)):
        return None
    return bases, narrow.view(np.uint16).reshape(-1, COLOURS + 1)


class ColourRows:
    """The K of three colours on a device, and their transposes once they are asked for.

    Attributes
    ----------
    W : Hats
    own : (3, N)
        The diagonals of K in rows of pixels, which are not among their entries.
    """

    def __init__(self, W: Hats, cores: Sequence[Any]) -> None:
        self.W = W
        pixels = W.shape[1]
        self.own = np.stack([K.diagonal()[:pixels].astype(np.float64) for K in cores])
        self._lock = threading.Lock()
        # Until those of the K^T are on the device.
        self._entries: JointEntries | None = JointEntries.of(cores, self.own)
        self._are_transposed = False
        self.forward = DeviceRows(W.device, self._entries)
        self._transposed: DeviceRows | None = None

    def transposed(self) -> DeviceRows:
        """The rows of the K^T."""
        with self._lock:
            if self._transposed is None:
                assert self._entries is not None  # noqa: S101 - they are uploaded once
                if not self._are_transposed:
                    # Those of K make room first.
                    self._entries = self._entries.transposed()
                    self._are_transposed = True
                self._transposed = DeviceRows(self.W.device, self._entries)
                self._entries = None
            return self._transposed

    def arrays(self) -> set[Array]:
        """All arrays on the device."""
        arrays = set(self.forward.arrays)
        if self._transposed is not None:
            arrays |= set(self._transposed.arrays)
        return arrays


@dataclass(frozen=True, eq=False, kw_only=True)
class Factors:
    """The diagonals and the mixing of `ColourHats` on the device; None for ones, or zeros of `own`.

    `inner`, `outer` and `columns` are (3, N) or (3 N,), `own` is (N, 4), `mixing` is M and
    `transposed_mixing` M^T, (3, 3).
    """

    inner: Array | None
    outer: Array
    own: Array | None
    columns: Array | None = None
    has_mixing: bool
    mixing: Array
    transposed_mixing: Array

    @classmethod
    def upload(
        cls,
        device: Device,
        inner: np.ndarray,
        outer: np.ndarray,
        own: np.ndarray,
        mixing: np.ndarray | None,
    ) -> Factors:
        """The factors (3, N) of a product, and M if colours are mixed."""
        own_of_nodes = None
        if own.any():
            padded = np.zeros((own.shape[1], NODE_VALUES), np.float32)
            padded[:, :COLOURS] = own.T
            own_of_nodes = device.upload(padded)
        M = np.eye(COLOURS) if mixing is None else mixing
        return cls(
            inner=None if np.all(inner == 1.0) else device.upload(inner),
            outer=device.upload(outer),
            own=own_of_nodes,
            has_mixing=mixing is not None,
            mixing=device.upload(M),
            transposed_mixing=device.upload(M.T),
        )

    @property
    def arrays(self) -> list[Array | None]:
        """All arrays of many numbers."""
        return [self.inner, self.outer, self.own, self.columns]

    def scales(self, transpose: bool) -> tuple[Array | None, Array | None]:
        """The factors of nodes, and those of the result."""
        if transpose:
            return self.outer, self.inner
        return self.inner, self.outer

    def defines(self, transpose: bool) -> dict[str, int]:
        """Defines of the kernels that say which factors there are, and how colours are mixed."""
        inner, outer = self.scales(transpose)
        mixed = 0
        if self.has_mixing:
            mixed = MIXED_RESULT if transpose else MIXED_OPERAND
        return {
            "INNER": int(inner is not None),
            "OUTER": int(outer is not None),
            "OWN": int(self.own is not None),
            "MIXED": mixed,
            "COLUMNS": int(self.columns is not None),
        }

    def mixing_arguments(self, transpose: bool, unread: Array) -> dict[str, Array]:
        """Arguments of the kernels that say how colours are mixed."""
        return {
            "mixing": self.transposed_mixing if transpose else self.mixing,
            "columns": unread if self.columns is None else self.columns,
        }


class ColourHats(Operator):
    """diag(outer) (W^T K W + diag(own)) diag(inner) M diag(columns) of three colours, (3 N, 3 N).

    Parameters
    ----------
    rows : ColourRows
    factors : Factors
    each : Operator
        The same operator, colour by colour, which takes several right-hand sides.
    """

    def __init__(self, rows: ColourRows, factors: Factors, each: Operator) -> None:
        device = rows.W.device
        self.rows = rows
        self.each = each
        self._block = CPU_BLOCK if device.is_cpu else 1
        self._group = 1 if device.is_cpu else GROUP
        self._factors = factors
        super().__init__(device, each.shape, *self._factors.arrays, each)
        self.error = each.error

    def arrays(self) -> set[Array]:
        """All arrays on the device, with those of each colour."""
        return super().arrays() | self.rows.arrays()

    def diagonal(self) -> np.ndarray:
        """The diagonals of the colours, one behind the other."""
        return self.each.diagonal()

    def with_columns(self, d: np.ndarray) -> ColourHats | None:
        """A diag(d), d (3 N,), which reads it along; None unless colours are mixed."""
        if not self._factors.has_mixing or self._factors.columns is not None:
            return None
        each = ScaledColumns(self.each, d)
        factors = replace(self._factors, columns=each.uploaded_d)
        return ColourHats(self.rows, factors, each)

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self._bind_product(x, out, epilogue, transpose)()

    def _bind_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Any:
        if x.columns != 1:
            return self.each._bind_product(x, out, epilogue, transpose)
        rows = self.rows.transposed() if transpose else self.rows.forward
        nodes = self.device.empty((rows.nodes, NODE_VALUES))
        sums = self.rows.W.scratch(NODE_VALUES)
        launches = [
            self._bind_scale(rows, x, nodes, transpose),
            *self._bind_levels(rows, nodes, sums, transpose),
            self._bind_finish(rows, nodes, sums, x, out, epilogue, transpose),
        ]
        return in_order(launches)

    def _kernel(self, name: str, rows: DeviceRows, transpose: bool) -> Kernel:
        """A kernel of the one program of these rows."""
        defines = self._factors.defines(transpose)
        return self.device.kernel(
            "colour_hats",
            f"colour_hats_{name}",
            NARROW=int(rows.is_narrow),
            BLOCK=self._block,
            **defines,
        )

    def _bind_scale(self, rows: DeviceRows, x: Array, nodes: Array, transpose: bool) -> Queued:
        """The launch that makes the nodes of level 0."""
        factors = self._factors
        inner, _ = factors.scales(transpose)
        return self._kernel("scale", rows, transpose).bind(
            -(-rows.pixels // self._block),
            self._group,
            pixels=rows.pixels,
            inner=x if inner is None else inner,
            x=x,
            nodes=nodes,
            **factors.mixing_arguments(transpose, x),
        )

    def _bind_levels(
        self, rows: DeviceRows, nodes: Array, sums: Array, transpose: bool
    ) -> list[Queued]:
        """The launches of all coarser levels: sums under hats, rows of K, light between nodes."""
        coarse = rows.nodes - rows.pixels
        if not coarse:
            return []
        W = self.rows.W
        light = nodes.like()
        multiply = self._kernel("rows", rows, transpose).bind(
            coarse,
            GROUP,
            first=rows.pixels,
            rows=coarse,
            pointers=rows.coarse_pointers,
            entries=rows.coarse_entries,
            nodes=nodes,
            light=light,
        )
        gather = W.bind_levels(nodes, nodes, PLAIN, False, sums, first_level=1)
        spread = W.bind_levels(light, light, PLAIN, True, sums, first_level=1)
        return [gather, multiply, spread]

    def _bind_finish(
        self,
        rows: DeviceRows,
        nodes: Array,
        sums: Array,
        x: Array,
        out: Array,
        epilogue: Epilogue,
        transpose: bool,
    ) -> Queued:
        """The launch over all pixels."""
        factors = self._factors
        _, outer = factors.scales(transpose)
        height, width = self.rows.W.grid
        return self._kernel("finish", rows, transpose).bind(
            (-(-width // self._block), height),
            (self._group, 1),
            height=height,
            width=width,
            levels=len(self.rows.W.levels),
            pointers=rows.pointers,
            bases=rows.bases,
            entries=rows.entries,
            nodes=nodes,
            sums=sums,
            outer=x if outer is None else outer,
            own=x if factors.own is None else factors.own,
            a=epilogue.a,
            b=epilogue.b,
            c=epilogue.c,
            x=x,
            y=epilogue.operand(out),
            out=out,
            **factors.mixing_arguments(transpose, x),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Colour:
    """One colour: (I + diag(scale) W^T K W) diag(inner) - diag(shift)."""

    W: Hats
    core: CSR
    scale: np.ndarray
    inner: np.ndarray
    shift: np.ndarray


def join_colours(
    blocks: Sequence[Operator], each: Operator, mixing: np.ndarray | None = None
) -> ColourHats | None:
    """diag(A_1, A_2, A_3) M, where all A are of a sketch of many pixels; None for others.

    `each` is the same, made of the blocks.
    """
    colours = []
    for block in blocks:
        colour = _colour_of(block)
        if colour is None:
            return None
        colours.append(colour)
    if len(colours) != COLOURS or not _have_same_hats(colours):
        return None
    rows = _rows_of(colours)
    if rows is None:
        return None
    inner = np.stack([colour.inner for colour in colours])
    outer = np.stack([colour.scale for colour in colours])
    shift = np.stack([colour.shift for colour in colours])
    is_lit = inner != 0.0
    if np.any(shift[~is_lit]) or not np.all(outer > 0.0):
        return None
    # A = diag(outer) (W^T K W + (I - diag(shift / inner)) / outer) diag(inner)
    own = rows.own + (1.0 - np.divide(shift, inner, out=np.zeros_like(inner), where=is_lit)) / outer
    # Where F is direct light nothing is left of it but rounding.
    own[np.abs(own) * outer <= ROUNDING * np.abs(shift)] = 0.0
    factors = Factors.upload(rows.W.device, inner, outer, own, mixing)
    return ColourHats(rows, factors, each)


def _colour_of(block: Operator) -> _Colour | None:
    """The parts of T or of R = S - I of one colour of a sketch; None for another operator."""
    if not isinstance(block, ScaledColumns) or not isinstance(block.A, IdentityPlus):
        return None
    R = block.A.R
    if not isinstance(R, Compressed) or block.A.sign != 1.0 or type(R.core) is not CSR:
        return None
    W = R.into
    out = R.out
    if not isinstance(W, Hats) or not isinstance(out, ScaledBasis):
        return None
    if not isinstance(out.of, Hats) or out.grid != W.grid:
        return None
    return _Colour(
        W=W,
        core=R.core,
        scale=np.asarray(out.scale, np.float64),
        inner=block.d,
        shift=np.broadcast_to(block.shift, block.d.shape),
    )


def share_entries(blocks: Sequence[Operator]) -> bool:
    """True if `join_colours` makes these operators one, but for what a device has no room for."""
    colours = []
    for block in blocks:
        colour = _colour_of(block.R if isinstance(block, IdentityPlus) else block)
        if colour is None:
            return False
        colours.append(colour)
    return len(colours) == COLOURS and _have_same_hats(colours)


def _have_same_hats(colours: Sequence[_Colour]) -> bool:
    """True if all colours are on one grid of one device."""
    first = colours[0].W
    for colour in colours:
        if colour.W.grid != first.grid or colour.W.device is not first.device:
            return False
    return True


def _rows_of(colours: Sequence[_Colour]) -> ColourRows | None:
    """The joint rows of the colours, made once in the life of the first; None if too large."""
    cores = [colour.core for colour in colours]
    known = cores[0].known
    if known.colour_rows is not None:
        references, rows = known.colour_rows
        # The memory of a matrix that is gone may be that of another one now.
        known_cores = [reference() for reference in references]
        if all(map(operator.is_, cores, known_cores)):
            return rows
    device = colours[0].W.device
    most = sum(core.nnz for core in cores) * WIDE_BYTES
    if most > device.max_allocation:
        return None
    rows = ColourRows(colours[0].W, [core.matrix() for core in cores])
    known.colour_rows = (tuple(map(weakref.ref, cores)), rows)
    return rows


def mixed_colours(operators: Sequence[Operator], mixing: np.ndarray) -> Operator:
    """T of three colours that see only their own light, which is mixed before."""
    coupled = Coupled.mixed(operators, mixing)
    joined = join_colours(operators, coupled, mixing)
    return coupled if joined is None else joined


def scale_columns(A: Operator, d: np.ndarray) -> Operator:
    """A diag(d), which colours of a sketch take along."""
    scaled = None
    if isinstance(A, ColourHats):
        scaled = A.with_columns(d)
    return ScaledColumns(A, d) if scaled is None else scaled
