# SPDX-License-Identifier: BSD-3-Clause
"""Several operators as one: diag(A_1, ..., A_c) on vectors that stand one below the other.

The three colours of a frame are then one vector, one product and one solve. What the operators have
in common is shared: an identity plus, or cores between one basis, become one of these; cores of one
format become one core, so that a product is one launch.
"""

from __future__ import annotations

import operator
import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl.device import Array
from ltcl.device.kernels import Queued, in_order
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.bases import Basis, SubsetBasis
from ltcl.operators.colour_hats import COLOURS, join_colours, share_entries
from ltcl.operators.compressed import Compressed
from ltcl.operators.csr import CSR
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.knowledge import NormBound
from ltcl.operators.rows import RowOperator
from ltcl.operators.scaled_columns import ScaledColumns
from ltcl.operators.tile_packing import Packed, joined_diagonally
from ltcl.operators.tiles import Tiles
from ltcl.operators.wavelets import Wavelet

# Bytes up to which matrices are joined, which takes as many once more.
MAX_JOINED_BYTES = 1 << 26
# Bytes of all operators up to which launches count more.
MAX_SMALL_BYTES = 1 << 24


class Place(NamedTuple):
    """The rows of x and of the result with which the part of a block begins."""

    of_x: int
    of_out: int


class BlockDiagonal(Operator):
    """diag(A_1, ..., A_c) of operators on one device.

    `block_diagonal` finds a faster form where there is one.

    Parameters
    ----------
    blocks : sequence of Operator

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import BlockDiagonal, Dense
    >>> device = ltcl.open_device()
    >>> A = BlockDiagonal([Dense(device, [[2.0]]), Dense(device, [[3.0]])])
    >>> (A @ numpy.array([1.0, 10.0])).tolist()
    [2.0, 30.0]
    """

    def __init__(self, blocks: Sequence[Operator]) -> None:
        device = check_blocks(blocks).device
        self.blocks = tuple(blocks)
        # Where each block begins, and the last one ends.
        self._rows = [0]
        self._columns = [0]
        for block in blocks:
            self._rows.append(self._rows[-1] + block.shape[0])
            self._columns.append(self._columns[-1] + block.shape[1])
        super().__init__(device, (self._rows[-1], self._columns[-1]), *blocks)
        self.error = max(block.error for block in blocks)
        _take_over_facts(self, blocks)

    def diagonal(self) -> np.ndarray:
        """The diagonals of the blocks, one behind the other."""
        if self._rows != self._columns:
            raise InputError(f"{type(self).__name__} of {self.shape} does not know its diagonal")
        return np.concatenate([block.diagonal() for block in self.blocks])

    def norm_bound(self) -> NormBound:
        """The largest bound of the blocks."""
        bounds = [block.norm_bound() for block in self.blocks]
        largest = max(bound.value for bound in bounds)
        are_bounds = all(bound.is_bound for bound in bounds)
        return NormBound(largest, is_bound=are_bounds)

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self._bind_product(x, out, epilogue, transpose)()

    def _bind_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        to, of = (self._columns, self._rows) if transpose else (self._rows, self._columns)
        launches = []
        for number, block in enumerate(self.blocks):
            rows = _rows_of_product(block, transpose)
            if rows is not None and x.columns == 1 and to[number] == of[number]:
                launches += _bind_rows(rows, to[number], x, out, epilogue)
            else:
                place = Place(of[number], to[number])
                launches.append(_bind_copies(block, place, x, out, epilogue, transpose))
        return in_order(launches)


def _take_over_facts(joined: Operator, blocks: Sequence[Operator]) -> None:
    """Errors of solutions, the largest of the blocks, and weights, where all blocks have some."""
    weights = []
    for block in blocks:
        joined.solution_error = max(joined.solution_error, block.solution_error)
        joined.error_bound = max(joined.error_bound, block.error_bound)
        if block.weights is not None:
            weights.append(block.weights)
    if len(weights) == len(blocks):
        joined.weights = np.concatenate(weights)


def block_diagonal(blocks: Sequence[Operator]) -> Operator:
    """diag(A_1, ..., A_c) in the fastest form for these operators.

    Parameters
    ----------
    blocks : sequence of Operator
        On one device; InputError for others. One operator alone comes back.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense, IdentityPlus, block_diagonal
    >>> device = ltcl.open_device()
    >>> S = block_diagonal([IdentityPlus(Dense(device, [[0.5]])) for _ in range(3)])
    >>> type(S).__name__, (S @ numpy.array([2.0, 4.0, 6.0])).tolist()
    ('IdentityPlus', [3.0, 6.0, 9.0])
    """
    first = check_blocks(blocks)
    if len(blocks) == 1:
        return first
    for join in JOINS:
        joined = join(blocks)
        if joined is not None:
            return joined
    return BlockDiagonal(blocks)


