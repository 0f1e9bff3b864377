# SPDX-License-Identifier: BSD-3-Clause
"""Vectors of which each device has its own rows, and products with a matrix in the same shares.

With the rows S_p and x_p on device p,

    (S x)_p = S_p x     each device sends the others its rows of x, and keeps those of the product

All else that a method does with vectors runs on each device's own rows, at the same time. For
that, devices meet at each product and at each inner product: with short vectors it takes longer
than all vectors on one device, with long ones less. Both are timed once, and the quicker is taken.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl.device import Array, Device, exchange, tuning, vectors
from ltcl.device.kernels import Queued, in_order
from ltcl.operators.epilogue import Epilogue

if TYPE_CHECKING:
    from ltcl.operators.base import Operator
    from ltcl.operators.shares import Share

# Sums of two vectors in a timed step: 9 vectors are read or written, as in a step of CG.
TIMED_SUMS = 3


@dataclass(frozen=True, eq=False)
class RowShares:
    """a A + c I, with the rows of A on several devices."""

    home: Device
    shares: tuple[Share, ...]
    a: float = 1.0
    c: float = 0.0

    def bind(
        self, x: SharedVector, out: SharedVector, operands: list[Array]
    ) -> Callable[[], object]:
        """A function that queues out = a A x + c x; all of x goes to `operands`, on each device."""
        launches = []
        for share, own_x, own_out, operand in zip(
            self.shares, x.parts, out.parts, operands, strict=True
        ):
            epilogue = Epilogue(a=self.a, b=self.c, y=own_x)
            launches.append(share.rows.bind(operand, own_out, epilogue))

        def queue() -> None:
            x.send_to_all(operands)
            for share, own_x, operand in zip(self.shares, x.parts, operands, strict=True):
                operand.set_rows(share.first, own_x)
            for launch in launches:
                launch()

        return queue


class SharedVector:
    """A vector (N,) or (N, k), of which each device has the rows of its share.

    Attributes
    ----------
    rows : RowShares
    parts : list of Array
        The rows of each share.
    shape : tuple of int
        Shape of the whole vector.
    """

    def __init__(self, rows: RowShares, shape: tuple[int, ...], whole: Array | None = None) -> None:
        self.rows = rows
        self.shape = shape
        self.parts = [share.device.empty((share.count, *shape[1:])) for share in rows.shares]
        self._whole = whole

    @classmethod
    def from_whole(cls, rows: RowShares, whole: Array) -> SharedVector:
        """The vector whose rows are sent to their devices, and which `gather` brings back there."""
        vector = cls(rows, whole.shape, whole)
        vector.hand_out()
        return vector

    @property
    def columns(self) -> int:
        """Number of right-hand sides."""
        return self.parts[0].columns

    @property
    def whole(self) -> Array:
        """Room for all rows on the home device, which holds them after `gather`."""
        if self._whole is None:
            self._whole = self.rows.home.empty(self.shape)
        return self._whole

    def like(self) -> SharedVector:
        """Make an uninitialised vector in the same shares."""
        return SharedVector(self.rows, self.shape)

    def fill(self, value: float) -> SharedVector:
        """Set all rows to a number; returns the vector."""
        for part in self.parts:
            vectors.fill(part, value)
        return self

    def copy(self) -> SharedVector:
        """Copy the values, on each device its own."""
        return self.like().copy_from(self)

    def copy_from(self, other: SharedVector) -> SharedVector:
        """Overwrite with the values of another vector in the same shares; returns this one."""
        for part, other_part in zip(self.parts, other.parts, strict=True):
            part.copy_from(other_part)
        return self

    def get(self) -> np.ndarray:
        """Copy all rows to the host."""
        return np.concatenate([part.get() for part in self.parts])

    def set(self, values: np.ndarray) -> SharedVector:
        """Overwrite with host values; returns the vector."""
        for share, part in zip(self.rows.shares, self.parts, strict=True):
            part.set(values[share.first : share.first + share.count])
        return self

    def norms(self) -> np.ndarray:
        """Norm (k,) of each column."""
        squares = [vectors.dot(part, part) for part in self.parts]
        return np.sqrt(np.sum(squares, axis=0))

    def gather(self) -> Array:
        """Queue all rows home, into `whole`, and return that."""
        self.send_to_all([self.whole])
        for share, part in zip(self.rows.shares, self.parts, strict=True):
            if share.device is self.rows.home:
                self.whole.set_rows(share.first, part)
        return self.whole

    def send_to_all(self, wholes: list[Array]) -> None:
        """Queue the rows of all other devices into each of `wholes`."""
        spans = [exchange.Span(0, share.first, share.count) for share in self.rows.shares]
        exchange.send_to_all(self.parts, spans, wholes)

    def hand_out(self) -> None:
        """Queue the rows of `whole` to their devices."""
        home = self.rows.home
        ready = home.mark()
        arrived = []
        for share, part in zip(self.rows.shares, self.parts, strict=True):
            if share.device is home:
                self.whole.copy_rows(share.first, part)
            else:
                arrived.append(
                    exchange.send_rows(self.whole, share.first, part, 0, share.count, ready)
                )
        home.wait_for(*arrived)


# What a method is written for: an array on one device, or in shares on several.
Vector = Array | SharedVector


@contextlib.contextmanager
def share_vectors(S: Operator, *wholes: Array) -> Iterator[list[Any]]:
    """Vectors in the shares of S inside the block, and at home again behind it.

    If S is not in shares, or quicker with all vectors at home, they are the arrays themselves.
    """
    rows = S.row_shares()
    if rows is None or not _are_quicker_in_shares(S, rows, wholes[0]):
        yield list(wholes)
        return
    shared = [SharedVector.from_whole(rows, whole) for whole in wholes]
    yield shared
    for vector in shared:
        vector.gather()


def _are_quicker_in_shares(S: Operator, rows: RowShares, x: Array) -> bool:
    """True if steps with vectors like `x` take less time in shares than at home; timed once."""
    known = S.known.is_quicker_in_shares
    if x.columns not in known:
        problem = f"{len(rows.shares)} devices, {x.shape[0]} rows, k={x.columns}, {S.nbytes} bytes"
        at_home = tuning.seconds(rows.home, f"step at home: {problem}", _step_at_home(S, x))
        in_shares = tuning.seconds(
            rows.home, f"step in shares: {problem}", _step_in_shares(rows, x)
        )
        known[x.columns] = in_shares <= at_home
    return known[x.columns]


def _step_at_home(S: Operator, x: Array) -> Queued:
    """A product and sums of vectors on the first device."""
    operand = vectors.fill(x.like(), 0.0)
    product = x.like()
    add = vectors.bind_axpby(0.5, operand, 0.5, product, operand)
    return in_order([S.bind(operand, product), *[add] * TIMED_SUMS])


def _step_in_shares(rows: RowShares, x: Array) -> Queued:
    """The same in shares, then an exchange of a few numbers, as of inner products."""
    operand = SharedVector(rows, x.shape).fill(0.0)
    product = operand.like()
    wholes = [share.device.empty(x.shape) for share in rows.shares]
    queue = [rows.bind(operand, product, wholes)]
    for own_x, own_product in zip(operand.parts, product.parts, strict=True):
        queue += [vectors.bind_axpby(0.5, own_x, 0.5, own_product, own_x)] * TIMED_SUMS
    spans = [exchange.Span(0, place, 1) for place in range(len(wholes))]
    # The first device waits for the numbers of the others.
    queue.append(functools.partial(exchange.send_to_all, operand.parts, spans, wholes))
    return in_order(queue)
