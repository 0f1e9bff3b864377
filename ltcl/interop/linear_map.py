# SPDX-License-Identifier: BSD-3-Clause
"""A linear map with its adjoint, and the derivative of a call, which is one.

The derivative of a linear map is the map itself: of y = A x, dL/dx = A^T dL/dy. Its own derivative
in dL/dy is A again, and so on to any order.
"""

from __future__ import annotations

import abc
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

# Stacks of arrays, (k, *shape) -> (k, *other shape).
Function = Callable[[np.ndarray], np.ndarray]

# Frameworks may call from several threads, kernels keep their arguments until they are launched.
_LOCK = threading.RLock()


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearMap:
    """A linear map of arrays of one shape to arrays of another, with its adjoint.

    Attributes
    ----------
    shape, out_shape : tuple of int
        Shapes of an operand and of a result.
    forward, adjoint : callable
        (k, *shape) -> (k, *out_shape), and back: k arrays at once.
    """

    shape: tuple[int, ...]
    out_shape: tuple[int, ...]
    forward: Function
    adjoint: Function

    @property
    def T(self) -> LinearMap:
        """The adjoint map."""
        return LinearMap(
            shape=self.out_shape,
            out_shape=self.shape,
            forward=self.adjoint,
            adjoint=self.forward,
        )

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The results of arrays (..., *shape), (..., *out_shape)."""
        with _LOCK:
            result = self.forward(stacked(x, self.shape))
        return result.reshape(*leading(x, self.shape), *self.out_shape)


def leading(x: np.ndarray, shape: tuple[int, ...]) -> tuple[int, ...]:
    """The lengths of the axes of x before those of `shape`."""
    return x.shape[: x.ndim - len(shape)]


def stacked(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """x as (k, *shape)."""
    return x.reshape(math.prod(leading(x, shape)), *shape)


class Derivative(abc.ABC):
    """The derivative of a linear call in one array, the source.

    Attributes
    ----------
    source : array of the caller's kind
        The array that the result depends on, of the shape of the operands of the map.
    result_name : str
        The attribute of the result that depends on it; empty where the result is the array.
    out_shape : tuple of int
        The shape of that array.
    """

    result_name: str = ""
    source: Any
    out_shape: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the source."""
        return tuple(self.source.shape)

    @abc.abstractmethod
    def linear_map(self, state: np.ndarray | None) -> LinearMap:
        """The call itself as a linear map; that of a piecewise linear call in a state."""

    def state_of(self, result: Any) -> np.ndarray | None:
        """The state in which a call has ended; None, as a linear call has no state."""
        return None


class PiecewiseDerivative(Derivative):
    """The derivative of a piecewise linear call, which is linear as long as its state stays."""

    @abc.abstractmethod
    def state_of(self, result: Any) -> np.ndarray:
        """The state in which a call has ended, a picture like its result."""

    @abc.abstractmethod
    def run(self, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Results and states of a stack of sources."""
