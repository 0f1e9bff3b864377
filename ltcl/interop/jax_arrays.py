# SPDX-License-Identifier: BSD-3-Clause
"""JAX's arrays, with derivatives, `jit` and `vmap`: calls that JAX traces become callbacks.

A traced call has no numbers yet. Its result is then the array that depends on them alone, for
`compensate` and `solve` in a `TracedResult`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ltcl.errors import InputTypeError
from ltcl.interop.arrays import Kind
from ltcl.interop.calls import Call
from ltcl.interop.linear_map import Derivative, PiecewiseDerivative, leading, stacked


class JAXKind(Kind):
    """`jax.Array`, and the tracers that stand for one."""

    untracked_advice = "JAX traces it: make this call outside of jit, grad and vmap"

    def read(self, value: Any) -> np.ndarray:
        """The memory of an array on the CPU, else a copy; other floating types as 32 bits."""
        array = np.asarray(value)
        if jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.kind != "f":
            return array.astype(np.float32)
        return array

    def give(self, array: np.ndarray, like: Any) -> Any:
        """An array on the device of `like`; of a tracer, on the one that JAX chooses."""
        values = array
        if jnp.issubdtype(like.dtype, jnp.floating) and array.dtype.kind == "f":
            values = array.astype(like.dtype, copy=False)
        if isinstance(like, Tracer):
            return jnp.asarray(values)
        return jax.device_put(values, next(iter(like.devices())))

    def is_tracked(self, value: Any) -> bool:
        """True for a tracer, which has no numbers."""
        return isinstance(value, Tracer)

    def differentiate(self, call: Call) -> Any:
        """The array that depends on the traced one, as a callback."""
        tracer = next(value for value in call.arrays.values() if self.is_tracked(value))
        derivative = call.derivative(self, tracer)
        if isinstance(derivative, PiecewiseDerivative):
            result = _piecewise(derivative, derivative.source)
        else:
            result = _linear(derivative, True, None, derivative.source)
        name = derivative.result_name
        return TracedResult(name, result) if name else result


class TracedResult:
    """The result of a call that JAX traces: only the array that the call is named after."""

    def __init__(self, name: str, value: Any) -> None:
        self._name = name
        setattr(self, name, value)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise InputTypeError(
            f"{name} has no numbers while JAX traces the call; only {self._name} is there"
        )

    def __repr__(self) -> str:
        return f"<ltcl result traced by JAX: {self._name}>"


def _floating(x: Any) -> Any:
    """The type of results of x: its own, or that of 32 bits for whole numbers."""
    return x.dtype if jnp.issubdtype(x.dtype, jnp.floating) else jnp.float32


def _callback(function: Any, shapes: Any, *arrays: Any) -> Any:
    """A function of NumPy arrays, all of which have the axes that `vmap` adds in front."""
    return jax.pure_callback(function, shapes, *arrays, vmap_method="broadcast_all")


def _linear(derivative: Derivative, is_forward: bool, state: Any, x: Any) -> Any:
    """The linear map of x in a state, or its adjoint."""
    out_shape = derivative.out_shape if is_forward else derivative.shape
    struct = jax.ShapeDtypeStruct(out_shape, _floating(x))

    def numbers(state: Any, x: Any) -> np.ndarray:
        x = KIND.read(x)
        state = None if state is None else stacked(KIND.read(state), derivative.out_shape)
        linear_map = derivative.linear_map(state)
        result = linear_map(x) if is_forward else linear_map.T(x)
        return result.astype(struct.dtype)

    @jax.custom_vjp
    def apply(state: Any, x: Any) -> Any:
        return _callback(numbers, struct, state, x)

    def forward(state: Any, x: Any) -> Any:
        return apply(state, x), state

    def backward(state: Any, gradient: Any) -> Any:
        no_gradient = None if state is None else jnp.zeros_like(state)
        return no_gradient, _linear(derivative, not is_forward, state, gradient)

    apply.defvjp(forward, backward)
    return apply(state, x)


def _piecewise(derivative: PiecewiseDerivative, x: Any) -> Any:
    """The result of a piecewise linear call, whose state the derivative needs."""
    value = jax.ShapeDtypeStruct(derivative.out_shape, _floating(x))
    # A number for each pixel: JAX has no derivatives of truth values to pass by.
    state = jax.ShapeDtypeStruct(derivative.out_shape, jnp.float32)

    def numbers(x: Any) -> tuple[np.ndarray, np.ndarray]:
        x = KIND.read(x)
        axes = (*leading(x, derivative.shape), *derivative.out_shape)
        values, states = derivative.run(stacked(x, derivative.shape))
        return (
            values.reshape(axes).astype(value.dtype),
            states.reshape(axes).astype(np.float32),
        )

    @jax.custom_vjp
    def apply(x: Any) -> Any:
        return _callback(numbers, (value, state), x)[0]

    def forward(x: Any) -> Any:
        return _callback(numbers, (value, state), x)

    def backward(state: Any, gradient: Any) -> Any:
        return (_linear(derivative, False, state, gradient),)

    apply.defvjp(forward, backward)
    return apply(x)


def is_array(cls: type) -> bool:
    """True for the class of arrays, and for tracers."""
    return issubclass(cls, (jax.Array, Tracer))


KIND = JAXKind()
