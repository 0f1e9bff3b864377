# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports: every task with them, and with the exact one beside."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl import checks
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators import CSR, Compressed, IdentityPlus, ScaledColumns, Wavelet
from tests.bases import stands_for, two_sided
from tests.problems import enclosure

GRID = (6, 7)
N = 42
SCENES = [enclosure(N, albedo, seed) for seed, albedo in enumerate((0.3, 0.4, 0.5))]
F = np.random.default_rng(1).uniform(0.3, 0.5, (3, N))
rng = np.random.default_rng(2)


def bound(S, exact_S):
    return float(np.linalg.norm(np.linalg.inv(S), 2) * np.linalg.norm(S - exact_S, 2))


def one_channel(device, channel=1, keep=0.5, f=None):
    """A channel S F, the float64 S that it stands for, and the exact one."""
    R = two_sided(device, SCENES[channel].R, keep, seed=channel)
    S = np.eye(N) + stands_for(R)
    true = np.eye(N) + SCENES[channel].R
    f = F[channel] if f is None else f
    return ScaledColumns(IdentityPlus(R, solution_error=bound(S, true)), f), S, true


def pair(device, channels=(1,), keep=0.5):
    """A compressed transport, grey or in colour, and the exact one."""
    matrices, _, true = zip(
        *(one_channel(device, channel, keep) for channel in channels), strict=True
    )
    f = F[1] if channels == (1,) else F
    exact = [S * F[channel] for S, channel in zip(true, channels, strict=True)]
    return ltcl.Transport(matrices, GRID, f), ltcl.Transport(exact, GRID, f, device=device)


def test_another_first_bounce_makes_another_S(device):
    """T = S F = S' F': the same picture, S' = S F / F', and a bound that F / F' widens."""
    matrix, S, true = one_channel(device)
    other = F[1] * rng.uniform(0.8, 1.25, N)
    T = ltcl.Transport(matrix, GRID, first_bounce=other)
    found = T.systems[0]
    assert isinstance(found.R, ScaledColumns)
    np.testing.assert_allclose(found.to_dense(), S * F[1] / other, atol=1e-5)
    ratio = F[1] / other
    assert T.error == pytest.approx(matrix.A.solution_error * ratio.max() / ratio.min())
    b = rng.normal(size=(N, 20))
    x = np.linalg.solve(true * ratio, b)
    off = np.linalg.solve(S * ratio, b)
    assert np.all(np.linalg.norm(off - x, axis=0) <= T.error * np.linalg.norm(x, axis=0))


def test_masked_pixels_stay_dark(device):
    f = np.where(np.arange(N) % 5 == 0, 0.0, F[1])
    matrix, _, _ = one_channel(device, f=f)
    with pytest.raises(InputError, match="on_dark"):
        ltcl.Transport(matrix, GRID, first_bounce=f, on_dark="raise")
    T = ltcl.Transport(matrix, GRID, first_bounce=f, on_dark="mask")
    assert T.systems == (matrix.A,)
    found = ltcl.compensate(T, T @ np.full(GRID, 0.5), rtol=T.error)
    assert not found.pattern.ravel()[T.masked].any()
    np.testing.assert_allclose(found.pattern.ravel()[~T.masked], 0.5, atol=0.05)


@pytest.mark.parametrize("task", [ltcl.compensate, ltcl.separate])
def test_results_tell_of_which_T_they_are(device, task):
    """A target met with T~ is missed with T by at most T~.error: ||E S~^-1|| is below it."""
    C, T = pair(device)
    desired = T @ rng.uniform(0.3, 0.7, GRID)
    with pytest.raises(InputError, match=r"rtol is 1e-06.* 0\.\d+.*exact=T"):
        task(C, desired, rtol=1e-6)
    alone = task(C, desired, rtol=C.error)
    assert alone.transport_error == C.error
    assert checks.upwards(C.error) in repr(alone)
    assert task(C, desired, exact=T).transport_error == 0.0
    if task is ltcl.compensate:
        missed = np.linalg.norm(T @ alone.pattern - alone.appearance) / np.linalg.norm(
            alone.appearance
        )
        assert 0.0 < missed <= C.error


@pytest.mark.parametrize("channels", [(1,), (0, 1, 2)])
@pytest.mark.parametrize(("rtol", "close"), [(1e-5, 1e-4), (1e-7, 1e-6), (1e-10, 1e-6)])
def test_tasks_beside_the_exact_one(device, channels, rtol, close):
    """Below float32, too: solutions of T itself by a factorization, before a picture is rounded."""
    C, T = pair(device, channels)
    desired = T @ rng.uniform(0.2, 0.8, GRID)  # within the bounds
    ours = ltcl.compensate(C, desired, exact=T, rtol=rtol)
    theirs = ltcl.compensate(T, desired, method="direct")
    # Rtol is of the norm.
    np.testing.assert_allclose(ours.pattern, theirs.pattern, rtol=0, atol=close)
    image = T @ rng.uniform(0.2, 0.8, GRID)
    ours = ltcl.separate(C, image, 2, exact=T, rtol=rtol)
    theirs = ltcl.separate(T, image, 2, method="direct")
    np.testing.assert_allclose(ours.direct, theirs.direct, rtol=max(close, 1e-5))
    np.testing.assert_allclose(ours.bounces, theirs.bounces, atol=max(close, 1e-5))
    assert ours.reciprocity_defect == theirs.reciprocity_defect < 1e-6
    for s in (s for each in ours.solutions for s in (each if isinstance(each, tuple) else (each,))):
        assert s.converged
        assert s.residual <= rtol


