# SPDX-License-Identifier: BSD-3-Clause
"""Kernels, launched with arguments by their names in the OpenCL source, which the compiler tells.

A `Kernel` is built once per device and defines. Calling it queues one launch; `bind` makes a
`Launch` that is queued again and again. In Python a launch takes about 6 us, a bound one below 1.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from ltcl.device.driver_errors import explain, translated
from ltcl.errors import InputTypeError

if TYPE_CHECKING:
    from ltcl.device.device import Device

# CL_KERNEL_ARG_ADDRESS_PRIVATE, the address space of numbers.
PRIVATE_ADDRESS = 0x119E
# A Python number as bytes, by its type in the source. Reals beyond float32 become infinite, as in
# a kernel.
PACKERS: dict[str, Callable[[Any], Any]] = {
    "real": ctypes.c_float,
    "float": ctypes.c_float,
    "int": struct.Struct("i").pack,
    "uint": struct.Struct("I").pack,
    "ulong": struct.Struct("Q").pack,
}
Size = int | tuple[int, ...]
# What queues something at each call: a `Launch`, or several in order.
Queued = Callable[[], object]


# An argument of a kernel, as the compiler reports it: its position, and how a Python number becomes
# bytes, None for buffers and local memory. A plain tuple, which Python unpacks fastest.
Parameter = tuple[int, Callable[[Any], Any] | None]


class Kernel:
    """A compiled kernel of one device, launched with its arguments by their names in the source.

    Values are Python numbers, `Array`s, or local memory. Work-items are rounded up to whole
    work-groups, whose size is clamped to what kernel and device allow (`group`). A name that is
    wrong or missing is an `InputTypeError`, at once; Python refuses one that is doubled.

    >>> import ltcl
    >>> device = ltcl.open_device("cpu")
    >>> out = device.empty(1000)
    >>> kernel = device.kernel("vector", "vector_fill")
    >>> event = kernel(1000, 64, count=1000, value=2.0, out=out)  # queue it once
    >>> launch = kernel.bind(1000, 64, count=1000, value=3.0, out=out)
    >>> event = launch()  # queue it, again and again
    >>> launch.set(value=4.0)
    >>> event = launch()
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
            work_group_size = device.cl.kernel_work_group_info.WORK_GROUP_SIZE
            kernel_limit = handle.get_work_group_info(work_group_size, device.handle)
            self._max_group: int = min(kernel_limit, device.max_group)
            multiple = device.cl.kernel_work_group_info.PREFERRED_WORK_GROUP_SIZE_MULTIPLE
            self.subgroup: int = handle.get_work_group_info(multiple, device.handle)
            self.parameters = _parameters(device.cl.kernel_arg_info, handle)
        self.idle.append(handle)

    def __call__(self, items: Size, group: Size, /, **arguments: Any) -> Any:
        """Queue a launch over `items`, rounded up to whole groups; returns its event at once."""
        return Launch(self, items, group, arguments)()

    def bind(self, items: Size, group: Size, /, **arguments: Any) -> Launch:
        """Make the launch that calling the kernel would queue, to be queued again and again."""
        return Launch(self, items, group, arguments)

    def group(self, size: Any) -> Any:
        """Work-group of a launch that asks for `size`: halved until kernel and device allow it."""
        if isinstance(size, int):
            return self.group((size,))[0]
        if size not in self._groups:
            sizes = list(map(min, size, self._item_limits))
            while math.prod(sizes) > self._max_group:
                sizes[sizes.index(max(sizes))] //= 2
            self._groups[size] = tuple(sizes)
        return self._groups[size]

    def take(self) -> Any:
        """Take a cl_kernel for one user, who puts it back into `idle`."""
        with contextlib.suppress(IndexError):
            return self.idle.pop()
        with translated(f"no kernel {self.name} for {self.device.name}"):
            return self.device.cl.Kernel(self._program, self.name)

    def check_names(self, names: Iterable[str]) -> None:
        """Refuse a launch with names that the kernel does not have, or without some that it has."""
        names = set(names)
        for name in sorted(names - self.parameters.keys()):
            raise self._unknown_name(name)
        missing = [name for name in self.parameters if name not in names]
        if missing:
            raise InputTypeError(f"kernel {self.name} needs argument {', '.join(missing)}")

    def argument_error(self, name: str, value: Any, error: Exception) -> Exception:
        """Error of ltcl for the `error` that was raised while an argument was set."""
        if isinstance(error, self.device.cl.Error):
            return explain(f"argument {name} of {self.name}", error)
        if name not in self.parameters:
            return self._unknown_name(name)
        return InputTypeError(
            f"argument {name} of kernel {self.name} is {value!r}; it must be a number of its type"
        )

    def _unknown_name(self, name: str) -> InputTypeError:
        known = ", ".join(self.parameters)
        return InputTypeError(f"kernel {self.name} has no argument {name}; it has {known}")


