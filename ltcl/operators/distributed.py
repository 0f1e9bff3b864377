# SPDX-License-Identifier: BSD-3-Clause
"""A matrix whose rows lie on the ranks of an MPI communicator: many devices solve in lock-step.

    A x   = (A_1 x; A_2 x; ...)     each rank multiplies its rows A_r on its device; one Allgatherv
    A^T x = sum_r A_r^T x_r         one Allreduce

Vectors are whole on every rank, and every rank runs the same solver on them. Devices are alike, so
the bits are the same on all ranks, and so is every decision; rank 0 takes those that depend on time
(`Device.agreed`). All calls are collective: every rank makes them, in the same order.

`comm` is a communicator of mpi4py. A rank that fails alone leaves the others waiting for it: start
scripts by ``mpiexec -n 2 python -m mpi4py script.py``, which then ends them all.
"""

from __future__ import annotations

import functools
import math
import os
import platform
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl.device import Array, Device, list_devices, open_device
from ltcl.device.discovery import choose
from ltcl.errors import DeviceError, InputError, LtclError
from ltcl.operators.base import Operator
from ltcl.operators.epilogue import PLAIN
from ltcl.operators.knowledge import Norms
from ltcl.operators.parts import Parts, upload_part
from ltcl.operators.rows import EntrySums, RowOperator

_opened: weakref.WeakValueDictionary[tuple[int, Device], RankDevice] = weakref.WeakValueDictionary()


class RankDevice(Device):
    """The device of one rank of `comm`, from `rank_device`.

    It holds the rows of its rank of each matrix.
    """

    def __init__(self, comm: Any, device: Device) -> None:
        # The same device with another way to split rows: one queue, memory pool, set of kernels.
        super().__init__(device.description, device.session)
        # Limits that were lowered on the device hold here, too.
        self.memory = device.memory
        self.max_allocation = device.max_allocation
        self.comm = comm
        # The devices of the other ranks are alike.
        self.others = (device,) * (comm.size - 1)

    def split_over_ranks(
        self, rows: int, upload_rows: Callable[[Device, slice], RowOperator]
    ) -> Operator:
        """An equal share of the rows on the device of each rank, uploaded by `upload_rows`."""
        start = rows * self.comm.rank // self.comm.size
        stop = rows * (self.comm.rank + 1) // self.comm.size
        share = together(self.comm, lambda: upload_rows(self, slice(start, stop)))
        return Distributed(self.comm, share)

    def agreed(self, value: Any) -> Any:
        """The value that rank 0 has measured."""
        return self.comm.bcast(value)


def rank_device(comm: Any, select: Device | str | None = None) -> RankDevice:
    """The device of this rank, as `ltcl.open_device` selects it.

    Ranks of one host take devices in turn.

    Raises
    ------
    DeviceError
        On all ranks, if one has no device, or another kind of device than rank 0.

    Examples
    --------
    >>> import ltcl
    >>> from mpi4py import MPI
    >>> device = rank_device(MPI.COMM_SELF)
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2), device=device)
    >>> ltcl.compensate(T, np.array([[0.3, 0.3]])).pattern.round(2).tolist()
    [[0.5, 0.5]]
    """
    if isinstance(select, RankDevice):
        return select
    hosts = comm.allgather(platform.node())
    ranks_before = hosts[: comm.rank].count(hosts[comm.rank])
    device = together(comm, lambda: _open_in_turn(select, ranks_before))
    kind = f"{device.name}, {device.driver}, {device.compute_units} compute units"
    kinds = comm.allgather(kind)
    for rank, other_kind in enumerate(kinds):
        if other_kind != kinds[0]:
            raise DeviceError(
                f"rank {rank} has {other_kind}; it must be that of rank 0, {kinds[0]}"
            )
    key = (comm.py2f(), device)
    opened = _opened.get(key)
    if opened is None:
        opened = RankDevice(comm, device)
        _opened[key] = opened
    return opened


def _open_in_turn(select: Device | str | None, turn: int) -> Device:
    """The selected device, or one like it: ranks of a host share them out by their turn."""
    if isinstance(select, Device):
        return select
    devices = list_devices()
    best = choose(devices, select or os.environ.get("LTCL_DEVICE"))
    alike = []
    for description in devices:
        if (description.name, description.driver) == (best.name, best.driver):
            alike.append(description.index)
    return open_device(alike[turn % len(alike)])


