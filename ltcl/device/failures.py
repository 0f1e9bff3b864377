# SPDX-License-Identifier: BSD-3-Clause
"""OpenCL status codes turned into ltcl errors that say what to do."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from ltcl.errors import DeviceError, LtclError, MemoryLimitError

_MEMORY = {"MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_RESOURCES", "OUT_OF_HOST_MEMORY", "INVALID_BUFFER_SIZE"}
_ADVICE = {
    "DEVICE_NOT_AVAILABLE": "the device is in use by another process or was unplugged; try LTCL_DEVICE=cpu",
    "COMPILER_NOT_AVAILABLE": "this driver cannot compile kernels; choose another device (ltcl devices)",
}


def refuse_forked(process: int) -> None:
    """Raise where this is not the `process` that opened OpenCL: after a fork, drivers hang."""
    if os.getpid() != process:
        raise DeviceError(
            "this process was forked from one that had used OpenCL, whose drivers do not survive that; start "
            'workers by multiprocessing.get_context("spawn") or "forkserver", and open the device in each'
        )


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
    import pyopencl as cl

    code = getattr(error, "code", None)
    status = str(error).partition("\n")[0] if code is None else cl.status_code.to_string(code, f"{code}")
    if status in _MEMORY:
        return MemoryLimitError(
            f"{doing}: the device ran out of memory ({status}); compress the matrix, free other buffers, "
            "or choose a device with more memory (ltcl devices)"
        )
    return DeviceError(f"{doing}: OpenCL answered {status}; {_ADVICE.get(status, 'see ltcl doctor')}")
