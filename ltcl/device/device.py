# SPDX-License-Identifier: BSD-3-Clause
"""An opened OpenCL device: its limits, its one in-order queue, its kernels, its memory."""

from __future__ import annotations

import math
import threading
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks
from ltcl.device import kernels
from ltcl.device.kernels import Kernel
from ltcl.device.vectors import Array, rounded
from ltcl.errors import MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.discovery import Description

SPARE_BYTES = 16  # behind every array: kernels may read the last pixel in one wide load
_POOLED = 256  # arrays up to this part of the memory are pooled: vectors, not matrices


class Device:
    """One OpenCL device with a context and an in-order queue. Made by `ltcl.open_device`.

    A block of the pool may be handed out again while a kernel that uses it is queued: there is one
    queue.

    Attributes
    ----------
    name, driver, kind : str
        As the driver reports them; kind is "gpu", "cpu", "accelerator" or "simulator".
    max_allocation : int
        Bytes of the largest single buffer. Operators cut matrices into slabs of rows below it.
    memory : int
        Bytes of memory; on a CPU what the host has free.
    allocations : int
        How often OpenCL has been asked for memory; arrays from the pool do not count.
    launches : Counter
        How often each kernel has been queued.
    others : tuple of Device
        Of ``open_device("all")``, the other devices of its platform: rows of matrices are on all of
        them.
    """

    def __init__(self, description: Description) -> None:
        import pyopencl as cl
        from pyopencl.tools import ImmediateAllocator, MemoryPool

        self.description = description
        self.name, self.driver, self.kind = description.name, description.driver, description.kind
        self.handle = handle = description.handle
        self.cl: Any = cl
        with kernels.translated(f"opening {self.name}"):
            self.context = cl.Context([handle])
            self.queue = cl.CommandQueue(self.context)
        self.compute_units: int = handle.max_compute_units
        self.max_group: int = handle.max_work_group_size
        self.local_memory: int = handle.local_mem_size
        self.max_allocation: int = handle.max_mem_alloc_size
        self.memory: int = checks.host_memory() if self.is_cpu else handle.global_mem_size
        self.others: tuple[Device, ...] = ()
        self.allocations, self.launches = 0, Counter[str]()
        self._pool = MemoryPool(
            ImmediateAllocator(self.queue), leading_bits_in_bin_id=4
        )  # 1/16 too large
        self._largest_pooled = min(self.memory // _POOLED, self.max_allocation // 16)
        self._programs: dict[tuple, tuple[Any, dict[str, Kernel]]] = {}
        self.reductions: dict[tuple, Any] = {}  # of `vectors`
        self._lock = threading.RLock()

    def __repr__(self) -> str:
        return f"<ltcl device {self.description.index} {self.name}, {self.driver}>"

    @property
    def is_cpu(self) -> bool:
        """Whether kernels should run one stream per work-item instead of one item per value."""
        return self.kind in ("cpu", "simulator")

    def kernel(self, file: str, name: str, **defines: Any) -> Kernel:
        """The kernel `name` of `kernels/<file>.cl` built with `defines`; built at the first call only."""
        kernels.refuse_forked()
        program = (file, *sorted(defines.items()))
        with self._lock:
            if program not in self._programs:
                self._programs[program] = kernels.build(self, file, defines), {}
            built, named = self._programs[program]
            if name not in named:
                named[name] = Kernel(self, built, name)
            return named[name]

    def launch(
        self, name: str, handle: Any, items: tuple[int, ...], group: tuple[int, ...]
    ) -> None:
        """Queue a cl_kernel whose arguments are set."""
        kernels.refuse_forked()
        try:
            self.cl.enqueue_nd_range_kernel(self.queue, handle, items, group)
        except self.cl.Error as error:
            raise kernels.explain(f"running {name} on {self.name}", error) from error
        self.launches[name] += 1

    def empty(self, shape: int | tuple[int, ...], dtype: Any = np.float32) -> Array:
        """An uninitialised array, in microseconds; refuses what the device cannot hold with both sizes."""
        shape, dtype = (shape,) if isinstance(shape, int) else tuple(shape), np.dtype(dtype)
        nbytes = math.prod(map(int, shape)) * dtype.itemsize
        if (size := nbytes + SPARE_BYTES) > self.max_allocation:
            raise MemoryLimitError(
                f"a buffer of {checks.size(nbytes)} for an array {shape} is beyond the largest that "
                f"{self.name} allows, {checks.size(self.max_allocation)}"
            )
        with kernels.translated(f"allocating {checks.size(nbytes)} on {self.name}"), self._lock:
            if (
                size > self._largest_pooled
            ):  # a new one, for which unused blocks of the pool make room
                self.allocations += 1
                self._pool.free_held()
                buffer = self.cl.Buffer(self.context, self.cl.mem_flags.READ_WRITE, size)
            else:
                unused = self._pool.held_blocks
                buffer = self._pool.allocate(size)  # frees unused blocks and tries again by itself
                self.allocations += self._pool.held_blocks >= unused
            return Array(self, buffer, shape, dtype)

    def upload(self, values: Any, dtype: Any = np.float32) -> Array:
        """A copy of `values` on the device, as `dtype`."""
        host = rounded(values, dtype)
        return self.empty(host.shape, dtype).set(host)

    def require(self, nbytes: int, what: str) -> None:
        """Refuse, before anything is allocated, `what` that needs more bytes than the device has."""
        if self.is_cpu and nbytes > checks.host_memory():  # which changes while a program runs
            self._pool.free_held()
        memory = min(self.memory, checks.host_memory()) if self.is_cpu else self.memory
        if nbytes > memory:
            raise MemoryLimitError(
                f"{what} needs {checks.size(nbytes)}, but {self.name} has {checks.size(memory)}; "
                "threshold or compress it, or choose another device"
            )

    def local(self, items: int) -> Any:
        """Local memory for one float32 an item of a work-group, as a kernel argument."""
        return self.cl.LocalMemory(4 * items)

    def copy(self, to: Any, of: Any, **sizes: Any) -> None:
        """Copy between a host array and a buffer (which waits), or two buffers (which is queued)."""
        with kernels.translated(f"copying on {self.name}"):
            self.cl.enqueue_copy(self.queue, to, of, **sizes)

    def agreed(self, value: Any) -> Any:
        """A measured `value`; where processes solve in lock-step, that of the first."""
        return value

    def flush(self) -> None:
        """Have the device begin with what is queued."""
        with kernels.translated(f"starting {self.name}"):
            self.queue.flush()

    def finish(self) -> None:
        """Wait until everything queued has run."""
        with kernels.translated(f"waiting for {self.name}"):
            self.queue.finish()
