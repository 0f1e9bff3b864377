# SPDX-License-Identifier: BSD-3-Clause
"""A public call with arrays of another library: NumPy's in their place, results as their kind.

The first of them decides on the kind of the results.
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.errors import InputTypeError
from ltcl.interop.arrays import Kind, kind_of
from ltcl.interop.linear_map import Derivative

# A NumPy array as an array of the caller's kind.
Give = Callable[[np.ndarray], Any]


@dataclass(frozen=True)
class Differentiable:
    """The arguments of a call that have a derivative, and how all of them make it."""

    names: tuple[str, ...]
    derivative: Callable[..., Derivative]


@dataclass(frozen=True, kw_only=True, eq=False)
class Call:
    """A call of `function` with some arrays of other libraries.

    Attributes
    ----------
    arguments : inspect.BoundArguments
    arrays : dict
        Those arrays by the names of the arguments.
    read : callable(name, value)
        An array as NumPy's; what cannot be read is refused by name.
    differentiable : Differentiable, optional
    """

    function: Callable[..., Any]
    arguments: inspect.BoundArguments
    arrays: dict[str, Any]
    read: Callable[[str, Any], np.ndarray]
    differentiable: Differentiable | None

    @property
    def like(self) -> Any:
        """The array that results are like."""
        return next(iter(self.arrays.values()))

    @property
    def kind(self) -> Kind:
        """The kind of that array."""
        return existing_kind(self.like)

    def run(self) -> Any:
        """The result, in the caller's kind."""
        tracked = [name for name, value in self.arrays.items() if is_tracked(value)]
        if not tracked:
            return give_result(self.run_numpy(), self.give)
        names = () if self.differentiable is None else self.differentiable.names
        for name in tracked:
            if name not in names:
                raise without_derivative(name, self.arrays[name])
        return existing_kind(self.arrays[tracked[0]]).differentiate(self)

    def run_numpy(self) -> Any:
        """The result of NumPy's arrays."""
        values = {}
        for name, value in self.arrays.items():
            values[name] = self.read(name, existing_kind(value).untracked(value))
        arguments = copy.copy(self.arguments)
        arguments.arguments = {**arguments.arguments, **values}
        return self.function(*arguments.args, **arguments.kwargs)

    def give(self, array: np.ndarray) -> Any:
        """An array as the caller's kind."""
        return self.kind.give(array, self.like)

    def derivative(self, kind: Kind, like: Any) -> Derivative:
        """The derivative, of arrays of one kind."""
        assert self.differentiable is not None  # noqa: S101 - some argument has a derivative
        values = dict(self._values())
        for name in self.differentiable.names:
            value = values[name]
            if kind_of(type(value)) is not kind and value is not None:
                array = self.read(name, value)
                if array.ndim:
                    values[name] = kind.give(array, like)
        return self.differentiable.derivative(**values)

    def _values(self) -> dict[str, Any]:
        """All arguments by name, with defaults."""
        arguments = copy.copy(self.arguments)
        arguments.apply_defaults()
        values: dict[str, Any] = {}
        for name, value in arguments.arguments.items():
            kind = arguments.signature.parameters[name].kind
            values |= value if kind is inspect.Parameter.VAR_KEYWORD else {name: value}
        return values


def existing_kind(value: Any) -> Kind:
    """The kind of an array that is known to have one."""
    kind = kind_of(type(value))
    assert kind is not None  # noqa: S101 - it was asked for before
    return kind


def is_tracked(value: Any) -> bool:
    """True for an array whose derivative is asked for."""
    return existing_kind(value).is_tracked(value)


def without_derivative(name: str, value: Any) -> InputTypeError:
    """The error of a tracked array as an argument that has no derivative."""
    return InputTypeError(
        f"{name} is a {type(value).__name__} whose derivative is asked for, but there is none "
        f"here; {existing_kind(value).untracked_advice}"
    )


def give_result(result: Any, give: Give) -> Any:
    """A result in the caller's kind: an array, or an object that knows which of its arrays are."""
    if isinstance(result, np.ndarray):
        return give(result)
    return result.with_arrays(give)


def replaced(result: Any, name: str, value: Any) -> Any:
    """A result with another value of an attribute; the value where the result is an array."""
    if not name:
        return value
    return dataclasses.replace(result, **{name: value})