def together(comm: Any, make: Callable[[], Any]) -> Any:
    """The result of `make`; an error on one rank is raised on all, which would wait for it."""
    result = None
    error = None
    try:
        result = make()
    except LtclError as problem:
        error = (type(problem), str(problem))
    except (MemoryError, OSError) as problem:
        error = (LtclError, str(problem) or "the host has no memory left")
    errors = comm.allgather(error)
    are_equal = len(set(errors)) == 1
    for rank, rank_error in enumerate(errors):
        if rank_error is not None:
            kind, text = rank_error
            message = text
            if not are_equal:
                message = f"rank {rank}: {text}"
            raise kind(message)
    return result


class Distributed(Parts):
    """A matrix (M, N) on the devices of all ranks: the first rows on that of rank 0, and so on.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
    rows : (m, N) array, scipy.sparse array, `CSR` or `Dense`
        Rows of this rank, at least one.
    device : Device or str, optional
        As `rank_device` takes it.

    Raises
    ------
    InputError, DeviceError, MemoryLimitError
        On all ranks, if the rows of one do not fit those of others, or its device.

    Examples
    --------
    >>> from mpi4py import MPI
    >>> comm = MPI.COMM_SELF
    >>> A = np.array([[1.0, 2.0], [0.0, 3.0]])
    >>> own_rows = np.array_split(A, comm.size)[comm.rank]
    >>> (Distributed(comm, own_rows) @ np.ones(2)).tolist()
    [3.0, 3.0]
    """

    where = "on several ranks"

    def __init__(self, comm: Any, rows: Any, device: Device | str | None = None) -> None:
        shapes = comm.allgather(np.shape(rows))
        for shape in shapes:
            if len(shape) != 2 or 0 in shape or shape[1] != shapes[0][1]:
                raise InputError(
                    f"rows have the shapes {shapes}, by rank; they must be (m, N), with m above 0"
                )
        self.comm = comm
        if isinstance(rows, Operator):
            rank = rank_device(comm, rows.device)
            self.rows: Any = rows
        else:
            rank = rank_device(comm, device)
            self.rows = together(comm, lambda: upload_part(rank, rows))
        self.counts = [shape[0] for shape in shapes]
        self.first = sum(self.counts[: comm.rank])
        super().__init__(rank, (sum(self.counts), shapes[0][1]), self.rows)
        self.error = math.hypot(*comm.allgather(self.rows.error))

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64."""
        pieces = []
        for first, rows in self.rows.blocks():
            start = self.first + first
            if start < self.shape[1]:
                pieces.append(rows.diagonal(start))
        all_pieces = []
        for rank_pieces in self.comm.allgather(pieces):
            all_pieces += rank_pieces
        return np.concatenate(all_pieces)

    def norms(self) -> Norms:
        """Norms of all rows together."""
        sums_of_ranks = self.comm.allgather(self.rows.sums())
        return functools.reduce(EntrySums.joined, sums_of_ranks).norms()

    def _host_product(self, x: Array, transpose: bool) -> np.ndarray:
        if transpose:
            return self._reduced_product(x)
        return self._gathered_product(x)

    def _gathered_product(self, x: Array) -> np.ndarray:
        """A x: the rows of all ranks below each other."""
        own_rows = self.device.empty((self.counts[self.comm.rank], *x.shape[1:]))
        self.rows._queue_product(x, own_rows, PLAIN, False)
        product = np.empty((self.shape[0], *x.shape[1:]), np.float32)
        sizes = [count * x.columns for count in self.counts]
        self.comm.Allgatherv(own_rows.get(), [product, sizes])
        return product

    def _reduced_product(self, x: Array) -> np.ndarray:
        """A^T x: the sum over all ranks."""
        own_x = x.rows(self.first, self.counts[self.comm.rank])
        term = self.device.empty((self.shape[1], *x.shape[1:]))
        self.rows._queue_product(own_x, term, PLAIN, True)
        product = np.empty((self.shape[1], *x.shape[1:]), np.float32)
        self.comm.Allreduce(term.get(), product)
        return product