def in_order(launches: Sequence[Queued]) -> Queued:
    """Make a function that queues all of these, one after the other."""
    if len(launches) == 1:
        return launches[0]
    queue = tuple(launches)

    def queue_all() -> None:
        for launch in queue:
            launch()

    return queue_all


def _parameters(info: Any, handle: Any) -> dict[str, Parameter]:
    """Arguments of a cl_kernel by name, in the order of the source."""
    parameters = {}
    for index in range(handle.num_args):
        pack = None
        if handle.get_arg_info(index, info.ADDRESS_QUALIFIER) == PRIVATE_ADDRESS:
            type_name = handle.get_arg_info(index, info.TYPE_NAME)
            pack = PACKERS[type_name.replace("unsigned ", "u")]
        name = handle.get_arg_info(index, info.NAME)
        parameters[name] = index, pack
    return parameters


class Launch:
    """A kernel with its items and arguments, to be queued by one thread at a time.

    It keeps its buffers alive.
    """

    def __init__(self, kernel: Kernel, items: Size, group: Size, arguments: dict[str, Any]) -> None:
        self._kernel = kernel
        self._name = kernel.name
        self._device = kernel.device
        self._parameters = kernel.parameters
        self._group = kernel.group(group if isinstance(group, tuple) else (group,))
        self.resize(items)
        if len(arguments) != len(kernel.parameters):
            kernel.check_names(arguments)
        self._handle = kernel.take()
        # OpenCL does not keep what a kernel was given.
        self._buffers: dict[str, Any] = {}
        self.set(**arguments)

    def __call__(self) -> Any:
        """Queue the launch; returns its event at once, None if it has no work-items."""
        if self._has_items:
            return self._device.launch(self._name, self._handle, self._size, self._group)
        return None

    def set(self, /, **values: Any) -> None:
        """Change arguments, by name, for the launches that follow: ``launch.set(keep=0.5)``."""
        parameters = self._parameters
        name = ""
        try:
            for name, value in values.items():
                position, pack = parameters[name]
                if pack is None:
                    self._handle.set_arg(position, getattr(value, "buffer", value))
                    self._buffers[name] = value
                else:
                    # `set_arg` would do as well, but tries all else before bytes: 6 us, not 0.1.
                    self._handle._set_arg_buf(position, pack(value))
        except Exception as error:
            raise self._kernel.argument_error(name, values[name], error) from error

    def resize(self, items: Size) -> None:
        """Change the number of work-items, rounded up to whole groups, for launches to come."""
        size = items if isinstance(items, tuple) else (items,)
        self._size = tuple(-(-n // g) * g for n, g in zip(size, self._group, strict=True))
        self._has_items = 0 not in self._size

    @property
    def name(self) -> str:
        """Name of its kernel."""
        return self._name

    @property
    def shape(self) -> tuple[int, ...]:
        """Work-items in each dimension, in whole work-groups."""
        return self._size

    @property
    def items(self) -> int:
        """Number of work-items."""
        return math.prod(self._size)

    @property
    def groups(self) -> int:
        """Number of work-groups."""
        return self.items // math.prod(self._group)

    def __del__(self) -> None:
        if hasattr(self, "_handle"):
            self._kernel.idle.append(self._handle)
