# SPDX-License-Identifier: BSD-3-Clause
"""Every public call once, small, in the launch shapes of a CPU and of a GPU.

CI runs this file again with work-groups of 8 and of 64 items at most (``POCL_MAX_WORK_GROUP_SIZE``): no
launch may ask for more than its kernel and device allow.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.device import Device
from ltcl.operators import IdentityPlus
from ltcl.solvers import METHODS, matrix_iteration

SCENE = ltcl.scenes.dihedral(4, albedo=0.6)
DESIRED = np.linspace(0.1, 0.3, 32, dtype=np.float32).reshape(SCENE.grid)


def transport(device: Device) -> ltcl.Transport:
    return SCENE.transport(device=device)


def residual(device: Device, method: str) -> float:
    S = transport(device).interreflection
    assert isinstance(S, IdentityPlus)
    b = np.random.default_rng(0).random((32, 3))
    options: dict[str, Any] = {"samples": 64} if method in ("monte_carlo", "hybrid") else {}
    x = ltcl.solve(S, b, method, rtol=1e-2, **options).x
    return float(np.linalg.norm(b - S.to_dense() @ x) / np.linalg.norm(b))


def compressed(device: Device, **options: Any) -> float:
    scene = ltcl.scenes.dihedral(8, albedo=0.6)
    T = scene.transport(device=device)
    C = ltcl.compress(T, rtol=0.05, **options)
    p = np.random.default_rng(1).random(T.grid)
    return float(np.linalg.norm(C @ p - T @ p) / np.linalg.norm(T @ p))


def inverted(device: Device) -> float:
    T = transport(device)
    c = ltcl.compensate(T, DESIRED, inverse=ltcl.invert(T, 0.02), rtol=0.02)
    return float(np.linalg.norm(T @ c.pattern - DESIRED) / np.linalg.norm(DESIRED))


def streamed(device: Device) -> float:
    """A bounce that is computed in each product."""
    A = ltcl.scenes.FormFactor(
        ltcl.scenes.cut(SCENE.walls, 4), albedo=SCENE.first_bounce.ravel(), device=device
    )
    x = np.random.default_rng(2).random(32)
    return float(np.linalg.norm(A @ x - SCENE.A @ x) / np.linalg.norm(SCENE.A @ x))


def separated(device: Device) -> float:
    b = ltcl.separate(transport(device), DESIRED, bounces=2)
    total = b.direct + np.sum(b.bounces, axis=0) + b.rest
    return float(np.linalg.norm(total - DESIRED) / np.linalg.norm(DESIRED))


# Each gives an error.
CALLS: dict[str, tuple[Callable[[Device], float], float]] = {
    "compensate": (lambda device: ltcl.compensate(transport(device), DESIRED).error, 0.02),
    "compensate, as bright as can be": (
        lambda device: ltcl.compensate(transport(device), 9 * DESIRED, gain="auto", loss=0.5).clipped,
        1.0,
    ),
    "compensate within bounds": (
        lambda device: ltcl.compensate(transport(device), DESIRED, bounds=(0.3, 0.5)).error,
        1.0,
    ),
    "separate": (separated, 1e-5),
    "relight": (lambda device: float(np.min(transport(device) @ DESIRED) < 0), 0.0),
    "analyze": (lambda device: ltcl.analyze(transport(device)).channels[0].spectral_radius, 2.0),
    "matrix iteration": (
        lambda device: matrix_iteration(transport(device).interreflection, rtol=1e-3).residual,
        1e-3,
    ),
    "compress": (compressed, 0.06),
    "compress by rows": (lambda device: compressed(device, basis="haar rows"), 0.06),
    "invert": (inverted, 0.05),
    "form factors": (streamed, 1e-4),
    **{
        f"solve by {method}": (lambda device, method=method: residual(device, method), 0.3)
        for method in METHODS
    },
}


@pytest.fixture(scope="module", params=["cpu", "gpu"])
def shaped_device(request: pytest.FixtureRequest, device: Device) -> Iterator[Device]:
    """The device, told to launch as it would were it of the other kind."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Device, "is_cpu", property(lambda _: request.param == "cpu"))
        yield Device(device.description)  # nothing built or tuned for the other kind


@pytest.mark.parametrize("name", CALLS)
def test_calls_work_in_any_launch_shape(shaped_device: Device, name: str) -> None:
    call, most = CALLS[name]
    assert call(shaped_device) <= most


def test_no_method_is_left_out() -> None:
    assert all(f"solve by {method}" in CALLS for method in itertools.chain(METHODS))
