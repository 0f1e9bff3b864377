# SPDX-License-Identifier: BSD-3-Clause
"""OpenCL status codes turned into ltcl errors that say what to do."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from ltcl.errors import DeviceError, LtclError, MemoryLimitError

_MEMORY = {"MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_RESOURCES", "OUT_OF_HOST_MEMORY", "INVALID_BUFFER_SIZE"}
_ADVICE = {
    "DEVICE_NOT_AVAILABLE": "the device is in use by another process or was unplugged; try LTCL_DEVICE=cpu",
    "COMPILER_NOT_AVAILABLE": "this driver cannot compile kernels; choose another device (ltcl devices)",
    "INVALID_WORK_GROUP_SIZE": "the driver refused a work-group size it had offered; please report it",
    "INVALID_KERNEL_ARGS": "an argument of the kernel was not set; please report it",
}


@contextlib.contextmanager
def translated(doing: str) -> Iterator[None]:
    """Raise an ltcl error that names what was being done where pyopencl raises its own."""
    import pyopencl as cl

    try:
        yield
    except cl.Error as error:
        raise explain(doing, error) from error


def explain(doing: str, error: Exception) -> LtclError:
    """The ltcl error for a pyopencl `error` raised while `doing` something."""
    status = _status(error)
    if status in _MEMORY:
        return MemoryLimitError(
            f"{doing}: the device ran out of memory ({status}); compress the matrix, free other buffers, "
            "or choose a device with more memory (ltcl devices)"
        )
    advice = _ADVICE.get(status, "see ltcl doctor")
    return DeviceError(f"{doing}: OpenCL answered {status}; {advice}")


def _status(error: Exception) -> str:
    import pyopencl as cl

    code = getattr(error, "code", None)
    if code is None:
        return str(error).splitlines()[0] if str(error) else type(error).__name__
    return cl.status_code.to_string(code, f"status {code}")