def joined_once(blocks: Sequence[Operator]) -> Operator:
    """`block_diagonal` of these operators, made once in the life of the first."""
    known = blocks[0].known
    if known.joined is not None:
        references, joined = known.joined
        # The memory of a block that is gone may be that of another one now.
        known_blocks = [reference() for reference in references]
        if len(blocks) == len(known_blocks) and all(map(operator.is_, blocks, known_blocks)):
            return joined
    joined = block_diagonal(blocks)
    known.joined = (tuple(map(weakref.ref, blocks)), joined)
    return joined


def are_quicker_joined(blocks: Sequence[Operator]) -> bool:
    """True if launches take longer than what they multiply with, or all share what is read."""
    return share_entries(blocks) or sum(block.nbytes for block in blocks) <= MAX_SMALL_BYTES


def check_blocks(blocks: Sequence[Operator]) -> Operator:
    """The first block; InputError unless all have one device."""
    if not blocks:
        raise InputError("blocks is empty; there must be at least one operator")
    first = blocks[0]
    for block in blocks:
        if block.device is not first.device:
            raise InputError(
                f"blocks are on {first.device} and {block.device}; all must be on one device"
            )
    return first


class Planes(Basis):
    """The coefficients of several pictures one below the other: diag(W, ..., W).

    Parameters
    ----------
    of : Basis
        W of one picture.
    count : int
        Number of pictures.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Planes, Wavelet
    >>> W = Planes(Wavelet(ltcl.open_device(), (1, 2), "haar"), 2)
    >>> print((W @ numpy.array([1.0, 1.0, 3.0, 3.0])).round(3) + 0)
    [1.414 0.    4.243 0.   ]
    """

    def __init__(self, of: Basis, count: int) -> None:
        h, w = of.grid
        super().__init__(of.device, (count * h, w), of.name, count * of.shape[0], of)
        self.of = of
        self.count = count
        self.orthonormal = of.orthonormal
        self.isometric = of.isometric

    def _bind_transform(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        if isinstance(self.of, Wavelet) and x.columns == 1:
            return self.of.bind_planes(x, out, epilogue, transpose, self.count)
        launches = []
        height, width = self.of.shape
        if transpose:
            height, width = width, height
        for number in range(self.count):
            place = Place(number * width, number * height)
            launches.append(_bind_copies(self.of, place, x, out, epilogue, transpose))
        return in_order(launches)

    def bind_ordered(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool, order: Array
    ) -> Queued | None:
        """The launches of wavelets that take the order of coefficients, for one right-hand side."""
        if not isinstance(self.of, Wavelet) or not self.of.takes_order or x.columns > 1:
            return None
        return self.of.bind_planes(x, out, epilogue, transpose, self.count, order)


def planes(bases: Sequence[Basis]) -> Basis | None:
    """Bases of pictures one below the other; None where they have nothing in common.

    Subsets of one basis may pick other coefficients of each picture.
    """
    first = bases[0]
    count = len(bases)
    if isinstance(first, SubsetBasis):
        return _subset_of_planes(first, bases)
    for W in bases:
        if not is_same(W, first):
            return None
    return Planes(first, count)


def _subset_of_planes(first: SubsetBasis, bases: Sequence[Basis]) -> SubsetBasis | None:
    """Subsets of one basis, or of pixels, one below the other; None for other bases."""
    count = len(bases)
    of = None
    coefficients = first.shape[1]
    if first.of is not None:
        of = Planes(first.of, count)
        coefficients = first.of.shape[0]
    places = []
    for number, W in enumerate(bases):
        if not isinstance(W, SubsetBasis) or not _have_same_whole(W, first):
            return None
        places.append(W.places + number * coefficients)
    height, width = first.grid
    return SubsetBasis(first.device, (count * height, width), np.concatenate(places), of)


def _have_same_whole(a: SubsetBasis, b: SubsetBasis) -> bool:
    """True if two subsets are of the same coefficients, or of the same pixels."""
    if a.grid != b.grid:
        return False
    if a.of is None or b.of is None:
        return a.of is b.of
    return is_same(a.of, b.of)


def is_same(a: Basis, b: Basis) -> bool:
    """True if two bases make the same coefficients."""
    if a is b:
        return True
    if type(a) is not type(b) or a.shape != b.shape:
        return False
    ours = a.to_arrays()
    theirs = b.to_arrays()
    if ours.keys() != theirs.keys():
        return False
    return all(np.array_equal(ours[name], theirs[name]) for name in ours)


def _join_systems(blocks: Sequence[Operator]) -> Operator | None:
    """I + diag(R_1, ...), where all are I + R, or all I - R."""
    systems = [block for block in blocks if isinstance(block, IdentityPlus)]
    signs = {system.sign for system in systems}
    if len(systems) != len(blocks) or len(signs) != 1:
        return None
    R = block_diagonal([system.R for system in systems])
    joined = IdentityPlus(R, signs.pop())
    _take_over_facts(joined, systems)
    return joined


def _join_sketch(blocks: Sequence[Operator]) -> Operator | None:
    """The three colours of a sketch of many pixels in one pass."""
    if len(blocks) != COLOURS:
        return None
    return join_colours(blocks, BlockDiagonal(blocks))


def _join_scaled(blocks: Sequence[Operator]) -> Operator | None:
    """diag(A_1, ...) diag(d), where all are A diag(d) - diag(shift)."""
    scaled = [block for block in blocks if isinstance(block, ScaledColumns)]
    if len(scaled) != len(blocks):
        return None
    matrices = []
    scales = []
    shifts = []
    for block in scaled:
        matrices.append(block.A)
        scales.append(block.d)
        shifts.append(np.broadcast_to(block.shift, block.shape[:1]))
    shift: Any = np.concatenate(shifts)
    if not shift.any():
        shift = 0.0
    return ScaledColumns(joined_once(matrices), np.concatenate(scales), shift)


def _join_compressed(blocks: Sequence[Operator]) -> Operator | None:
    """W_out^T diag(C_1, ...) W_in, where all have the same bases."""
    compressed = [block for block in blocks if isinstance(block, Compressed)]
    if len(compressed) != len(blocks):
        return None
    out_bases: list[Basis] = []
    into_bases: list[Basis] = []
    diagonals = []
    for R in compressed:
        if R.out is not None:
            out_bases.append(R.out)
        if R.into is not None:
            into_bases.append(R.into)
        if R.known_diagonal is not None:
            diagonals.append(R.known_diagonal)
    counts = {0, len(blocks)}
    if len(out_bases) not in counts or len(into_bases) not in counts:
        return None
    out = planes(out_bases) if out_bases else None
    into = out
    if any(R.into is not R.out for R in compressed):
        into = planes(into_bases) if into_bases else None
    has_no_planes = (out is None and out_bases) or (into is None and into_bases)
    if has_no_planes or (out is None and into is None):
        return None
    diagonal = None
    if len(diagonals) == len(blocks):
        diagonal = np.concatenate(diagonals)
    error = max(R.error for R in compressed)
    core = block_diagonal([R.core for R in compressed])
    return Compressed(core, out, into, error, diagonal=diagonal)


def _join_csr(blocks: Sequence[Operator]) -> Operator | None:
    """Join matrices in compressed sparse rows, where they are small."""
    if any(type(block) is not CSR for block in blocks) or _are_large(blocks):
        return None
    matrices: list[Any] = []
    for block in blocks:
        if isinstance(block, CSR):
            matrices.append(block.matrix())
    joined = scipy.sparse.block_diag(matrices, format="csr")
    return CSR(blocks[0].device, scipy.sparse.csr_array(joined))


def _join_tiles(blocks: Sequence[Operator]) -> Operator | None:
    """Join matrices of tiles, where they are small."""
    packed: list[Packed] = [block.packed for block in blocks if isinstance(block, Tiles)]
    if len(packed) != len(blocks) or _are_large(blocks):
        return None
    return Tiles(blocks[0].device, joined_diagonally(packed))


# Ways to join operators, of which the first that can is taken.
JOINS = (_join_systems, _join_sketch, _join_scaled, _join_compressed, _join_csr, _join_tiles)


def _are_large(blocks: Sequence[Operator]) -> bool:
    """True if a launch less is not worth a second copy."""
    return sum(block.nbytes for block in blocks) > MAX_JOINED_BYTES


def _rows_of_product(block: Operator, transpose: bool) -> RowOperator | None:
    """The square rows by which a block is multiplied, if it has some."""
    if not isinstance(block, RowOperator) or block.shape[0] != block.shape[1]:
        return None
    if not transpose:
        return block
    copy = getattr(block, "transposed_copy", None)
    return None if copy is None else copy()


def _bind_rows(
    rows: RowOperator, first: int, x: Array, out: Array, epilogue: Epilogue
) -> list[Queued]:
    """The launches of a block whose rows begin at value `first` of x and out."""
    variant = rows.fastest(x, 1)
    launches: list[Queued] = []
    for slab in rows.slabs:
        # A vector of one column that begins later is a column behind others.
        launches.append(rows._bind_slab(slab, (first, 1), x, out, epilogue, variant))
    return launches


def _bind_copies(
    block: Operator, place: Place, x: Array, out: Array, epilogue: Epilogue, transpose: bool
) -> Queued:
    """The product of a block with copies of its rows of x and out."""
    height, width = block.shape
    if transpose:
        height, width = width, height
    operand = block.device.empty((width, *x.shape[1:]))
    product = block.device.empty((height, *x.shape[1:]))
    a, b, y, c = epilogue
    # What is not added must not be read: it may be no number.
    added = product if b else None
    bound = block._bind_product(operand, product, Epilogue(a, b, added, c), transpose)

    def multiply() -> None:
        x.copy_rows(place.of_x, operand)
        if b and y is not None:
            y.copy_rows(place.of_out, product)
        bound()
        out.set_rows(place.of_out, product)

    return multiply
