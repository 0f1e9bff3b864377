# SPDX-License-Identifier: BSD-3-Clause
"""Standard deviations of patterns and bounces against errors of many measurements."""

from __future__ import annotations

import pickle
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.transport.noise import Noise
from tests.transport.noise.measured import SCENES, measure, noise_of, truth

random = np.random.default_rng()
FLOOR = 1e-3


@pytest.fixture(autouse=True)
def _seed(request: pytest.FixtureRequest) -> None:
    """Give each test random numbers of its own."""
    seed = zlib.crc32(request.node.name.encode())
    random.bit_generator.state = np.random.default_rng(seed).bit_generator.state


def picture(T: ltcl.Transport, *more: int) -> np.ndarray:
    """A smooth pattern on the grid, its light between 0.3 and 0.7."""
    return ltcl.images.resize(random.uniform(0.3, 0.7, (3, 3, *more)).astype(np.float32), T.grid)


def parts(b: Any) -> np.ndarray:
    """Direct light and bounces in one array, of a separation or its `std`."""
    return np.concatenate([b.direct[None], b.bounces])


def within(ratios: Any) -> np.ndarray:
    """Shares of errors within one and two standard deviations."""
    return np.array([np.mean(np.abs(ratios) < n) for n in (1, 2)])


def calibrated(ratios: Any, rtol: float = 1.0) -> bool:
    """True if 68 % and 95 % of errors are within one and two deviations, as of normal errors."""
    return bool((np.abs(within(ratios) - (0.68, 0.95)) < rtol * np.array([0.07, 0.04])).all())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "level"), [(scene, (1e-4, 1e-3, 1e-2)[k % 3]) for k, scene in enumerate(SCENES)]
)
def test_errors_are_as_large_as_their_deviations(scene: str, level: float) -> None:
    """Bounces 0 to 3, patterns, and pictures under them; bench/uncertainty.py has more cases."""
    T = truth(scene)
    noise = noise_of(T, level, photons=1.0)
    light = picture(T)
    image = (T @ light).astype(np.float64)
    true = ltcl.separate(T, image, 3, rtol=1e-5)
    ratios = []
    bounces = []
    for seed in range(8):
        measured = measure(T, noise, seed)
        b = ltcl.separate(measured, image, 3)
        c = ltcl.compensate(measured, image, bounds=(-9.0, 9.0), rtol=1e-3)
        bounces.append((parts(b) - parts(true)) / parts(b.std))
        shown = (c.appearance - T @ c.pattern) / c.std.appearance
        ratios.append([(c.pattern - light) / c.std.pattern, shown])
    for each in (*np.moveaxis(np.array(bounces), 1, 0), *np.moveaxis(np.array(ratios), 1, 0)):
        assert calibrated(each), within(each)


def test_noise_of_the_own_row_is_in_closed_form() -> None:
    """A T without bounces: sigma |p| over F, without the pixel itself in bounces; known white."""
    F = random.uniform(0.5, 1.0, 12)
    noise = Noise.uniform((12, 12), FLOOR)
    T = ltcl.Transport(np.diag(F), (3, 4), noise=noise)
    p = random.uniform(0.2, 0.8, (3, 4))
    b = ltcl.separate(T, T @ p, 1)
    c = ltcl.compensate(T, T @ p)
    others = FLOOR * np.sqrt(np.sum(p**2) - p**2)
    for deviation, expected in (
        (b.std.direct, others),
        (b.std.bounces[0], others),
        (c.std.appearance, FLOOR * np.linalg.norm(p)),
        (c.std.pattern, FLOOR * np.linalg.norm(p) / F.reshape(3, 4)),
    ):
        np.testing.assert_allclose(deviation, np.broadcast_to(expected, (3, 4)), rtol=0.02)
    known = replace(noise, white=np.full((1, 12), 4e-6))
    white = ltcl.compensate(ltcl.Transport(np.diag(F), (3, 4), noise=known), F.reshape(3, 4))
    np.testing.assert_allclose(white.std.appearance, 2e-3, rtol=1e-3)


def colours(mixing: Any, noise: Noise | None, error: np.ndarray | float = 0.0) -> ltcl.Transport:
    matrices = np.stack([scale * truth("corner", 8).to_numpy() for scale in (1.0, 0.8, 0.6)])
    return ltcl.Transport(matrices + error, truth("corner", 8).grid, mixing=mixing, noise=noise)


