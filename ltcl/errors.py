# SPDX-License-Identifier: BSD-3-Clause
"""Every problem ltcl raises, as one small family.

A message is one line: the argument, what it was, what it must be. Each is a builtin exception, too.
"""

from __future__ import annotations

import math
from typing import Any


class LtclError(Exception):
    """Base of every exception that ltcl raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (
            type(self),
            self.args,
            self.__dict__,
        )  # else Dask makes a FileError by `ValueError.__new__`


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


class ClusterError(LtclError, RuntimeError):
    """A cluster does not answer, was lost, or has no worker that can take part."""


class BatchError(LtclError, RuntimeError):
    """Some of many scenes failed. `results` has all, in order, with errors in their places."""

    def __init__(self, message: str, results: Any = ()) -> None:
        super().__init__(message)
        self.results = list(results)


class AcquisitionError(LtclError, RuntimeError):
    """A photograph is missing, stale or unusable, or the rig failed; the message says which and why."""


class ScanRefused(AcquisitionError):
    """Photographs that are in a store already cannot be used: what goes on with it would end as it did."""


class PhotographMissing(AcquisitionError):
    """A person has yet to take the photograph `shot` of the shooting list; `missing` are not there yet."""

    def __init__(self, message: str, number: int = 0, shot: Any = None, missing: int = 1) -> None:
        super().__init__(message)
        self.number, self.shot, self.missing = number, shot, missing


class ConvergenceError(LtclError, ArithmeticError):
    """A solve did not reach its tolerance. `solution`, as the function returns it, holds the best iterate."""

    def __init__(self, message: str, solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution
