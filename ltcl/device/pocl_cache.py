# SPDX-License-Identifier: BSD-3-Clause
"""The folder in which PoCL keeps compiled kernels, checked where PoCL would end the process.

PoCL writes each program (`program.bc`) and each kernel, a shared library, to this folder, and loads
the library from there. It calls `abort` if the folder cannot hold or run it, or if a file was cut
off by an earlier full disk or power cut.

    FOLDER/XX/PROGRAM/last_accessed                    touched by each build of the program
    FOLDER/XX/PROGRAM/program.bc                       LLVM bitcode
    FOLDER/XX/PROGRAM/KERNEL/WORK_GROUP/KERNEL.so      ELF

Known limit: a disk that becomes full between the check and the launch of a kernel.
"""

from __future__ import annotations

import contextlib
import functools
import mmap
import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path

from ltcl import checks
from ltcl.errors import DeviceError

# A part of the driver's name.
DRIVER = "Portable Computing Language"
# The preprocessed source of one program takes 0.7 MiB for a moment.
MIN_FREE_BYTES = 4 << 20
MIN_FREE_FILES = 64
# Clocks of a network disk differ.
CLOCK_SECONDS = 2.0
# Looks at a file that may be half written, and the time between them.
WRITING_TRIALS = 6
WRITING_SECONDS = 0.1
ELF_64_MAGIC = b"\x7fELF\x02"
# Blocks follow: a word of 32 bits, the number of words to come, and these.
BITCODE_MAGIC = b"BC\xc0\xde"
# Every file has a longer head.
MIN_FILE_BYTES = 64


def folder() -> Path:
    """The folder that PoCL uses."""
    chosen = os.environ.get("POCL_CACHE_DIR")
    if chosen:
        return Path(chosen)
    caches = os.environ.get("XDG_CACHE_HOME")
    if caches:
        return Path(caches, "pocl", "kcache")
    home = os.environ.get("HOME")
    if home:
        return Path(home, ".cache", "pocl", "kcache")
    return Path("/tmp/pocl/kcache")  # noqa: S108 - PoCL's choice


def check_folder() -> None:
    """Raise DeviceError if PoCL cannot write to its folder, or load kernels from it."""
    path = folder()
    if not hasattr(os, "statvfs"):
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
        disk = os.statvfs(path)
    except OSError as error:
        raise _refusal(f"cannot be used ({error.strerror})") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise _refusal("cannot be written")
    if disk.f_flag & os.ST_NOEXEC:
        raise _refusal("is on a disk mounted noexec, from which no kernel can be loaded")
    free = disk.f_bavail * disk.f_frsize
    if free < MIN_FREE_BYTES:
        need = checks.size(MIN_FREE_BYTES)
        raise _refusal(f"is on a full disk: {checks.size(free)} are free, PoCL needs {need}")
    # File systems without a limit report 0 files.
    if disk.f_files and disk.f_favail < MIN_FREE_FILES:
        raise _refusal(f"is on a full disk: it can take {disk.f_favail} more files")


def _refusal(problem: str) -> DeviceError:
    return DeviceError(
        f"PoCL's folder for compiled kernels, {folder()}, {problem}; set POCL_CACHE_DIR to a "
        "folder that can be written, on a disk with room that may run programs"
    )


@contextlib.contextmanager
def checked() -> Iterator[None]:
    """Check the folder before a program is built in the block, and its kernels afterwards."""
    check_folder()
    check_programs(folder())
    start = time.time()
    yield
    check_kernels(since=start - CLOCK_SECONDS)


@functools.cache
def check_programs(path: Path) -> None:
    """Raise DeviceError if a program is cut off: PoCL would end the process at its exit.

    Programs are checked once, since this takes up to 50 us for each.
    """
    for program in _programs(path):
        _check_file(program / "program.bc")


def check_kernels(since: float = 0.0) -> int:
    """Raise DeviceError if a kernel of a program that was built `since` a time is cut off.

    Returns the number of kernels.
    """
    count = 0
    for program in _programs(folder(), since):
        for kernel in program.glob("*/*/*.so"):
            _check_file(kernel)
            count += 1
    return count


def _programs(path: Path, since: float = 0.0) -> Iterator[Path]:
    """The folders of programs that were built at `since` or later."""
    for first_letters in _entries(path):
        for program in _entries(first_letters):
            with contextlib.suppress(OSError):
                if os.stat(f"{program}/last_accessed").st_mtime >= since:
                    yield Path(program)


def _entries(path: str | Path) -> list[str]:
    """Paths in a folder; none if it is missing or not a folder."""
    with contextlib.suppress(OSError), os.scandir(path) as entries:
        return [entry.path for entry in entries]
    return []


def _check_file(path: Path) -> None:
    """Raise DeviceError if the file is cut off, and not just being written by another process."""
    for _ in range(WRITING_TRIALS):
        if is_whole(path):
            return
        time.sleep(WRITING_SECONDS)
    raise DeviceError(
        f"{path}, which PoCL compiled earlier, is damaged; delete the folder {folder()}, or set "
        "POCL_CACHE_DIR to another one"
    )


def is_whole(path: Path) -> bool:
    """True unless a shared library or a bitcode file is shorter than its own headers say.

    Files of other formats pass, if they are not all but empty.
    """
    try:
        with (
            path.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            if len(content) < MIN_FILE_BYTES:
                return False
            if content[:5] == ELF_64_MAGIC:
                return _elf_size(content) <= len(content)
            if content[:4] == BITCODE_MAGIC:
                return _bitcode_size(content) == len(content)
            return True
    except OSError:
        # Another process has just replaced it.
        return True
    except (struct.error, ValueError):
        # An empty file has no map.
        return False


def _elf_size(content: mmap.mmap) -> int:
    """Bytes of a 64-bit ELF file, by its tables of segments and sections."""
    segments, sections, segment_size, segment_count, section_size, section_count = (
        struct.unpack_from("<32xQQ6xHHHH", content)
    )
    size = sections + section_size * section_count
    for number in range(segment_count):
        place = segments + segment_size * number
        offset, length = struct.unpack_from("<8xQ16xQ", content, place)
        size = max(size, offset + length)
    return size


def _bitcode_size(content: mmap.mmap) -> int:
    """Bytes of a file of LLVM bitcode, by the lengths of its outermost blocks."""
    place = len(BITCODE_MAGIC)
    while place < len(content):
        _, words = struct.unpack_from("<II", content, place)
        place += 8 + 4 * words
    return place
