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
        # Without this, unpickling makes a FileError by `ValueError.__new__`, which loses its type.
        return type(self), self.args, self.__dict__


class InputError(LtclError, ValueError):
    """An argument has an unusable value: shape, range, NaN, structure."""


class InputTypeError(LtclError, TypeError):
    """An argument is of an unusable type, or an unknown option was given."""


class ToleranceError(InputError):
    """A tolerance is below what float32 resolves.

    `least` is about the smallest tolerance that it does resolve, infinite where unknown.
    """

    def __init__(self, message: str, least: float = math.inf) -> None:
        super().__init__(message)
        self.least = least


class FileError(InputError, OSError):
    """A file is missing, truncated, lies about its size, or has an unknown format."""


class MemoryLimitError(LtclError, MemoryError):
    """Something would not fit in the memory of host or device; raised before allocation."""


class DeviceError(LtclError, RuntimeError):
    """An OpenCL device is missing, or failed; the message says what to do."""


class ClusterError(LtclError, RuntimeError):
    """A cluster does not answer, was lost, or has no worker that can take part."""


class BatchError(LtclError, RuntimeError):
    """Scenes failed; `results` has all results in order, with the errors of those that failed."""

    def __init__(self, message: str, results: Any = ()) -> None:
        super().__init__(message)
        self.results = list(results)


class AcquisitionError(LtclError, RuntimeError):
    """A photograph is missing, stale or unusable, or the rig failed."""


class ScanRefused(AcquisitionError):
    """Photographs in a store cannot be used; a scan that goes on would fail again."""


class PhotographMissing(AcquisitionError):
    """A person has yet to take a photograph of the shooting list.

    `number` and `shot` are that photograph's; `missing` counts the photographs that are not there.
    """

    def __init__(self, message: str, number: int = 0, shot: Any = None, missing: int = 1) -> None:
        super().__init__(message)
        self.number = number
        self.shot = shot
        self.missing = missing


class ConvergenceError(LtclError, ArithmeticError):
    """A solve did not reach its tolerance; `solution` holds the best iterate."""

    def __init__(self, message: str, solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution
