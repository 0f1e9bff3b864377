# SPDX-License-Identifier: BSD-3-Clause
"""An opened OpenCL device: its limits, its one in-order queue, its kernels, its memory."""

from __future__ import annotations

import contextlib
import math
import os
import threading
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks
from ltcl.device import failures, kernels
from ltcl.device.array import Array, rounded
from ltcl.device.kernels import Kernel
from ltcl.errors import MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.discovery import Description

SPARE_BYTES = 16  # behind every array: kernels may read the last pixel in one wide load
_POOLED = 256  # arrays up to this part of the memory are pooled: vectors are, matrices are not


@dataclass
class Profile:
    """Launches and seconds per kernel, as the device's own clock saw them."""

    launches: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))


class _Recording(threading.local):
    """The launches that this thread is profiling."""

    events: list[tuple[str, Any]] | None = None


class Device:
    """One OpenCL device with a context and an in-order queue. Made by `ltcl.open_device`.

    Arrays up to 1/256 of the memory come from a pool: a block may be handed out again while a kernel that
    uses it is still queued, which is right since all threads share the one queue.

    Attributes
    ----------
    name, driver, kind : str
        As the driver reports them; kind is "gpu", "cpu", "accelerator" or "simulator".
    max_allocation : int
        Bytes of the largest single buffer. Operators cut matrices into slabs of rows below it.
    memory : int
        Bytes of memory; on a CPU what the host has free, since drivers there report arbitrary parts of it.
    allocations : int
        How often OpenCL has been asked for memory; arrays from the pool do not count.
    """

    def __init__(self, description: Description) -> None:
        import pyopencl as cl
        from pyopencl.tools import ImmediateAllocator, MemoryPool

        self.description = description
        self.name, self.driver, self.kind = description.name, description.driver, description.kind
        self.handle = handle = description.handle
        self.cl: Any = cl
        with failures.translated(f"opening {self.name}"):
            self.context = cl.Context([handle])
            # Profiling costs 0.1 us a launch and so may always be on.
            self.queue = cl.CommandQueue(
                self.context, properties=cl.command_queue_properties.PROFILING_ENABLE
            )
        self.compute_units: int = handle.max_compute_units
        self.max_group: int = handle.max_work_group_size
        self.local_memory: int = handle.local_mem_size
        self.max_allocation: int = handle.max_mem_alloc_size
        self.memory: int = checks.host_memory() if self.is_cpu else handle.global_mem_size
        self.allocations = 0
        # Blocks are a sixteenth too large at most, and allocated at once: a refusal comes here, not later.
        self._pool = MemoryPool(ImmediateAllocator(self.queue), leading_bits_in_bin_id=4)
        self._largest_pooled = min(self.memory // _POOLED, self.max_allocation // 16)
        self._programs: dict[tuple, Any] = {}
        self._kernels: dict[tuple[str, tuple], Kernel] = {}
        self.reductions: dict[tuple, Any] = {}  # of `vectors`
        self._lock = threading.RLock()
        self._recording = _Recording()
        self._process = os.getpid()

    def __repr__(self) -> str:
        return f"<ltcl device {self.description.index} {self.name}, {self.driver}>"

    @property
    def is_cpu(self) -> bool:
        """Whether kernels should run one stream per work-item instead of one item per value."""
        return self.kind in ("cpu", "simulator")

    def kernel(self, file: str, name: str, **defines: Any) -> Kernel:
        """The kernel `name` of `kernels/<file>.cl` built with `defines`; built at the first call only."""
        failures.refuse_forked(self._process)
        program = (file, *sorted(defines.items()))
        with self._lock:
            if (name, program) not in self._kernels:
                if program not in self._programs:
                    self._programs[program] = kernels.build(self, file, defines)
                self._kernels[name, program] = Kernel(self, self._programs[program], name)
            return self._kernels[name, program]

    def launch(self, name: str, handle: Any, items: tuple[int, ...], group: tuple[int, ...] | None) -> None:
        """Queue a cl_kernel whose arguments are set."""
        # No context manager here: a launch is microseconds, and a solve makes dozens.
        failures.refuse_forked(self._process)
        try:
            event = self.cl.enqueue_nd_range_kernel(self.queue, handle, items, group)
        except self.cl.Error as error:
            raise failures.explain(f"running {name} on {self.name}", error) from error
        if self._recording.events is not None:
            self._recording.events.append((name, event))

    def empty(self, shape: int | tuple[int, ...], dtype: Any = np.float32) -> Array:
        """An uninitialised array, in microseconds; refuses what the device cannot hold with both sizes."""
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        dtype = np.dtype(dtype)
        nbytes = math.prod(map(int, shape)) * dtype.itemsize
        if nbytes + SPARE_BYTES > self.max_allocation:
            raise MemoryLimitError(
                f"a buffer of {checks.size(nbytes)} for an array {shape} is beyond the largest that "
                f"{self.name} allows, {checks.size(self.max_allocation)}"
            )
        failures.refuse_forked(self._process)
        try:
            return Array(self, self._allocate(nbytes + SPARE_BYTES), shape, dtype)
        except self.cl.Error as error:
            raise failures.explain(f"allocating {checks.size(nbytes)} on {self.name}", error) from error

    def _allocate(self, nbytes: int) -> Any:
        """A buffer from the pool, or a new one; unused blocks of the pool make room where memory is short."""
        with self._lock:
            if nbytes <= self._largest_pooled:
                unused = self._pool.held_blocks
                buffer = self._pool.allocate(nbytes)  # frees unused blocks and tries again by itself
                self.allocations += self._pool.held_blocks >= unused
                return buffer
            self.allocations += 1
            try:
                return self.cl.Buffer(self.context, self.cl.mem_flags.READ_WRITE, nbytes)
            except self.cl.Error:
                self._pool.free_held()
                return self.cl.Buffer(self.context, self.cl.mem_flags.READ_WRITE, nbytes)

    def upload(self, values: Any, dtype: Any = np.float32) -> Array:
        """A copy of `values` on the device, as `dtype`."""
        host = rounded(values, dtype)
        return self.empty(host.shape, dtype).set(host)

    def require(self, nbytes: int, what: str) -> None:
        """Refuse, before anything is allocated, `what` that needs more bytes than the device has."""
        memory = self.memory
        if self.is_cpu and nbytes > checks.host_memory():  # which changes while a program runs
            self._pool.free_held()
            memory = min(memory, checks.host_memory())
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
        failures.refuse_forked(self._process)
        with failures.translated(f"copying on {self.name}"):
            self.cl.enqueue_copy(self.queue, to, of, **sizes)

    def finish(self) -> None:
        """Wait until everything queued has run."""
        failures.refuse_forked(self._process)
        with failures.translated(f"waiting for {self.name}"):
            self.queue.finish()

    @contextlib.contextmanager
    def profile(self) -> Iterator[Profile]:
        """Count launches and device seconds of every kernel that this thread runs inside the block."""
        outer, result, events = self._recording.events, Profile(), []
        self._recording.events = events
        try:
            yield result
        finally:
            self._recording.events = outer
            self.finish()
            for name, event in events:
                result.launches[name] += 1
                result.seconds[name] += (event.profile.end - event.profile.start) * 1e-9
            if outer is not None:  # a profile around this one
                outer += events
