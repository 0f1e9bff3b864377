# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports against dense solutions in float64, on scenes and random matrices."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl.errors import ConvergenceError, InputError, InputTypeError, MemoryLimitError, ToleranceError
from ltcl.operators import Compressed
from ltcl.transport import to_arrays
from tests import gallery
from tests.compression.helpers import dense_systems, smooth, sparse, worst_error

SCENES = {
    "dihedral": lambda: ltcl.scenes.dihedral(12, albedo=0.8).transport(),
    "open box": lambda: ltcl.scenes.box(8, sides=3, albedo=0.7).transport(),
    "closed box at the limit": lambda: ltcl.scenes.box(6, albedo=0.5).transport(),
    "closed box beyond it": lambda: ltcl.scenes.box(6, albedo=0.8).transport(),
    "colour": lambda: ltcl.scenes.dihedral(8, albedo=(0.8, 0.5, 0.2)).transport(),
    "sparse": lambda: sparse(12, 15),
    "no bounces": lambda: ltcl.Transport(np.eye(20), (4, 5)),
    "one pixel": lambda: ltcl.Transport([[2.0]], (1, 1), first_bounce=[1.5]),
}


def core_bytes(C: ltcl.Transport) -> int:
    return sum(channel.nbytes for channel in C.compression.channels)


@pytest.fixture(scope="module")
def corner() -> tuple[ltcl.Transport, ltcl.Transport]:
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    return T, ltcl.compress(T, 0.05, basis="db2")


@pytest.mark.parametrize("rtol", [0.1, 1e-2])
@pytest.mark.parametrize("scene", SCENES)
def test_solutions_are_within_the_bound_and_the_bound_within_the_tolerance(scene, rtol):
    T = SCENES[scene]()
    C = ltcl.compress(T, rtol)
    assert C.error <= rtol
    for S, compressed, report in zip(dense_systems(T), C.systems, C.compression.channels, strict=True):
        dense = compressed.to_dense()
        assert worst_error(S, dense) <= report.solution_error == compressed.solution_error <= C.error
        assert np.linalg.norm(dense - S, 2) <= report.error == compressed.R.error
        assert np.linalg.norm(np.linalg.inv(dense), 2) <= report.inverse_norm
        assert report.confidence >= 1 - 2.1e-6
        np.testing.assert_allclose(compressed.R.diagonal(), np.diagonal(S) - 1, atol=1e-5)


