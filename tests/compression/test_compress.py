# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports against dense solutions in float64, on scenes and random matrices."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl.errors import ConvergenceError, InputError, InputTypeError, MemoryLimitError, ToleranceError
from ltcl.operators import Compressed, Sum
from tests import gallery
from tests.compression.helpers import core_arrays, dense_systems, sharp, smooth, sparse, spilled, worst_error

SUM = "db2 + pixels"
SCENES = {
    "dihedral": lambda: ltcl.scenes.dihedral(12, albedo=0.8).transport(),
    "open box": lambda: ltcl.scenes.box(8, sides=3, albedo=0.7).transport(),
    "closed box at the limit": lambda: ltcl.scenes.box(6, albedo=0.5).transport(),
    "closed box beyond it": lambda: ltcl.scenes.box(6, albedo=0.8).transport(),
    "colour": lambda: ltcl.scenes.dihedral(8, albedo=(0.8, 0.5, 0.2)).transport(),
    "sparse": lambda: sparse(12, 15),
    "light that spills": lambda: spilled(8, 0.1),
    "no bounces": lambda: ltcl.Transport(np.eye(20), (4, 5)),
    "one pixel": lambda: ltcl.Transport([[2.0]], (1, 1), first_bounce=[1.5]),
}


def inside(C: ltcl.Transport) -> Compressed:
    """R~ of the first channel."""
    R = C.systems[0].R
    assert isinstance(R, Compressed)
    return R


@pytest.fixture(scope="module")
def corner() -> tuple[ltcl.Transport, ltcl.Transport]:
    """A smooth T, and what it is compressed to in db2."""
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    return T, ltcl.compress(T, 0.05, basis="db2")


@pytest.fixture(scope="module")
def spill() -> tuple[ltcl.Transport, ltcl.Transport]:
    """A T that is sharp and smooth, and what it is as a sum."""
    T = spilled(12, 0.1)
    return T, ltcl.compress(T, 0.02, basis=SUM)


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
        assert error <= told.error
        assert np.linalg.norm(np.linalg.inv(found), 2) <= told.inverse_norm
        assert compressed.solution_error == told.solution_error
        assert compressed.R.error == told.error
        assert told.confidence >= 1 - 2.1e-6
        np.testing.assert_allclose(compressed.R.diagonal(), np.diagonal(S) - 1, atol=1e-5)


@settings(max_examples=16, deadline=None)
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


@pytest.mark.parametrize("tuned", ["0", "1"])
@pytest.mark.parametrize("basis", [None, SUM])
def test_the_same_transport_gives_the_same_bits(basis, tuned, monkeypatch):
    monkeypatch.setenv("LTCL_TUNE", tuned)
    T = spilled(8, 0.1)
    one, two = (core_arrays(ltcl.compress(T, 0.02, basis=basis)) for _ in range(2))
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


def test_what_is_dropped_is_reported(device):
    T = ltcl.scenes.dihedral(12, albedo=0.8).transport(device=device)
    C = ltcl.compress(T, basis="db2")
    (told,) = C.compression.channels
    R = inside(C)
    assert R.into is not None
    W, core = R.into.to_dense(), R.core.to_dense()
    wanted = W @ (dense_systems(T)[0] - np.eye(T.shape[0])) @ W.T
    kept = core != 0
    assert told.kept == pytest.approx(np.count_nonzero(kept) / T.shape[0], rel=1e-3)
    assert told.dropped == pytest.approx(np.linalg.norm(wanted[~kept]), rel=1e-3)
    assert told.quantisation == pytest.approx(np.linalg.norm((wanted - core)[kept]), rel=1e-2, abs=1e-6)
    assert np.abs(wanted[kept]).min() >= told.threshold * (1 - 1e-4)
    assert told.nbytes == R.core.nbytes
    assert (told.launches, told.format) == (1, "tiles")


