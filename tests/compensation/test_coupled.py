# SPDX-License-Identifier: BSD-3-Clause
"""Transports whose colours mix, against the explicit matrix of all colours in float64."""

from __future__ import annotations

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
    [CHANNELS[c] * (1.0 if c == d else 0.1 + 0.05 * d) + 0.01 * random.random((N, N)) for d in range(3)]
    for c in range(3)
]
FORMS = {
    "array": np.asarray,
    "stack": np.asarray,
    "csr": scipy.sparse.csr_array,
    "operator": aslinearoperator,
}
WHOLE = {
    "mixing": scipy.linalg.block_diag(*CHANNELS) @ np.kron(M, np.eye(N)),
    "blocks": np.block(BLOCKS),
}


def transport(kind: str, device, form: str = "array") -> ltcl.Transport:
    make = FORMS[form]
    if kind == "mixing":
        F = None if form != "operator" else np.stack([np.diag(T) for T in CHANNELS])
        first = "diagonal" if F is None else F
        return ltcl.Transport([make(T) for T in CHANNELS], GRID, first, mixing=M, device=device)
    blocks = np.array(BLOCKS) if form == "stack" else [[make(T) for T in row] for row in BLOCKS]
    return ltcl.Transport(blocks, GRID, device=device)


def picture(kind: str, pattern: np.ndarray) -> np.ndarray:
    """T pattern for patterns (..., h, w, 3)."""
    flat = pattern.reshape(-1, N, 3).transpose(0, 2, 1).reshape(-1, 3 * N)
    return (flat @ WHOLE[kind].T).reshape(-1, 3, N).transpose(0, 2, 1).reshape(pattern.shape)


@pytest.mark.parametrize("kind", WHOLE)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("frames", [(), (2,)])
def test_relighting_mixes_colours(device, kind, form, frames):
    T = transport(kind, device, form)
    pattern = random.uniform(0, 1, (*frames, *GRID, 3))
    np.testing.assert_allclose(T @ pattern, picture(kind, pattern), rtol=1e-5)
    assert T.channels == 3
    assert T.couples


@pytest.mark.parametrize("kind", WHOLE)
@pytest.mark.parametrize("frames", [(), (2,)])
def test_a_pattern_within_reach_is_found_again(device, kind, frames):
    T = transport(kind, device)
    pattern = random.uniform(0.2, 0.8, (*frames, *GRID, 3))
    c = ltcl.compensate(T, picture(kind, pattern), rtol=1e-5)
    np.testing.assert_allclose(c.pattern, pattern, atol=2e-3)
    assert c.clipped == 0.0
    assert c.error < 1e-4
    if kind == "mixing":
        assert c.limited == ()
        assert isinstance(c.solution, tuple)


@pytest.mark.parametrize("kind", WHOLE)
@pytest.mark.parametrize("weighted", [False, True])
def test_within_bounds_the_colours_share_what_is_missing(device, kind, weighted):
    T = transport(kind, device)
    desired = picture(kind, random.uniform(-0.5, 1.5, (2, *GRID, 3)))
    background = random.uniform(0, 0.1, (*GRID, 3))
    weights = random.uniform(0.2, 1, (*GRID, 3)) if weighted else np.ones((*GRID, 3))
    c = ltcl.compensate(
        T, desired, background=background, weights=weights if weighted else None, rtol=1e-4, gain=1.1
    )
    w = weights.reshape(N, 3).T.ravel()
    for frame, found in zip(desired, c.appearance, strict=True):
        target = (1.1 * frame - background).reshape(N, 3).T.ravel()
        cost = lsq_linear(w[:, None] * WHOLE[kind], w * target, (0, 1), tol=1e-14).cost
        left = w * ((found - background).reshape(N, 3).T.ravel() - target)
        assert np.linalg.norm(left) == pytest.approx(
            np.sqrt(2 * cost), abs=float(2e-4 * np.linalg.norm(w * target))
        )
    assert 0.0 < c.clipped < 1.0
    assert len(c.limited) == 1


@pytest.mark.parametrize("kind", WHOLE)
def test_the_largest_gain(device, kind):
    T = transport(kind, device)
    pattern = random.uniform(0.2, 0.8, (*GRID, 3))
    exact = ltcl.compensate(T, picture(kind, pattern), gain="auto", method="auto", rtol=1e-4)
    if kind == "mixing":
        assert exact.gain == pytest.approx(1 / pattern.max(), rel=1e-3)
        assert exact.limited == ()
    more = ltcl.compensate(T, picture(kind, pattern), gain="auto", loss=0.03)
    assert more.gain > 1 / pattern.max()
    assert 0.028 < more.error <= 0.03 * (1 + 1e-4)


