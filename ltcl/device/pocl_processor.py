# SPDX-License-Identifier: BSD-3-Clause
"""A name for processors that are newer than the compiler of PoCL.

PoCL compiles kernels for the processor that its LLVM names. Of one that is newer, LLVM says
"generic", a name that its own compiler refuses: no kernel compiles. PoCL has no setting for it. So
the name in PoCL's description of the device is replaced by that of an older processor, whose
instructions this one has.

PoCL's description is a struct that begins at the handle of the device. It is read through
``/proc/self/mem``, which refuses memory that is not there, and written only where the name stands
directly behind that of the target, both as pointers to text.
"""

from __future__ import annotations

import ctypes
import platform
import sys
from pathlib import Path
from typing import Any, BinaryIO

DRIVER = "Portable Computing Language"
UNNAMED = b"generic\0"
TARGET = b"x86_64-"
# Bytes of a description that are searched; the name stands at 640 in PoCL 3.0.
DESCRIPTION_BYTES = 4096
POINTER_BYTES = ctypes.sizeof(ctypes.c_void_p)
# Names that every compiler of PoCL knows, and the instructions that tell them; the first fits best.
NAMES = (
    ("skylake-avx512", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "clwb", "pku"}),
    ("haswell", {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"}),
    ("x86-64", set[str]()),
)
CPU_FACTS = Path("/proc/cpuinfo")
MEMORY = Path("/proc/self/mem")

# The driver points to these from then on.
_given: dict[str, ctypes.Array[ctypes.c_char]] = {}


def provide(driver: str, handle: Any) -> None:
    """Give the processor of a device of PoCL a name, if it has none: before its first kernel."""
    if DRIVER not in driver or sys.platform != "linux" or platform.machine() != "x86_64":
        return
    name_unnamed(handle.int_ptr, known_name(_instructions()))


def name_unnamed(description: int, name: str) -> bool:
    """Replace "generic" in the description at this address; return whether it was there."""
    with MEMORY.open("rb", buffering=0) as memory:
        place = _find_unnamed(memory, description)
    if place is None:
        return False
    text = _given.setdefault(name, ctypes.create_string_buffer(name.encode()))
    ctypes.c_void_p.from_address(place).value = ctypes.addressof(text)
    return True


def known_name(instructions: set[str]) -> str:
    """The name of the newest known processor that has no other instructions.

    >>> known_name({"sse2", "avx"})
    'x86-64'
    """
    for name, needed in NAMES:
        if needed <= instructions:
            return name
    raise AssertionError("the last name needs no instructions")


def _find_unnamed(memory: BinaryIO, description: int) -> int | None:
    """The address of the pointer to "generic" that follows one to the target's name."""
    is_target = False
    for place in range(description, description + DESCRIPTION_BYTES, POINTER_BYTES):
        pointer = int.from_bytes(_read(memory, place, POINTER_BYTES), sys.byteorder)
        if is_target and _read(memory, pointer, len(UNNAMED)) == UNNAMED:
            return place
        is_target = _read(memory, pointer, len(TARGET)) == TARGET
    return None


def _read(memory: BinaryIO, address: int, size: int) -> bytes:
    """Bytes of this process; none where it has no memory."""
    try:
        memory.seek(address)
        return memory.read(size)
    except (OSError, OverflowError, ValueError):
        return b""


def _instructions() -> set[str]:
    """The names of the processor's instructions, as Linux has them."""
    try:
        facts = CPU_FACTS.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return set()
    for line in facts.splitlines():
        if line.startswith("flags"):
            return set(line.partition(":")[2].split())
    return set()
