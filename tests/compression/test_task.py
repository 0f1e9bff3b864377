# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports against dense solutions in float64, on scenes and random matrices."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl import checks
from ltcl.compression import window
from ltcl.errors import InputError
from ltcl.operators import Compressed, Dense, Tiles
from tests import gallery
from tests.compression.helpers import smooth

SCENES = {
    "dihedral": lambda: ltcl.scenes.dihedral(12, albedo=0.8).transport(),
    "open box": lambda: ltcl.scenes.box(8, sides=3, albedo=0.7).transport(),
    "closed box at the limit": lambda: ltcl.scenes.box(6, albedo=0.5).transport(),
    "closed box beyond it": lambda: ltcl.scenes.box(6, albedo=0.8).transport(),
    "colour": lambda: ltcl.scenes.dihedral(8, albedo=(0.8, 0.5, 0.2)).transport(),
    "sparse": lambda: ltcl.Transport(sparse(12, 15), (12, 15)),
    "no bounces": lambda: ltcl.Transport(np.eye(20), (4, 5)),
    "one pixel": lambda: ltcl.Transport([[2.0]], (1, 1), first_bounce=[1.5]),
}


def sparse(h: int, w: int) -> scipy.sparse.csr_array:
    """A few strong links between pixels, and F between 0.5 and 1."""
    n = h * w
    R = 0.3 * np.abs(gallery.sparse(n, n, 0.02).toarray())
    return scipy.sparse.csr_array((np.eye(n) + R) * np.random.default_rng(2).uniform(0.5, 1, n))


def dense_systems(T: ltcl.Transport) -> list[np.ndarray]:
    """S = T F^-1 of every channel in float64, by NumPy."""
    return [
        (matrix.toarray() if scipy.sparse.issparse(matrix) else np.asarray(matrix, np.float64)) / F
        for matrix, F in zip(T.matrices, np.atleast_2d(T.first_bounce), strict=True)
    ]


def tiles(C: ltcl.Transport) -> Tiles:
    """The core of its first channel."""
    R = C.systems[0].R
    assert isinstance(R, Compressed)
    assert isinstance(R.core, Tiles)
    return R.core


def worst_error(S: np.ndarray, found: np.ndarray) -> float:
    """The largest ||x~ - x|| / ||x|| over all right-hand sides: ||S~^-1 E||."""
    return float(np.linalg.norm(np.linalg.solve(found, found - S), 2))


@pytest.mark.parametrize("rtol", [0.1, 1e-2])
@pytest.mark.parametrize("scene", SCENES)
def test_solutions_are_within_the_bound_and_the_bound_within_the_tolerance(scene, rtol):
    T = SCENES[scene]()
    C = ltcl.compress(T, rtol)
    assert C.error <= rtol
    for S, compressed, told in zip(dense_systems(T), C.systems, C.compression.channels, strict=True):
        found = compressed.to_dense()
        error = float(np.linalg.norm(found - S, 2))
        assert worst_error(S, found) <= told.solution_error <= C.error
        assert told.error_estimate * (1 - 1e-3) - 1e-6 <= error <= told.error
        assert np.linalg.norm(np.linalg.inv(found), 2) <= told.inverse_norm
        assert compressed.solution_error == told.solution_error
        assert compressed.R.error == told.error


@settings(max_examples=12, deadline=None)
@given(
    basis=st.sampled_from(["db2", "haar", "db4 rows", "pixels", "sym4", "haar + pixels"]),
    h=st.integers(1, 12),
    w=st.integers(1, 12),
    rtol=st.sampled_from([0.3, 0.05, 3e-3]),
    noise=st.sampled_from([0.0, 1e-4, 1e-2]),
    strength=st.sampled_from([0.3, 3.0]),
    seed=st.integers(0, 999),
)
def test_the_bound_holds_for_random_matrices(basis, h, w, rtol, noise, strength, seed):
    n = h * w
    R = strength * smooth((h, w), seed) + noise * gallery.signed(n, n, seed)
    S = np.eye(n) + R
    T = ltcl.Transport(S, (h, w), first_bounce=np.ones(n))
    C = ltcl.compress(T, rtol, basis=basis)
    assert worst_error(S, C.systems[0].to_dense()) <= C.error <= rtol