def test_solves_run_on_coefficients_and_refuse_what_is_not_in_them(corner):
    T, C = corner
    S = dense_systems(T)[0]
    b = np.random.default_rng(5).random(T.shape[0])
    x = np.linalg.solve(S, b)
    found = ltcl.solve(C.interreflection, b, "chebyshev", rtol=0.05).x
    assert np.linalg.norm(found - x) <= (C.error + 0.05 * np.linalg.cond(S)) * np.linalg.norm(x)
    with pytest.raises(InputError, match=r"rtol is 0\.0001"):
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
    S = matrix.astype(np.float64) / T.first_bounce
    b = S @ (T.first_bounce[:, None] * patterns)
    x = np.linalg.solve(S, b)
    found = ltcl.solve(C.interreflection, b, "direct", rtol=0.02).x
    errors = np.linalg.norm(found - x, axis=0) / np.linalg.norm(x, axis=0)
    assert np.all(errors <= C.error)
    assert C.error <= 0.02
    assert C.compression.nbytes < 0.05 * 4 * matrix.size


@pytest.mark.parametrize("scene", ["dihedral", "colour"])
def test_a_budget_is_kept_or_refused_with_what_it_takes(scene):
    T, bases = SCENES[scene](), ["db2", "haar"]
    free = ltcl.compress(T, 0.02, basis=bases).compression.nbytes
    with pytest.raises(InputError, match=rf"budget is {free // 4} .* 0\.02 needs \d+") as refused:
        ltcl.compress(T, 0.02, free // 4, basis=bases)
    needed = int(re.findall(r"needs (\d+)", str(refused.value))[0])
    enough = ltcl.compress(T, 0.02, needed, basis=bases)
    assert enough.error <= 0.02
    assert enough.compression.nbytes <= needed
    assert ltcl.compress(T, 0.9, 1000, basis="db2").compression.nbytes <= 1000


def test_sharp_light_is_written_as_a_sum():
    """Where that takes so many bytes fewer that transforms pay, or where a budget asks for it."""
    T = sharp(16)
    C = ltcl.compress(T, 0.02, basis=["db2", SUM])
    sizes = {trial.basis: trial.nbytes for trial in C.compression.channels[0].trials}
    fewest = ltcl.compress(T, 0.02, 2 * sizes[SUM], basis=["db2", SUM])
    assert 4 * sizes[SUM] < sizes["db2"]
    assert fewest.compression.channels[0].basis == SUM


@pytest.mark.parametrize("rtol", [0.1, 0.01])
@pytest.mark.parametrize("scene", ["dihedral", "open box"])
def test_smooth_light_is_written_in_wavelets_on_both_sides(scene, rtol):
    C = ltcl.compress(SCENES[scene](), rtol)
    (told,) = C.compression.channels
    assert told.basis in ("db2", "haar", "db4")
    assert {SUM, "pixels"} <= {trial.basis for trial in told.trials}
    assert inside(C).two_sided


def test_a_sum_keeps_what_is_sharp_in_pixels(spill):
    T, C = spill
    S, found, (told,) = dense_systems(T)[0], C.systems[0].to_dense(), C.compression.channels
    R = C.systems[0].R
    assert isinstance(R, Sum)
    P, smooth_part = R.operators
    assert isinstance(P, Compressed)
    assert isinstance(smooth_part, Compressed)
    assert (P.out, P.into) == (None, None)
    assert smooth_part.two_sided
    assert told.nbytes == P.core.nbytes + smooth_part.core.nbytes
    assert np.linalg.norm(found - S) <= told.dropped + told.quantisation + 1e-5
    b = np.random.default_rng(5).random(len(S))
    refined = ltcl.solve(C.interreflection, b, rtol=1e-5, exact=T.interreflection).x
    np.testing.assert_allclose(refined, np.linalg.solve(S, b), atol=1e-3)


def test_stored_and_loaded_they_have_the_same_bits(corner, spill, tmp_path):
    for number, (_, C) in enumerate((corner, spill)):
        path = tmp_path / f"{number}.npz"
        ltcl.save(path, C)
        again = ltcl.load(path)
        assert (again.error, again.nbytes) == (C.error, C.nbytes)
        for a, b in zip(core_arrays(C), core_arrays(again), strict=True):
            assert a.tobytes() == b.tobytes()
        pattern = np.random.default_rng(1).random((5, *C.grid))
        np.testing.assert_array_equal(again @ pattern, C @ pattern)


def test_masked_pixels_stay_masked_and_mixed_colours_mixed():
    S = np.eye(64) + smooth((8, 8))
    F = np.ones(64)
    F[[3, 40]] = 0.0
    T = ltcl.Transport(S * F, (8, 8), first_bounce=F, on_dark="mask")
    C = ltcl.compress(T, 0.02, basis="db2")
    np.testing.assert_array_equal(C.masked, T.masked)
    a, b = (ltcl.compensate(one, np.full((8, 8), 0.3), rtol=0.02).pattern for one in (T, C))
    assert a[0, 3] == b[0, 3] == 0.0
    np.testing.assert_allclose(a, b, atol=0.05 * a.max())
    mixing = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.1, 0.0, 1.0]])
    T = ltcl.Transport(
        ltcl.scenes.dihedral(4, albedo=(0.8, 0.5, 0.2)).transport().matrices, (4, 8), mixing=mixing
    )
    pattern = np.random.default_rng(3).random((4, 8, 3))
    np.testing.assert_allclose(ltcl.compress(T, 0.02) @ pattern, T @ pattern, rtol=0.05, atol=0.02)


