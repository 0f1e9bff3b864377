# SPDX-License-Identifier: BSD-3-Clause
"""Rows of a matrix on several devices: products and steps, with vectors that stay where they are.

With the rows A_p on device p, and vectors on the first device,

    A x   = (A_1 x; A_2 x; ...)     x goes to each device, its rows come back
    A^T x = sum_p A_p^T x_p         its rows of x go to each device, a term comes back

In steps of a stationary iteration each device keeps its rows of x and r, and all of the direction
d; after a step each sends the others its rows of d, and nothing else. Everything is queued, and
events say what comes first (`ltcl.device.exchange`): the host waits for nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.device import Array, Device, exchange, vectors
from ltcl.device.kernels import Queued
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.rows import RowOperator, RowStepper
from ltcl.operators.stepper import Stepper


@dataclass(frozen=True, eq=False)
class Share:
    """Rows of a matrix from row `first` on, on the device of their own operator."""

    first: int
    rows: RowOperator

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.rows.shape[0]

    @property
    def device(self) -> Device:
        """Device of the rows."""
        return self.rows.device

    def send(self, source: Array, target: Array, ready: object) -> object:
        """Queue a copy of the vector's own rows between arrays of the whole length."""
        return exchange.send_rows(source, self.first, target, self.first, self.count, ready)


class AwayProduct:
    """The rows of A x of another device than that of the vectors."""

    def __init__(self, share: Share, x: Array, out: Array, epilogue: Epilogue) -> None:
        self.share = share
        self._x = x
        self._out = out
        device = share.device
        self._x_there = device.empty(x.shape)
        self._out_there = device.empty(out.shape)
        self._y = epilogue.y if epilogue.b else None
        # y is not read where b is 0.
        y_there = self._out_there if self._y is None else device.empty(out.shape)
        self._y_there = y_there
        there = epilogue._replace(y=y_there)
        self._multiply = share.rows.bind_rows(share.first, self._x_there, self._out_there, there)

    def begin(self, ready: object) -> None:
        """Send x, and queue the product."""
        exchange.send_rows(self._x, 0, self._x_there, 0, self._x.shape[0], ready)
        if self._y is not None:
            self.share.send(self._y, self._y_there, ready)
        self._multiply()
        self._done = self.share.device.mark()

    def end(self) -> None:
        """Queue the way of the rows into `out`, before all that comes later on both devices."""
        arrived = self.share.send(self._out_there, self._out, self._done)
        self.share.device.wait_for(arrived)


class AwayTerm:
    """The term of A^T x of another device than that of the vectors, added to `out`."""

    def __init__(self, share: Share, x: Array, out: Array, a: float) -> None:
        self.share = share
        self._x = x
        device = share.device
        self._x_there = device.empty((share.count, *x.shape[1:]))
        self._term_there = device.empty(out.shape)
        self._term = out.like()
        self._multiply = share.rows.bind(
            self._x_there, self._term_there, Epilogue(a=a), transpose=True
        )
        self._add = vectors.bind_axpby(1.0, self._term, 1.0, out, out)

    def begin(self, ready: object) -> None:
        """Send the rows of x, and queue the product."""
        share = self.share
        exchange.send_rows(self._x, share.first, self._x_there, 0, share.count, ready)
        self._multiply()
        self._done = share.device.mark()

    def end(self) -> None:
        """Queue the way of the term into `out`, before all that comes later on both devices."""
        there = self._term_there
        arrived = exchange.send_rows(there, 0, self._term, 0, there.shape[0], self._done)
        self.share.device.wait_for(arrived)
        self._add()


def bind_product(
    home: Device, shares: list[Share], x: Array, out: Array, epilogue: Epilogue
) -> Queued:
    """A function that queues the product with all rows; the vectors are on the device `home`."""
    away = []
    own = []
    for share in shares:
        if share.device is home:
            own.append(share.rows.bind_rows(share.first, x, out, epilogue))
        else:
            away.append(AwayProduct(share, x, out, epilogue))
    return _queue_all(home, own, away)


def bind_transpose(
    home: Device, shares: list[Share], x: Array, out: Array, epilogue: Epilogue
) -> Queued:
    """A function that queues the product with the transpose."""
    a, b, y, c = epilogue.without_shift(x)
    added = Epilogue(a=0.0, b=b, y=y)
    # What is added to the sum of all terms comes first.
    own: list[Queued] = [_bind_added(added, out)]
    away = []
    for share in shares:
        if share.device is home:
            own += _own_term(share, x, out, a)
        else:
            away.append(AwayTerm(share, x, out, a))
    queue = _queue_all(home, own, away)
    if not c:
        return queue
    shift = vectors.bind_axpby(c, x, 1.0, out, out)

    def queue_with_shift() -> None:
        queue()
        shift()

    return queue_with_shift


