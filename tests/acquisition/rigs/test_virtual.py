# SPDX-License-Identifier: BSD-3-Clause
"""`VirtualRig` and `camera_map` against their equations, and noise against its distributions."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.stats
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.acquisition import Shots, VirtualRig, camera_map
from ltcl.errors import InputError, LtclError
from ltcl.images import from_srgb, to_srgb

GRID = (3, 4)
N = 12
CLEAN: dict[str, Any] = {"gain": None, "read": 0.0, "black": 0.0, "bits": "float", "response": "linear"}
M = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.2, 0.8]])
CURVES = ("linear", "srgb", "gamma2.2", "film")


def matrix(seed: int = 0, rows: int = N) -> np.ndarray:
    return np.random.default_rng(seed).random((rows, N)) / N


def pattern(channels: int = 1, seed: int = 9) -> np.ndarray:
    return np.random.default_rng(seed).random(GRID if channels == 1 else (*GRID, 3)).astype(np.float32)


@pytest.mark.parametrize(
    "kind", [np.asarray, scipy.sparse.csr_array, scipy.sparse.coo_array, np.float32, aslinearoperator]
)
def test_grey_photographs_follow_the_equations(kind: Any) -> None:
    T, x, seconds = matrix(), pattern(), 0.75
    ambient = np.random.default_rng(2).random(N) / 10
    settings = {**CLEAN, "black": 0.03, "projector_black": 0.02, "sensitivity": 0.9}
    rig = VirtualRig(kind(T), GRID, **settings, ambient=ambient)
    L = T @ (0.02 + 0.98 * from_srgb(x.astype(np.float64)).ravel()) + ambient
    np.testing.assert_allclose(rig.radiance(x).ravel(), L, rtol=1e-5)
    expected = 0.03 + 0.97 * (0.9 * seconds * L)
    np.testing.assert_allclose(rig.photograph(x, seconds).ravel(), expected, rtol=1e-5)


def test_colour_photographs_follow_the_equations() -> None:
    T, x = [matrix(c) for c in range(3)], pattern(3)
    curves = {"response": ["linear", "srgb", np.sqrt], "projector_response": ["linear", "srgb", "gamma2.2"]}
    rig = VirtualRig(T, GRID, **{**CLEAN, **curves}, mixing=M, ambient=[0.1, 0.2, 0.3])
    flat = x.reshape(N, 3).astype(np.float64)
    q = np.stack([flat[:, 0], from_srgb(flat[:, 1]), flat[:, 2] ** 2.2], axis=-1) @ M.T
    L = np.stack([T[c] @ q[:, c] for c in range(3)], axis=-1) + np.array([0.1, 0.2, 0.3])
    expected = np.minimum(np.stack([L[:, 0], to_srgb(L[:, 1]), np.sqrt(L[:, 2])], axis=-1), 1)
    np.testing.assert_allclose(rig.photograph(x, 1.0).reshape(N, 3), expected, rtol=1e-5)
    grey = pattern()
    np.testing.assert_array_equal(rig.radiance(grey), rig.radiance(np.repeat(grey[..., None], 3, axis=-1)))


def test_one_lit_pixel_gives_a_column_and_a_map_warps_it() -> None:
    T, C, x = matrix(rows=20), np.random.default_rng(5).random((30, 20)), np.zeros(GRID)
    x[1, 2] = 1.0
    rig = VirtualRig(T, GRID, camera_grid=(4, 5), **CLEAN)
    np.testing.assert_allclose(rig.radiance(x), T[:, 6].reshape(4, 5), rtol=1e-12)
    warped = VirtualRig(T, GRID, camera_grid=(5, 6), camera_map=C, ambient=0.5, **CLEAN)
    np.testing.assert_allclose(warped.radiance(x).ravel(), C @ (T[:, 6] + 0.5), rtol=1e-6)


def test_a_transport_brings_its_matrices_and_its_mixing() -> None:
    parts, x = [matrix(c) + np.eye(N) for c in range(3)], pattern(3)
    T = ltcl.Transport(parts, grid=GRID, mixing=M)
    np.testing.assert_allclose(VirtualRig(T, GRID, **CLEAN).radiance(x), T @ from_srgb(x), rtol=1e-4)


X = np.linspace(0.0, 1.0, 400).reshape(20, 20)


@pytest.mark.parametrize("name", CURVES)
def test_a_projector_undoes_a_camera_of_the_same_name(name: str) -> None:
    rig = VirtualRig(np.eye(400), (20, 20), **{**CLEAN, "response": name}, projector_response=name)
    codes = rig.photograph(X, 1.0)
    np.testing.assert_allclose(codes, X, atol=1e-6)


def test_film_is_a_logistic_in_log_light() -> None:
    rig = VirtualRig(np.eye(400), (20, 20), **{**CLEAN, "response": "film"}, projector_response="linear")
    light = X.ravel()[1:]
    c = rig.photograph(X, 1.0).astype(np.float64).ravel()[1:] / (1 + 0.25**1.2)
    slopes = np.diff(np.log(c / (1 - c))) / np.diff(np.log(light))  # logit over log exposure: a straight line
    np.testing.assert_allclose(slopes, 1.2, rtol=1e-2)


PIXELS = 40_000


def exposed(value: float, **settings: Any) -> np.ndarray:
    """40 000 pixels under the same light."""
    grid = (200, PIXELS // 200)
    rig = VirtualRig(scipy.sparse.eye_array(PIXELS).tocsr(), grid, **{**CLEAN, **settings}, ambient=value)
    return rig.photograph(np.zeros(grid), 1.0).astype(np.float64)


@pytest.mark.parametrize("value", [0.001, 0.02, 0.4])
def test_photons_are_poisson(value: float) -> None:
    counts = exposed(value, gain=1000.0).ravel() * 1000.0
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-3)  # whole electrons
    law = scipy.stats.poisson(1000.0 * value)
    low, high = int(law.ppf(0.002)), int(law.ppf(0.998))
    edges = np.unique(np.linspace(low, high, min(30, high - low + 1)).astype(int))
    cut = np.concatenate([[-np.inf], edges + 0.5, [np.inf]])
    observed, expected = np.histogram(counts, cut)[0], np.diff(law.cdf(cut)) * counts.size
    keep = expected >= 5
    statistic = np.sum((observed[keep] - expected[keep]) ** 2 / expected[keep])
    assert scipy.stats.chi2.sf(statistic, keep.sum() - 1) > 1e-3


def test_read_noise_is_normal_and_of_each_pixel() -> None:
    x = exposed(0.5, read=0.01)
    assert scipy.stats.kstest(x.ravel(), scipy.stats.norm(0.5, 0.01).cdf).pvalue > 1e-3
    z = (x - x.mean()) / x.std()
    for pairs in (z[:, 1:] * z[:, :-1], z[1:] * z[:-1]):
        assert abs(pairs.mean()) < 4 / np.sqrt(pairs.size)


def test_saturation_offset_and_noise_below_zero() -> None:
    for value in (1.5, 1e18):
        assert np.all(exposed(value, bits=8, gain=1000.0, read=0.01, response="srgb") == 255)
    x = exposed(0.0, read=0.01, black=0.1)
    assert abs(x.mean() - 0.1) < 4 * 0.009 / np.sqrt(PIXELS)
    assert (x < 0.1).mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(PIXELS))
    assert exposed(0.0, read=0.01, bits=16).min() == 0


@pytest.mark.parametrize(("bits", "levels"), [(8, 256), (10, 1024), (12, 4096), (16, 65536), ("float", None)])
def test_levels(bits: Any, levels: int | None) -> None:
    rig = VirtualRig(matrix(), GRID, **{**CLEAN, "bits": bits}, exposures=(0.25, 1.0))
    shots, x = Shots(rig), pattern()
    np.testing.assert_allclose(shots.photograph(x, 1.0), rig.radiance(x), atol=0.51 / ((levels or 1e6) - 1))
    assert (shots.levels, shots.exposures) == (levels, (0.25, 1.0))
    assert json.loads(json.dumps(shots.describe(), allow_nan=False))["rig"]["kind"] == "virtual"


def noisy(**change: Any) -> VirtualRig:
    return VirtualRig(matrix(), GRID, **{"bits": 12, "gain": 500.0, "read": 0.01, "seed": 4, **change})


def test_a_resumed_run_sees_the_same_noise() -> None:
    x, y = pattern(), pattern(seed=10)
    first, resumed = noisy(), noisy()
    straight = [first.photograph(*shot) for shot in [(x, 1.0), (y, 1.0), (x, 1.0), (x, 0.5)]]
    np.testing.assert_array_equal(resumed.photograph(x, 0.5), straight[3])
    resumed.recall(x, 1.0, straight[0])
    np.testing.assert_array_equal(resumed.photograph(x, 1.0), straight[2])
    np.testing.assert_array_equal(resumed.photograph(y, 1.0), straight[1])


def test_noise_differs_with_codes_seconds_repeat_and_seed() -> None:
    x, other = np.full((100, 10), 0.5), np.full((100, 10), 0.5 + 1e-5)
    settings: dict[str, Any] = {**CLEAN, "read": 0.01, "black": 0.2}
    rig, seeded = (VirtualRig(np.eye(1000), (100, 10), **settings, seed=seed) for seed in (1, 2))
    shots = [(rig, x, 0.01), (rig, x, 0.01), (rig, x, 0.02), (rig, other, 0.01), (seeded, x, 0.01)]
    noise = np.array([rig.photograph(codes, seconds).ravel() for rig, codes, seconds in shots])
    correlation = np.corrcoef(noise) - np.eye(len(shots))
    assert np.abs(correlation).max() < 0.15  # 4.7 standard deviations of 1 / sqrt(1000)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"grid": (3, 5)}, "grid is 3 x 5 = 15 pixels"),
        ({"T": matrix(rows=20)}, "camera_grid is None; .* 20 camera pixels"),
        ({"camera_grid": (2, 5)}, "camera_grid is 2 x 5"),
        ({"T": np.full((N, N), np.nan)}, "T has 144 NaN"),
        ({"T": [matrix()] * 2}, "T has 2 channels"),
        ({"camera_map": np.ones((12, 7))}, r"camera_map has shape \(12, 7\)"),
        ({"camera_map": [np.ones((12, 12))] * 3}, "camera_map has three channels"),
        ({"mixing": np.eye(3)}, "mixing"),
        ({"ambient": -0.1}, "ambient is as low as -0.1"),
        ({"ambient": [0.1, 0.2, 0.3]}, r"ambient has shape \(3,\)"),
        ({"projector_black": 1.0}, "projector_black"),
        ({"sensitivity": 0.0}, "sensitivity"),
        ({"seed": -1}, "seed"),
        ({"gain": 0}, "gain"),
        ({"read": -1e-3}, "read"),
        ({"black": 1.0}, "black"),
        ({"bits": 7}, "bits is 7"),
        ({"response": "sRGB"}, "response is 'sRGB'; it must be one of linear, srgb, film, gamma2.2"),
        ({"response": ["srgb", "srgb"]}, "response has 2 curves"),
        ({"response": lambda x: 2 * x}, "response .*spans 0 to 2"),
        ({"response": lambda x: x * np.nan}, "response.*NaN"),
        ({"response": 2.2}, r"response is 2\.2"),
        ({"projector_response": lambda x: 1 - x}, "projector_response"),
    ],
)
def test_impossible_rigs_are_refused(change: dict[str, Any], part: str) -> None:
    with pytest.raises(LtclError, match=part):
        VirtualRig(**{"T": matrix(), "grid": GRID, **change})


def test_areas_of_a_shifted_and_scaled_camera_are_exact_where_rays_divide_them() -> None:
    """A camera pixel of 0.5 x 0.75 whose edges lie on quarters: overlaps of intervals, by 12 rays a side."""
    C = camera_map(lambda u, v: (0.5 * u + 0.125, 0.75 * v - 0.25), (4, 6), (3, 3)).toarray()

    def overlaps(start: float, size: float, count: int) -> np.ndarray:
        low = start + size * (np.arange(count)[:, None] - 0.5)
        n = np.arange(3)
        return np.clip(np.minimum(low + size, n + 0.5) - np.maximum(low, n - 0.5), 0, None) / size

    np.testing.assert_allclose(C, np.kron(overlaps(-0.25, 0.75, 4), overlaps(0.125, 0.5, 6)), atol=1e-12)


def test_rays_outside_the_grid_and_nowhere_see_nothing() -> None:
    C = camera_map(lambda u, v: (np.where(u > 1.0, np.nan, u), v), (2, 4), (1, 4))
    np.testing.assert_allclose(C.sum(axis=1), [1, 0.5, 0, 0, 0, 0, 0, 0], atol=1e-12)
    with pytest.raises(InputError, match=r"place gives \(\) and \(2, 3\)"):
        camera_map(lambda u, v: (0.0, v), (2, 3), (2, 3))