def test_what_is_dropped_is_reported(device):
    T = ltcl.scenes.dihedral(12, albedo=0.8).transport(device=device)
    C = ltcl.compress(T, basis="db2")
    (told,) = C.compression.channels
    R = C.systems[0].R
    assert isinstance(R, Compressed)
    assert R.into is not None
    W, core = R.into.to_dense(), R.core.to_dense()
    wanted = W @ (dense_systems(T)[0] - np.eye(T.shape[0])) @ W.T
    kept = core != 0
    assert told.kept == pytest.approx(np.count_nonzero(kept) / T.shape[0], rel=1e-3)
    assert told.dropped == pytest.approx(np.linalg.norm(wanted[~kept]), rel=1e-3)
    assert told.quantisation == pytest.approx(np.linalg.norm((wanted - core)[kept]), rel=1e-2, abs=1e-6)
    assert np.abs(wanted[kept]).min() >= told.threshold * (1 - 1e-4)
    assert told.nbytes == R.core.nbytes
    assert told.confidence >= 1 - 3e-6


def test_solves_run_on_coefficients_and_refuse_what_is_not_in_them(device):
    T = ltcl.scenes.dihedral(12, albedo=0.8).transport(device=device)
    C = ltcl.compress(T, basis="db2")
    b = np.random.default_rng(5).random(T.shape[0])
    x = np.linalg.solve(dense_systems(T)[0], b)
    found = ltcl.solve(C.interreflection, b, "chebyshev", rtol=1e-2).x
    # The bound of the operator, and a residual of 1 % times ||S^-1|| ||S||.
    allowed = C.error + 1e-2 * np.linalg.cond(dense_systems(T)[0])
    assert np.linalg.norm(found - x) <= allowed * np.linalg.norm(x)
    with pytest.raises(InputError, match=r"rtol is 0\.0001; S is compressed"):
        ltcl.solve(C.interreflection, b, rtol=1e-4)
    refined = ltcl.solve(C.interreflection, b, rtol=1e-5, exact=T.interreflection).x
    assert np.linalg.norm(refined - x) <= 1e-4 * np.linalg.norm(x)


def test_a_path_traced_transport(shared_data, device):
    with np.load(shared_data / "transport-dihedral" / "transport.npz") as file:
        matrix, (h, w) = file["T"], file["grid"].tolist()
    with np.load(shared_data / "transport-dihedral" / "bounces.npz") as file:
        patterns = file["patterns"].reshape(len(file["patterns"]), -1).T
    T = ltcl.Transport(matrix, (h, w), device=device)
    C = ltcl.compress(T, 0.02, basis="db2")
    assert C.error <= 0.02
    S = matrix.astype(np.float64) / T.first_bounce
    b = S @ (T.first_bounce[:, None] * patterns)
    x = np.linalg.solve(S, b)
    found = ltcl.solve(C.interreflection, b, "direct", rtol=0.02).x
    errors = np.linalg.norm(found - x, axis=0) / np.linalg.norm(x, axis=0)
    assert np.all(errors <= C.error)
    assert C.compression.nbytes < 0.05 * 4 * matrix.size


