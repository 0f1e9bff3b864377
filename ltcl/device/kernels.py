# SPDX-License-Identifier: BSD-3-Clause
"""One way to run a kernel: find the source, build it once per device and defines, launch it.

Includes are expanded here, with `#line` marks: messages of every driver point at the file a person
edits.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
import os
import re
import struct
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ltcl.errors import DeviceError, InputTypeError, LtclError, MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.device import Device

# Exact float32: no fast-math (it deletes NaN tests), contraction of a * b + c is left to the
# driver.
_OPTIONS = ["-cl-std=CL1.2", "-cl-kernel-arg-info", "-w"]
_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
_PRIVATE = 0x119E  # CL_KERNEL_ARG_ADDRESS_PRIVATE: numbers
_PACKERS: dict[
    str, Any
] = {  # a Python number as bytes; reals beyond float32 are infinite, as in a kernel
    "real": ctypes.c_float,
    "float": ctypes.c_float,
    "int": struct.Struct("i").pack,
    "uint": struct.Struct("I").pack,
    "ulong": struct.Struct("Q").pack,
}
_Size = int | tuple[int, ...]
_MEMORY = {
    "MEM_OBJECT_ALLOCATION_FAILURE",
    "OUT_OF_RESOURCES",
    "OUT_OF_HOST_MEMORY",
    "INVALID_BUFFER_SIZE",
}
_ADVICE = {
    "DEVICE_NOT_AVAILABLE": "the device is in use by another process or was unplugged; try LTCL_DEVICE=cpu",
    "COMPILER_NOT_AVAILABLE": "this driver cannot compile kernels; choose another device (ltcl devices)",
}
_process: dict[str, int] = {}  # the first one that asked OpenCL


def folder() -> Path:
    """The folder of `.cl` files: `ltcl/kernels` where installed, `kernels/` beside `ltcl/` in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for place in (package / "kernels", package.parent / "kernels"):
        if (place / "common" / "real.h").is_file():
            return place
    raise DeviceError(f"the OpenCL kernels of ltcl are missing beside {package}; reinstall ltcl")


@functools.cache
def load(name: str) -> str:
    """The text of `kernels/<name>.cl` with its includes, ready for the compiler."""
    return _expand(f"{name}.cl", folder(), set())


def _expand(relative: str, root: Path, seen: set[str]) -> str:
    seen.add(relative)
    lines = [f'#line 1 "{relative}"']
    for number, line in enumerate((root / relative).read_text(encoding="utf-8").splitlines(), 1):
        include = _INCLUDE.match(line)
        if include and include[1] not in seen:
            lines.append(_expand(include[1], root, seen))
        lines.append(f'#line {number + 1} "{relative}"' if include else line)
    return "\n".join(lines)


def build(device: Device, file: str, defines: dict[str, Any]) -> Any:
    """`kernels/<file>.cl` as a pyopencl program for `device`; DeviceError with the compiler's own words."""
    options = _OPTIONS + [f"-D{name}={value}" for name, value in sorted(defines.items())]
    # Intel's compiler reports every success.
    with warnings.catch_warnings(action="ignore", category=device.cl.CompilerWarning):
        try:
            return device.cl.Program(device.context, load(file)).build(options)
        except device.cl.Error as error:
            log_text = str(error).split("(options:")[0].strip()  # pyopencl adds options and source
            where = f"{device.name} ({device.driver}) with {' '.join(options)}"
            raise DeviceError(
                f"kernels/{file}.cl does not compile on {where}:\n{log_text}"
            ) from error


class Parameter(NamedTuple):
    """One argument of a kernel, as the compiler reports it."""

    index: int
    # The bytes of a Python number; None for buffers and local memory.
    pack: Callable[[Any], Any] | None


