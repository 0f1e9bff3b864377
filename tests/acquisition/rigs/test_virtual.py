# SPDX-License-Identifier: BSD-3-Clause
"""`VirtualRig` against its equations written out, and that its noise depends on what it says."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.acquisition import Shots, VirtualRig
from ltcl.errors import InputError, LtclError
from ltcl.images import from_srgb, to_srgb

GRID = (3, 4)
N = 12
CLEAN: dict[str, Any] = {"gain": None, "read": 0.0, "black": 0.0, "bits": "float", "response": "linear"}


def matrix(seed: int = 0, rows: int = N, columns: int = N) -> np.ndarray:
    return np.random.default_rng(seed).random((rows, columns)) / columns


def pattern(channels: int = 1, seed: int = 9) -> np.ndarray:
    return np.random.default_rng(seed).random(GRID if channels == 1 else (*GRID, 3)).astype(np.float32)


@pytest.mark.parametrize("kind", [np.asarray, scipy.sparse.csr_array, scipy.sparse.coo_array, np.float32])
def test_grey_photographs_follow_the_equations(kind: Any) -> None:
    T, x, seconds = matrix(), pattern(), 0.75
    ambient = np.random.default_rng(2).random(N) / 10
    rig = VirtualRig(
        kind(T), GRID, **{**CLEAN, "black": 0.03}, projector_black=0.02, ambient=ambient, sensitivity=0.9
    )
    q = 0.02 + 0.98 * from_srgb(x.astype(np.float64)).ravel()
    L = T @ q + ambient
    np.testing.assert_allclose(rig.radiance(x).ravel(), L, rtol=1e-5)
    expected = 0.03 + 0.97 * (0.9 * seconds * L)
    np.testing.assert_allclose(rig.photograph(x, seconds).ravel(), expected, rtol=1e-5)


def test_colour_photographs_follow_the_equations() -> None:
    T, x = [matrix(c) for c in range(3)], pattern(3)
    M = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.2, 0.8]])
    rig = VirtualRig(
        T,
        GRID,
        **{**CLEAN, "response": ["linear", "srgb", np.sqrt]},
        projector_response=["linear", "srgb", "gamma2.2"],
        mixing=M,
        ambient=[0.1, 0.2, 0.3],
    )
    flat = x.reshape(N, 3).astype(np.float64)
    p = np.stack([flat[:, 0], from_srgb(flat[:, 1]), flat[:, 2] ** 2.2], axis=-1)
    q = p @ M.T
    L = np.stack([T[c] @ q[:, c] for c in range(3)], axis=-1) + np.array([0.1, 0.2, 0.3])
    expected = np.stack([L[:, 0], to_srgb(L[:, 1]), np.sqrt(L[:, 2])], axis=-1)
    photograph = rig.photograph(x, 1.0)
    assert photograph.shape == (*GRID, 3)
    np.testing.assert_allclose(photograph.reshape(N, 3), np.minimum(expected, 1), rtol=1e-5)


def test_grey_codes_feed_all_channels_alike() -> None:
    rig = VirtualRig([matrix(c) for c in range(3)], GRID, **CLEAN)
    x = pattern()
    np.testing.assert_array_equal(rig.radiance(x), rig.radiance(np.repeat(x[..., None], 3, axis=-1)))


def test_one_lit_pixel_gives_a_column() -> None:
    T, x = matrix(rows=20, columns=N), np.zeros(GRID)
    x[1, 2] = 1.0
    rig = VirtualRig(T, GRID, camera_grid=(4, 5), **CLEAN)
    np.testing.assert_allclose(rig.radiance(x).ravel(), T[:, 6], rtol=1e-12)
    assert rig.photograph(x, 1.0).shape == (4, 5)


@pytest.mark.parametrize("kind", [np.asarray, scipy.sparse.csr_array])
def test_a_map_warps_light_to_the_camera(kind: Any) -> None:
    T, C, x = matrix(), matrix(5, rows=30), pattern()
    rig = VirtualRig(T, GRID, camera_grid=(5, 6), camera_map=kind(C), ambient=0.5, **CLEAN)
    q = from_srgb(x.astype(np.float64)).ravel()
    np.testing.assert_allclose(rig.radiance(x).ravel(), C @ (T @ q + 0.5), rtol=1e-6)


def test_a_transport_brings_its_matrices_and_its_mixing() -> None:
    M = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.2, 0.8]])
    parts = [matrix(c) + np.eye(N) for c in range(3)]
    T = ltcl.Transport(parts, grid=GRID, mixing=M)
    x = pattern(3)
    own = VirtualRig(T, GRID, **CLEAN).radiance(x)
    np.testing.assert_allclose(own, VirtualRig(parts, GRID, mixing=M, **CLEAN).radiance(x), rtol=1e-12)
    np.testing.assert_allclose(own, T @ from_srgb(x), rtol=1e-4)  # what the library itself relights


def test_less_than_no_light_is_none() -> None:
    rig = VirtualRig(-np.eye(N), GRID, bits=8, black=0.1, response="linear", gain=100.0, read=0.0)
    assert np.all(rig.photograph(np.ones(GRID), 1.0) == round(0.1 * 255))


def rigs(**change: Any) -> VirtualRig:
    return VirtualRig(matrix(), GRID, **{"bits": 12, "gain": 500.0, "read": 0.01, "seed": 4, **change})


def test_a_resumed_run_sees_the_same_noise() -> None:
    x, y = pattern(), pattern(seed=10)
    first = rigs()
    straight = [first.photograph(*shot) for shot in [(x, 1.0), (y, 1.0), (x, 1.0), (x, 0.5)]]
    resumed = rigs()
    assert np.array_equal(resumed.photograph(x, 0.5), straight[3])
    assert np.array_equal(resumed.photograph(x, 1.0), straight[0])
    assert np.array_equal(resumed.photograph(x, 1.0), straight[2])
    assert np.array_equal(resumed.photograph(y, 1.0), straight[1])


def test_noise_differs_where_anything_does() -> None:
    x = np.full(GRID, 0.5, np.float32)

    def residual(rig: VirtualRig, codes: np.ndarray, seconds: float) -> np.ndarray:
        clean = VirtualRig(matrix(), GRID, **CLEAN).photograph(codes, seconds)
        return (rig.photograph(codes, seconds) - 0.004) / 0.996 - clean

    settings: dict[str, Any] = {"bits": "float", "gain": None, "response": "linear", "black": 0.004}
    rig = rigs(**settings)
    found = [residual(rig, x, 0.01), residual(rig, x, 0.01), residual(rig, x, 0.02)]
    found += [residual(rig, x * np.float32(1.0001), 0.01), residual(rigs(**settings, seed=5), x, 0.01)]
    for a in range(len(found)):
        for b in range(a):
            assert np.abs(found[a] - found[b]).max() > 1e-3


def test_asking_does_not_change_what_was_given() -> None:
    rig = VirtualRig(matrix(), GRID, **CLEAN)
    x = pattern()
    given = rig.radiance(x)
    kept = given.copy()
    given[:] = 7.0
    x2 = x.copy()
    np.testing.assert_array_equal(rig.radiance(x2), kept)
    rig.radiance(x)
    x[:] = 0.0  # the rig compares with its last pattern, of which it keeps a copy
    np.testing.assert_array_equal(rig.radiance(x), np.zeros(GRID))


@pytest.mark.parametrize(("bits", "levels"), [(8, 256), (12, 4096), (16, 65536), ("float", None)])
def test_shots_of_a_virtual_rig(bits: Any, levels: int | None) -> None:
    rig = VirtualRig(matrix(), GRID, **{**CLEAN, "bits": bits}, exposures=(0.25, 1.0))
    shots = Shots(rig)
    x = pattern()
    np.testing.assert_allclose(shots.photograph(x, 1.0), rig.radiance(x), atol=0.51 / ((levels or 1e6) - 1))
    assert (shots.levels, shots.exposures) == (levels, (0.25, 1.0))
    assert json.loads(json.dumps(shots.describe(), allow_nan=False))["rig"]["kind"] == "virtual"


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"grid": (3, 5)}, "grid is 3 x 5 = 15 pixels"),
        ({"T": matrix(rows=20)}, "camera_grid is None, but there are 20 camera pixels"),
        ({"camera_grid": (2, 5)}, "camera_grid is 2 x 5"),
        ({"T": np.full((N, N), np.nan)}, "T has 144 NaN"),
        ({"T": [matrix()] * 2}, "T has 2 channels"),
        ({"T": [[matrix()] * 3] * 3}, "T"),
        ({"camera_map": np.ones((12, 7))}, r"camera_map has shape \(12, 7\); .* M = 12"),
        ({"camera_map": [np.ones((12, 12))] * 3}, "camera_map has three channels"),
        ({"mixing": np.eye(3)}, "mixing"),
        ({"ambient": -0.1}, "ambient reaches down to -0.1"),
        (
            {"ambient": [0.1, 0.2, 0.3]},
            r"ambient has shape \(3,\); it must be one of \(\), \(12,\), \(12, 1\)",
        ),
        ({"ambient": np.nan}, "ambient"),
        ({"projector_black": 1.0}, "projector_black"),
        ({"sensitivity": 0.0}, "sensitivity"),
        ({"seed": -1}, "seed"),
        ({"response": "s-curve"}, "response"),
        ({"projector_response": lambda x: -x}, "projector_response"),
        ({"gain": 0}, "gain"),
    ],
)
def test_impossible_rigs_are_refused(change: dict[str, Any], part: str) -> None:
    with pytest.raises(LtclError, match=part):
        VirtualRig(**{"T": matrix(), "grid": GRID, **change})


@pytest.mark.parametrize(
    ("codes", "seconds"), [(np.zeros((4, 3)), 1.0), (np.full(GRID, 2.0), 1.0), (np.zeros(GRID), 0.0)]
)
def test_bad_requests_are_refused(codes: np.ndarray, seconds: float) -> None:
    with pytest.raises(InputError):
        rigs().photograph(codes, seconds)
