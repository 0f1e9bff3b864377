# SPDX-License-Identifier: BSD-3-Clause
"""CuPy's arrays, which go through the host: OpenCL drivers do not share memory with CUDA's."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from ltcl.interop.arrays import Kind
from ltcl.interop.host import say_once


class CuPyKind(Kind):
    """`cupy.ndarray`."""

    def read(self, value: Any) -> np.ndarray:
        """A copy on the host."""
        say_once("CuPy arrays")
        return value.get()

    def give(self, array: np.ndarray, like: Any) -> Any:
        """A copy on the device of `like`."""
        with like.device:
            return _cupy().asarray(self.in_type_of(array, like))


def _cupy() -> Any:
    """The package, which whoever gave one of its arrays has imported."""
    return sys.modules["cupy"]


def is_array(cls: type) -> bool:
    """True for the class of arrays, and those that derive from it."""
    return issubclass(cls, _cupy().ndarray)


KIND = CuPyKind()
