# SPDX-License-Identifier: BSD-3-Clause
"""Verdicts on damaged transports: two sentences that name the damage and nothing else."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.cli.main import main
from ltcl.transport.noise import Noise
from ltcl.transport.verdict import Verdict, verdict
from tests import json_schema
from tests.transport.noise.measured import measure, noise_of, truth

random = np.random.default_rng()
# Noise beneath all damages, to the median first bounce.
LEVEL = 1e-4
# Words of verdicts.
NOISE = "because of noise"
EXPOSURES = "times as many exposures"
GOOD = "errors by noise are .* in pictures"
MATT = "as far as light between lit, matt surfaces explains"


@pytest.fixture(autouse=True)
def reseed(request):
    """Give each test random numbers of its own."""
    seeded = np.random.default_rng([*request.node.name.encode()])
    random.bit_generator.state = seeded.bit_generator.state


def measured(A: np.ndarray, noise: Noise) -> tuple[np.ndarray, Noise]:
    return A + random.standard_normal(A.shape) * np.sqrt(noise.variance(A)), noise


def noisy(level: float, photons: float = 0.0) -> Callable[..., Any]:
    return lambda A, grid: measured(A, noise_of(ltcl.Transport(A, grid), level, photons))


def dark_wall(A: np.ndarray, grid: tuple[int, int]) -> tuple[np.ndarray, Noise]:
    """The right third reflects a third, and its noise is 20 times as large."""
    height, width = grid
    is_right = np.tile(np.arange(width) >= 2 * width // 3, height)
    uniform = noise_of(ltcl.Transport(A, grid), LEVEL)
    noise = dataclasses.replace(uniform, rows=1.0 + 399.0 * is_right[None])
    return measured(np.where(is_right[:, None], 0.3, 1.0) * A, noise)


def dark_pixels(A: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """12 pixels in a corner; the last of them lights nothing at all."""
    height, width = grid
    rows = height - 1 - np.arange(3)
    pixels = (width * rows[:, None] + np.arange(4)).ravel()
    numbers = np.arange(len(A))
    is_seen = ~np.isin(numbers, pixels)
    is_lit = numbers != pixels[-1]
    return A * is_seen[:, None] * is_lit


def shift(rows: int, columns: int, share: float = 1.0) -> Callable[..., np.ndarray]:
    def damage(A: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
        shifted = np.roll(A.reshape(*grid, -1), (rows, columns), axis=(0, 1)).reshape(A.shape)
        return share * shifted + (1.0 - share) * A

    return damage


def entries(i: Any, j: Any, value: float) -> Callable[..., np.ndarray]:
    """Set entry (i, j), or row i if j is None, to a share of the median first bounce."""

    def damage(A: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
        B = A.copy()
        light = value * np.median(A.diagonal())
        if j is None:
            B[i] = light
        else:
            B[i, j] = light
        return B

    return damage


# Name, damage of T (N, N) on a grid, words of the text, what it is good for (compensation,
# bounces), cause
DAMAGES: list[tuple[str, Callable[..., Any], str, str, str]] = [
    ("none", lambda A, grid: A, GOOD, "cb", ""),
    ("noise of 1e-3", noisy(1e-3), f"bounce.*{NOISE}.*{EXPOSURES}", "c", "bounces"),
    ("noise of 1e-2", noisy(1e-2), f"pictures.*{NOISE}.*{EXPOSURES}.*bounces", "", "pictures"),
    ("photons", noisy(LEVEL, 1e5), f"pictures.*{NOISE}", "b?", "pictures"),
    (
        "noise in a dark wall",
        dark_wall,
        f"{NOISE} in the dark right part: .*{EXPOSURES}",
        "",
        "pictures",
    ),
    ("dark pixels, zero column", dark_pixels, "lower left part stay unlit", "cb", "dark"),
    (
        "dark columns",
        lambda A, grid: A * (np.arange(len(A)) % 7 != 3),
        "14 % of projector",
        "",
        "dark",
    ),
    ("wrong grid", lambda A, grid: A, "grid.*--grid", "", "other_grid"),
    (
        "ambient light of 1 %",
        lambda A, grid: A + 0.01 * A.sum(axis=1).mean(),
        "subtract",
        "",
        "ambient",
    ),
    (
        "ambient light of 10 %",
        lambda A, grid: A + 0.1 * A.sum(axis=1).mean(),
        "subtract",
        "",
        "ambient",
    ),
    ("negative offset", lambda A, grid: A - A.mean() / 2, "negative offset", "", "offset"),
    (
        "flicker",
        lambda A, grid: A * random.normal(1.0, 0.05, len(A)),
        "by [4-6].* %.*perhaps drifted",
        "",
        "flicker",
    ),
    ("one pixel to the right", shift(0, 1), "brightest 0 rows and -1 columns", "", "shifted"),
    ("half a pixel down", shift(1, 0, 0.5), "brightest -1 rows and 0 columns", "", "shifted"),
    ("hot row", entries(40, None, 1.0), "1 hot camera pixel.* upper", "", "hot_rows"),
    ("warm row", entries(40, None, 0.1), "1 hot camera pixel.* upper", "", "hot_rows"),
    ("bright outlier", entries(40, 200, 1.0), "outliers in the upper", "", "outliers"),
    ("small outlier", entries(40, 200, 0.2), "outliers in the upper", "c", "outliers"),
    (
        "saturated",
        lambda A, grid: np.minimum(A, np.quantile(A.diagonal(), 0.7)),
        "saturate",
        "",
        "saturated",
    ),
    # The next two do not show in T, as the module says.
    ("slow drift", lambda A, grid: A * np.linspace(1.0, 0.8, len(A)), GOOD, "cb", ""),
    ("gain", lambda A, grid: 1e30 * A, GOOD, "cb", ""),
    (
        "noise, gain",
        lambda A, grid: 1e30 * noisy(1e-3)(A, grid)[0],
        f"bounce.*{NOISE}",
        "c",
        "bounces",
    ),
]


def good(judged: Verdict) -> str:
    return "c" * bool(judged.compensation) + "b" * bool(judged.bounces)


@pytest.mark.parametrize("scene", ["corner", "box"])
@pytest.mark.parametrize(("name", "damage", "words", "expected", "cause"), DAMAGES)
def test_the_damage_is_named_and_nothing_else(name, damage, words, expected, cause, scene):
    T = truth(scene)
    undamaged = measure(T, noise_of(T, LEVEL), 0).to_numpy().astype(np.float64)
    changed = damage(undamaged, T.grid)
    noise = None
    if isinstance(changed, tuple):
        changed, noise = changed
    height, width = T.grid
    if cause == "other_grid":
        height, width = width, height
    # diag(T) changes the third bounce of the box by more than 5 %.
    first_bounce = "exact" if "b" in expected else "diagonal"
    judged = verdict(ltcl.Transport(changed, (height, width), first_bounce, noise=noise))
    assert re.fullmatch(expected, good(judged)), judged.text
    assert re.search(words, judged.text, re.IGNORECASE), judged.text
    assert judged.causes[:1] == (cause,) * bool(cause), judged.text
    assert set(judged.causes) <= {cause, "bounces", "pictures"}, judged.causes
    assert judged.text.count(". ") == 1
    assert judged.text.startswith("Good" if good(judged) else "Not good")


def colours(order: tuple[int, ...], **settings: Any) -> ltcl.Transport:
    """Three channels of a corner; their first bounces in another order."""
    T = truth("corner").to_numpy()
    scales = (1.0, 0.7, 0.4)
    matrices = [scale * T for scale in scales]
    exact = 1.0 / np.diagonal(np.linalg.inv(T))
    first_bounce = [scales[c] * exact for c in order]
    return ltcl.Transport(matrices, (12, 24), first_bounce, **settings)


def blocks(order: tuple[int, ...]) -> ltcl.Transport:
    """Blocks of a corner whose brightest ones are in this order."""
    T = truth("corner").to_numpy()
    rows = []
    for c in order:
        row = [0.1 * T, 0.1 * T, 0.1 * T]
        row[c] = T
        rows.append(row)
    return ltcl.Transport(rows, (12, 24))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("T", "words", "expected"),
    [
        (lambda: colours((0, 1, 2)), GOOD, "cb"),
        (lambda: colours((1, 0, 2)), "green for red, red for green", ""),
        (
            lambda: colours((0, 1, 2), mixing=np.eye(3)[[0, 2, 1]]),
            "blue for green, green for blue",
            "",
        ),
        (lambda: colours((0, 1, 2), mixing=0.8 * np.eye(3) + 0.1), GOOD, "cb"),
        (lambda: blocks((0, 1, 2)), "bounces need a T without blocks", "c"),
        (lambda: blocks((2, 1, 0)), "blue for red, red for blue", ""),
        (
            lambda: ltcl.Transport(
                np.eye(288)[:96], (12, 24), camera_grid=(4, 24), noise=Noise.uniform((96, 288), 0.0)
            ),
            "bounces need one grid",
            "c",
        ),
        (lambda: truth("glossy"), "not reciprocal.*gloss", "c"),
        (
            lambda: measure(truth("glossy"), noise_of(truth("glossy"), 1e-3), 0),
            "not reciprocal.*gloss",
            "c",
        ),
        (lambda: ltcl.compress(truth("corner"), 0.05, basis="haar"), "^Unknown", ""),
        (lambda: ltcl.Transport(np.eye(8) + 0.1, (2, 4)), "^Unknown: fewer than 64 pixels", ""),
        (
            lambda: ltcl.Transport(np.full((64, 64), 3e38, np.float32), (8, 8)),
            "^Unknown: .* (nan|inf):",
            "",
        ),
        (
            lambda: ltcl.Transport(
                np.flipud(noisy(1e-3)(truth("corner").to_numpy(), (12, 24))[0]), (12, 24)
            ),
            "^Not good((?!saturate).)*$",
            "",
        ),
    ],
)
def test_colours_shapes_and_surfaces(T, words, expected):
    judged = verdict(T())
    assert good(judged) == expected, judged.text
    assert re.search(words, judged.text, re.IGNORECASE), judged.text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "photons", "least"),
    [
        ("corner", 0.0, 0.8),
        ("corner", 300.0, 0.7),
        ("box", 0.0, 0.8),
        ("box", 300.0, 0.7),
        ("glossy", 0.0, 0.4),
    ],
)
def test_errors_by_noise_are_those_of_the_truth(scene, photons, least):
    """Errors are taken by dense inverses; both pictures under white are those of the true T."""
    T = truth(scene)
    A = T.to_numpy()
    measured_T = measure(T, noise_of(T, 5e-4, photons), 0)
    B = measured_T.to_numpy().astype(np.float64)
    light = np.linalg.solve(B, np.ones(len(B)))
    p = np.clip(light / np.quantile(light, 0.9), 0.0, 1.0)
    errors = {"pictures": relative_error(B @ p, A @ p)}
    white = A.sum(axis=1)
    true_bounces = dense_bounces(A, white)
    for k, bounce in enumerate(dense_bounces(B, white)):
        errors[f"bounce_{k}"] = relative_error(bounce, true_bounces[k])
    numbers = verdict(measured_T).numbers
    for name in ("pictures", "bounce_1", "bounce_2", "bounce_3"):
        assert least < numbers[name] / errors[name] < 1.0 / least, name
    b = ltcl.separate(measured_T, measured_T @ np.ones(T.grid), 3)
    deviations = np.linalg.norm(b.std.bounces, axis=(1, 2))
    expected = deviations / np.linalg.norm(b.bounces, axis=(1, 2))
    stated = [numbers[name] for name in ("bounce_1", "bounce_2", "bounce_3")]
    np.testing.assert_allclose(stated, expected, rtol=0.3)


def relative_error(x: np.ndarray, exact: np.ndarray) -> float:
    return float(np.linalg.norm(x - exact) / np.linalg.norm(exact))


def dense_bounces(A: np.ndarray, light: np.ndarray) -> list[np.ndarray]:
    """Bounces 0 to 3 of a picture: b_k = S^-1 l, l without b_k."""
    bounces = []
    for _ in range(4):
        b = np.linalg.solve(A / A.diagonal(), light)
        light = light - b
        bounces.append(b)
    return bounces


@pytest.mark.parametrize(("ambient", "causes"), [(0.0, set()), (0.01, {"ambient"})])
def test_a_closed_bright_room_is_no_ambient_light(ambient, causes):
    T = ltcl.scenes.box(8, albedo=0.9).transport().to_numpy().astype(np.float64)
    judged = verdict(ltcl.Transport(T + ambient * T.sum(axis=1).mean(), (8, 48)))
    assert set(judged.causes) - {"dark", "bounces"} == causes, judged.text


@pytest.mark.slow
@pytest.mark.parametrize(
    "known", [{"sum_deviation": 0.07}, {"saturation": 0.07}, {"negative_bounce": 0.07}]
)
def test_numbers_from_elsewhere_count(known):
    A = truth("corner").to_numpy()
    T = ltcl.Transport(A, (12, 24), "exact")
    judged = verdict(T, bounce_highest=np.nan, **known)  # which is not known
    assert (judged.causes, judged.bounces) == (tuple(known), False)
    assert "7 %" in judged.text


@pytest.mark.slow
def test_reports_end_in_it(capsys, tmp_path):
    """`info` without a device, and `analyze`; their numbers are those of the library."""
    ltcl.save(tmp_path / "T.npz", truth("corner"))
    judged = ltcl.analyze(truth("corner")).verdict
    assert judged.numbers["negative_bounce"] < 1e-3
    for command in ("info", "analyze"):
        assert main([command, str(tmp_path / "T.npz"), "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        json_schema.check([command], document)
        (entry,) = document
        assert entry["verdict"]["text"] == judged.text
        assert entry["verdict"]["numbers"]["bounce_3"] == pytest.approx(
            judged.numbers["bounce_3"], rel=1e-3
        )
        assert main([command, str(tmp_path / "T.npz")]) == 0
        assert capsys.readouterr().out.rstrip().endswith(judged.text)