class Kernel:
    """A compiled kernel of one device, launched with its arguments by their names in the source.

    Values are Python numbers, `Array`s, or local memory. Work-items are rounded up to whole
    work-groups, whose size is clamped to what kernel and device allow (`group`).

    >>> import ltcl
    >>> device = ltcl.open_device("cpu")
    >>> out = device.empty(1000)
    >>> kernel = device.kernel("vector", "vector_fill")
    >>> kernel(1000, 64, count=1000, value=2.0, out=out)  # queue it once
    >>> launch = kernel.bind(1000, 64, count=1000, value=3.0, out=out)
    >>> launch()  # queue it, again and again
    >>> launch.set(value=4.0)
    >>> launch()
    >>> out.get()[:3].tolist()
    [4.0, 4.0, 4.0]
    """

    def __init__(self, device: Device, program: Any, name: str) -> None:
        self.device = device
        self.name = name
        self._program = program
        # cl_kernels of launches that are gone: making one costs 0.1 ms.
        self.idle: list[Any] = []
        self._groups: dict[tuple[int, ...], tuple[int, ...]] = {}
        self._item_limits: list[int] = device.handle.max_work_item_sizes
        handle = self.take()
        with translated(f"asking for {name} on {device.name}"):
            work_group = device.cl.kernel_work_group_info.WORK_GROUP_SIZE
            allowed = handle.get_work_group_info(work_group, device.handle)
            self._max_group: int = min(allowed, device.max_group)
            self.parameters = _parameters(device.cl.kernel_arg_info, handle)
        self.idle.append(handle)

    def __call__(self, items: _Size, group: _Size, /, *positional: Any, **named: Any) -> None:
        """Queue a launch over `items` rounded up to whole groups; returns at once."""
        Launch(self, items, group, self._by_name(positional, named))()

    def bind(self, items: _Size, group: _Size, /, *positional: Any, **named: Any) -> Launch:
        """The launch that calling the kernel would queue, to be queued again and again."""
        return Launch(self, items, group, self._by_name(positional, named))

    def group(self, size: Any) -> Any:
        """The work-group of a launch that asks for `size`: halved until kernel and device allow it."""
        if isinstance(size, int):
            return self.group((size,))[0]
        if size not in self._groups:
            sizes = list(map(min, size, self._item_limits))
            while math.prod(sizes) > self._max_group:
                sizes[sizes.index(max(sizes))] //= 2
            self._groups[size] = tuple(sizes)
        return self._groups[size]

    def take(self) -> Any:
        """A cl_kernel for one user, who puts it back into `idle`."""
        with contextlib.suppress(IndexError):
            return self.idle.pop()
        with translated(f"no kernel {self.name} for {self.device.name}"):
            return self.device.cl.Kernel(self._program, self.name)

    def check_names(self, names: Iterable[str]) -> None:
        """Refuse names that the kernel does not have, and a launch that lacks some."""
        names = set(names)
        unknown = sorted(names - self.parameters.keys())
        if unknown:
            raise self._unknown(unknown[0])
        missing = [name for name in self.parameters if name not in names]
        if missing:
            raise InputTypeError(f"kernel {self.name} needs argument {', '.join(missing)}")

    def argument_error(self, name: str, value: Any, error: Exception) -> Exception:
        """The error of ltcl for `error`, raised while an argument was set."""
        if isinstance(error, self.device.cl.Error):
            return explain(f"argument {name} of {self.name}", error)
        if name not in self.parameters:
            return self._unknown(name)
        return InputTypeError(
            f"argument {name} of kernel {self.name} is {value!r}; it must be a number of its type"
        )

    def _unknown(self, name: str) -> InputTypeError:
        known = ", ".join(self.parameters)
        return InputTypeError(f"kernel {self.name} has no argument {name}; it has {known}")

    def _by_name(self, positional: tuple, named: dict[str, Any]) -> dict[str, Any]:
        """All arguments by name, those without a name in the order of the source."""
        if not positional:
            return named
        if len(positional) > len(self.parameters):
            raise InputTypeError(
                f"kernel {self.name} got {len(positional)} arguments; "
                f"it has {len(self.parameters)}: {', '.join(self.parameters)}"
            )
        values = dict(zip(self.parameters, positional, strict=False))
        doubled = values.keys() & named.keys()
        if doubled:
            raise InputTypeError(f"kernel {self.name} got argument {min(doubled)} twice")
        return values | named


