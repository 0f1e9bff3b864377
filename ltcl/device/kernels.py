# SPDX-License-Identifier: BSD-3-Clause
"""One way to run a kernel: find the source, build it once per device and defines, launch it.

A `.cl` file compiles as it stands with the kernels folder on the include path. ltcl expands the includes
itself, with `#line` marks, so that messages of every driver point at the file a person edits. Binaries are
left to the cache of the driver: that of pyopencl is bypassed, since it reads and writes pickles.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import math
import re
import struct
import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ltcl.device import failures
from ltcl.errors import DeviceError

if TYPE_CHECKING:
    from ltcl.device.device import Device

# Exact float32: no fast-math (it deletes NaN tests), contraction of a * b + c is left to the driver.
_OPTIONS = ["-cl-std=CL1.2", "-cl-kernel-arg-info"]
_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
_KERNEL = re.compile(r"\bkernel\s+void\s+(\w+)\s*\(")
_Size = int | tuple[int, ...]


@dataclass(frozen=True)
class Source:
    """One kernel file, ready for the compiler: its text, the digest of that, the names of its kernels."""

    text: str
    digest: str
    kernels: tuple[str, ...]


def folder() -> Path:
    """The folder of `.cl` files: `ltcl/kernels` where installed, `kernels/` beside `ltcl/` in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for place in (package / "kernels", package.parent / "kernels"):
        if (place / "common" / "real.h").is_file():
            return place
    raise DeviceError(f"the OpenCL kernels of ltcl are missing beside {package}; reinstall ltcl")


@functools.cache
def load(name: str) -> Source:
    """Read `kernels/<name>.cl` with its includes.

    >>> load("vector").kernels[0]
    'vector_fill'
    """
    text = _expand(f"{name}.cl", folder(), set())
    return Source(text, hashlib.sha256(text.encode()).hexdigest(), tuple(_KERNEL.findall(text)))


def _expand(relative: str, root: Path, seen: set[str]) -> str:
    seen.add(relative)
    lines = [f'#line 1 "{relative}"']
    for number, line in enumerate((root / relative).read_text(encoding="utf-8").splitlines(), 1):
        if not (include := _INCLUDE.match(line)):
            lines.append(line)
            continue
        if include[1] not in seen:
            lines.append(_expand(include[1], root, seen))
        lines.append(f'#line {number + 1} "{relative}"')
    return "\n".join(lines)


def build(device: Device, file: str, defines: dict[str, Any]) -> Any:
    """`kernels/<file>.cl` as a pyopencl program for `device`; DeviceError with the compiler's own words."""
    options = _OPTIONS + [f"-D{name}={value}" for name, value in sorted(defines.items())]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", device.cl.CompilerWarning)  # Intel's compiler reports every success
        try:
            return device.cl.Program(device.context, load(file).text).build(options)
        except device.cl.Error as error:
            log_text = str(error).split("(options:")[0].strip()  # pyopencl adds options and source
            raise DeviceError(
                f"kernels/{file}.cl does not compile on {device.name} ({device.driver}) with "
                f"{' '.join(options)}:\n{log_text}"
            ) from error


