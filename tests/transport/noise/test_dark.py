# SPDX-License-Identifier: BSD-3-Clause
"""Pixels whose first bounce is noise or 0: masked or refused, reported, shown."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse

import ltcl
from ltcl.errors import InputError
from ltcl.images import read, write
from ltcl.transport.noise import Noise
from tests.cli.conftest import program  # noqa: F401

pytestmark = pytest.mark.slow

random = np.random.default_rng()
n = 32
GRID = (n, n)
LEVEL = 2e-4  # of the noise, times the median first bounce
Y, X = np.mgrid[:n, :n] / n
DESIRED = {
    "grey": np.full(GRID, 0.5),
    "gradient": 0.3 + 0.5 * X * Y,
    "bump": 0.3 + 0.3 * np.exp(-9 * X**2),
}


@pytest.fixture(autouse=True)
def _seed(request: pytest.FixtureRequest) -> None:
    seeded = np.random.default_rng([*request.node.name.encode()])
    random.bit_generator.state = seeded.bit_generator.state


class Corner(NamedTuple):
    """White walls of 32 x 16 pixels each, and what is measured of them where pixels are `dark`."""

    true: np.ndarray  # T without these pixels
    scene: np.ndarray  # with them, without noise
    measured: np.ndarray
    dark: np.ndarray  # (13,), ascending


@cache
def corner() -> Corner:
    """Albedo 0.85, direct light of 81.8 %; 12 pixels have 1e-6 of their light, one has none."""
    rng = np.random.default_rng(1)
    N = n * n
    G = np.asarray(ltcl.scenes.dihedral(n).form_factors)
    pairs = G.reshape(n, n, 2, n, n, 2).sum(axis=5).mean(axis=2).reshape(N, N)
    true = 0.85 * np.linalg.inv(np.eye(N) - 0.85 * pairs)
    pixels = rng.choice(N, 13, replace=False)
    light = np.where(np.isin(np.arange(N), pixels[1:]), 1e-6, 1.0)
    scene = light[:, None] * true * light * (np.arange(N) != pixels[0])
    noise = LEVEL * np.median(np.diag(true)) * rng.standard_normal((N, N))
    measured = (scene + noise * (np.arange(N) != pixels[0])).astype(np.float32)
    return Corner(true, scene, measured, np.sort(pixels))


@pytest.mark.slow
@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
@pytest.mark.parametrize("first_bounce", ["diagonal", "exact", "estimate", "given"])
def test_they_are_masked_with_one_warning_or_refused(caplog, form, first_bounce) -> None:
    case = corner()
    F: Any = np.full(n * n, 0.85) if first_bounce == "given" else first_bounce
    T = ltcl.Transport(form(case.measured), GRID, F)
    assert [record.message for record in caplog.records] == [f"{T.dark_note}; they stay unlit"]
    np.testing.assert_array_equal(np.flatnonzero(T.masked), case.dark)
    np.testing.assert_allclose(T.first_bounce[~T.masked], 0.85, rtol=0.04)
    with pytest.raises(InputError, match=r"13 of 1024 pixels.*on_dark='mask'"):
        ltcl.Transport(form(case.measured), GRID, F, on_dark="raise")


@pytest.mark.slow
def test_direct_light_is_right() -> None:
    """Against the albedo, of the light of the photograph of the scene as it is."""
    case = corner()
    image = case.scene.sum(axis=1).reshape(GRID)
    share = ltcl.separate(ltcl.Transport(case.measured, GRID), image).direct.sum() / image.sum()
    assert share == pytest.approx(0.85 * n * n / case.true.sum(), rel=0.005)
    assert share == pytest.approx(0.818, abs=0.005)


@pytest.mark.parametrize("picture", DESIRED)
def test_gain_is_that_without_these_pixels(picture) -> None:
    case = corner()
    desired = DESIRED[picture]
    best = ltcl.compensate(ltcl.Transport(case.true, GRID), desired, gain="auto").gain
    c: Any = ltcl.compensate(ltcl.Transport(case.measured, GRID), desired, gain="auto")
    assert c.gain == pytest.approx(best, rel=0.02)
    assert c.solution.products + sum(each.products for each in c.limited) < 60
    around = scipy.ndimage.median_filter(c.pattern, 3)
    is_saturated = c.pattern > 0.99
    # No pixel is saturated alone.
    assert np.all(c.pattern[is_saturated] < 1.1 * around[is_saturated])
    missing = np.delete(case.scene @ c.pattern.ravel() - c.target.ravel(), case.dark)
    assert np.linalg.norm(missing) < 0.015 * np.linalg.norm(c.target)


@pytest.mark.rare
def test_the_command_line_does_the_same_and_shows_them(program, tmp_path: Path) -> None:  # noqa: F811
    case = corner()
    grey = tmp_path / "grey.exr"
    white = tmp_path / "white.exr"
    path = tmp_path / "T.npz"
    np.savez(path, T=case.measured, grid=GRID)
    write(grey, DESIRED["grey"].astype(np.float32))
    write(white, case.scene.sum(axis=1).reshape(GRID).astype(np.float32))
    separated = program("separate", path, white, "--out", tmp_path / "b", "--json")
    (picture,) = separated.json["pictures"]
    assert picture["parts"][0]["share"] == pytest.approx(0.818, abs=0.005)
    assert separated.err.count("13 of 1024 pixels") == 1
    common = "compensate", path, grey, "--gain", "auto", "--out", tmp_path / "c"
    (picture,) = program(*common, "--dark", "0.01", "--json").json["pictures"]
    best = ltcl.compensate(ltcl.Transport(case.true, GRID), DESIRED["grey"], gain="auto").gain
    assert picture["gain"] == pytest.approx(best, rel=0.02)
    assert "13 camera pixels" in program(*common).out
    program(*common, "--on-dark", "raise").assert_refused("T.npz", "13 of 1024 pixels")
    for command in ("info", "analyze"):
        (facts,) = program(command, path, "--show-dark", tmp_path / "dark.png", "--json").json
        assert facts["dark_pixels" if command == "info" else "masked"] == 13
        # A pixel of each square.
        shown = read(tmp_path / "dark.png")[-8 - 512 : -8 : 16, 8 : 8 + 512 : 16]
        orange = (shown[..., 0] > 2 * shown[..., 2]).ravel()
        np.testing.assert_array_equal(np.flatnonzero(orange), case.dark)


# Dark pixels.

SMALL = ltcl.scenes.dihedral(4, albedo=[[0.6], [0.3]])
T32 = SMALL.matrices()[0]
SOME = np.arange(32) % 7 == 3
DIM = np.where(SOME, 0.01, 1.0)
SIGMA = Noise.uniform((32, 32), 0.02)
QUIET = Noise.uniform((32, 32), 0.0)


@pytest.mark.parametrize(
    ("matrix", "options", "dark"),
    [
        (T32 * DIM, {}, False),  # dim, without noise
        (T32 * DIM**2, {"noise": QUIET}, False),
        (T32 * DIM**4, {"noise": QUIET}, True),  # of which no camera and no float32 sees anything
        (T32 * DIM**4, {"noise": QUIET, "dark_threshold": 0.0}, False),
        (np.linalg.inv(np.diag(1 / (0.6 * DIM)) - SMALL.form_factors), {}, False),  # dark paint
        (T32 * DIM, {"dark_threshold": 0.05}, True),
        (T32 * DIM, {"noise": SIGMA}, True),
        (T32 * DIM**0.5, {"noise": SIGMA}, True),
        (T32 * ~SOME, {}, True),
        (T32 * ~SOME[:, None], {}, True),
        (T32 * ~SOME, {"first_bounce": SMALL.first_bounce}, True),
    ],
)
def test_what_is_dark(matrix, options, dark) -> None:
    np.testing.assert_array_equal(ltcl.Transport(matrix, (4, 8), **options).masked, SOME & dark)


@pytest.mark.parametrize(("options", "gain"), [({}, 1.0), ({"dark_threshold": 0.0}, 1e-12)])
def test_pixels_without_light_do_not_decide_the_gain(options, gain) -> None:
    """Projector pixels with 1e-12 of the others' light, and noise as small."""
    desired = np.full((4, 8), 0.5)
    without = ltcl.Transport(T32 * ~SOME, (4, 8))
    best = ltcl.compensate(without, desired, gain="auto").gain
    T = ltcl.Transport(T32 * np.where(SOME, 1e-12, 1.0), (4, 8), noise=QUIET, **options)
    assert ltcl.compensate(T, desired, gain="auto").gain == pytest.approx(gain * best, rel=0.1)


