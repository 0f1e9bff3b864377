# SPDX-License-Identifier: BSD-3-Clause
"""Large buffers of PoCL in huge pages, where the system gives them to those who ask.

A matrix is read at the speed of the memory only if the processor need not look up a page every
4 KiB: dense products gain a tenth, products with random columns a fifth.
"""

from __future__ import annotations

import ctypes
import logging
import mmap
from typing import TYPE_CHECKING, Any

from ltcl.device import pocl_cache

if TYPE_CHECKING:
    from ltcl.device.device import Device

# Bytes of a buffer from which on it asks: two huge pages of most processors.
MIN_BYTES = 1 << 22

log = logging.getLogger(__name__)


def ask(device: Device, buffer: Any, size: int) -> None:
    """Ask for huge pages for a new buffer of a CPU, which nobody has written yet."""
    advice = getattr(mmap, "MADV_HUGEPAGE", None)
    is_pocl = pocl_cache.DRIVER in device.driver and device.is_cpu
    if size < MIN_BYTES or advice is None or not is_pocl:
        return
    cl = device.cl
    flags = cl.map_flags.WRITE_INVALIDATE_REGION
    try:
        # PoCL maps a buffer to where it lies.
        memory, _ = cl.enqueue_map_buffer(device.queue, buffer, flags, 0, size, "u1")
        start = -(-memory.ctypes.data // mmap.PAGESIZE) * mmap.PAGESIZE
        length = memory.ctypes.data + size - start
        failed = ctypes.CDLL(None).madvise(ctypes.c_void_p(start), ctypes.c_size_t(length), advice)
        memory.base.release(device.queue)
    except (cl.Error, OSError, AttributeError) as error:
        log.info("no huge pages: %s", error)
        return
    if failed:
        log.info("the system has no huge pages for %d bytes", size)
