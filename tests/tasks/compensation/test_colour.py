# SPDX-License-Identifier: BSD-3-Clause
"""Transports in colour, mixed and not, against the explicit matrix of all colours in float64."""

from __future__ import annotations

from operator import attrgetter

import numpy as np
import pytest
import scipy.sparse
from scipy.optimize import lsq_linear
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.errors import InputError
from tests.problems import lambertian

GRID = (3, 4)
N = 12
M = np.array([[0.9, 0.15, 0.0], [0.1, 0.8, 0.1], [0.0, 0.2, 0.7]])
CHANNELS = [lambertian(N, rho, seed=90 + c).T for c, rho in enumerate((0.5, 1.0, 2.0))]
random = np.random.default_rng(91)
BLOCKS = [
    [
        CHANNELS[c] * (1.0 if c == d else 0.1 + 0.05 * d) + 0.01 * random.random((N, N))
        for d in range(3)
    ]
    for c in range(3)
]
FORMS = {"array": np.asarray, "csr": scipy.sparse.csr_array, "operator": aslinearoperator}
TALL = [random.uniform(0, 1, (20, N)) for _ in range(3)]
DARK = [T * (np.arange(N) != 5) if c == 1 else T for c, T in enumerate(CHANNELS)]
MATRICES = {"mixing": CHANNELS, "rectangular": TALL, "masked": DARK}
APART = {"colour": CHANNELS, "grey": CHANNELS[:1] * 3, "colour, masked": DARK}
WHOLE = {  # of all colours, (3 M, 3 N)
    "blocks": np.block(BLOCKS),
    **{
        kind: scipy.linalg.block_diag(*matrices) @ np.kron(M, np.eye(N))
        for kind, matrices in MATRICES.items()
    },
    **{kind: scipy.linalg.block_diag(*matrices) for kind, matrices in APART.items()},
}


def transport(kind: str, device, form: str = "array") -> ltcl.Transport:
    make = FORMS.get(form, np.asarray)
    if kind == "blocks":
        blocks = np.array(BLOCKS) if form == "stack" else [[make(T) for T in row] for row in BLOCKS]
        return ltcl.Transport(blocks, GRID, device=device)
    if kind == "grey":
        return ltcl.Transport(CHANNELS[0], GRID, device=device)
    F = "diagonal" if form != "operator" else np.stack([np.diag(T) for T in CHANNELS])
    options = {"mixing": None if kind in APART else M, "device": device, "on_dark": "mask"}
    camera = (4, 5) if kind == "rectangular" else GRID
    return ltcl.Transport(
        [make(T) for T in (MATRICES | APART)[kind]], GRID, F, camera_grid=camera, **options
    )


def picture(kind: str, pattern: np.ndarray) -> np.ndarray:
    """T pattern for patterns (..., h, w, 3)."""
    flat = pattern.reshape(-1, N, 3).transpose(0, 2, 1).reshape(-1, 3 * N)
    camera = (4, 5) if kind == "rectangular" else GRID
    colours = (flat @ WHOLE[kind].T).reshape(len(flat), 3, -1)
    return colours.swapaxes(1, 2).reshape(*pattern.shape[:-3], *camera, 3)


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
    """And a pixel that is masked in one colour stays dark in all."""
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
        assert not ltcl.compensate(T, 2 * desired).pattern[..., 1, 1, :].any()
    elif kind == "mixing":
        assert c.limited == ()
        assert isinstance(c.solution, tuple)


@pytest.mark.parametrize("kind", ["mixing", "blocks", "rectangular", "colour", "grey"])
@pytest.mark.parametrize("weighted", [False, True])
def test_within_bounds_the_colours_share_what_is_missing(device, kind, weighted):
    T = transport(kind, device)
    desired = picture(kind, random.uniform(-0.5, 1.5, (2, *GRID, 3)))
    background = random.uniform(0, 0.1, desired.shape[1:])
    weights = random.uniform(0.2, 1, background.shape) if weighted else np.ones(background.shape)
    c = ltcl.compensate(
        T,
        desired,
        background=background,
        weights=weights if weighted else None,
        rtol=1e-4,
        gain=1.1,
    )
    w = weights.reshape(-1, 3).T.ravel()
    for frame, found in zip(desired, c.appearance, strict=True):
        target = (1.1 * frame - background).reshape(-1, 3).T.ravel()
        cost = lsq_linear(w[:, None] * WHOLE[kind], w * target, (0, 1), tol=1e-14).cost
        left = np.linalg.norm(w * ((found - background).reshape(-1, 3).T.ravel() - target))
        assert left == pytest.approx(
            np.sqrt(2 * cost), abs=float(2e-4 * np.linalg.norm(w * target))
        )
    assert 0.0 < c.clipped < 1.0
    assert len(c.limited) == (3 if kind == "colour" else 1)


@pytest.mark.parametrize("kind", ["mixing", "blocks", "masked", "colour, masked"])
def test_the_largest_gain(device, kind):
    """One for all colours; a masked pixel, which shines at none, does not limit it."""
    T = transport(kind, device)
    pattern = random.uniform(0.2, 0.8, (*GRID, 3))
    pattern[1, 1] *= "masked" not in kind
    desired = picture(kind, pattern)
    if "masked" in kind:
        desired[1, 1] = 9.0  # does not count
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


@pytest.mark.parametrize(
    "use", [attrgetter("first_bounce"), attrgetter("interreflection"), ltcl.analyze]
)
def test_blocks_have_no_S_of_one_colour(device, use):
    T = transport("blocks", device)
    with pytest.raises(InputError, match=r"T .*blocks"):
        use(T)
    with pytest.raises(InputError, match=r"T .*blocks"):
        ltcl.separate(T, np.ones((*GRID, 3)))
