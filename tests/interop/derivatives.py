# SPDX-License-Identifier: BSD-3-Clause
"""Calls with derivatives, and what their derivatives are by dense matrices in float64."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.operators import Operator
from tests.interop.calls import GRID, picture, transport

RTOL = 1e-6
MIXING = np.eye(3) + 0.1


@functools.cache
def mixed() -> Any:
    return ltcl.Transport(transport(3).matrices, GRID, mixing=MIXING)


@functools.cache
def wide() -> Any:
    """A camera of twice as many pixels, whose pattern is a least-squares one."""
    matrix = transport().to_numpy()
    return ltcl.Transport(np.vstack([matrix, 0.8 * matrix]), GRID, camera_grid=(8, 8))


@functools.cache
def masked() -> Any:
    """Pixels 3 and 17 light nothing."""
    matrix = transport().to_numpy() * (~np.isin(np.arange(32), [3, 17]))
    return ltcl.Transport(matrix, GRID, dark_threshold=0.01)


@dataclass(frozen=True, kw_only=True)
class LinearCall:
    """A linear call, an operand of it, and the same call as a matrix of flattened arrays."""

    run: Callable[[Any], Any]
    operand: np.ndarray
    matrix: Callable[[], np.ndarray]


def _matrix_of(run: Callable[[Any], Any], shape: tuple[int, ...]) -> np.ndarray:
    """The matrix of a linear call by its columns."""
    columns = []
    for unit in np.eye(int(np.prod(shape))):
        columns.append(np.ravel(run(unit.reshape(shape))))
    return np.stack(columns, axis=1)


def linear_call(run: Callable[[Any], Any], *shape: int) -> LinearCall:
    return LinearCall(run=run, operand=picture(*shape), matrix=lambda: _matrix_of(run, shape))


def _solution(b: Any, method: str = "auto", **options: Any) -> Any:
    return ltcl.solve(transport().interreflection, b, method, rtol=RTOL, **options).x


LINEAR: dict[str, LinearCall] = {
    "T @ p": linear_call(lambda p: transport() @ p, *GRID),
    "T @ flat p": linear_call(lambda p: transport() @ p, 32),
    "T @ frames": linear_call(lambda p: transport() @ p, 2, *GRID),
    "T in colour @ grey": linear_call(lambda p: transport(3) @ p, *GRID),
    "T in colour @ frames": linear_call(lambda p: transport(3) @ p, 2, *GRID),
    "T in colour @ colour": linear_call(lambda p: transport(3) @ p, *GRID, 3),
    "T @ colour": linear_call(lambda p: transport() @ p, *GRID, 3),
    "T that mixes @ colour": linear_call(lambda p: mixed() @ p, *GRID, 3),
    "T of another camera": linear_call(lambda p: wide() @ p, *GRID),
    "relight": linear_call(lambda p: ltcl.relight(transport(), p), *GRID),
    "S @ x": linear_call(lambda x: transport().interreflection @ x, 32),
    "S @ X": linear_call(lambda x: transport().interreflection @ x, 32, 2),
    "S.matvec": linear_call(lambda x: transport().interreflection.matvec(x), 32),
    "S.T.matmat": linear_call(lambda x: transport().interreflection.T.matmat(x), 32, 2),
    "solve": linear_call(_solution, 32),
    "solve of columns": linear_call(_solution, 32, 2),
    "solve by chebyshev": linear_call(lambda b: _solution(b, "chebyshev"), 32),
    "solve by relaxation": linear_call(lambda b: _solution(b, "gauss_seidel"), 32),
}


@dataclass(frozen=True, kw_only=True)
class CompensateCall:
    """A compensation, with some of its pixels at a bound."""

    make: Callable[[], Any]
    desired: np.ndarray
    background: np.ndarray | None = None
    options: dict[str, Any]

    def run(self, desired: Any, background: Any = None) -> Any:
        return ltcl.compensate(
            self.make(), desired, background=background, rtol=RTOL, **self.options
        )


def compensate_call(
    make: Callable[[], Any] = transport,
    desired: np.ndarray | None = None,
    background: Any = None,
    **options: Any,
) -> CompensateCall:
    if desired is None:
        desired = picture(high=0.4)
    return CompensateCall(make=make, desired=desired, background=background, options=options)


WEIGHTS = picture(seed=5, high=1.0) + 0.5
BLACK = picture(seed=6, high=0.05)
COMPENSATE: dict[str, CompensateCall] = {
    "within the bounds": compensate_call(desired=np.full(GRID, 0.2)),
    "clipped": compensate_call(),
    "weighted": compensate_call(weights=WEIGHTS),
    "clamped": compensate_call(clamp=True),
    "with background and gain": compensate_call(background=BLACK, gain=0.8),
    "with an even background": compensate_call(background=np.array(0.03)),
    "frames": compensate_call(desired=picture(3, *GRID, high=0.4), background=BLACK),
    "flat": compensate_call(desired=picture(32, high=0.4), background=BLACK),
    "grey in colour": compensate_call(lambda: transport(3)),
    "in colour": compensate_call(
        lambda: transport(3), picture(*GRID, 3, high=0.3), background=BLACK
    ),
    "a background in colour": compensate_call(
        lambda: transport(3), background=picture(*GRID, 3, seed=7, high=0.05)
    ),
    "mixing colours": compensate_call(mixed, picture(*GRID, 3, seed=1, high=0.2)),
    "mixing colours within the bounds": compensate_call(mixed, np.full((*GRID, 3), 0.1)),
    "another camera": compensate_call(wide, picture(8, 8)),
    "masked pixels": compensate_call(masked),
    "masked pixels that count": compensate_call(masked, weights=WEIGHTS),
}
# Of the difference of two patterns: larger than what float32 hides, smaller than most pixels are
# away from a bound.
STEP = 1e-3
DIRECTIONS = 6


def difference_quotients(
    call: CompensateCall, weights: np.ndarray, which: str
) -> Iterator[tuple[np.ndarray, float]]:
    """Directions, and the slopes of sum(weights * pattern), by differences of float32 patterns.

    Only those along which no pixel comes to a bound or leaves one: there the pattern has a kink.
    """
    base: dict[str, Any] = {"desired": call.desired, "background": call.background}
    free = call.run(**base).free_pixels()
    random = np.random.default_rng(3)
    for _ in range(DIRECTIONS):
        direction = random.standard_normal(np.shape(base[which]))
        ends = []
        for sign in (1, -1):
            ends.append(call.run(**{**base, which: base[which] + sign * STEP * direction}))
        if all(np.array_equal(end.free_pixels(), free) for end in ends):
            change = ends[0].pattern.astype(np.float64) - ends[1].pattern
            yield direction, float(np.sum(weights * change)) / (2 * STEP)


def agrees_with_differences(
    call: CompensateCall, weights: np.ndarray, gradients: dict[str, np.ndarray]
) -> None:
    """The gradients of sum(weights * pattern) are those of difference quotients, to 1e-3."""
    compared = 0
    for which, gradient in gradients.items():
        for direction, slope in difference_quotients(call, weights, which):
            size = np.linalg.norm(gradient) * np.linalg.norm(direction) / np.sqrt(direction.size)
            assert np.sum(gradient * direction) == pytest.approx(slope, abs=1e-3 * size), which
            compared += 1
    assert compared >= 2


@dataclass
class Count:
    """Products with all operators so far, columns apart."""

    products: int = 0


@contextmanager
def counted(monkeypatch: pytest.MonkeyPatch) -> Iterator[Count]:
    """Count the products of operators, whoever asks."""
    count = Count()
    apply, bind = Operator.apply, Operator.bind

    def counting_apply(self: Operator, *arguments: Any, **options: Any) -> Any:
        count.products += 1
        return apply(self, *arguments, **options)

    def counting_bind(self: Operator, *arguments: Any, **options: Any) -> Any:
        launch = bind(self, *arguments, **options)

        def counting_launch() -> object:
            count.products += 1
            return launch()

        return counting_launch

    with monkeypatch.context() as patch:
        patch.setattr(Operator, "apply", counting_apply)
        patch.setattr(Operator, "bind", counting_bind)
        yield count