def _parameters(info: Any, handle: Any) -> dict[str, Parameter]:
    """The arguments of a cl_kernel by name, in the order of the source."""
    parameters = {}
    for index in range(handle.num_args):
        name = handle.get_arg_info(index, info.NAME)
        pack = None
        if handle.get_arg_info(index, info.ADDRESS_QUALIFIER) == _PRIVATE:
            type_name = handle.get_arg_info(index, info.TYPE_NAME)
            pack = _PACKERS[type_name.replace("unsigned ", "u")]
        parameters[name] = Parameter(index, pack)
    return parameters


class Launch:
    """A kernel with its items and arguments, which it keeps alive: to be queued by one thread at a time."""

    def __init__(self, kernel: Kernel, items: _Size, group: _Size, values: dict[str, Any]) -> None:
        self._kernel = kernel
        self._group = kernel.group(group if isinstance(group, tuple) else (group,))
        self.resize(items)
        if len(values) != len(kernel.parameters):
            kernel.check_names(values)
        self._handle = kernel.take()
        self._parameters = kernel.parameters
        # Buffers live as long as the launch: OpenCL does not keep them.
        self._kept: dict[str, Any] = {}
        self.set(**values)

    def __call__(self) -> None:
        """Queue the launch; returns at once."""
        if 0 not in self._size:
            self._kernel.device.launch(self._kernel.name, self._handle, self._size, self._group)

    def set(self, *indexed: Any, **values: Any) -> None:
        """Change arguments, by name, for the launches that follow: ``launch.set(keep=0.5)``."""
        if indexed:
            index, value = indexed
            values = {list(self._kernel.parameters)[index]: value}
        parameters = self._parameters
        handle = self._handle
        name = ""
        try:
            for name, value in values.items():
                index, pack = parameters[name]
                if pack is None:
                    handle.set_arg(index, getattr(value, "buffer", value))
                    self._kept[name] = value
                else:
                    # `set_arg` would do as well, but tries all else before bytes: 6 us, not 0.1.
                    handle._set_arg_buf(index, pack(value))
        except Exception as error:
            raise self._kernel.argument_error(name, values[name], error) from error

    def resize(self, items: _Size) -> None:
        """Change the number of work-items, rounded up to whole groups, for the launches that follow."""
        size = items if isinstance(items, tuple) else (items,)
        self._size = tuple(-(-n // g) * g for n, g in zip(size, self._group, strict=True))

    def __del__(self) -> None:
        if hasattr(self, "_handle"):
            self._kernel.idle.append(self._handle)


def refuse_forked() -> None:
    """Raise in a process forked from one that had used OpenCL: drivers hang there."""
    if _process.setdefault("first", os.getpid()) != os.getpid():
        raise DeviceError(
            "this process was forked from one that had used OpenCL, whose drivers do not survive that; start "
            'workers by multiprocessing.get_context("spawn") or "forkserver", and open the device in each'
        )


@contextlib.contextmanager
def translated(doing: str) -> Iterator[None]:
    """Raise an ltcl error that names what was being done where pyopencl raises its own; not after a fork."""
    refuse_forked()
    import pyopencl as cl

    try:
        yield
    except cl.Error as error:
        raise explain(doing, error) from error


def explain(doing: str, error: Exception) -> LtclError:
    """The ltcl error for a pyopencl `error` raised while `doing` something."""
    import pyopencl as cl

    code = getattr(error, "code", None)
    status = (
        str(error).partition("\n")[0] if code is None else cl.status_code.to_string(code, f"{code}")
    )
    if status in _MEMORY:
        return MemoryLimitError(
            f"{doing}: the device ran out of memory ({status}); compress the matrix, free other buffers, "
            "or choose a device with more memory (ltcl devices)"
        )
    return DeviceError(
        f"{doing}: OpenCL answered {status}; {_ADVICE.get(status, 'see ltcl doctor')}"
    )