class Kernel:
    """A compiled kernel of one device.

    Call it with the number of work-items, the work-group size (None: the driver's choice) and the
    arguments: Python numbers, `Array`, or local memory. Items are rounded up to whole groups; groups are
    clamped to what kernel and device allow (`group`).
    """

    def __init__(self, device: Device, program: Any, name: str) -> None:
        self.device, self.name = device, name
        self._program = program
        self.idle: list[Any] = []  # cl_kernels of launches that are gone: making one costs 0.1 ms
        self._handle = handle = self.take()
        info = device.cl.kernel_work_group_info.WORK_GROUP_SIZE
        with failures.translated(f"asking for {name} on {device.name}"):
            self._most: int = min(handle.get_work_group_info(info, device.handle), device.max_group)
            self._packers = tuple(_packer(device, handle, index) for index in range(handle.num_args))
        self._groups: dict[_Size, _Size] = {}
        # Arguments live in the cl_kernel until the launch: one thread at a time.
        self._lock = threading.Lock()

    def __call__(self, items: _Size, group: _Size | None, *arguments: Any) -> None:
        """Queue a launch over `items` rounded up to whole groups; returns at once."""
        size, local = self.shape(items, group)
        if 0 in size:
            return
        with self._lock:
            for index, (_, argument) in enumerate(zip(self._packers, arguments, strict=True)):
                self.set(self._handle, index, argument)
            self.device.launch(self.name, self._handle, size, local)

    def bind(self, items: _Size, group: _Size | None, *arguments: Any) -> Launch:
        """The launch that calling the kernel would queue, to be queued again and again."""
        return Launch(self, items, group, arguments)

    def group(self, wanted: Any) -> Any:
        """The work-group that a launch with `wanted` has: halved until kernel and device allow it."""
        if wanted not in self._groups:
            sizes = list(wanted) if isinstance(wanted, tuple) else [wanted]
            for axis in range(len(sizes)):
                while sizes[axis] > self.device.handle.max_work_item_sizes[axis]:
                    sizes[axis] //= 2
            while math.prod(sizes) > self._most:
                sizes[sizes.index(max(sizes))] //= 2
            self._groups[wanted] = tuple(sizes) if isinstance(wanted, tuple) else sizes[0]
        return self._groups[wanted]

    def shape(self, items: _Size, group: _Size | None) -> tuple[tuple[int, ...], tuple[int, ...] | None]:
        """What OpenCL is asked for: the items in whole groups, and the clamped group."""
        size = items if isinstance(items, tuple) else (items,)
        if group is None:
            return size, None
        local = self.group(group if isinstance(group, tuple) else (group,))
        return tuple(-(-n // g) * g for n, g in zip(size, local, strict=True)), local

    def set(self, handle: Any, index: int, value: Any) -> None:
        """Set argument `index` of one of the kernel's cl_kernels, a number by its type in the source."""
        packer = self._packers[index]
        try:
            if packer is None:
                handle.set_arg(index, getattr(value, "buffer", value))
            else:  # `set_arg` would do as well, but tries all else before bytes: 6 us instead of 0.1
                handle._set_arg_buf(index, packer(value))
        except self.device.cl.Error as error:
            raise failures.explain(f"argument {index} of {self.name}", error) from error

    def take(self) -> Any:
        """A cl_kernel for one user, who puts it back into `idle`."""
        with contextlib.suppress(IndexError):
            return self.idle.pop()
        with failures.translated(f"no kernel {self.name} for {self.device.name}"):
            return self.device.cl.Kernel(self._program, self.name)


class Launch:
    """A kernel with its items and arguments, which are set once; call it to queue it again.

    One thread at a time: the arguments are its state. It keeps its arrays alive.
    """

    def __init__(self, kernel: Kernel, items: _Size, group: _Size | None, arguments: tuple) -> None:
        self._kernel = kernel
        self._size, self._group = kernel.shape(items, group)
        self._handle = kernel.take()
        self._arguments = dict(enumerate(arguments))
        for index, argument in self._arguments.items():
            self.set(index, argument)

    def __call__(self) -> None:
        """Queue the launch; returns at once."""
        if 0 not in self._size:
            self._kernel.device.launch(self._kernel.name, self._handle, self._size, self._group)

    def set(self, index: int, value: Any) -> None:
        """Change argument `index` for the launches that follow."""
        self._kernel.set(self._handle, index, value)
        self._arguments[index] = value

    def resize(self, items: _Size) -> None:
        """Change the number of work-items for the launches that follow; the work-group stays."""
        self._size, _ = self._kernel.shape(items, self._group)

    def __del__(self) -> None:
        if hasattr(self, "_handle"):
            self._kernel.idle.append(self._handle)


def _packer(device: Device, handle: Any, index: int) -> Callable[[Any], bytes] | None:
    """How a Python number becomes argument `index`; None of buffers and local memory."""
    info = device.cl.kernel_arg_info
    if handle.get_arg_info(index, info.ADDRESS_QUALIFIER) != _PRIVATE:
        return None
    return _PACKERS[handle.get_arg_info(index, info.TYPE_NAME).replace("unsigned ", "u")]


def _pack_real(value: float) -> bytes:
    try:
        return _REAL(value)
    except OverflowError:  # as in a kernel: beyond float32 is infinite
        return _REAL(math.copysign(math.inf, value))


_PRIVATE = 0x119E  # CL_KERNEL_ARG_ADDRESS_PRIVATE: numbers
_REAL = struct.Struct("f").pack
_PACKERS: dict[str, Callable[[Any], bytes]] = {
    "real": _pack_real,
    "float": _pack_real,
    "int": struct.Struct("i").pack,
    "uint": struct.Struct("I").pack,
    "ulong": struct.Struct("Q").pack,
}
