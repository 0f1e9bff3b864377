# SPDX-License-Identifier: BSD-3-Clause
"""An opened OpenCL device: its limits, its one in-order queue, its kernels, its memory."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks
from ltcl.device import driver_errors, huge_pages, sources
from ltcl.device.arrays import Array, rounded
from ltcl.device.kernels import Kernel
from ltcl.errors import MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.discovery import Description

# Bytes behind every array: kernels may read the last pixel in one wide load.
SPARE_BYTES = 16
# Vectors come from the pool, matrices do not: arrays up to these parts of the memory, and of the
# largest buffer, are vectors.
POOLED_PART_OF_MEMORY = 256
POOLED_PART_OF_BUFFER = 16
# Leading bits of a size that the pool tells apart: blocks are at most 1/16 too large.
POOL_BIN_BITS = 4


class Session:
    """Everything that is open on an OpenCL device; several `Device`s may share it."""

    def __init__(self, handle: Any) -> None:
        import pyopencl as cl
        from pyopencl.tools import ImmediateAllocator, MemoryPool

        self.context = cl.Context([handle])
        self.queue = cl.CommandQueue(self.context)
        allocator = ImmediateAllocator(self.queue)
        self.pool = MemoryPool(allocator, leading_bits_in_bin_id=POOL_BIN_BITS)
        self.launches = Counter[str]()
        # A program of pyopencl and its kernels by name, for each file and defines.
        self.programs: dict[tuple, tuple[Any, dict[str, Kernel]]] = {}
        # Plans of ltcl.device.vectors, by kernel and size.
        self.reductions: dict[tuple, Any] = {}
        self.lock = threading.RLock()
        # Held while a program is built, for as long as a compiler takes.
        self.building = threading.RLock()


class Device:
    """OpenCL device with a context and an in-order queue. Made by `ltcl.open_device`.

    A block of the pool may be handed out again while a kernel that uses it is queued: there is one
    queue.

    Attributes
    ----------
    name, driver, kind : str
        Names that the driver reports; kind is "gpu", "cpu", "accelerator" or "simulator".
    max_allocation : int
        Bytes of the largest single buffer. Operators cut matrices into slabs of rows below it.
    memory : int
        Bytes of memory; on a CPU the free memory of the host.
    allocations : int
        Number of times that OpenCL was asked for memory; arrays from the pool do not count.
    launches : Counter
        Number of times that each kernel was queued.
    others : tuple of Device
        Other devices of the platform after ``open_device("all")``: rows of matrices are on all of
        them.
    """

    def __init__(self, description: Description, session: Session | None = None) -> None:
        import pyopencl as cl

        handle = description.handle
        self.description = description
        self.name = description.name
        self.driver = description.driver
        self.kind = description.kind
        self.handle = handle
        self.cl: Any = cl
        if session is None:
            with driver_errors.translated(f"opening {self.name}"):
                session = Session(handle)
        self.session = session
        self.context = session.context
        self.queue = session.queue
        self.launches = session.launches
        self.compute_units: int = handle.max_compute_units
        self.max_group: int = handle.max_work_group_size
        self.local_memory: int = handle.local_mem_size
        self.max_allocation: int = handle.max_mem_alloc_size
        self.memory: int = handle.global_mem_size
        if self.is_cpu:
            self.memory = checks.host_memory()
        self.others: tuple[Device, ...] = ()

        self.allocations = 0
        self._largest_pooled = min(
            self.memory // POOLED_PART_OF_MEMORY, self.max_allocation // POOLED_PART_OF_BUFFER
        )

    def __repr__(self) -> str:
        return f"<ltcl device {self.description.index} {self.name}, {self.driver}>"

    @property
    def is_cpu(self) -> bool:
        """True if kernels should run a stream per work-item instead of an item per value."""
        return self.kind in ("cpu", "simulator")

    def kernel(self, file: str, name: str, **defines: Any) -> Kernel:
        """Kernel `name` of `kernels/<file>.cl` with `defines`; built at the first call only."""
        program, kernels = self.program(file, defines)
        with self.session.lock:
            if name not in kernels:
                kernels[name] = Kernel(self, program, name)
            return kernels[name]

    def program(self, file: str, defines: Mapping[str, Any]) -> tuple[Any, dict[str, Kernel]]:
        """Program of `kernels/<file>.cl` and its kernels by name; built at the first call only."""
        driver_errors.refuse_forked()
        key = (file, *sorted(defines.items()))
        programs = self.session.programs
        if key not in programs:
            with self.session.building:
                if key not in programs:
                    programs[key] = sources.build(self, file, defines), {}
        return programs[key]

    def has_program(self, file: str, defines: Mapping[str, Any]) -> bool:
        """True if a program is built."""
        return (file, *sorted(defines.items())) in self.session.programs

    def launch(
        self, name: str, handle: Any, items: tuple[int, ...], group: tuple[int, ...]
    ) -> None:
        """Queue a cl_kernel whose arguments are set."""
        driver_errors.refuse_forked()
        try:
            self.cl.enqueue_nd_range_kernel(self.queue, handle, items, group)
        except self.cl.Error as error:
            raise driver_errors.explain(f"running {name} on {self.name}", error) from error
        self.launches[name] += 1

    def empty(self, shape: int | tuple[int, ...], dtype: Any = np.float32) -> Array:
        """Make an uninitialised array, in microseconds.

        Raises
        ------
        MemoryLimitError
            The device cannot hold it; the message has both sizes.
        """
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        dtype = np.dtype(dtype)
        nbytes = math.prod(map(int, shape)) * dtype.itemsize
        buffer_size = nbytes + SPARE_BYTES
        if buffer_size > self.max_allocation:
            raise MemoryLimitError(
                f"a buffer of {checks.size(nbytes)} for an array {shape} is beyond the largest "
                f"that {self.name} allows, {checks.size(self.max_allocation)}"
            )
        action = f"allocating {checks.size(nbytes)} on {self.name}"
        with driver_errors.translated(action), self.session.lock:
            return Array(self, self._allocate(buffer_size), shape, dtype)

    def _allocate(self, size: int) -> Any:
        """Buffer from the pool, or a new one for which unused blocks of the pool make room."""
        pool = self.session.pool
        if size > self._largest_pooled:
            self.allocations += 1
            pool.free_held()
            buffer = self.cl.Buffer(self.context, self.cl.mem_flags.READ_WRITE, size)
            huge_pages.ask(self, buffer, size)
            return buffer
        unused_blocks = pool.held_blocks
        # The pool frees unused blocks and tries again by itself.
        buffer = pool.allocate(size)
        is_new = pool.held_blocks >= unused_blocks
        self.allocations += is_new
        if is_new:
            huge_pages.ask(self, buffer, size)
        return buffer

    def upload(self, values: Any, dtype: Any = np.float32) -> Array:
        """Copy `values` to the device, as `dtype`."""
        host = rounded(values, dtype)
        return self.empty(host.shape, dtype).set(host)

    def require(self, nbytes: int, purpose: str) -> None:
        """Refuse `purpose` if it needs more bytes than the device has, before allocation."""
        # The memory of a host changes while a program runs.
        if self.is_cpu and nbytes > checks.host_memory():
            self.session.pool.free_held()
        memory = self.memory
        if self.is_cpu:
            memory = min(memory, checks.host_memory())
        if nbytes > memory:
            raise MemoryLimitError(
                f"{purpose} needs {checks.size(nbytes)}, "
                f"but {self.name} has {checks.size(memory)}; "
                "threshold or compress it, or choose another device"
            )

    def local(self, items: int) -> Any:
        """Local memory for one float32 per item of a work-group, as a kernel argument."""
        return self.cl.LocalMemory(4 * items)

    def copy(self, destination: Any, source: Any, **sizes: Any) -> None:
        """Copy between a host array and a buffer, and wait; or queue a copy of two buffers."""
        with driver_errors.translated(f"copying on {self.name}"):
            self.cl.enqueue_copy(self.queue, destination, source, **sizes)

    def queue_copy(self, destination: Any, source: Any) -> Any:
        """Queue a copy between a host array and a buffer; the host array must stay until it ends.

        Returns an object whose `wait` returns when it has ended.
        """
        with driver_errors.translated(f"copying on {self.name}"):
            return self.cl.enqueue_copy(self.queue, destination, source, is_blocking=False)

    def agreed(self, value: Any) -> Any:
        """A measured `value`; where processes solve in lock-step, that of the first."""
        return value

    def flush(self) -> None:
        """Start what is queued."""
        with driver_errors.translated(f"starting {self.name}"):
            self.queue.flush()

    def finish(self) -> None:
        """Wait until everything queued has run."""
        with driver_errors.translated(f"waiting for {self.name}"):
            self.queue.finish()