def _bind_added(epilogue: Epilogue, out: Array) -> Queued:
    """The launch of out = b y."""
    if epilogue.y is None or not epilogue.b:
        return vectors.bind_fill(out, 0.0)
    return vectors.bind_axpby(epilogue.b, epilogue.y, 0.0, epilogue.y, out)


def _own_term(share: Share, x: Array, out: Array, a: float) -> list[Queued]:
    """The launches that add the term of the rows on the device of the vectors."""
    own_x = x.device.empty((share.count, *x.shape[1:]))

    def copy() -> None:
        x.copy_rows(share.first, own_x)

    added = Epilogue(a=a).added_to(out)
    return [copy, share.rows.bind(own_x, out, added, transpose=True)]


def _queue_all(
    home: Device, own: list[Queued], away: list[AwayProduct] | list[AwayTerm]
) -> Callable[[], None]:
    """A function that queues products on all devices, which work at the same time."""

    def queue() -> None:
        if away:
            ready = home.mark()
            for product in away:
                product.begin(ready)
        for launch in own:
            launch()
        home.flush()
        for product in away:
            product.end()

    return queue


class SharedStepper(Stepper):
    """Steps on several devices, of which each changes its rows of x, r and d.

    `x` and `r` themselves are up to date after `finish` and `norms`.
    """

    def __init__(
        self, shares: list[Share], x: Array, r: Array, slots: int, a: float, c: float
    ) -> None:
        self._shares = shares
        self._has_own_rows = True
        home = next(share.rows for share in shares if share.device is x.device)
        super().__init__(home, x, r, slots, a, c)

    def _prepare(self) -> None:
        self._steppers = []
        for share in self._shares:
            x, r = self.x, self.r
            if share.device is not x.device:
                x, r = (share.device.empty(self.x.shape) for _ in range(2))
            steps = RowStepper(share.rows, x, r, self.slots, self._a, self._c, start=share.first)
            self._steppers.append(steps)
        self._away = []
        for share, steps in zip(self._shares, self._steppers, strict=True):
            if steps.x is not self.x:
                self._away.append((share, steps))
            else:
                self._own = steps
        self.d, self.spare = self._own.d, self._own.spare

    def start(self, gain: float) -> None:
        """Queue d = gain r, the first direction, on all devices."""
        self._hand_out(all_of_r=True)
        for steps in self._steppers:
            steps.start(gain)

    def step(self, keep: float, gain: float) -> None:
        """Queue one step, after which each device knows all of the next direction."""
        if not self._has_own_rows:
            self._hand_out(all_of_r=False)
        marks = []
        for steps in self._steppers:
            steps.step(keep, gain)
            marks.append(steps.A.device.mark())
        for share, steps, mark in zip(self._shares, self._steppers, marks, strict=True):
            for other in self._steppers:
                if other is not steps:
                    share.send(steps.d, other.d, mark)
        self.d, self.spare = self._own.d, self._own.spare
        self.waiting += 1

    def finish(self) -> None:
        """Bring the rows of x and r home; see `Stepper.finish`."""
        self._gather()
        self.waiting = 0
        for steps in self._steppers:
            steps.finish()

    def norms(self) -> np.ndarray:
        """Norms (waiting, k) of the residuals, and x and r home; see `Stepper.norms`."""
        self._gather()
        self.waiting = 0
        squares = [steps.norms() ** 2 for steps in self._steppers]
        return np.sqrt(np.sum(squares, axis=0))

    def _gather(self) -> None:
        """Queue the rows of x and r home, where all that comes later finds them."""
        for share, steps in self._away:
            mark = share.device.mark()
            arrived_x = share.send(steps.x, self.x, mark)
            arrived_r = share.send(steps.r, self.r, mark)
            share.device.wait_for(arrived_x, arrived_r)
        # They may be changed at home.
        self._has_own_rows = False

    def _hand_out(self, *, all_of_r: bool) -> None:
        """Queue the rows of x and r to their devices, or all of r, of which a first d is made."""
        mark = self.x.device.mark()
        arrived = []
        for share, steps in self._away:
            arrived.append(share.send(self.x, steps.x, mark))
            if all_of_r:
                rows = self.r.shape[0]
                arrived.append(exchange.send_rows(self.r, 0, steps.r, 0, rows, mark))
            else:
                arrived.append(share.send(self.r, steps.r, mark))
        for _, steps in self._away:
            steps.A.device.flush()
        self.x.device.wait_for(*arrived)
        self._has_own_rows = True
