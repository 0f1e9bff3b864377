# SPDX-License-Identifier: BSD-3-Clause
"""`VirtualRig` and `camera_map` against their equations, and noise against its distributions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.stats
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.acquisition import Shots, VirtualRig, camera_map
from ltcl.errors import LtclError
from ltcl.images import from_srgb, to_srgb

random = np.random.default_rng(0)
GRID = (3, 4)
N = 12
PIXELS = 40_000
CLEAN: dict[str, Any] = {
    "gain": None,
    "read": 0.0,
    "black": 0.0,
    "bits": "float",
    "response": "linear",
}
M = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.2, 0.8]])
KINDS = [np.asarray, scipy.sparse.csr_array, scipy.sparse.coo_array, np.float32, aslinearoperator]


def matrix(rows: int = N) -> np.ndarray:
    return random.random((rows, N)) / N


@pytest.mark.parametrize("kind", KINDS)
def test_grey_photographs_follow_the_equations(kind: Any) -> None:
    T = matrix(20)
    C = random.random((30, 20))
    x = random.random(GRID)
    ambient = random.random(20) / 10
    settings = {
        **CLEAN,
        "black": 0.03,
        "projector_black": 0.02,
        "sensitivity": 0.09,
        "ambient": ambient,
    }
    rig = VirtualRig(kind(T), GRID, **settings, camera_grid=(5, 6), camera_map=C)
    L = C @ (T @ (0.02 + 0.98 * from_srgb(x).ravel()) + ambient)
    np.testing.assert_allclose(rig.radiance(x).ravel(), L, rtol=1e-5)
    np.testing.assert_allclose(
        rig.photograph(x, 0.75).ravel(), 0.03 + 0.97 * 0.09 * 0.75 * L, rtol=1e-5
    )


@pytest.mark.parametrize("as_transport", [False, True])
def test_colour_photographs_follow_the_equations(as_transport: bool) -> None:
    T = [matrix() + np.eye(N) / 2 for _ in range(3)]
    x = random.random((*GRID, 3))
    curves = ["linear", "srgb", "gamma2.2"]
    ambient = [0.1, 0.2, 0.3]
    options: dict[str, Any] = {
        **CLEAN,
        "response": curves,
        "projector_response": curves,
        "ambient": ambient,
    }
    if as_transport:
        rig = VirtualRig(ltcl.Transport(T, grid=GRID, mixing=M), GRID, **options)
    else:
        rig = VirtualRig(T, GRID, mixing=M, **options)
    r, g, b = x.reshape(N, 3).T
    q = np.stack([r, from_srgb(g), b**2.2], axis=-1) @ M.T
    L = np.stack([T[c] @ q[:, c] for c in range(3)], axis=-1) + np.array(ambient)
    expected = np.minimum(np.stack([L[:, 0], to_srgb(L[:, 1]), L[:, 2] ** (1 / 2.2)], axis=-1), 1)
    np.testing.assert_allclose(rig.photograph(x, 1.0).reshape(N, 3), expected, rtol=1e-5)
    grey = random.random(GRID)
    np.testing.assert_array_equal(
        rig.radiance(grey), rig.radiance(np.repeat(grey[..., None], 3, axis=-1))
    )


@pytest.mark.parametrize("name", ["linear", "srgb", "gamma2.2", "film"])
def test_a_projector_undoes_a_camera_of_the_same_name(name: str) -> None:
    x = np.linspace(0.0, 1.0, 400).reshape(20, 20)
    rig = VirtualRig(np.eye(400), (20, 20), **{**CLEAN, "response": name}, projector_response=name)
    np.testing.assert_allclose(rig.photograph(x, 1.0), x, atol=1e-6)
    if name == "film":  # a logistic in log light
        camera = VirtualRig(
            np.eye(400), (20, 20), **{**CLEAN, "response": name}, projector_response="linear"
        )
        expected = (1 + 0.25**1.2) / (1 + (0.25 / np.maximum(x, 1e-9)) ** 1.2)
        np.testing.assert_allclose(camera.photograph(x, 1.0), expected, atol=1e-6)


def exposed(value: float, **settings: Any) -> np.ndarray:
    """40 000 pixels under the same light."""
    grid = (200, PIXELS // 200)
    rig = VirtualRig(
        scipy.sparse.eye_array(PIXELS).tocsr(), grid, **{**CLEAN, **settings}, ambient=value
    )
    return rig.photograph(np.zeros(grid), 1.0).astype(np.float64)


@pytest.mark.parametrize("value", [0.001, 0.02, 0.4])
def test_photons_are_poisson(value: float) -> None:
    counts = exposed(value, gain=1000.0).ravel() * 1000.0
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-3)  # whole electrons
    mean = 1000.0 * value
    assert abs(counts.mean() - mean) < 4 * np.sqrt(mean / PIXELS)
    assert abs(counts.var() - mean) < 4 * np.sqrt((mean + 2 * mean**2) / PIXELS)


def test_read_noise_is_normal_and_of_each_pixel() -> None:
    x = exposed(0.5, read=0.01)
    assert scipy.stats.kstest(x.ravel(), scipy.stats.norm(0.5, 0.01).cdf).pvalue > 1e-3
    z = (x - x.mean()) / x.std()
    for pairs in (z[:, 1:] * z[:, :-1], z[1:] * z[:-1]):
        assert abs(pairs.mean()) < 4 / np.sqrt(pairs.size)


def test_saturation_offset_and_noise_below_zero() -> None:
    assert np.all(exposed(1e18, bits=8, gain=1000.0, read=0.01, response="srgb") == 255)
    assert abs(exposed(0.0, read=0.01, black=0.1).mean() - 0.1) < 4 * 0.009 / np.sqrt(PIXELS)
    assert exposed(0.0, read=0.01, bits=16).min() == 0


@pytest.mark.parametrize(("bits", "levels"), [(8, 256), (10, 1024), (16, 65536), ("float", None)])
def test_levels(bits: Any, levels: int | None) -> None:
    x = random.random(GRID)
    rig = VirtualRig(matrix(), GRID, **{**CLEAN, "bits": bits})
    shots = Shots(rig)
    code = shots.photograph(x, 1.0)
    np.testing.assert_allclose(code, rig.radiance(x), atol=0.51 / ((levels or 1e6) - 1))
    assert shots.levels == levels


def test_a_resumed_run_sees_the_same_noise() -> None:
    T = matrix()
    x, y = random.random((2, *GRID))
    first, resumed = (VirtualRig(T, GRID, bits=12, gain=500.0, read=0.01, seed=4) for _ in range(2))
    straight = [first.photograph(codes, 1.0) for codes in (x, y, x)]
    resumed.recall(x, 1.0, straight[0])
    np.testing.assert_array_equal(resumed.photograph(x, 1.0), straight[2])
    np.testing.assert_array_equal(resumed.photograph(y, 1.0), straight[1])


def test_noise_differs_with_codes_seconds_repeat_and_seed() -> None:
    x = np.full((100, 10), 0.5)
    settings = {**CLEAN, "read": 0.01, "black": 0.2}
    rig, seeded = (VirtualRig(np.eye(1000), (100, 10), **settings, seed=seed) for seed in (1, 2))
    shots = [
        (rig, x, 0.01),
        (rig, x, 0.01),
        (rig, x, 0.02),
        (rig, x + 1e-5, 0.01),
        (seeded, x, 0.01),
    ]
    noise = np.array([rig.photograph(codes, seconds).ravel() for rig, codes, seconds in shots])
    correlation = np.corrcoef(noise) - np.eye(len(shots))
    assert np.abs(correlation).max() < 0.15  # 4.7 deviations of 1 / sqrt(1000)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"grid": (3, 5)}, "grid is 3 x 5 = 15 pixels"),
        ({"T": np.ones((20, N))}, "camera_grid is 3 x 4 = 12 pixels; .* 20"),
        ({"camera_grid": (2, 5)}, "camera_grid is 2 x 5"),
        ({"camera_map": np.ones((12, 7))}, r"camera_map has shape .*\(12, 7\)"),
        ({"ambient": [0.1, 0.2, 0.3]}, r"ambient has shape \(3,\)"),
        ({"ambient": -1}, "ambient is as low as -1"),
        ({"sensitivity": -1}, "sensitivity is -1"),
        ({"read": -1}, "read is -1"),
        ({"bits": -1}, "bits is -1"),
        ({"response": "sRGB"}, "response is 'sRGB'; .* linear, srgb, film, gamma2.2"),
    ],
)
def test_impossible_rigs_are_refused(change: dict[str, Any], part: str) -> None:
    with pytest.raises(LtclError, match=part):
        VirtualRig(**{"T": np.eye(N), "grid": GRID, **change})


def test_areas_of_a_shifted_and_scaled_camera_are_exact_where_rays_divide_them() -> None:
    """Camera pixels are 0.5 x 0.75, with edges on quarters; 12 rays a side divide them evenly."""
    C = camera_map(lambda u, v: (0.5 * u + 0.125, 0.75 * v - 0.25), (4, 6), (3, 3)).toarray()

    def overlaps(start: float, size: float, count: int) -> np.ndarray:
        n = np.arange(3)
        low = start + size * (np.arange(count)[:, None] - 0.5)
        overlap = np.minimum(low + size, n + 0.5) - np.maximum(low, n - 0.5)
        return np.clip(overlap, 0, None) / size

    np.testing.assert_allclose(
        C, np.kron(overlaps(-0.25, 0.75, 4), overlaps(0.125, 0.5, 6)), atol=1e-12
    )


def test_rays_outside_the_grid_and_nowhere_see_nothing() -> None:
    C = camera_map(lambda u, v: (np.where(u > 1.0, np.nan, u), v), (2, 4), (1, 4))
    np.testing.assert_allclose(C.sum(axis=1), [1, 0.5, 0, 0, 0, 0, 0, 0], atol=1e-12)
    first = camera_map(lambda u, v: (0.0, v), (2, 3), (2, 3)).toarray()  # a column for all
    np.testing.assert_allclose(first.sum(axis=0), [3, 0, 0, 3, 0, 0], atol=1e-12)