@pytest.mark.parametrize("scene", ["dihedral", "colour"])
def test_a_budget_is_kept_or_refused_with_what_would_do(scene):
    T = SCENES[scene]()
    bases = ["db2", "haar"]
    free = ltcl.compress(T, 0.02, basis=bases).compression.nbytes
    with pytest.raises(InputError, match=r"budget is \d+ bytes, but rtol 0.02 needs \d+") as refused:
        ltcl.compress(T, 0.02, free // 4, basis=bases)
    found = re.search(r"needs (\d+) .*allows rtol ([\d.]+)", str(refused.value))
    assert found is not None
    enough = ltcl.compress(T, 0.02, int(found[1]), basis=bases)
    assert enough.error <= 0.02
    assert enough.compression.nbytes <= int(found[1])
    looser = ltcl.compress(T, float(found[2]), free // 4, basis=bases)
    assert looser.error <= float(found[2])
    assert looser.compression.nbytes <= free // 4


def test_a_budget_for_nothing_is_refused():
    with pytest.raises(InputError, match="no rtol below 1 fits into it"):
        ltcl.compress(SCENES["closed box beyond it"](), budget=8, basis="db2")


def test_rows_from_elsewhere_give_the_same_bits(tmp_path):
    T = ltcl.scenes.dihedral(8, albedo=0.8).transport()
    path = tmp_path / "T.npy"
    np.save(path, T.matrices[0])
    rows = np.load(path, mmap_mode="r")
    kept = ltcl.compress(T, 0.02, basis="db2")
    streamed = ltcl.compress(rows, 0.02, basis="db2", grid=T.grid, memory=32 * T.shape[0] * 16)
    assert streamed.compression.channels[0].threshold == kept.compression.channels[0].threshold
    a, b = (tiles(C) for C in (kept, streamed))
    np.testing.assert_array_equal(a.matrix().toarray(), b.matrix().toarray())
    np.testing.assert_array_equal(kept.first_bounce, streamed.first_bounce)


def test_operators_give_their_rows_by_products(device):
    T = ltcl.scenes.dihedral(8, albedo=0.8).transport()
    for operator in (Dense(device, T.matrices[0]), scipy.sparse.linalg.aslinearoperator(T.matrices[0])):
        F = None if isinstance(operator, Dense) else T.first_bounce
        C = ltcl.compress(operator, 0.05, basis="db2", grid=T.grid, first_bounce=F)
        np.testing.assert_allclose(C.first_bounce, T.first_bounce, rtol=1e-6)
        assert worst_error(dense_systems(T)[0], C.systems[0].to_dense()) <= C.error <= 0.05


def test_rows_may_be_dropped_where_no_memory_holds_them(monkeypatch):
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    systems = T.systems  # before there is no memory left
    assert systems
    monkeypatch.setattr(checks, "host_memory", lambda: 1 << 20)  # half of it for 512 x 512 numbers
    C = ltcl.compress(T, 0.05, basis="db2", memory=1 << 20)
    monkeypatch.undo()
    assert C.compression.channels[0].dropped_between > 0.0
    assert worst_error(dense_systems(T)[0], C.systems[0].to_dense()) <= C.error <= 0.05


def test_bases_are_tried_on_a_window_of_a_large_picture(monkeypatch):
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    monkeypatch.setattr(window, "SIDE", 16)
    C = ltcl.compress(T, 0.02)
    assert C.compression.window == (16, 16)
    assert len(C.compression.channels[0].trials) >= 6
    assert worst_error(dense_systems(T)[0], C.systems[0].to_dense()) <= C.error <= 0.02


def test_a_window_is_the_middle():
    T = ltcl.scenes.dihedral(6, albedo=0.8).transport()
    R = T.systems[0].R.to_dense()
    problem = window.Problem(ltcl.compression.sources.source("R", R), T.systems[0].R, T.grid)
    part = window.window(problem, 4)
    chosen = [row * 12 + column for row in range(1, 5) for column in range(4, 8)]
    np.testing.assert_allclose(part.operator.to_dense(), R[np.ix_(chosen, chosen)], rtol=1e-6)
    assert part.grid == (4, 4)
    few = window.Problem(problem.R, problem.operator, problem.grid, memory=32 * len(R) * 16)
    np.testing.assert_array_equal(window.window(few, 4).operator.to_dense(), part.operator.to_dense())
    assert window.window(problem, 64) is problem


def test_masked_pixels_stay_masked():
    S = np.eye(64) + smooth((8, 8))
    F = np.ones(64)
    F[[3, 40]] = 0.0
    T = ltcl.Transport(S * F, (8, 8), first_bounce=F, on_dark="mask")
    C = ltcl.compress(T, 0.02, basis="db2")
    np.testing.assert_array_equal(C.masked, T.masked)
    desired = np.full((8, 8), 0.3)
    a, b = (ltcl.compensate(transport, desired, rtol=0.02).pattern for transport in (T, C))
    assert a[0, 3] == b[0, 3] == 0.0
    np.testing.assert_allclose(a, b, atol=0.05 * a.max())


def test_what_was_mixed_stays_mixed():
    mixing = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.1, 0.0, 1.0]])
    matrices = ltcl.scenes.dihedral(4, albedo=(0.8, 0.5, 0.2)).transport().matrices
    T = ltcl.Transport(matrices, (4, 8), mixing=mixing)
    C = ltcl.compress(T, 0.02)
    pattern = np.random.default_rng(3).random((4, 8, 3))
    np.testing.assert_allclose(C @ pattern, T @ pattern, rtol=0.05, atol=0.02)


def test_progress_ends_at_one():
    seen: list[tuple[str, float]] = []
    ltcl.compress(SCENES["colour"](), 0.05, progress=lambda text, share: seen.append((text, share)))
    shares = [share for _, share in seen]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert seen[0][0] == "red: trying db2"


@pytest.mark.parametrize("rtol", [0, 1, 1.5, -0.1, float("nan"), "much"])
def test_tolerances_that_are_none_are_refused(rtol):
    with pytest.raises(InputError, match="rtol is"):
        ltcl.compress(SCENES["one pixel"](), rtol)


@pytest.mark.parametrize("basis", ["bior2.2", "dmey", "wavelets", "haar columns", "pyramid", ""])
def test_bases_that_are_not_orthonormal_are_refused(basis):
    with pytest.raises(InputError, match=re.escape(f"basis is {basis!r}; it must be pixels")):
        ltcl.compress(SCENES["one pixel"](), basis=basis)