@settings(max_examples=16, deadline=None)
@given(
    basis=st.sampled_from(["db2", "haar", "db4 rows", "pixels", "sym4"]),
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
@pytest.mark.parametrize("basis", [None, "db2 rows"])
def test_the_same_transport_gives_the_same_bits(basis, tuned, monkeypatch):
    monkeypatch.setenv("LTCL_TUNE", tuned)
    T = SCENES["open box"]()
    one, two = (to_arrays(ltcl.compress(T, 0.02, basis=basis)) for _ in range(2))
    assert one.keys() == two.keys()
    for name, array in one.items():
        assert (array.dtype, array.shape) == (two[name].dtype, two[name].shape)
        assert array.tobytes() == two[name].tobytes()


def test_what_is_dropped_is_reported():
    T = ltcl.scenes.dihedral(12, albedo=0.8).transport()
    C = ltcl.compress(T, basis="db2")
    (report,) = C.compression.channels
    R = C.systems[0].R
    assert isinstance(R, Compressed)
    assert R.into is not None
    W, core = R.into.to_dense(), R.core.to_dense()
    exact = W @ (dense_systems(T)[0] - np.eye(T.shape[0])) @ W.T
    kept = core != 0
    assert report.kept == pytest.approx(np.count_nonzero(kept) / T.shape[0], rel=1e-3)
    assert report.dropped == pytest.approx(np.linalg.norm(exact[~kept]), rel=1e-3)
    assert report.quantisation == pytest.approx(np.linalg.norm((exact - core)[kept]), rel=1e-2, abs=1e-6)
    assert np.abs(exact[kept]).min() >= report.threshold * (1 - 1e-4)
    assert (report.nbytes, report.launches) == (R.core.nbytes, 1)


def test_solves_run_on_coefficients_and_refuse_what_is_not_in_them(corner):
    T, C = corner
    S = dense_systems(T)[0]
    x = np.random.default_rng(5).random(T.shape[0])
    approximate = ltcl.solve(C.interreflection, S @ x, "chebyshev", rtol=0.05).x
    assert np.linalg.norm(approximate - x) <= (C.error + 0.05 * np.linalg.cond(S)) * np.linalg.norm(x)
    with pytest.raises(InputError, match=r"rtol is 0\.0001"):
        ltcl.solve(C.interreflection, x, rtol=1e-4)
    refined = ltcl.solve(C.interreflection, S @ x, rtol=1e-5, exact=T.interreflection).x
    assert np.linalg.norm(refined - x) <= 1e-4 * np.linalg.norm(x)


@pytest.mark.parametrize("scene", ["dihedral", "colour"])
def test_a_budget_is_kept_or_refused_with_what_it_takes(scene):
    T, bases = SCENES[scene](), ["db2", "haar"]
    free = core_bytes(ltcl.compress(T, 0.02, basis=bases))
    with pytest.raises(InputError, match=rf"budget is {free // 4} .* 0\.02 needs \d+") as refused:
        ltcl.compress(T, 0.02, free // 4, basis=bases)
    needed = int(re.findall(r"needs (\d+)", str(refused.value))[0])
    enough = ltcl.compress(T, 0.02, needed, basis=bases)
    assert enough.error <= 0.02
    assert core_bytes(enough) <= needed
    assert core_bytes(ltcl.compress(T, 0.9, 1000, basis="db2")) <= 1000


@pytest.mark.parametrize(("scene", "bases"), [("open box", ("db2", "haar", "db4")), ("sparse", ("pixels",))])
def test_smooth_light_is_written_in_wavelets_and_sharp_light_in_pixels(scene, bases):
    (report,) = ltcl.compress(SCENES[scene](), 0.01).compression.channels
    assert report.basis in bases
    assert {trial.basis for trial in report.trials} == {"db2", "haar", "db4", "pixels"}
    assert report.nbytes <= 1.3 * min(trial.nbytes for trial in report.trials if not trial.left)


def test_masked_pixels_stay_masked_and_mixed_colours_mixed():
    F = np.ones(64)
    F[[3, 40]] = 0.0
    T = ltcl.Transport((np.eye(64) + smooth((8, 8))) * F, (8, 8), first_bounce=F, on_dark="mask")
    C = ltcl.compress(T, 0.02, basis="db2")
    np.testing.assert_array_equal(C.masked, T.masked)
    a, b = (ltcl.compensate(one, np.full((8, 8), 0.3), rtol=0.02).pattern for one in (T, C))
    assert a[0, 3] == b[0, 3] == 0.0
    np.testing.assert_allclose(a, b, atol=0.05 * a.max())
    matrices = ltcl.scenes.dihedral(4, albedo=(0.8, 0.5, 0.2)).transport().matrices
    T = ltcl.Transport(matrices, (4, 8), mixing=np.eye(3) + 0.1 * np.eye(3, k=1))
    pattern = np.random.default_rng(3).random((4, 8, 3))
    np.testing.assert_allclose(ltcl.compress(T, 0.02) @ pattern, T @ pattern, rtol=0.05, atol=0.02)


NAMES = ["bior2.2", "dmey", "haar columns", "", "db2 + pixels", "pixels rows", " rows", 3, [], ["db2", 3]]


@pytest.mark.parametrize(
    ("option", "value"),
    [("rtol", value) for value in (0, 1, 1.5, -0.1, float("nan"), "much")]
    + [("basis", name) for name in NAMES]
    + [("memory", value) for value in ("1GB", -1, 0, 2.5, True)]
    + [("budget", 0), ("grid", (1, 1))],
)
def test_options_are_refused(option, value):
    with pytest.raises((InputError, InputTypeError), match=f"{option} is"):
        ltcl.compress(ltcl.scenes.dihedral(2, albedo=0.6).transport(), **{option: value})


@pytest.mark.parametrize(
    ("T", "options", "kind", "words"),
    [
        (np.eye(6), {"grid": (2, 4)}, InputError, "grid is 2 x 4"),
        (np.eye(6), {}, InputError, "grid is None"),
        (np.eye(6), {"grid": (2, 3), "memory": 100}, MemoryLimitError, "memory is 100 B"),
        (ltcl.Transport(np.ones((6, 4)), (2, 2), camera_grid=(2, 3)), {}, InputError, "only relight"),
        (np.eye(4) + np.eye(4)[::-1], {"grid": (2, 2), "basis": "pixels"}, ConvergenceError, "S is singular"),
        (None, {}, InputError, "T is compressed already"),
    ],
)
def test_other_refusals(corner, T, options, kind, words):
    with pytest.raises(kind, match=words):
        ltcl.compress(corner[1] if T is None else T, **options)


@pytest.mark.parametrize("scene", ["sparse", "open box"])
@pytest.mark.parametrize("basis", ["db2", "pixels"])
def test_what_float32_does_not_keep_is_refused_with_what_it_does(scene, basis):
    T = SCENES[scene]()
    with pytest.raises(ToleranceError, match=r"rtol is 1e-07") as refused:
        ltcl.compress(T, 1e-7, basis=basis)
    least = refused.value.least
    assert 1e-7 < least < 1e-3
    for rtol in (least, 1.45 * least):
        assert ltcl.compress(T, rtol, basis=basis).error <= rtol


@pytest.mark.parametrize("command", [ltcl.compress, ltcl.invert])
def test_a_tolerance_below_float32_is_refused_before_any_work(command, corner):
    stages = []
    with pytest.raises(ToleranceError, match="rtol is 1e-12"):
        command(corner[0], 1e-12, progress=lambda text, share: stages.append(text))
    assert not stages


@pytest.mark.parametrize("command", [ltcl.compress, ltcl.invert])
def test_a_host_without_memory_refuses_in_one_line(command):
    def rows(x):
        raise MemoryError("Unable to allocate")

    parts: dict[str, Any] = {"shape": (64, 64), "matvec": rows, "rmatvec": rows, "rmatmat": rows}
    operator = scipy.sparse.linalg.LinearOperator(**parts, dtype=float)
    T = ltcl.Transport(operator, (8, 8), first_bounce=np.ones(64))
    with pytest.raises(MemoryLimitError, match="needs up to 32 KiB for 64 pixels"):
        command(T)


def test_every_stage_is_announced(corner):
    calls = []
    ltcl.invert(corner[0], 0.05, progress=lambda stage, share: calls.append((stage, share)))
    stages, shares = zip(*calls, strict=True)
    assert {"trying db2", "trying pixels", "done"} < set(stages)
    assert any("norm of S^-1" in stage for stage in stages)
    assert list(shares) == sorted(shares)