@pytest.mark.slow
@pytest.mark.parametrize("mixing", [None, [[0.9, 0.1, 0.0], [0.1, 0.8, 0.1], [0.0, 0.2, 0.9]]])
def test_frames_and_colours(mixing: Any) -> None:
    """Each frame and colour as errors of it; channels have noise of their own."""
    T = colours(mixing, None)
    noise = Noise.uniform(T.shape, [1e-3, 2e-3, 4e-3])
    light = np.stack([picture(T, 3), picture(T, 3)])
    image = T @ light
    ratios = []
    true = parts(ltcl.separate(T, image, 1, rtol=1e-5))
    for _ in range(8):
        error = noise.floor[:, None, None] * random.standard_normal((3, *T.shape))
        measured = colours(mixing, noise, error)
        b = ltcl.separate(measured, image, 1)
        c = ltcl.compensate(measured, image, rtol=1e-3, bounds=(-9, 9))
        assert parts(b.std).shape == true.shape
        ratios.append([*(parts(b) - true) / parts(b.std), (c.pattern - light) / c.std.pattern])
    for each in np.moveaxis(np.array(ratios), (1, -1), (0, 1)).reshape(9, -1):
        assert calibrated(each, 1.3), within(each)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["bounds", "rows", "blocks"])
def test_patterns_of_least_squares(case: str) -> None:
    """Free pixels of clipped patterns, of twice as many camera pixels, and of coupled colours."""
    A = truth("corner", 8).to_numpy()
    grid = truth("corner", 8).grid
    options: dict[str, Any] = {"camera_grid": (2 * grid[0], grid[1])} if case == "rows" else {}
    bounds = (0.0, 0.65) if case == "bounds" else (-9.0, 9.0)
    matrices = {
        "bounds": A,
        "rows": np.concatenate([A, 0.5 * A]),
        "blocks": np.eye(3)[:, :, None, None] * A + 0.1 * A,
    }
    true = matrices[case]
    T = ltcl.Transport(true, grid, **options)
    noise = Noise.uniform(true.shape[-2:], [FLOOR] * T.channels)
    light = picture(T, 3) if T.channels == 3 else picture(T)
    image = T @ light
    ratios = []
    best = ltcl.compensate(T, image, rtol=1e-5, bounds=bounds).pattern
    for _ in range(10):
        entries = true + FLOOR * random.standard_normal(true.shape)
        measured = ltcl.Transport(entries, grid, noise=noise, **options)
        c = ltcl.compensate(measured, image, rtol=1e-5, bounds=bounds)
        free = (c.pattern > bounds[0]) & (c.pattern < bounds[1])
        assert (c.std.pattern[~free] == 0).all()
        assert c.std.appearance.shape == image.shape
        inside = free & (best < bounds[1])
        ratios.append((c.pattern - best)[inside] / c.std.pattern[inside])
    assert calibrated(np.concatenate(ratios)), within(np.concatenate(ratios))


@pytest.mark.rare
def test_compressed_inverted_and_masked_transports_have_the_same_deviations() -> None:
    T = truth("box", 8)
    noise = noise_of(T, 1e-3)
    exact = ltcl.Transport(T.to_numpy(), T.grid, noise=noise)
    C = ltcl.compress(exact, rtol=1e-3)
    inverse = ltcl.invert(exact, rtol=1e-3)
    dark = T.to_numpy().copy()
    dark[:, 5] = 0.0
    masked = ltcl.Transport(dark, T.grid, on_dark="mask", noise=noise)
    image = T @ picture(T)
    b = ltcl.separate(exact, image, 2)
    c = ltcl.compensate(exact, image)
    tasks: list[tuple[ltcl.Transport, dict[str, Any]]]
    assert C.noise is noise
    tasks = [(C, {"exact": exact}), (C, {}), (exact, {"inverse": inverse}), (masked, {})]
    for T_, options in tasks:
        s = ltcl.separate(T_, image, 2, **options).std
        p = ltcl.compensate(T_, image, **options).std
        assert np.median(np.abs(np.log(parts(s) / parts(b.std)))) < 0.02
        is_lit = ~T_.masked.reshape(image.shape)
        assert np.median(np.abs(np.log(p.pattern[is_lit] / c.std.pattern[is_lit]))) < 0.02
        assert (p.pattern[~is_lit] == 0).all()


def test_noise_and_deviations_are_computed_at_the_first_use() -> None:
    T = ltcl.Transport(truth("corner", 8).to_numpy(), truth("corner", 8).grid)
    b = ltcl.separate(T, np.ones(T.grid), 1)
    c = ltcl.compensate(T, np.full(T.grid, 0.3))
    assert "noise" not in vars(T)
    assert b.std is b.std
    assert c.std is c.std
    assert parts(pickle.loads(pickle.dumps(b)).std).shape == parts(b).shape  # noqa: S301
