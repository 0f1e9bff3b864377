# SPDX-License-Identifier: BSD-3-Clause
"""What a damaged transport is good for, and why not: two sentences that name the damage and nothing else."""

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
LEVEL = 1e-4  # of noise beneath all damages
NOISE, EXPOSURES, GOOD = (
    "because of noise",
    "times as many exposures",
    "errors by noise are .* in pictures",
)


@pytest.fixture(autouse=True)
def reseed(request):
    random.bit_generator.state = np.random.default_rng(
        [*request.node.name.encode()]
    ).bit_generator.state


def measured(A: np.ndarray, noise: Noise) -> tuple[np.ndarray, Noise]:
    return A + random.standard_normal(A.shape) * np.sqrt(noise.variance(A)), noise


def noisy(level: float, photons: float = 0.0) -> Callable[..., Any]:
    return lambda A, grid: measured(A, noise_of(ltcl.Transport(A, grid), level, photons))


def dark_wall(A: np.ndarray, grid: tuple[int, int]) -> tuple[np.ndarray, Noise]:
    """The right third is as dark as a third, and its noise 20 times as large."""
    right = np.tile(np.arange(grid[1]) >= 2 * grid[1] // 3, grid[0])
    noise = dataclasses.replace(
        noise_of(ltcl.Transport(A, grid), LEVEL), rows=1.0 + 399.0 * right[None]
    )
    return measured(np.where(right[:, None], 0.3, 1.0) * A, noise)


def dark_pixels(A: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """12 pixels in a corner; the last of them lights nothing at all."""
    pixels = (grid[1] * (grid[0] - 1 - np.arange(3)[:, None]) + np.arange(4)).ravel()
    return A * ~np.isin(np.arange(len(A)), pixels)[:, None] * (np.arange(len(A)) != pixels[-1])


def shift(rows: int, columns: int, share: float = 1.0) -> Callable[..., np.ndarray]:
    def damage(A: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
        shifted = np.roll(A.reshape(*grid, -1), (rows, columns), axis=(0, 1)).reshape(A.shape)
        return share * shifted + (1.0 - share) * A

    return damage


def entries(i: Any, j: Any, value: float) -> Callable[..., np.ndarray]:
    """Some are a share of the median first bounce."""
    at = np.ix_(np.atleast_1d(i), np.atleast_1d(j)) if j is not None else (i,)
    return lambda A, grid: [B := A.copy(), B.__setitem__(at, value * np.median(A.diagonal()))][0]


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
        "by [4-6].* % from col",
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
    changed = damage(measure(T, noise_of(T, LEVEL), 0).to_numpy().astype(np.float64), T.grid)
    A, noise = changed if isinstance(changed, tuple) else (changed, None)
    h, w = T.grid[::-1] if cause == "other_grid" else T.grid
    judged = verdict(ltcl.Transport(A, (h, w), noise=noise))
    assert re.fullmatch(expected, good(judged)), judged.text
    assert re.search(words, judged.text, re.IGNORECASE), judged.text
    assert judged.causes[:1] == (cause,) * bool(cause), judged.text
    assert set(judged.causes) <= {cause, "bounces", "pictures"}, judged.causes
    assert judged.text.count(". ") == 1
    assert judged.text.startswith("Good" if good(judged) else "Not good")


def colours(order: tuple[int, ...], **settings: Any) -> ltcl.Transport:
    """Three channels of a corner; their first bounces in another order."""
    T, scales = truth("corner").to_numpy(), (1.0, 0.7, 0.4)
    return ltcl.Transport(
        [s * T for s in scales], (12, 24), [scales[c] * T.diagonal() for c in order], **settings
    )


def blocks(order: tuple[int, ...]) -> ltcl.Transport:
    T = truth("corner").to_numpy()
    return ltcl.Transport([[T if d == c else 0.1 * T for d in range(3)] for c in order], (12, 24))


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
        (lambda: blocks((0, 1, 2)), "bounces need one grid", "c"),
        (lambda: blocks((2, 1, 0)), "blue for red, red for blue", ""),
        (
            lambda: ltcl.Transport(np.eye(288)[:96], (12, 24), camera_grid=(4, 24)),
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
    """By dense inverses, whose pictures under white are those of the true T."""
    T = truth(scene)
    A, noise, errors = T.to_numpy(), noise_of(T, 5e-4, photons), []
    B = measure(T, noise, 0).to_numpy().astype(np.float64)
    light, left = np.linalg.solve(B, np.ones(len(B))), [A.sum(axis=1)] * 2
    pairs = [[M @ np.clip(light / np.quantile(light, 0.9), 0.0, 1.0) for M in (B, A)]]
    for _ in range(4):
        b = [np.linalg.solve(M / M.diagonal(), l) for M, l in zip((B, A), left, strict=True)]
        left = [l - b_k for l, b_k in zip(left, b, strict=True)]
        pairs.append(b)
    errors = [np.linalg.norm(x - y) / np.linalg.norm(y) for x, y in pairs]
    numbers = verdict(M := measure(T, noise, 0)).numbers
    names = ("pictures", "bounce_1", "bounce_2", "bounce_3")
    ratios = [
        numbers[name] / error for name, error in zip(names, [errors[0], *errors[2:]], strict=True)
    ]
    assert least < min(ratios), ratios
    assert max(ratios) < 1.0 / least, ratios
    b = ltcl.separate(M, M @ np.ones(T.grid), 3)
    of_std = np.linalg.norm(b.std.bounces, axis=(1, 2)) / np.linalg.norm(b.bounces, axis=(1, 2))
    np.testing.assert_allclose([numbers[name] for name in names[1:]], of_std, rtol=0.3)


@pytest.mark.parametrize(("ambient", "causes"), [(0.0, set()), (0.01, {"ambient"})])
def test_a_closed_bright_room_is_no_ambient_light(ambient, causes):
    T = ltcl.scenes.box(8, albedo=0.9).transport().to_numpy().astype(np.float64)
    judged = verdict(ltcl.Transport(T + ambient * T.sum(axis=1).mean(), (8, 48)))
    assert set(judged.causes) - {"dark", "bounces"} == causes, judged.text


@pytest.mark.parametrize(
    "known", [{"sum_deviation": 0.07}, {"saturation": 0.07}, {"negative_bounce": 0.07}]
)
def test_numbers_from_elsewhere_count(known):
    judged = verdict(truth("corner"), bounce_highest=np.nan, **known)  # which is not known
    assert (judged.causes, judged.bounces) == (tuple(known), False)
    assert "7 %" in judged.text


def test_reports_end_in_it(capsys, tmp_path):
    """`info` without a device, and `analyze`; their numbers are those of the library."""
    ltcl.save(tmp_path / "T.npz", truth("corner"))
    judged = ltcl.analyze(truth("corner")).verdict
    assert judged.numbers["negative_bounce"] < 1e-3
    for command in ("info", "analyze"):
        assert main([command, str(tmp_path / "T.npz"), "--json"]) == 0
        json_schema.check([command], document := json.loads(capsys.readouterr().out))
        (entry,) = document
        assert entry["verdict"]["text"] == judged.text
        assert entry["verdict"]["numbers"]["bounce_3"] == pytest.approx(
            judged.numbers["bounce_3"], rel=1e-3
        )
        assert main([command, str(tmp_path / "T.npz")]) == 0
        assert capsys.readouterr().out.rstrip().endswith(judged.text)