def test_beyond_the_projector(device):
    """Least squares within bounds take products with the transpose, compressed or exact."""
    C, T = pair(device)
    desired = rng.uniform(0.0, 3.0, GRID)
    alone = ltcl.compensate(C, desired, rtol=C.error)
    matrix = C.operators[0].to_dense()
    assert alone.clipped > 0.0
    missed = np.linalg.norm(desired.ravel() - matrix @ alone.pattern.ravel()) / np.linalg.norm(
        desired
    )
    assert alone.error == pytest.approx(missed, rel=1e-3)
    assert alone.gap <= C.error
    ours = ltcl.compensate(C, desired, exact=T, rtol=1e-4)
    theirs = ltcl.compensate(T, desired, rtol=1e-4)
    assert ours.error == pytest.approx(theirs.error, abs=2e-4)


def test_what_does_not_lie_beside(device, small_device):
    C, T = pair(device)
    rgb = pair(device, (0, 1, 2))[1]
    matrix = T.matrices[0]
    wrong: list[tuple[Any, type[LtclError], str]] = [
        (matrix, InputTypeError, "exact is a ndarray"),
        (T.interreflection, InputTypeError, "exact is a IdentityPlus"),
        (rgb, InputError, "exact has channels 3.* 1"),
        (ltcl.Transport(matrix, (7, 6)), InputError, r"exact has grid \(7, 6\).*\(6, 7\)"),
        (ltcl.Transport(matrix, GRID, first_bounce=2 * F[1]), InputError, "exact.*first bounce"),
        (ltcl.Transport(matrix[:12], GRID, camera_grid=(3, 4)), InputError, "one grid"),
        (
            ltcl.Transport(matrix, GRID, first_bounce=F[1], device=small_device),
            InputError,
            "device",
        ),
    ]
    for exact, kind, says in wrong:
        for task in (ltcl.compensate, ltcl.separate):
            with pytest.raises(kind, match=says):
                task(C, np.ones(GRID), exact=exact)
    mixed = ltcl.Transport(rgb.matrices, GRID, first_bounce=F, mixing=np.eye(3) + 0.1)
    with pytest.raises(InputError, match=r"exact.*mixes"):
        ltcl.compensate(rgb, np.ones((*GRID, 3)), exact=mixed)
    with pytest.raises(InputTypeError, match="monte_carlo"):
        ltcl.separate(C, np.ones(GRID), method="monte_carlo", exact=T)


def test_analysis_by_products(device):
    """Results that need entries are unknown; others are those of the exact T, up to its errors."""
    ours, theirs = (ltcl.analyze(one).channels[0] for one in pair(device, keep=0.999))
    assert np.isnan(
        [ours.norm_inf, ours.energy.negative_entries, ours.products["gauss_seidel"]]
    ).all()
    for name in ("spectral_radius", "negative_bounce", "reciprocity_defect"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), abs=1e-2)
    for name in ("bounce_highest", "albedo_from_columns"):
        assert getattr(ours.energy, name) == pytest.approx(getattr(theirs.energy, name), abs=1e-2)
    assert ours.products["jacobi"] == pytest.approx(theirs.products["jacobi"], abs=1)


def test_tasks_accept_a_T_without_any_bound(device):
    """An infinite bound tells nothing of solutions, so that only exact= helps; others go on."""
    R = two_sided(device, SCENES[1].R, 0.5)
    C = ltcl.Transport(
        ScaledColumns(IdentityPlus(R, solution_error=np.inf), F[1]), GRID, first_bounce=F[1]
    )
    T = pair(device)[1]
    with pytest.raises(InputError, match="inf"):
        ltcl.compensate(C, np.ones(GRID))
    assert ltcl.compensate(C, T @ np.full(GRID, 0.5), exact=T, rtol=1e-5).error < 1e-4
    assert ltcl.analyze(C).channels[0].negative_bounce < 0.01


def test_what_was_dropped_is_not_taken_for_gloss(device):
    """Walls that share no light share some of either sign once coefficients are dropped."""
    scene = ltcl.scenes.dihedral(12, albedo=0.6)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    W = Wavelet(device, T.grid, "db2")
    R = T.systems[0].to_dense() - np.eye(T.shape[0])
    core = W.to_dense() @ R @ W.to_dense().T
    core = CSR(device, scipy.sparse.csr_array(np.where(np.abs(core) < 1e-3, 0.0, core)))
    compressed = Compressed(core, W, W)
    S = np.eye(len(R)) + compressed.to_dense()
    F = T.first_bounce
    matrix = ScaledColumns(IdentityPlus(compressed, solution_error=bound(S, np.eye(len(R)) + R)), F)
    C = ltcl.Transport(matrix, T.grid, first_bounce=F)
    found = ltcl.separate(C, T @ np.ones(T.grid), 1, rtol=0.1)
    assert found.negative_bounce > 0.005
    assert "section 8.4" not in found.warning
