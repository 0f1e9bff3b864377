# SPDX-License-Identifier: BSD-3-Clause
"""An opened OpenCL device: its limits, its in-order queue, its kernels, its memory."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import failures, kernels
from ltcl.device.array import Array, rounded
from ltcl.device.description import Description
from ltcl.device.kernels import Kernel
from ltcl.errors import MemoryLimitError

SPARE_BYTES = 16  # behind every array: kernels may read the last pixel in one wide load


@dataclass
class Profile:
    """Launches and seconds per kernel, as the device's own clock saw them."""

    launches: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


class Device:
    """One OpenCL device with a context and an in-order queue. Made by `ltcl.open_device`.

    Attributes
    ----------
    name, driver, kind : str
        As the driver tells them; kind is "gpu", "cpu", "accelerator" or "simulator".
    max_allocation : int
        Bytes of the largest single buffer. Operators cut matrices into slabs of rows below it.
    memory : int
        Bytes of memory; on a CPU what the host has free, since drivers there report arbitrary parts of it.
    """

    def __init__(self, description: Description) -> None:
        import pyopencl as cl

        self.description = description
        self.name, self.driver, self.kind = description.name, description.driver, description.kind
        self.handle = description.handle
        with failures.translated(f"opening {self.name}"):
            self.context = cl.Context([self.handle])
            self.queue = cl.CommandQueue(self.context)
        self.compute_units: int = self.handle.max_compute_units
        self.max_group: int = self.handle.max_work_group_size
        self.local_memory: int = self.handle.local_mem_size
        self.max_allocation: int = self.handle.max_mem_alloc_size
        self.memory: int = checks.host_memory() if self.is_cpu else self.handle.global_mem_size
        self._programs: dict[tuple[str, tuple[tuple[str, Any], ...]], dict[str, Kernel]] = {}
        self._lock = threading.RLock()
        self._events: list[tuple[str, Any]] | None = None  # of the launches being profiled

    def __repr__(self) -> str:
        return f"<ltcl device {self.description.index} {self.name}, {self.driver}>"

    @property
    def is_cpu(self) -> bool:
        """Whether kernels should run one stream per work-item instead of one item per value."""
        return self.kind in ("cpu", "simulator")

    def kernel(self, file: str, name: str, **defines: Any) -> Kernel:
        """The kernel `name` of `kernels/<file>.cl` built with `defines`; built at the first call only."""
        key = (file, tuple(sorted(defines.items())))
        with self._lock:
            if key not in self._programs:
                self._programs[key] = kernels.build(self, file, defines)
            return self._programs[key][name]

    def empty(self, shape: int | tuple[int, ...], dtype: Any = np.float32) -> Array:
        """An uninitialised array; refuses what the device cannot hold with both sizes."""
        import pyopencl as cl

        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        nbytes = math.prod(map(int, shape)) * np.dtype(dtype).itemsize
        if nbytes + SPARE_BYTES > self.max_allocation:
            raise MemoryLimitError(
                f"a buffer of {checks.size(nbytes)} for an array {shape} is beyond the largest that "
                f"{self.name} allows, {checks.size(self.max_allocation)}"
            )
        with failures.translated(f"allocating {checks.size(nbytes)} on {self.name}"):
            buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, nbytes + SPARE_BYTES)
        return Array(self, buffer, shape, np.dtype(dtype))

    def upload(self, values: Any, dtype: Any = np.float32) -> Array:
        """A copy of `values` on the device, as `dtype`."""
        host = rounded(values, dtype)
        return self.empty(host.shape, dtype).set(host)

    def require(self, nbytes: int, what: str) -> None:
        """Refuse, before anything is allocated, `what` that needs more bytes than the device has."""
        # What a host has free changes while a program runs.
        memory = min(self.memory, checks.host_memory()) if self.is_cpu else self.memory
        if nbytes > memory:
            raise MemoryLimitError(
                f"{what} needs {checks.size(nbytes)}, but {self.name} has {checks.size(memory)}; "
                "threshold or compress it, or choose another device"
            )

    def local(self, items: int) -> Any:
        """Local memory for one float32 an item of a work-group, as a kernel argument."""
        import pyopencl as cl

        return cl.LocalMemory(4 * items)

    def finish(self) -> None:
        """Wait until everything queued has run."""
        with failures.translated(f"waiting for {self.name}"):
            self.queue.finish()

    @contextlib.contextmanager
    def profile(self) -> Iterator[Profile]:
        """Count launches and device seconds of every kernel run inside the block."""
        import pyopencl as cl

        outer, result, events = (self.queue, self._events), Profile(), []
        self.finish()
        self.queue = cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        self._events = events
        try:
            yield result
        finally:
            try:
                self.finish()
            finally:
                self.queue, self._events = outer
            for name, event in events:
                result.launches[name] = result.launches.get(name, 0) + 1
                spent = (event.profile.end - event.profile.start) * 1e-9
                result.seconds[name] = result.seconds.get(name, 0.0) + spent
                self.record(name, event)  # of a profile around this one, too

    def record(self, name: str, event: Any) -> None:
        """Keep the event of a launch while `profile` is active."""
        if self._events is not None:
            self._events.append((name, event))
