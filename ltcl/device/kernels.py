# SPDX-License-Identifier: BSD-3-Clause
"""One way to run a kernel: build once per (source, defines, device), typed arguments, launch."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from ltcl.device import failures, programs, sources

if TYPE_CHECKING:
    from ltcl.device.device import Device

# Exact float32: no fast-math (it deletes NaN tests), contraction of a * b + c is left to the driver.
_OPTIONS = ["-cl-std=CL1.2"]
_Size = int | tuple[int, ...]


class Kernel:
    """A compiled kernel of one device.

    Call it with the number of work-items, the work-group size (None: the driver's choice) and the
    arguments: Python numbers, `Array`, or pyopencl buffers and local memory.
    """

    def __init__(self, device: Device, built: Any, name: str, types: tuple[type | None, ...]) -> None:
        import pyopencl as cl

        self.device = device
        self.name = name
        self._kernel = built
        self._errors = cl.Error
        # Untyped Python scalars are refused by pyopencl with CL_INVALID_VALUE: their types are set once.
        self._kernel.set_scalar_arg_dtypes(list(types))
        # Arguments live in the cl_kernel until the launch: one thread at a time.
        self._lock = threading.Lock()
        self._largest_group = 0

    def __call__(self, items: _Size, group: _Size | None, *arguments: Any) -> None:
        """Queue a launch over `items` rounded up to whole groups; returns at once."""
        size = items if isinstance(items, tuple) else (items,)
        local = (group,) if isinstance(group, int) else group
        if 0 in size:
            return
        if local is not None:
            size = tuple(-(-n // g) * g for n, g in zip(size, local, strict=True))
        raw = [getattr(argument, "buffer", argument) for argument in arguments]
        # No context manager here: a launch is microseconds, and a solve makes dozens.
        try:
            with self._lock:
                event = self._kernel(self.device.queue, size, local, *raw)
        except self._errors as error:
            raise failures.explain(f"running {self.name} on {self.device.name}", error) from error
        self.device.record(self.name, event)

    def largest_group(self) -> int:
        """The largest work-group this kernel can run with on its device."""
        import pyopencl as cl

        if not self._largest_group:
            self._largest_group = self._kernel.get_work_group_info(
                cl.kernel_work_group_info.WORK_GROUP_SIZE, self.device.handle
            )
        return self._largest_group


def build(device: Device, file: str, defines: dict[str, Any]) -> dict[str, Kernel]:
    """Compile `kernels/<file>.cl` for `device`; returns its kernels by name."""
    import pyopencl as cl

    source = sources.load(file)
    options = _OPTIONS + [f"-D{name}={value}" for name, value in sorted(defines.items())]
    program = programs.build(device, source, options)
    return {
        name: Kernel(device, cl.Kernel(program, name), name, types)
        for name, types in source.signatures.items()
    }
