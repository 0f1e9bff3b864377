# SPDX-License-Identifier: BSD-3-Clause
"""The kinds of arrays that are not NumPy's, found by the type of a value.

A kind reads its arrays as NumPy's, and gives NumPy's back as its own. Floating numbers come back in
the type of the array that was given, as 64 bits in, 64 bits out; others in the type that ltcl gave.
"""

from __future__ import annotations

import abc
import functools
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ltcl.interop.calls import Call

# The module of the kinds of a package, by the package in which a type is defined.
_MODULES = {
    "torch": "torch_tensors",
    "jax": "jax_arrays",
    "jaxlib": "jax_arrays",
    "cupy": "cupy_arrays",
    "dask": "dask_arrays",
    "xarray": "labelled_arrays",
}


class Kind(abc.ABC):
    """A kind of arrays. It has no state: all is said by the array that was given."""

    # What to do with a tracked array where there is no derivative.
    untracked_advice = "give its numbers alone, as by .detach()"

    @abc.abstractmethod
    def read(self, value: Any) -> np.ndarray:
        """The values on the host, where they are if NumPy can see them there.

        TypeError, RuntimeError or BufferError where NumPy cannot read them.
        """

    @abc.abstractmethod
    def give(self, array: np.ndarray, like: Any) -> Any:
        """A NumPy array as an array of this kind, where `like` is."""

    def in_type_of(self, array: np.ndarray, like: Any) -> np.ndarray:
        """Floating numbers in the type of `like`, if that is one of them; others as they are."""
        dtype = self.floating_type(like)
        if dtype is None or array.dtype.kind != "f":
            return array
        with np.errstate(over="ignore"):
            return array.astype(dtype, copy=False)

    def floating_type(self, value: Any) -> np.dtype | None:
        """The floating type of NumPy that `value` holds; None for all other types."""
        dtype = np.dtype(value.dtype)
        return dtype if dtype.kind == "f" else None

    def is_tracked(self, value: Any) -> bool:
        """True if a derivative is asked for, or if the values are not known yet."""
        return False

    def unreadable_advice(self, value: Any) -> str:
        """Advise on an array that `read` cannot read."""
        return "give it as a NumPy array"

    def untracked(self, value: Any) -> Any:
        """The same values, of which no derivative is asked for."""
        return value

    def differentiate(self, call: Call) -> Any:
        """The result of a call with its derivative."""
        raise TypeError("this kind of array has no derivatives")


class DLPackKind(Kind):
    """An array that DLPack hands over, back by the package's `from_dlpack` or the type itself."""

    def read(self, value: Any) -> np.ndarray:
        """The values where they are; those of another device are copied to the host."""
        device, _ = value.__dlpack_device__()
        if device != _CPU:
            return np.from_dlpack(value, device="cpu")
        try:
            return np.from_dlpack(value)
        except (BufferError, RuntimeError, TypeError):
            # Read-only arrays, and those that track a derivative, are not exported by all.
            return np.asarray(value)

    def give(self, array: np.ndarray, like: Any) -> Any:
        """The array of the same package; NumPy's where that makes none of it."""
        package = importlib.import_module(_package(type(like)))
        make = getattr(package, "from_dlpack", type(like))
        try:
            return make(array)
        except TypeError:
            return array

    def floating_type(self, value: Any) -> np.dtype | None:
        """Unknown: packages name their types as they like."""
        return None


class ArrayAPIKind(DLPackKind):
    """An array of the Python array API standard, by its own namespace."""

    def give(self, array: np.ndarray, like: Any) -> Any:
        """The array of the same namespace, on the device of `like`."""
        namespace = like.__array_namespace__()
        return namespace.asarray(self.in_type_of(array, like), device=like.device)

    def floating_type(self, value: Any) -> np.dtype | None:
        """The floating type of the same name."""
        namespace = value.__array_namespace__()
        for name in ("float32", "float64"):
            if value.dtype == getattr(namespace, name):
                return np.dtype(name)
        return None


_CPU = 1  # kDLCPU
_DLPACK = DLPackKind()
_ARRAY_API = ArrayAPIKind()


# A hit of the cache costs as much as a look into a dictionary.
@functools.cache
def kind_of(cls: type) -> Kind | None:
    """The kind of arrays of a type; None for NumPy's, and for all that is no array."""
    if issubclass(cls, (np.ndarray, np.generic)):
        return None
    for base in cls.__mro__:
        name = _MODULES.get(_package(base))
        if name is not None:
            module = importlib.import_module(f"ltcl.interop.{name}")
            if module.is_array(cls):
                return module.KIND
    if hasattr(cls, "__array_namespace__"):
        return _ARRAY_API
    return _DLPACK if hasattr(cls, "__dlpack__") else None


def _package(cls: type) -> str:
    return cls.__module__.partition(".")[0]


def read(value: Any) -> np.ndarray:
    """The values of any array as NumPy's; the errors are those of `Kind.read` and of NumPy."""
    kind = kind_of(type(value))
    if kind is None:
        return np.asarray(value)
    return kind.read(value)


def numbers(value: Any) -> np.ndarray:
    """The values of any array, of which no derivative is asked for."""
    kind = kind_of(type(value))
    if kind is None:
        return np.asarray(value)
    return kind.read(kind.untracked(value))


def giver(like: Any) -> Callable[[np.ndarray], Any]:
    """A function that turns NumPy's arrays into the kind of `like`."""
    kind = kind_of(type(like))
    if kind is None:
        return np.asarray
    return functools.partial(kind.give, like=like)


def memory_of(value: Any) -> np.ndarray | None:
    """The memory of an array as NumPy's, to write to; None where NumPy sees but a copy."""
    if kind_of(type(value)) is None:
        return value if isinstance(value, np.ndarray) else None
    first, second = read(value), read(value)
    return first if np.shares_memory(first, second) else None