def test_a_masked_pixel_is_dark_in_all_colours(device):
    matrices = [T.copy() for T in CHANNELS]
    matrices[1][5, 5] = 0.0
    T = ltcl.Transport(matrices, GRID, mixing=M, device=device, on_dark="mask")
    pattern = random.uniform(0.2, 0.8, (N, 3))
    pattern[5] = 0.0
    whole = scipy.linalg.block_diag(*matrices) @ np.kron(M, np.eye(N))
    desired = (whole @ pattern.T.ravel()).reshape(3, N).T
    np.testing.assert_allclose((T @ pattern.reshape(*GRID, 3)).reshape(N, 3), desired, rtol=1e-5)
    c = ltcl.compensate(T, desired.reshape(*GRID, 3), rtol=1e-5)
    np.testing.assert_allclose(c.pattern.reshape(N, 3), pattern, atol=1e-3)
    bright = ltcl.compensate(T, 2 * desired.reshape(*GRID, 3))
    assert not bright.pattern.reshape(N, 3)[5].any()


def test_rectangular_channels_mix_too(device):
    matrices = [random.uniform(0, 1, (20, N)) for _ in range(3)]
    whole = scipy.linalg.block_diag(*matrices) @ np.kron(M, np.eye(N))
    T = ltcl.Transport(matrices, GRID, camera_grid=(4, 5), mixing=M, device=device)
    target = 1.2 * whole @ random.uniform(0, 1, 3 * N)
    c = ltcl.compensate(T, target.reshape(3, 20).T.reshape(4, 5, 3), rtol=1e-4)
    cost = lsq_linear(whole, target, (0, 1), tol=1e-14).cost
    left = whole @ c.pattern.reshape(N, 3).T.ravel() - target
    assert np.linalg.norm(left) == pytest.approx(np.sqrt(2 * cost), abs=float(2e-4 * np.linalg.norm(target)))


def test_blocks_have_no_S_of_one_colour(device):
    T = transport("blocks", device)
    for refuse in (
        lambda: T.first_bounce,
        lambda: T.interreflection,
        lambda: ltcl.separate(T, np.ones((*GRID, 3))),
        lambda: ltcl.analyze(T),
    ):
        with pytest.raises(InputError, match=r"T .*blocks"):
            refuse()


SINGULAR = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]])
BAD = [
    ({"matrix": CHANNELS, "mixing": SINGULAR}, "mixing has the condition number .*"),
    ({"matrix": CHANNELS, "mixing": np.zeros((3, 3))}, "mixing has the condition number inf"),
    ({"matrix": CHANNELS, "mixing": np.eye(2)}, r"mixing has shape \(2, 2\); it must be \(3, 3\)"),
    ({"matrix": CHANNELS, "mixing": np.full((3, 3), np.nan)}, "mixing has 9 NaN"),
    ({"matrix": CHANNELS[0], "mixing": M}, "mixing .* one channel"),
    ({"matrix": BLOCKS, "mixing": M}, "mixing .* 3 x 3 blocks"),
    ({"matrix": BLOCKS, "first_bounce": np.ones(N)}, "first_bounce .* of 3 x 3 blocks"),
    ({"matrix": BLOCKS[:2]}, r"matrix has rows of \[3, 3\] matrices; it must be 3 x 3"),
    ({"matrix": [BLOCKS[0], BLOCKS[1], BLOCKS[2][:2]]}, r"matrix has rows of \[3, 3, 2\] matrices"),
    ({"matrix": [BLOCKS[0], BLOCKS[1], CHANNELS[2]]}, "matrix has rows of"),
    (
        {"matrix": [*BLOCKS[:2], [CHANNELS[0], CHANNELS[1], np.ones((N, 5))]]},
        r"matrix has .*\[\(12, 5\), \(12, 12\)\]",
    ),
    (
        {"matrix": [*BLOCKS[:2], [CHANNELS[0], CHANNELS[1], CHANNELS[2] * np.nan]]},
        r"matrix\[2\]\[2\] has 144 NaN",
    ),
]


@pytest.mark.parametrize(("arguments", "says"), BAD)
def test_bad_couplings_are_refused(arguments, says):
    with pytest.raises(InputError, match=says) as caught:
        ltcl.Transport(grid=GRID, **arguments)
    assert "\n" not in str(caught.value)
