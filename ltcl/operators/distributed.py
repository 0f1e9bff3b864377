# SPDX-License-Identifier: BSD-3-Clause
"""A matrix whose rows lie on the ranks of an MPI communicator: one solve in lock-step on many devices.

    A x   = (A_1 x; A_2 x; ...)     each rank multiplies its rows A_r on its own device; one
    Allgatherv A^T x = sum_r A_r^T x_r         one Allreduce

Vectors are whole on every rank, and every rank runs the same solver on them. Devices are alike, so
the bits are the same on all ranks, and so is every decision; where one depends on time, rank 0
decides (`Device.agreed`). All calls are collective: every rank makes them, in the same order.

`comm` is a communicator of mpi4py. A rank that fails alone leaves the others waiting for it: start
scripts by ``mpiexec -n 2 python -m mpi4py script.py``, which then ends them all.
"""

from __future__ import annotations

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
from ltcl.operators.base import PLAIN, Norms, Operator
from ltcl.operators.parts import Parts, upload_part
from ltcl.operators.rows import RowOperator

_opened: weakref.WeakValueDictionary[tuple[int, Device], RankDevice] = weakref.WeakValueDictionary()


class RankDevice(Device):
    """The device of one rank of `comm`, from `rank_device`: of each matrix it holds the rows of the rank."""

    def __init__(self, comm: Any, own: Device) -> None:
        vars(self).update(vars(own))  # one queue, memory pool and set of kernels
        self.comm, self.others = comm, (own,) * (comm.size - 1)  # which are alike

    def split_over_ranks(self, rows: int, make: Callable[[Device, slice], RowOperator]) -> Operator:
        """What `make` puts on the device of each rank: as many rows as on others."""
        start, stop = (rows * end // self.comm.size for end in (self.comm.rank, self.comm.rank + 1))
        return Distributed(self.comm, together(self.comm, lambda: make(self, slice(start, stop))))

    def agreed(self, value: Any) -> Any:
        """What rank 0 has measured."""
        return self.comm.bcast(value)


def rank_device(comm: Any, select: Device | str | None = None) -> RankDevice:
    """The device of this rank, as `ltcl.open_device` selects it; ranks of one host take devices in turn.

    DeviceError on all ranks where one has no device, or another kind of device than rank 0.

    Examples
    --------
    >>> import ltcl
    >>> from mpi4py import MPI
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2), device=rank_device(MPI.COMM_SELF))
    >>> ltcl.compensate(T, np.array([[0.3, 0.3]])).pattern.round(2).tolist()
    [[0.5, 0.5]]
    """
    if isinstance(select, RankDevice):
        return select
    hosts = comm.allgather(platform.node())
    turn = hosts[: comm.rank].count(hosts[comm.rank])

    def find() -> Device:
        if isinstance(select, Device):
            return select
        best = choose(devices := list_devices(), select or os.environ.get("LTCL_DEVICE"))
        alike = [
            each.index for each in devices if (each.name, each.driver) == (best.name, best.driver)
        ]
        return open_device(alike[turn % len(alike)])

    own = together(comm, find)
    kinds = comm.allgather(f"{own.name}, {own.driver}, {own.compute_units} compute units")
    for rank, kind in enumerate(kinds):
        if kind != kinds[0]:
            raise DeviceError(f"rank {rank} has {kind}; it must be that of rank 0, {kinds[0]}")
    key = comm.py2f(), own
    return _opened.setdefault(key, _opened.get(key) or RankDevice(comm, own))


def together(comm: Any, make: Callable[[], Any]) -> Any:
    """What `make` returns; an error on one rank is raised on all, which would wait for that rank forever."""
    result, error = None, None
    try:
        result = make()
    except (LtclError, MemoryError, OSError) as problem:
        kind = type(problem) if isinstance(problem, LtclError) else LtclError
        error = kind, str(problem) or "the host has no memory left"
    errors = comm.allgather(error)
    for rank, (kind, text) in ((rank, error) for rank, error in enumerate(errors) if error):
        raise kind(text if len({*errors}) == 1 else f"rank {rank}: {text}")
    return result


class Distributed(Parts):
    """A matrix (M, N) on the devices of all ranks: the first rows on that of rank 0, and so on.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
    rows : (m, N) array, scipy.sparse array, `CSR` or `Dense`
        Of this rank, at least one.
    device : Device or str, optional
        As `rank_device` takes it.

    Raises
    ------
    InputError, DeviceError, MemoryLimitError
        On all ranks, where the rows of one do not fit those of others, or its device.

    Examples
    --------
    >>> from mpi4py import MPI
    >>> comm, A = MPI.COMM_SELF, np.array([[1.0, 2.0], [0.0, 3.0]])
    >>> (Distributed(comm, np.array_split(A, comm.size)[comm.rank]) @ np.ones(2)).tolist()
    [3.0, 3.0]
    """

    where = "on several ranks"

    def __init__(self, comm: Any, rows: Any, device: Device | str | None = None) -> None:
        shapes = comm.allgather(np.shape(rows))
        if any(len(shape) != 2 or 0 in shape or shape[1] != shapes[0][1] for shape in shapes):
            raise InputError(
                f"rows have the shapes {shapes}, by rank; they must be (m, N), with m above 0"
            )
        device = rank_device(comm, rows.device if isinstance(rows, Operator) else device)
        make = lambda: rows if isinstance(rows, Operator) else upload_part(device, rows)  # noqa: E731
        self.comm, self.rows = comm, together(comm, make)
        self.counts = [count for count, _ in shapes]
        self.first = sum(self.counts[: comm.rank])
        super().__init__(device, (sum(self.counts), shapes[0][1]), self.rows)
        self.error = math.hypot(*comm.allgather(self.rows.error))

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64."""
        blocks = ((self.first + first, rows) for first, rows in self.rows.blocks())
        own = [rows.diagonal(first) for first, rows in blocks if first < self.shape[1]]
        return np.concatenate([part for parts in self.comm.allgather(own) for part in parts])

    def norms(self) -> Norms:
        """Norms of all rows together."""
        columns, inf, squares, lowest = zip(*self.comm.allgather(self.rows.sums()), strict=True)
        return Norms(
            float(np.max(np.sum(columns, axis=0))), max(inf), sum(squares) ** 0.5, min(lowest)
        )

    def _gathered(self, x: Array, transpose: bool) -> np.ndarray:
        count = self.counts[self.comm.rank]
        own = x.rows(self.first, count) if transpose else x
        product = self.device.empty((self.shape[1] if transpose else count, *x.shape[1:]))
        self.rows._product(own, product, PLAIN, transpose)
        whole = np.empty((self.shape[transpose], *x.shape[1:]), np.float32)
        if transpose:
            self.comm.Allreduce(product.get(), whole)
        else:
            self.comm.Allgatherv(
                product.get(), [whole, [count * x.columns for count in self.counts]]
            )
        return whole
