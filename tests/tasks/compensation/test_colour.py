# SPDX-License-Identifier: BSD-3-Clause
"""Transports in colour, mixed and not, against the explicit matrix of all colours in float64."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.errors import InputError
from tests.problems import lambertian

GRID = (3, 4)
N = 12
RADII = (0.5, 1.0, 2.0)
M = np.array([[0.9, 0.15, 0.0], [0.1, 0.8, 0.1], [0.0, 0.2, 0.7]])
FORMS = {"array": np.asarray, "csr": scipy.sparse.csr_array, "operator": aslinearoperator}

random = np.random.default_rng(91)
CHANNELS = [lambertian(N, rho, seed=90 + c).T for c, rho in enumerate(RADII)]
TALL = [random.uniform(0, 1, (20, N)) for _ in range(3)]
# Pixel 5 is dark in green.
DARK = [CHANNELS[0], CHANNELS[1] * (np.arange(N) != 5), CHANNELS[2]]
GREY = [CHANNELS[0]] * 3


def coupled_blocks() -> list[list[np.ndarray]]:
    """3 x 3 matrices, the largest of them on the diagonal."""
    blocks = []
    for c, matrix in enumerate(CHANNELS):
        row = []
        for d in range(3):
            share = 1.0 if c == d else 0.1 + 0.05 * d
            row.append(share * matrix + 0.01 * random.random((N, N)))
        blocks.append(row)
    return blocks


BLOCKS = coupled_blocks()
MIXED = {"mixing": CHANNELS, "rectangular": TALL, "masked": DARK}
APART = {"colour": CHANNELS, "grey": GREY, "colour, masked": DARK}


def whole_matrix(kind: str) -> np.ndarray:
    """T of all colours, (3 M, 3 N)."""
    if kind == "blocks":
        return np.block(BLOCKS)
    if kind in APART:
        return np.asarray(block_diag(*APART[kind]))
    return np.asarray(block_diag(*MIXED[kind])) @ np.kron(M, np.eye(N))


def transport(kind: str, device, form: str = "array") -> ltcl.Transport:
    make = FORMS.get(form, np.asarray)
    if kind == "blocks":
        blocks: Any = np.array(BLOCKS)
        if form != "stack":
            blocks = [[make(T) for T in row] for row in BLOCKS]
        return ltcl.Transport(blocks, GRID, device=device)
    if kind == "grey":
        return ltcl.Transport(CHANNELS[0], GRID, device=device)
    matrices = (MIXED | APART)[kind]
    first_bounce: Any = "diagonal"
    if form == "operator":
        first_bounce = np.stack([np.diag(T) for T in matrices])
    return ltcl.Transport(
        [make(T) for T in matrices],
        GRID,
        first_bounce,
        camera_grid=camera_grid(kind),
        mixing=None if kind in APART else M,
        device=device,
        on_dark="mask",
    )


def camera_grid(kind: str) -> tuple[int, int]:
    return (4, 5) if kind == "rectangular" else GRID


def flat_colours(picture: np.ndarray) -> np.ndarray:
    """Pictures (..., h, w, 3) as (frames, 3 N), colour after colour."""
    pixels = picture.shape[-3] * picture.shape[-2]
    return picture.reshape(-1, pixels, 3).transpose(0, 2, 1).reshape(-1, 3 * pixels)


def picture(kind: str, pattern: np.ndarray) -> np.ndarray:
    """T pattern of patterns (..., h, w, 3)."""
    frames = pattern.shape[:-3]
    colours = flat_colours(pattern) @ whole_matrix(kind).T
    colours = colours.reshape(len(colours), 3, -1).swapaxes(1, 2)
    return colours.reshape(*frames, *camera_grid(kind), 3)


@pytest.mark.parametrize("kind", ["mixing", "blocks"])
@pytest.mark.parametrize("form", [*FORMS, "stack"])
@pytest.mark.parametrize("frames", [(), (2,)])
def test_relighting_mixes_colours(device, kind, form, frames):
    T = transport(kind, device, form)
    pattern = random.uniform(0, 1, (*frames, *GRID, 3))
    np.testing.assert_allclose(T @ pattern, picture(kind, pattern), rtol=1e-5)
    assert T.channels == 3
    assert T.couples


@pytest.mark.parametrize("kind", ["mixing", "blocks", "masked"])
@pytest.mark.parametrize("frames", [(), (2,)])
def test_a_pattern_within_reach_is_found_again(device, kind, frames):
    """A pixel that is masked in one colour stays dark in all."""
    T = transport(kind, device)
    pattern = random.uniform(0.2, 0.8, (*frames, *GRID, 3))
    pattern[..., 1, 1, :] *= kind != "masked"
    desired = picture(kind, pattern)
    np.testing.assert_allclose(T @ pattern, desired, rtol=1e-5)
    c = ltcl.compensate(T, desired, rtol=1e-5)
    np.testing.assert_allclose(c.pattern, pattern, atol=2e-3)
    assert c.clipped == 0.0
    assert c.error < 1e-4
    if kind == "masked":
        bright = ltcl.compensate(T, 2 * desired)
        assert not bright.pattern[..., 1, 1, :].any()
    elif kind == "mixing":
        assert c.limited == ()
        assert isinstance(c.solution, tuple)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mixing", "blocks", "rectangular", "colour", "grey"])
@pytest.mark.parametrize("weighted", [False, True])
def test_within_bounds_the_colours_share_what_is_missing(device, kind, weighted):
    T = transport(kind, device)
    desired = picture(kind, random.uniform(-0.5, 1.5, (2, *GRID, 3)))
    background = random.uniform(0, 0.1, desired.shape[1:])
    weights = None
    w = np.ones(background.size)
    if weighted:
        weights = random.uniform(0.2, 1, background.shape)
        w = flat_colours(weights)[0]
    c = ltcl.compensate(T, desired, background=background, weights=weights, rtol=1e-4, gain=1.1)
    targets = flat_colours(1.1 * desired - background)
    found = flat_colours(c.appearance - background)
    matrix = w[:, None] * whole_matrix(kind)
    for target, light in zip(targets, found, strict=True):
        least = np.sqrt(2 * lsq_linear(matrix, w * target, (0, 1), tol=1e-14).cost)
        tolerance = 2e-4 * np.linalg.norm(w * target)
        assert np.linalg.norm(w * (light - target)) == pytest.approx(least, abs=float(tolerance))
    assert 0.0 < c.clipped < 1.0
    assert len(c.limited) == (3 if kind == "colour" else 1)


@pytest.mark.parametrize("kind", ["mixing", "blocks", "masked", "colour, masked"])
def test_the_largest_gain(device, kind):
    """The gain is one for all colours; a masked pixel, which shines at none, does not limit it."""
    T = transport(kind, device)
    pattern = random.uniform(0.2, 0.8, (*GRID, 3))
    pattern[1, 1] *= "masked" not in kind
    desired = picture(kind, pattern)
    if "masked" in kind:
        # Does not count.
        desired[1, 1] = 9.0
    exact = ltcl.compensate(T, desired, gain="auto", method="auto", rtol=1e-4)
    if kind != "blocks":
        assert exact.gain == pytest.approx(1 / pattern.max(), rel=1e-3)
        assert exact.limited == ()
        np.testing.assert_allclose(exact.pattern, exact.gain * pattern, atol=1e-3)
        assert not exact.out_of_reach.any()
        assert exact.error < 1e-3
    more = ltcl.compensate(T, desired, gain="auto", loss=0.03)
    assert more.gain > 1 / pattern.max()
    assert 0.028 < more.error <= 0.03 * (1 + 1e-4)


@pytest.mark.parametrize("use", [attrgetter("first_bounce"), attrgetter("interreflection")])
def test_blocks_have_no_S_of_one_colour(device, use):
    T = transport("blocks", device)
    with pytest.raises(InputError, match=r"T .*blocks"):
        use(T)
    with pytest.raises(InputError, match=r"T .*blocks"):
        ltcl.separate(T, np.ones((*GRID, 3)))
