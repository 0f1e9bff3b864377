# SPDX-License-Identifier: BSD-3-Clause
"""Errors of drivers as errors of ltcl, and the refusal of processes in which drivers hang."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from ltcl.errors import DeviceError, LtclError, MemoryLimitError

MEMORY_STATUSES = {
    "MEM_OBJECT_ALLOCATION_FAILURE",
    "OUT_OF_RESOURCES",
    "OUT_OF_HOST_MEMORY",
    "INVALID_BUFFER_SIZE",
}
ADVICE = {
    "DEVICE_NOT_AVAILABLE": (
        "the device is in use by another process or was unplugged; try LTCL_DEVICE=cpu"
    ),
    "COMPILER_NOT_AVAILABLE": (
        "this driver cannot compile kernels; choose another device (ltcl devices)"
    ),
}

# The process that first asked OpenCL; a fork inherits it.
_first_process: dict[str, int] = {}


def refuse_forked() -> None:
    """Raise in a process forked from one that had used OpenCL: drivers hang there."""
    process = os.getpid()
    if _first_process.setdefault("id", process) != process:
        raise DeviceError(
            "this process was forked from one that had used OpenCL, whose drivers do not survive "
            'that; start workers by multiprocessing.get_context("spawn") or "forkserver", and open '
            "the device in each"
        )


@contextlib.contextmanager
def translated(action: str) -> Iterator[None]:
    """Raise an error of ltcl that names the `action` instead of one of pyopencl; refuse forks."""
    refuse_forked()
    import pyopencl as cl

    try:
        yield
    except cl.Error as error:
        raise explain(action, error) from error


def explain(action: str, error: Exception) -> LtclError:
    """Error of ltcl for the `error` that pyopencl raised during the `action`."""
    status = _status(error)
    if status in MEMORY_STATUSES:
        return MemoryLimitError(
            f"{action}: the device ran out of memory ({status}); compress the matrix, free other "
            "buffers, or choose a device with more memory (ltcl devices)"
        )
    advice = ADVICE.get(status, "see ltcl doctor")
    return DeviceError(f"{action}: OpenCL answered {status}; {advice}")


def _status(error: Exception) -> str:
    """Name of the status code of an error, or the first line of one without a code."""
    import pyopencl as cl

    code = getattr(error, "code", None)
    if code is None:
        return str(error).partition("\n")[0]
    return cl.status_code.to_string(code, f"{code}")
