# SPDX-License-Identifier: BSD-3-Clause
"""The derivative of a compensation's pattern in the light that the projector has to add.

With that light e = gain desired - background, the pattern p minimizes ||W (T p - e)|| within the
bounds. It is piecewise linear in e: while the same pixels are free, that is, not held at a bound,

    T_f^T W^2 (T p - e) = 0,    so that    dp_f = (T_f^T W^2 T_f)^-1 T_f^T W^2 de

with the columns T_f of free pixels, and the adjoint of it: dL/de = W^2 T_f q, where q solves
T_f^T W^2 T_f q = dL/dp_f. Where all pixels are free, T is square and dL/de = S^-T F^-1 dL/dp. Light
that was clamped instead is F^-1 S^-1 e at free pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ltcl.errors import InputError
from ltcl.interop.linear_map import LinearMap, PiecewiseDerivative, stacked
from ltcl.operators import Operator
from ltcl.solvers import solve_each
from ltcl.solvers.derivative import (
    METHODS_OF_TRANSPOSE,
    as_exact_transpose,
    method_of_transpose,
)
from ltcl.solvers.host_krylov import least_squares, normal_equations
from ltcl.tasks.compensation.inputs import RTOL, check_gain, check_weights
from ltcl.tasks.compensation.problem import (
    ChannelSystem,
    Columns,
    channel_systems,
    stack_channels,
)
from ltcl.tasks.compensation.result import Compensation
from ltcl.tasks.requirements import default_rtol
from ltcl.transport import frames as layout
from ltcl.transport.relighting import add_colours
from ltcl.transport.transport import Transport, check_transport

# Steps of the conjugate gradients on the free pixels.
MAXITER = 1000
# The relative residual that products in float32 reach for certain.
LEAST_RTOL = 1e-6
# Options of a solve that one of the transpose has, too.
OPTIONAL = ("maxiter", "throw")


class CompensationDerivative(PiecewiseDerivative):
    """The derivative of the pattern of `compensate`, whose arguments these are.

    Raises
    ------
    InputError
        gain="auto", and a T of several projectors: their derivatives are not known.
    """

    result_name = "pattern"

    def __init__(
        self, compensate: Callable[..., Compensation], T: Any, desired: Any, **arguments: Any
    ) -> None:
        self._T = check_transport(T, square=False)
        if T.scene is not T:
            raise InputError("T is of several projectors, whose patterns have no derivative here")
        gain = check_gain(arguments.pop("gain"), arguments["loss"])
        if gain is None:
            raise InputError(
                "gain is 'auto', which has no derivative; give the number that it finds for "
                "desired without one"
            )
        self._layout = layout.find_layout(
            "desired", tuple(desired.shape), T.camera_grid, T.channels
        )
        self.out_shape = self._layout.shape(T.grid)
        self.source = light_to_add(T, desired, gain, arguments.pop("background"))
        self._compensate = compensate
        self._arguments = arguments

    # The call itself, of a stack of sources.

    def run(self, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Patterns and their free pixels."""
        T = self._T
        frames = self._layout.stacked(len(sources))
        light = sources.reshape(frames.frame_count, *T.camera_grid, -1)
        if T.channels == 3:
            light = np.broadcast_to(light, (*light.shape[:3], 3))
        elif not self._layout.colour:
            light = light[..., 0]
        weights = self._weights_of(len(sources))
        result = self._compensate(T, light, **{**self._arguments, "weights": weights})
        shape = (len(sources), *self.out_shape)
        return result.pattern.reshape(shape), self.state_of(result).reshape(shape)

    def state_of(self, result: Any) -> np.ndarray:
        """The free pixels of a pattern."""
        return result.free_pixels()

    # Its derivative.

    def linear_map(self, state: np.ndarray | None) -> LinearMap:
        """The derivative where these pixels are free."""
        assert state is not None  # noqa: S101 - a compensation has a state
        free = stacked(state, self.out_shape) != 0
        return LinearMap(
            shape=self.shape,
            out_shape=self.out_shape,
            forward=lambda light: self._patterns(light, free),
            adjoint=lambda patterns: self._light(patterns, free),
        )

    def _patterns(self, light: np.ndarray, free: np.ndarray) -> np.ndarray:
        """The change of patterns by a change of the light to be added."""
        T = self._T
        frames = self._layout.stacked(len(light))
        sides = frames.columns(light, T.shape[0], T.channels)
        is_free = frames.columns(free, T.shape[1], T.channels)
        if self._is_undone(is_free):
            solutions = solve_each(T.systems, sides, **self._solve_arguments)
            undone = [solution.x for solution in solutions]
            changes = layout.to_light(undone, np.atleast_2d(T.first_bounce), T.mixing)
        else:
            changes = self._changes_of_free(sides, is_free, len(light))
        patterns = frames.pack(changes, T.grid)
        return patterns * free.reshape(patterns.shape)

    def _changes_of_free(self, sides: Columns, is_free: Columns, count: int) -> Columns:
        changes = []
        for system in self._free_systems(sides, is_free, count):
            x = least_squares(
                system.A,
                system.values,
                system.is_free,
                system.weights,
                rtol=max(self._rtol, LEAST_RTOL),
                maxiter=MAXITER,
            )
            changes.append(system.divided(x))
        return changes

    def _light(self, patterns: np.ndarray, free: np.ndarray) -> np.ndarray:
        """The adjoint of `_patterns`."""
        T = self._T
        frames = self._layout.stacked(len(patterns))
        columns = frames.columns(patterns * free, T.shape[1], T.channels)
        is_free = frames.columns(free, T.shape[1], T.channels)
        if self._is_undone(is_free):
            light = self._undo_transpose(columns)
        else:
            light = self._light_of_free(columns, is_free, len(patterns))
        return add_colours(frames.pack(light, T.camera_grid), len(patterns), self.shape)

    def _undo_transpose(self, columns: Columns) -> Columns:
        """S^-T F^-1 of each channel; where colours mix, their mixing is undone before."""
        T = self._T
        if T.mixing is not None:
            unmixing = np.linalg.inv(T.mixing)
            columns = list(np.einsum("ij,ink->jnk", unmixing, np.stack(columns)))
        sides = layout.to_light(columns, np.atleast_2d(T.first_bounce), None)
        options = self._solve_arguments
        exact = [S.T for S in options.pop("exact")]
        method, options = method_of_transpose(options.pop("method"), options)
        systems = [as_exact_transpose(S) for S in T.systems]
        solutions = solve_each(systems, sides, method, exact=exact, **options)
        return [solution.x for solution in solutions]

    def _light_of_free(self, columns: Columns, is_free: Columns, count: int) -> Columns:
        """W^2 T_f q of each system, where q solves the normal equations of its free pixels."""
        light = []
        for system in self._free_systems(columns, is_free, count):
            _, picture = normal_equations(
                system.A,
                system.divided(system.values),
                system.is_free,
                system.weights,
                rtol=max(self._rtol, LEAST_RTOL),
                maxiter=MAXITER,
            )
            light.append(system.weights**2 * picture)
        return light

    # What it is computed with.

    @cached_property
    def _reference(self) -> Transport:
        """The transport within whose pictures the pattern is the best."""
        exact = self._arguments["exact"]
        return self._T if exact is None else exact

    @cached_property
    def _systems(self) -> tuple[ChannelSystem, ...]:
        return channel_systems(self._reference)

    @cached_property
    def _rtol(self) -> float:
        rtol = self._arguments["rtol"]
        if rtol is None:
            exact = self._arguments["exact"]
            inverse = self._arguments["inverse"]
            rtol = default_rtol(RTOL, self._T, exact, inverse)
        return rtol

    @property
    def _solve_arguments(self) -> dict[str, Any]:
        """The arguments of a solve without bounds."""
        named = {name: value for name, value in self._arguments.items() if name in OPTIONAL}
        exact = self._arguments["exact"]
        systems = () if exact is None else exact.systems
        method = self._arguments["method"]
        if method not in METHODS_OF_TRANSPOSE:
            method = "auto"
        return {**named, "method": method, "rtol": self._rtol, "exact": systems}

    def _is_undone(self, is_free: Columns) -> bool:
        """True if the pattern is that without bounds, at the pixels that are free."""
        T = self._T
        if not T.is_square or self._arguments["clamp"]:
            return T.is_square
        weights = self._arguments["weights"]
        if weights is not None and T.masked.any():
            # Masked pixels may count.
            return False
        return all(np.all(f | T.masked[:, None]) for f in is_free)

    def _weights_of(self, count: int) -> Any:
        """The weights of `count` pictures."""
        weights = self._arguments["weights"]
        if weights is None or count == 1:
            return weights
        T = self._T
        shape = layout.find_layout("weights", np.shape(weights), T.camera_grid, T.channels)
        if shape.frame_count <= 1:
            return weights
        return np.concatenate([weights] * count)

    def _free_systems(self, values: Columns, is_free: Columns, count: int) -> Iterator[FreeSystem]:
        """The systems with their values, one (N, k) or (M, k) array each, and free pixels."""
        T = self._T
        frames = self._layout.stacked(count)
        width = values[0].shape[1]
        black = [np.broadcast_to(np.float32(0), (T.shape[0], width))] * T.channels
        weights, _ = check_weights(self._weights_of(count), T, frames, black)
        systems = self._systems
        number = len(systems)
        stacks = [stack_channels(values, number), stack_channels(is_free, number)]
        if weights is None:
            stacks.append([np.ones((1, 1))] * number)
        else:
            stacks.append(stack_channels(weights, number))
        for (A, scale), start, free, weight in zip(systems, *stacks, strict=True):
            is_lit = (scale > 0)[:, None]
            yield FreeSystem(A=A, scale=scale, values=start, is_free=free & is_lit, weights=weight)


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeSystem:
    """A system T = A diag(scale), with values to start from, free pixels and weights."""

    A: Operator
    scale: np.ndarray
    values: np.ndarray
    is_free: np.ndarray
    weights: np.ndarray

    def divided(self, light: np.ndarray) -> np.ndarray:
        """Light over the scale, 0 where that is 0."""
        scale = np.broadcast_to(self.scale[:, None], light.shape)
        return np.divide(light, scale, out=np.zeros(light.shape), where=scale > 0)


def light_to_add(T: Transport, desired: Any, gain: float, background: Any) -> Any:
    """gain * desired - background, where one of them may be grey, and the latter one frame."""
    light = desired
    if gain != 1.0:
        light = gain * desired
    if background is None:
        return light
    if np.ndim(background) == 0:
        return light - background
    grid = T.camera_grid
    light = _unflattened(light, grid)
    background = _unflattened(background, grid)
    is_coloured = light.shape[-3:] == (*grid, 3)
    has_coloured_background = background.shape[-3:] == (*grid, 3)
    if has_coloured_background and not is_coloured:
        light = light[..., None]
    elif is_coloured and not has_coloured_background:
        background = background[..., None]
    return light - background


def _unflattened(picture: Any, grid: tuple[int, int]) -> Any:
    """A picture with rows and columns."""
    return picture.reshape(grid) if picture.ndim == 1 else picture