def test_a_report_tells_where_nothing_was_gained():
    T = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    C = ltcl.compress(T, 1e-5, basis="db2")
    assert C.compression.uncompressed == 4 * T.shape[0] ** 2 <= C.compression.nbytes
    assert "more than T's 4 KiB" in str(C.compression)


@pytest.mark.parametrize(
    ("options", "kind", "words"),
    [
        *[({"rtol": rtol}, InputError, "rtol is") for rtol in (0, 1, 1.5, -0.1, float("nan"), "much")],
        *[
            ({"basis": name}, InputError, re.escape(f"basis is {name!r}"))
            for name in ("bior2.2", "dmey", "wavelets", "haar columns", "hilbert", "pyramid", "")
        ],
        *[
            ({"basis": name}, InputError, re.escape(f"basis is {name!r}"))
            for name in ("db2 rows + pixels", "db2 + pixels rows", "pixels + pixels", " + pixels")
        ],
        *[({"basis": basis}, InputTypeError, f"basis is {basis!r}") for basis in (3, 0.5, True)],
        ({"basis": ["db2", 3]}, InputTypeError, "basis is 3"),
        ({"basis": []}, InputError, "basis is empty"),
        *[({"memory": memory}, InputError, "memory is") for memory in ("1GB", -1, 0, 2.5, True)],
        ({"budget": 0}, InputError, "budget is 0"),
        ({"grid": (1, 1)}, InputError, "grid is given"),
    ],
)
def test_options_of_no_use_are_refused(options, kind, words):
    with pytest.raises(kind, match=words):
        ltcl.compress(ltcl.scenes.dihedral(2, albedo=0.6).transport(), **options)


def test_other_refusals(corner):
    with pytest.raises(InputError, match="grid is 2 x 4"):
        ltcl.compress(np.eye(6), grid=(2, 4))
    with pytest.raises(InputError, match="grid is None"):
        ltcl.compress(np.eye(6))
    with pytest.raises(MemoryLimitError, match="memory is 100 B"):
        ltcl.compress(np.eye(6), grid=(2, 3), memory=100)
    with pytest.raises(InputError, match="only relight"):
        ltcl.compress(ltcl.Transport(np.ones((6, 4)), (2, 2), camera_grid=(2, 3)))
    with pytest.raises(InputError, match="T is compressed already"):
        ltcl.compress(corner[1])
    singular = np.eye(16)
    singular[:2, :2] = 1.0
    with pytest.raises(ConvergenceError, match="S is singular"):
        ltcl.compress(ltcl.Transport(singular, (4, 4)), basis="pixels")


@pytest.mark.parametrize("scene", ["light that spills", "open box"])
@pytest.mark.parametrize("basis", ["db2", "pixels", SUM])
def test_what_float32_does_not_keep_is_refused_with_what_it_does(scene, basis):
    T = SCENES[scene]()
    with pytest.raises(ToleranceError, match=r"rtol is 1e-12") as refused:
        ltcl.compress(T, 1e-12, basis=basis)
    least = refused.value.least
    assert 1e-12 < least < 1e-3
    assert ltcl.compress(T, 1.5 * least, basis=basis).error <= 1.5 * least
