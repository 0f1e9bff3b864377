# SPDX-License-Identifier: BSD-3-Clause
"""Every problem ltcl raises, as one small family.

A message is one line: the argument, what it was, what it must be. Each is also the builtin exception that a
Python user expects, and what is beside the message has a default, so that `pickle` needs the message alone.
"""

from __future__ import annotations

import math
from typing import Any


class LtclError(Exception):
    """Base of every exception that ltcl raises on purpose."""


class InputError(LtclError, ValueError):
    """An argument has an unusable value: shape, range, NaN, structure."""


class InputTypeError(LtclError, TypeError):
    """An argument is of an unusable type, or an unknown option was given."""


class ToleranceError(InputError):
    """A tolerance is below what float32 keeps; `least` is about what it does, infinite where not known."""

    def __init__(self, message: str, least: float = math.inf) -> None:
        super().__init__(message)
        self.least = least


class FileError(InputError, OSError):
    """A file is missing, truncated, lies about its size, or has an unknown format."""


class MemoryLimitError(LtclError, MemoryError):
    """Something would not fit in the memory of the host or of the device; said before allocation."""


class DeviceError(LtclError, RuntimeError):
    """An OpenCL device is missing, or failed; the message says what to do."""


class AcquisitionError(LtclError, RuntimeError):
    """A photograph is missing, stale or unusable, or the rig failed; the message says which and why."""


class ScanRefused(AcquisitionError):
    """Photographs that are in a store already cannot be used: what goes on with it would end as it did."""


class PhotographMissing(AcquisitionError):
    """A photograph has yet to be taken by a person; `number` is its place in the shooting list."""

    def __init__(self, message: str, number: int = 0) -> None:
        super().__init__(message)
        self.number = number


class ConvergenceError(LtclError, ArithmeticError):
    """A solve did not reach its tolerance. `solution`, as the function returns it, holds the best iterate."""

    def __init__(self, message: str, solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution
