# SPDX-License-Identifier: BSD-3-Clause
"""Programs that are built beside an upload, by a thread, before a first product or solve asks.

A compiler takes 20 to 500 ms for a program, also for one that it finds in its own cache. Who needs
a program sooner builds it, or waits for the thread. Other drivers than PoCL keep what they
compiled.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ltcl.device import pocl_cache
from ltcl.errors import LtclError

if TYPE_CHECKING:
    from ltcl.device.device import Device

# Name of the threads.
THREAD = "ltcl builds"
# Programs (file, defines) of vectors, which every use of a device runs, and of first solves.
_of_vectors: list[tuple[str, Mapping[str, Any]]] = [("vector", {})]
_of_solves = list(_of_vectors)


def announce(file: str, defines: Mapping[str, Any]) -> None:
    """Have a program built ahead of first solves."""
    _of_solves.append((file, defines))


def begin(device: Device, file: str, defines: Mapping[str, Any], *, solves: bool = False) -> None:
    """Begin to build a program of products; with `solves` those of solves, too."""
    programs = [(file, defines)]
    if solves:
        programs += _of_solves
    _start(device, programs)


def begin_with_vectors(device: Device) -> None:
    """Begin to build what every use of a new device runs; a compiler also has to start itself."""
    _start(device, _of_vectors)


def _start(device: Device, programs: list[tuple[str, Mapping[str, Any]]]) -> None:
    """Start a thread where some programs are not built."""
    if pocl_cache.DRIVER not in device.driver:
        return
    waiting = [program for program in programs if not device.has_program(*program)]
    if waiting:
        threading.Thread(target=_build, args=(device, waiting), name=THREAD).start()


def _build(device: Device, programs: list[tuple[str, Mapping[str, Any]]]) -> None:
    """Build programs; what fails does so again, and is told, where it is used."""
    for file, defines in programs:
        with contextlib.suppress(LtclError):
            device.program(file, defines)