def test_noise_is_not_estimated_without_need(monkeypatch) -> None:
    monkeypatch.setattr("ltcl.transport.transport.estimate", None)
    ltcl.Transport(T32 * ~SOME, (4, 8))
    with pytest.raises(TypeError, match="NoneType"):
        ltcl.Transport(T32 * DIM, (4, 8))


@pytest.mark.parametrize("share", [0.5, 0.8, 0.98])
def test_most_pixels_may_be_dark_with_noise(share) -> None:
    scene = ltcl.scenes.dihedral(8)
    lit = random.permutation(128) >= share * 128
    noise = 7e-4 * random.standard_normal((128, 128))
    T = ltcl.Transport(scene.matrices()[0] * lit + noise, scene.grid)
    np.testing.assert_array_equal(T.masked, ~lit)
    with pytest.raises(InputError, match=r"noise.*every pixel|every pixel.*noise"):
        ltcl.Transport(noise, scene.grid)


# Impossible separations.


# Pixel 1 shows twice the light of pixel 0.
BRIGHTER = [[1, 0], [2, 1]]


@pytest.mark.parametrize(
    ("T", "image", "says"),
    [
        (
            ltcl.Transport(T32, (4, 8), 3 * SMALL.first_bounce),
            T32.sum(axis=1),
            r"2\d\d% of .*: \(\d, \d\)",
        ),
        (ltcl.Transport(BRIGHTER, (1, 2)), np.array([1.0, 0.0]), r"-100% of .*: \(0, 1\)"),
        (
            ltcl.Transport([np.eye(2), BRIGHTER, np.eye(2)], (1, 2)),
            np.eye(2, 3, 1),
            r"-100% of .*: \(0, 1\)",
        ),
    ],
)
def test_an_impossible_separation_is_refused(T, image, says) -> None:
    with pytest.raises(InputError, match=says):
        ltcl.separate(T, image.reshape(*T.grid, *image.shape[1:]))


@pytest.mark.parametrize("level", [1e-3, 1e-2])
def test_noise_alone_is_not_refused(level) -> None:
    """A wall without interreflection has direct light alone, a little more or less by noise."""
    T = ltcl.Transport(np.eye(64) + level * random.standard_normal((64, 64)), (8, 8))
    images = random.uniform(0.5, 1.0, (20, 8, 8)) + level * random.standard_normal((20, 8, 8))
    shares = ltcl.separate(T, images).direct.sum(axis=(1, 2)) / images.sum(axis=(1, 2))
    np.testing.assert_allclose(shares, 1.0, atol=40 * level)
