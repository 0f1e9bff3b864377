# SPDX-License-Identifier: BSD-3-Clause
"""Every public call once, small, in the launch shape of a GPU: all other tests run in that of a CPU.

CI runs this file again with work-groups of 8 items at most (``POCL_MAX_WORK_GROUP_SIZE``): no
launch may ask for more than its kernel and device allow.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.device import Device
from ltcl.solvers import METHODS, matrix_series

SCENE = ltcl.scenes.dihedral(4, albedo=0.6)
DESIRED = np.linspace(0.1, 0.3, 32, dtype=np.float32).reshape(SCENE.grid)


def apart(found: Any, exact: Any) -> float:
    return float(np.linalg.norm(np.subtract(found, exact)) / np.linalg.norm(exact))


def residual(device: Device, method: str) -> float:
    S, b = SCENE.transport(device=device).interreflection, np.random.default_rng(0).random((32, 3))
    options: dict[str, Any] = {"samples": 64} if method in ("monte_carlo", "hybrid") else {}
    return apart(S @ ltcl.solve(S, b, method, rtol=1e-2, **options).x, b)


def compressed(device: Device, **options: Any) -> float:
    T = ltcl.scenes.dihedral(8, albedo=0.6).transport(device=device)
    p = np.random.default_rng(1).random(T.grid)
    return apart(ltcl.compress(T, rtol=0.05, **options) @ p, T @ p)


def inverted(device: Device) -> float:
    T = SCENE.transport(device=device)
    return apart(
        T @ ltcl.compensate(T, DESIRED, inverse=ltcl.invert(T, 0.02), rtol=0.02).pattern, DESIRED
    )


def streamed(device: Device) -> float:
    """A bounce that is computed in each product."""
    patches = ltcl.scenes.cut(SCENE.walls, 4)
    A = ltcl.scenes.FormFactor(patches, albedo=SCENE.first_bounce.ravel(), device=device)
    x = np.random.default_rng(2).random(32)
    return apart(A @ x, SCENE.A @ x)


def separated(device: Device) -> float:
    b = ltcl.separate(SCENE.transport(device=device), DESIRED, bounces=2)
    return apart(b.direct + np.sum(b.bounces, axis=0) + b.rest, DESIRED)


def relit(device: Device) -> float:
    T = SCENE.transport(device=device)
    return apart((T @ DESIRED).ravel(), T.matrices[0] @ DESIRED.ravel())


def compensated(device: Device, scale: float = 1.0, **options: Any) -> ltcl.Compensation:
    return ltcl.compensate(SCENE.transport(device=device), scale * DESIRED, **options)


# Each gives an error, and the most it may be.
CALLS: dict[str, tuple[Callable[[Device], float], float]] = {
    "compensate": (lambda device: compensated(device).error, 0.02),
    "compensate brightly": (
        lambda device: compensated(device, 9, gain="auto", loss=0.5).clipped,
        1.0,
    ),
    "compensate within bounds": (lambda device: compensated(device, bounds=(0.3, 0.5)).error, 1.0),
    "separate": (separated, 1e-5),
    "relight": (relit, 1e-5),
    "analyze": (
        lambda device: ltcl.analyze(SCENE.transport(device=device)).channels[0].spectral_radius,
        2.0,
    ),
    "matrix iteration": (
        lambda device: (
            matrix_series(SCENE.transport(device=device).interreflection, rtol=1e-3).residual
        ),
        1e-3,
    ),
    "compress": (compressed, 0.06),
    "compress by rows": (lambda device: compressed(device, basis="haar rows"), 0.06),
    "invert": (inverted, 0.05),
    "form factors": (streamed, 1e-4),
    **{
        f"solve by {name}": (lambda device, name=name: residual(device, name), 0.3)
        for name in METHODS
    },
}


@pytest.mark.parametrize("shaped", ["gpu"], indirect=True)
@pytest.mark.parametrize("name", CALLS)
def test_calls_work_in_the_launch_shape_of_a_gpu(
    shaped: Device, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("LTCL_TUNE", "0")  # test_rows.py runs every launch there is to choose from
    call, most = CALLS[name]
    assert call(shaped) <= most
