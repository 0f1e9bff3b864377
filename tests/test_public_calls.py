# SPDX-License-Identifier: BSD-3-Clause
"""Every public call once, small, in the launch shape of a GPU; other tests use a CPU's.

CI runs this file again with work-groups of 8 items at most (``POCL_MAX_WORK_GROUP_SIZE``): no
launch may ask for more than its kernel and device allow.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.device import Device
from ltcl.solvers import METHODS, matrix_series

SCENE = ltcl.scenes.dihedral(4, albedo=0.6)
DESIRED = np.linspace(0.1, 0.3, 32, dtype=np.float32).reshape(SCENE.grid)

# A call, and the error that it may have at most.
CALLS: dict[str, tuple[Callable[[Device], float], float]] = {}


def call(name: str, largest_error: float) -> Callable[[Any], Any]:
    """Register a function of a device, which returns an error."""

    def register(function: Callable[[Device], float]) -> Callable[[Device], float]:
        CALLS[name] = (function, largest_error)
        return function

    return register


def relative_error(found: Any, exact: Any) -> float:
    return float(np.linalg.norm(np.subtract(found, exact)) / np.linalg.norm(exact))


def compensate(device: Device, scale: float = 1.0, **options: Any) -> ltcl.Compensation:
    return ltcl.compensate(SCENE.transport(device=device), scale * DESIRED, **options)


@call("compensate", 0.02)
def compensation_error(device: Device) -> float:
    return compensate(device).error


@call("compensate brightly", 1.0)
def clipped_share(device: Device) -> float:
    return compensate(device, 9, gain="auto", loss=0.5).clipped


@call("compensate within bounds", 1.0)
def bounded_error(device: Device) -> float:
    return compensate(device, bounds=(0.3, 0.5)).error


@call("prepared frames", 0.02)
def prepared_error(device: Device) -> float:
    T = SCENE.transport(device=device)
    compensator = ltcl.Compensator(T, encode="linear", dtype="float32")
    return relative_error(T @ compensator(DESIRED), DESIRED)


@call("separate", 1e-5)
def separation_error(device: Device) -> float:
    b = ltcl.separate(SCENE.transport(device=device), DESIRED, bounces=2)
    return relative_error(b.direct + np.sum(b.bounces, axis=0) + b.rest, DESIRED)


@call("relight", 1e-5)
def relighting_error(device: Device) -> float:
    T = SCENE.transport(device=device)
    return relative_error((T @ DESIRED).ravel(), T.matrices[0] @ DESIRED.ravel())


@call("analyze", 2.0)
def spectral_radius(device: Device) -> float:
    return ltcl.analyze(SCENE.transport(device=device)).channels[0].spectral_radius


@call("matrix iteration", 1e-3)
def matrix_residual(device: Device) -> float:
    return matrix_series(SCENE.transport(device=device).interreflection, rtol=1e-3).residual


def compression_error(device: Device, **options: Any) -> float:
    T = ltcl.scenes.dihedral(8, albedo=0.6).transport(device=device)
    p = np.random.default_rng(1).random(T.grid)
    return relative_error(ltcl.compress(T, rtol=0.05, **options) @ p, T @ p)


@call("compress", 0.06)
def picture_compression_error(device: Device) -> float:
    return compression_error(device)


@call("compress by rows", 0.06)
def row_compression_error(device: Device) -> float:
    return compression_error(device, basis="haar rows")


@call("invert", 0.05)
def inversion_error(device: Device) -> float:
    T = SCENE.transport(device=device)
    inverse = ltcl.invert(T, 0.02)
    pattern = ltcl.compensate(T, DESIRED, inverse=inverse, rtol=0.02).pattern
    return relative_error(T @ pattern, DESIRED)


@call("form factors", 1e-4)
def form_factor_error(device: Device) -> float:
    """The error of a bounce that is computed in each product."""
    patches = ltcl.scenes.cut(SCENE.walls, 4)
    A = ltcl.scenes.FormFactor(patches, albedo=SCENE.first_bounce.ravel(), device=device)
    x = np.random.default_rng(2).random(32)
    return relative_error(A @ x, SCENE.A @ x)


def residual(device: Device, method: str) -> float:
    S = SCENE.transport(device=device).interreflection
    b = np.random.default_rng(0).random((32, 3))
    options: dict[str, Any] = {}
    if method in ("monte_carlo", "hybrid"):
        options["samples"] = 64
    return relative_error(S @ ltcl.solve(S, b, method, rtol=1e-2, **options).x, b)


for method_name in METHODS:
    CALLS[f"solve by {method_name}"] = (partial(residual, method=method_name), 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("shaped", ["gpu"], indirect=True)
@pytest.mark.parametrize("name", CALLS)
def test_calls_work_in_the_launch_shape_of_a_gpu(
    shaped: Device, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    # test_rows.py runs every launch there is to choose from.
    monkeypatch.setenv("LTCL_TUNE", "0")
    function, largest_error = CALLS[name]
    assert function(shaped) <= largest_error
