# SPDX-License-Identifier: BSD-3-Clause
"""An opened OpenCL device: its limits, its one in-order queue, its kernels, its memory."""

from __future__ import annotations

import contextlib
import math
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks
from ltcl.device import driver_errors, huge_pages, sources
from ltcl.device.arrays import Array, rounded
from ltcl.device.kernels import Kernel
from ltcl.device.profile import COPY, DOWNLOAD, UPLOAD, Profile
from ltcl.errors import DeviceError, MemoryLimitError

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

    def __init__(self, handle: Any, context: Any = None) -> None:
        import pyopencl as cl
        from pyopencl.tools import ImmediateAllocator, MemoryPool

        self.handle = handle
        # Devices of one context copy between each other.
        self.context = cl.Context([handle]) if context is None else context
        self.queue = cl.CommandQueue(self.context, handle)
        allocator = ImmediateAllocator(self.queue)
        self.pool = MemoryPool(allocator, leading_bits_in_bin_id=POOL_BIN_BITS)
        self.launches = Counter[str]()
        # A program of pyopencl and its kernels by name, for each file and defines.
        self.programs: dict[tuple, tuple[Any, dict[str, Kernel]]] = {}
        # Plans of ltcl.device.vectors, by kernel and size.
        self.reductions: dict[tuple, Any] = {}
        self.lock = threading.RLock()
        # Held while something is queued, as `profile` changes the queue.
        self.queueing = threading.Lock()
        self.profiles: list[Profile] = []
        self._plain_queue = self.queue
        self._timed_queue: Any = None
        self._transfer_queues: dict[str, Any] = {}
        # Held while a program is built, for as long as a compiler takes.
        self.building = threading.RLock()

    @property
    def uploads(self) -> Any:
        """A queue of copies from the host alone, made when it is asked for."""
        return self._transfer_queue(UPLOAD)

    @property
    def downloads(self) -> Any:
        """A queue of copies to the host alone, made when it is asked for."""
        return self._transfer_queue(DOWNLOAD)

    def _transfer_queue(self, direction: str) -> Any:
        with self.lock:
            if direction not in self._transfer_queues:
                self._transfer_queues[direction] = self._make_timed_queue()
            return self._transfer_queues[direction]

    def _make_timed_queue(self) -> Any:
        """A queue whose events have times."""
        import pyopencl as cl

        timed = cl.command_queue_properties.PROFILING_ENABLE
        return cl.CommandQueue(self.context, self.handle, timed)

    def begin(self, profile: Profile) -> None:
        """Have a profile take note of all that is queued from now on."""
        if self._timed_queue is None:
            self._timed_queue = self._make_timed_queue()
        with self.queueing:
            self.profiles.append(profile)
            self._change_queue(self._timed_queue)

    def end(self, profile: Profile) -> None:
        """Have a profile take no more notes."""
        with self.queueing:
            self.profiles.remove(profile)
            if not self.profiles:
                self._change_queue(self._plain_queue)

    def _change_queue(self, queue: Any) -> None:
        """Use another queue, in which all waits for what is queued in this one."""
        import pyopencl as cl

        if queue is self.queue:
            return
        queued = cl.enqueue_marker(self.queue)
        self.queue.flush()
        cl.enqueue_barrier(queue, wait_for=[queued])
        self.queue = queue


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
    def queue(self) -> Any:
        """The queue of OpenCL; `profile` changes it for a while."""
        return self.session.queue

    @property
    def has_clock(self) -> bool:
        """True if the device tells when a kernel began and ended."""
        timed = self.cl.command_queue_properties.PROFILING_ENABLE
        return bool(self.handle.queue_properties & timed)

    @property
    def is_cpu(self) -> bool:
        """True if kernels should run a stream per work-item instead of an item per value."""
        return self.kind in ("cpu", "simulator")

    @property
    def subgroup(self) -> int:
        """Work-items that a GPU runs in step, as its driver says: 32 or 64 on most."""
        return self.kernel("vector", "vector_fill").subgroup

    def kernel(self, file: str, name: str, **defines: Any) -> Kernel:
        """Kernel `name` of `kernels/<file>.cl` with `defines`; built at the first call only.

        A `file` that ends with .cl is the path of one elsewhere.
        """
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

    def launch(self, name: str, handle: Any, items: tuple[int, ...], group: tuple[int, ...]) -> Any:
        """Queue a cl_kernel whose arguments are set; returns its event."""
        driver_errors.refuse_forked()
        session = self.session
        try:
            with session.queueing:
                event = self.cl.enqueue_nd_range_kernel(session.queue, handle, items, group)
        except self.cl.Error as error:
            raise driver_errors.explain(f"running {name} on {self.name}", error) from error
        self.launches[name] += 1
        for profile in session.profiles:
            profile.add(name, event)
        return event

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
        with (
            driver_errors.translated(f"copying on {self.name}"),
            self._queueing_of(destination, source),
        ):
            event = self.cl.enqueue_copy(self.queue, destination, source, **sizes)
        self._note_copy(event, destination, source, sizes)

    def queue_copy(self, destination: Any, source: Any) -> Any:
        """Queue a copy between a host array and a buffer; the host array must stay until it ends.

        Returns an object whose `wait` returns when it has ended.
        """
        with driver_errors.translated(f"copying on {self.name}"), self.session.queueing:
            event = self.cl.enqueue_copy(self.queue, destination, source, is_blocking=False)
        self._note_copy(event, destination, source, {})
        return event

    def queue_bytes(self, destination: Any, source: Any, ready: Any, **sizes: int) -> Any:
        """Queue a copy between buffers of two devices behind an event, start it; returns its own.

        Another queue would wait forever for what was never started.
        """
        with driver_errors.translated(f"copying to {self.name}"), self.session.queueing:
            event = self.cl.enqueue_copy(self.queue, destination, source, wait_for=[ready], **sizes)
            self.queue.flush()
        self.profile_copy(COPY, event, sizes["byte_count"])
        return event

    def _queueing_of(self, *places: Any) -> Any:
        """The lock of what is queued; none for a copy that waits, for others would, too."""
        if any(isinstance(place, np.ndarray) for place in places):
            return contextlib.nullcontext()
        return self.session.queueing

    def _note_copy(self, event: Any, destination: Any, source: Any, sizes: Any) -> None:
        """Let profiles take note of a copy."""
        if isinstance(source, np.ndarray):
            self.profile_copy(UPLOAD, event, source.nbytes)
        elif isinstance(destination, np.ndarray):
            self.profile_copy(DOWNLOAD, event, destination.nbytes)
        else:
            self.profile_copy(COPY, event, sizes["byte_count"])

    def profile_copy(self, direction: str, event: Any, nbytes: int) -> None:
        """Let profiles take note of a copy that was queued."""
        for profile in self.session.profiles:
            profile.add(direction, event, nbytes)

    def mark(self) -> Any:
        """The event at which all that is queued so far has ended, for another queue to wait for."""
        with driver_errors.translated(f"waiting for {self.name}"), self.session.queueing:
            event = self.cl.enqueue_marker(self.queue)
            self.queue.flush()
        return event

    def wait_for(self, *events: Any) -> None:
        """Let all that is queued from now on wait for events of other queues, as far as given."""
        pending = [event for event in events if event is not None]
        if not pending:
            return
        with driver_errors.translated(f"waiting for {self.name}"), self.session.queueing:
            self.cl.enqueue_barrier(self.queue, wait_for=pending)

    @contextlib.contextmanager
    def profile(self) -> Iterator[Profile]:
        """Time the kernels and copies of the block by the device's own clock.

        The result has its numbers at the end of the block, for which it waits. What other threads
        queue on the device counts, too; other devices of ``open_device("all")`` have profiles of
        their own. Launches cost a little more meanwhile.

        Raises
        ------
        DeviceError
            The driver keeps no times.

        Examples
        --------
        >>> import ltcl
        >>> device = ltcl.open_device()
        >>> x = device.empty(1000)
        >>> with device.profile() as profile:
        ...     x = ltcl.device.vectors.fill(x, 1.0)
        ...     y = x.copy()
        >>> profile.kernels["vector_fill"].launches, profile.copies["copy"].nbytes
        (1, 4000)
        """
        if not self.has_clock:
            raise DeviceError(f"{self.name} ({self.driver}) keeps no times of kernels")
        profile = Profile()
        with driver_errors.translated(f"profiling {self.name}"):
            self.session.begin(profile)
        try:
            yield profile
        finally:
            try:
                self.finish()
            finally:
                self.session.end(profile)
            profile.end()

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
