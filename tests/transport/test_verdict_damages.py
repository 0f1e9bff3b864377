# SPDX-License-Identifier: BSD-3-Clause
"""Damages that look like one another, in square and rectangular T: each under its own name."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

import ltcl
from ltcl.cli.main import main
from ltcl.transport.verdict import Verdict, verdict

pytestmark = pytest.mark.slow

random = np.random.default_rng(11)
SCENES = {
    "corner": ltcl.scenes.dihedral(12, albedo=0.7),
    "box": ltcl.scenes.box(8, sides=3, albedo=0.7),
}
TRUE = {name: scene.transport().to_numpy().astype(float) for name, scene in SCENES.items()}


def measured(name: str, level: float = 1e-4) -> np.ndarray:
    T = TRUE[name]
    return T + level * np.median(T.diagonal()) * random.standard_normal(T.shape)


def judge(name: str, matrix: np.ndarray) -> Verdict:
    return verdict(ltcl.Transport(matrix, SCENES[name].grid))


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("cut", [0.99, 0.8, 0.5])
def test_a_T_that_saturates_at_every_pixel_saturates(name, cut):
    T = measured(name, 1e-3)
    judged = judge(name, np.minimum(T, cut * TRUE[name].diagonal().min()))
    assert (judged.causes[0], judged.compensation) == ("saturated", False)
    assert judged.numbers["saturated"] >= len(T) / 2


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("albedo", [1.0, 0.5])
@pytest.mark.parametrize("offset", [0.0, 2e-5, 2e-4])
@pytest.mark.parametrize("gain", [0.0, 0.05])
def test_offsets_of_rows_and_gains_of_columns_are_told_apart(name, albedo, offset, gain):
    """Albedos that differ from pixel to pixel are neither."""
    N = len(TRUE[name])
    median = np.median(TRUE[name].diagonal())
    T = random.uniform(albedo, 1.0, (N, 1)) * measured(name, 3e-5)
    T = T * (1.0 + gain * random.standard_normal((1, N)))
    offsets = offset * median * random.standard_normal((N, 1))
    white = np.median(T.sum(axis=1))
    judged = judge(name, T + offsets)
    assert judged.numbers["flicker"] == pytest.approx(gain, abs=0.2 * gain + 0.018)
    share = np.std(offsets) * N / white
    assert judged.numbers["row_offset"] == pytest.approx(share, abs=0.3 * share + 0.01)
    assert ("flicker" in judged.causes) == (gain > 0)


def dead_projector_pixel(T: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[:, 30] = np.median(T, axis=1)
    return T


def dead_camera_pixel(T: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[30] = 0.0
    return T


def camera_pixels(rows: int, columns: int) -> Callable[[np.ndarray], np.ndarray]:
    """Each camera pixel is so many."""

    def resample(T: np.ndarray) -> np.ndarray:
        pictures = T.reshape(12, 24, -1).repeat(rows, axis=0).repeat(columns, axis=1)
        return pictures.reshape(-1, T.shape[1])

    return resample


def camera_of_larger_pixels(T: np.ndarray) -> np.ndarray:
    return T.reshape(6, 2, 12, 2, -1).mean(axis=(1, 3)).reshape(72, -1)


CAMERAS: list[tuple[str, Callable[[np.ndarray], np.ndarray], tuple[int, int]]] = [
    ("the same", lambda T: T, (12, 24)),
    ("dead projector pixel", dead_projector_pixel, (12, 24)),
    ("dead camera pixel", dead_camera_pixel, (12, 24)),
    ("twice the rows", camera_pixels(2, 1), (24, 24)),
    ("six times", camera_pixels(2, 3), (24, 72)),
    ("a quarter", camera_of_larger_pixels, (6, 12)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "resample", "camera_grid"), CAMERAS)
@pytest.mark.parametrize("ambient", [0.0, 1e-3, 1e-2])
def test_ambient_light_is_named_whatever_the_camera(
    capsys, tmp_path, kind, resample, camera_grid, ambient
):
    """`info` and `analyze` say the same."""
    T = resample(measured("corner") + ambient)
    transport = ltcl.Transport(T, (12, 24), camera_grid=camera_grid)
    judged = ltcl.analyze(transport).verdict
    assert ("ambient" in judged.causes) == (ambient > 0), judged.text
    if ambient:
        assert "perhaps ambient light" in judged.text
        assert judged.compensation is False
    assert "other_grid" not in judged.causes
    ltcl.save(tmp_path / "T.npz", transport)
    for command in ("info", "analyze"):
        assert main([command, str(tmp_path / "T.npz"), "--json"]) == 0
        (entry,) = json.loads(capsys.readouterr().out)
        assert entry["verdict"]["text"] == judged.text


@pytest.mark.slow
@pytest.mark.parametrize("camera_grid", [(24, 24), (24, 72)])
def test_a_camera_of_other_pixels_saturates_and_drifts_too(camera_grid):
    rows, columns = camera_grid
    repeat = camera_pixels(rows // 12, columns // 24)
    cut = 0.8 * TRUE["corner"].diagonal().min()
    noise = 1e-3 * random.standard_normal((rows * columns, 288))
    T = np.minimum(repeat(TRUE["corner"]) + noise, cut)
    judged = verdict(ltcl.Transport(T, (12, 24), camera_grid=camera_grid))
    assert judged.causes[0] == "saturated"
    drifting = measured("corner") * (1.0 + 0.05 * random.standard_normal(288))
    judged = verdict(ltcl.Transport(repeat(drifting), (12, 24), camera_grid=camera_grid))
    assert judged.causes[0] == "flicker"


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("bits", [8, 10, 16])
def test_codes_of_few_bits_are_no_drift(name, bits):
    T = random.uniform(0.5, 1.0, (len(TRUE[name]), 1)) * TRUE[name]
    codes = np.rint(T / T.max() * (2**bits - 1))
    judged = judge(name, codes / (2**bits - 1))
    assert ("quantized" in judged.causes) == (bits < 16), judged.text
    assert "flicker" not in judged.causes


@pytest.mark.parametrize("first_bounce", ["diagonal", "exact", "true"])
def test_bounces_are_good_as_far_as_T_shows(device, first_bounce):
    """The verdict and the separation say what T does not show, and what the choice of F changes."""
    scene = SCENES["corner"]
    F = scene.first_bounce if first_bounce == "true" else first_bounce
    T = ltcl.Transport(TRUE["corner"], scene.grid, F, device=device)
    judged = verdict(T)
    is_chosen = first_bounce != "diagonal"
    assert judged.bounces is is_chosen
    assert ("lit, matt surfaces" in judged.text) == is_chosen
    assert ("first_bounce='exact'" in judged.text) == (not is_chosen)

    bounces = {}
    for choice in ("diagonal", "exact"):
        chosen = ltcl.Transport(TRUE["corner"], scene.grid, choice, device=device)
        b = ltcl.separate(chosen, T @ np.ones(T.grid), 3, rtol=1e-5)
        bounces[choice] = b.bounces.reshape(3, -1)
    for k in range(3):
        difference = np.linalg.norm(bounces["diagonal"][k] - bounces["exact"][k])
        expected = difference / np.linalg.norm(bounces["exact"][k])
        assert judged.numbers[f"spread_{k + 1}"] == pytest.approx(expected, rel=0.03)
        assert T.bounce_spread[k] == pytest.approx(expected, rel=0.03)
        assert f"{100 * T.bounce_spread[k]:.2g}" in b.warning


def large_pixels(T: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """T of a camera and a projector of pixels of twice the size."""
    h, w = grid
    parts = T.reshape(h // 2, 2, w // 2, 2, h // 2, 2, w // 2, 2)
    return parts.mean(axis=(1, 3)).sum(axis=(3, 5)).reshape(len(T) // 4, -1)


def mean_of_pixels(picture: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    h, w = grid
    return picture.reshape(h // 2, 2, w // 2, 2).mean(axis=(1, 3)).ravel()


def bounces_under_white(T: np.ndarray, first_bounce: str) -> list[np.ndarray]:
    """Bounces 1 to 3, in float64."""
    inverse = np.linalg.inv(T)
    F = T.diagonal() if first_bounce == "diagonal" else 1.0 / inverse.diagonal()
    light = T.sum(axis=1)
    bounces = []
    for _ in range(4):
        bounces.append(F * (inverse @ light))
        light = light - bounces[-1]
    return bounces[1:]


@pytest.mark.parametrize("first_bounce", ["diagonal", "exact"])
@pytest.mark.parametrize("name", SCENES)
def test_the_change_by_larger_pixels_is_told(device, name, first_bounce):
    """It is that of T of pixels of twice the size; pixels of half the size change as much."""
    scene = SCENES[name]
    T = ltcl.Transport(TRUE[name], scene.grid, first_bounce, device=device)
    judged = verdict(T)
    b = ltcl.separate(T, T @ np.ones(T.grid), 3)
    fine = bounces_under_white(TRUE[name], first_bounce)
    coarse = bounces_under_white(large_pixels(TRUE[name], scene.grid), first_bounce)
    for k in range(3):
        expected = mean_of_pixels(fine[k], scene.grid)
        change = np.linalg.norm(coarse[k] - expected) / np.linalg.norm(expected)
        assert judged.numbers[f"resolution_{k + 1}"] == pytest.approx(change, rel=0.03, abs=3e-4)
        assert T.resolution_spread[k] == pytest.approx(change, rel=0.03, abs=1e-3)
        assert f"{100 * T.resolution_spread[k]:.2g}" in b.warning
    if judged.bounces:
        largest = max(judged.numbers[f"resolution_{k}"] for k in (1, 2, 3))
        assert f"{100 * largest:.2g} %" in judged.text


def test_the_change_by_larger_pixels_is_about_the_error_of_bounces(device):
    """T of pixels in which light is uneven, beside bounces that are known."""
    scene = ltcl.scenes.dihedral(24, albedo=0.7)
    fine = scene.transport().to_numpy().astype(float)
    true = bounces_under_white(fine, "diagonal")
    T = large_pixels(fine, scene.grid)
    grid = (scene.grid[0] // 2, scene.grid[1] // 2)
    measured = bounces_under_white(T, "diagonal")
    spread = ltcl.Transport(T, grid, device=device).resolution_spread
    for k in range(3):
        expected = mean_of_pixels(true[k], scene.grid)
        error = np.linalg.norm(measured[k] - expected) / np.linalg.norm(expected)
        # What is left of the error beyond half of these pixels is as large again.
        assert error < spread[k] < 3.0 * error


@pytest.mark.parametrize("grid", [(1, 64), (9, 7), (8, 8)])
def test_masked_pixels_and_odd_grids_have_a_change_by_larger_pixels(device, grid):
    pixels = grid[0] * grid[1]
    step = np.abs(np.subtract.outer(np.arange(pixels), np.arange(pixels)))
    matrix = 0.6 * np.eye(pixels) + 0.01 * np.exp(-step / 10.0)
    is_dark = np.arange(pixels) % 13 == 5
    matrix[is_dark] = 0.0
    matrix[:, is_dark] = 0.0
    T = ltcl.Transport(matrix, grid, on_dark="mask", device=device)
    assert np.all(np.array(T.resolution_spread) > 0.0)
    assert max(T.resolution_spread) < 1.0


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("level", [1e-4, 1e-3])
def test_noise_is_no_gloss(name, level):
    """Its negative light averages out between parts of the picture, but for its own share."""
    judged = judge(name, measured(name, level))
    assert judged.numbers["negative_bounce"] < 0.001
    assert "negative_bounce" not in judged.causes
