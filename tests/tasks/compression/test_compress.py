# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports, of rows from wherever they come, against dense solutions in float64."""

from __future__ import annotations

import functools
import re
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl import checks
from ltcl.errors import (
    ConvergenceError,
    InputError,
    InputTypeError,
    MemoryLimitError,
    ToleranceError,
)
from ltcl.operators import Compressed, Dense, IdentityPlus, SubsetBasis
from ltcl.tasks.compression import inverse_norm
from tests import gallery
from tests.operators.helpers import FORMATS


def smooth(grid: tuple[int, int], seed: int = 0) -> np.ndarray:
    """A smooth R with a few sharp entries, (N, N) float32."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1)
    distance = (y[:, None] - y) ** 2 / grid[0] ** 2 + (x[:, None] - x) ** 2 / grid[1] ** 2
    R = np.exp(-3 * distance) / len(x)
    R[rng.integers(0, len(x), 5), rng.integers(0, len(x), 5)] += 0.2
    return R.astype(np.float32)


def sparse(h: int, w: int) -> ltcl.Transport:
    """A few strong links between pixels, and F between 0.5 and 1."""
    n = h * w
    R = 0.3 * np.abs(gallery.sparse(n, n, 0.02).toarray())
    T = scipy.sparse.csr_array((np.eye(n) + R) * np.random.default_rng(2).uniform(0.5, 1, n))
    return ltcl.Transport(T, (h, w))


def dense_systems(T: ltcl.Transport) -> list[np.ndarray]:
    """S = T F^-1 of every channel in float64, by NumPy."""
    matrices = zip(T.matrices, np.atleast_2d(T.first_bounce), strict=True)
    return [
        scipy.sparse.coo_array(matrix).toarray().astype(np.float64) / F for matrix, F in matrices
    ]


def worst_error(S: np.ndarray, approximate: np.ndarray) -> float:
    """The largest ||x~ - x|| / ||x|| over all right-hand sides: ||S~^-1 E||."""
    return float(np.linalg.norm(np.linalg.solve(approximate, approximate - S), 2))


def norm_of_inverse(S: np.ndarray) -> float:
    return float(np.linalg.norm(np.linalg.inv(S), 2))


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


@pytest.mark.slow
@pytest.mark.parametrize("rtol", [0.1, 1e-2])
@pytest.mark.parametrize("scene", SCENES)
def test_solutions_are_within_the_bound_and_the_bound_within_the_tolerance(scene, rtol):
    T = SCENES[scene]()
    C = ltcl.compress(T, rtol, norm="worst")
    assert C.error <= rtol
    for S, compressed, report in zip(
        dense_systems(T), C.systems, C.compression.channels, strict=True
    ):
        dense = compressed.to_dense()
        assert (
            worst_error(S, dense) <= report.solution_error == compressed.solution_error <= C.error
        )
        assert np.linalg.norm(dense - S, 2) <= report.error == compressed.R.error
        assert norm_of_inverse(dense) <= report.inverse_norm
        assert report.confidence >= 1 - 2.1e-6
        np.testing.assert_allclose(compressed.R.diagonal(), np.diagonal(S) - 1, atol=1e-5)


@pytest.mark.rare
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
    C = ltcl.compress(T, rtol, basis=basis, norm="worst")
    assert worst_error(S, C.systems[0].to_dense()) <= C.error <= rtol


@pytest.mark.rare
@pytest.mark.parametrize("tuned", ["0", "1"])
@pytest.mark.parametrize("basis", [None, "db2 rows"])
def test_the_same_transport_gives_the_same_bits(basis, tuned, monkeypatch):
    monkeypatch.setenv("LTCL_TUNE", tuned)
    T = SCENES["open box"]()
    one, two = (ltcl.compress(T, 0.02, basis=basis).to_arrays() for _ in range(2))
    assert {name: (array.dtype, array.shape, array.tobytes()) for name, array in one.items()} == {
        name: (array.dtype, array.shape, array.tobytes()) for name, array in two.items()
    }


def test_what_is_dropped_is_reported():
    T = ltcl.scenes.dihedral(12, albedo=0.8).transport()
    C = ltcl.compress(T, basis="db2", norm="worst")
    (report,) = C.compression.channels
    R = C.systems[0].R
    assert isinstance(R, Compressed)
    assert R.into is not None
    W = R.into.to_dense()
    core = R.core.to_dense()
    exact = W @ (dense_systems(T)[0] - np.eye(T.shape[0])) @ W.T
    kept = core != 0
    assert report.kept == pytest.approx(np.count_nonzero(kept) / T.shape[0], rel=1e-3)
    assert report.dropped == pytest.approx(np.linalg.norm(exact[~kept]), rel=1e-3)
    assert report.quantisation == pytest.approx(
        np.linalg.norm((exact - core)[kept]), rel=1e-2, abs=1e-6
    )
    assert np.abs(exact[kept]).min() >= report.threshold * (1 - 1e-4)
    assert report.nbytes == R.core.nbytes


def test_solves_run_on_coefficients_and_refuse_what_is_not_in_them(corner):
    T, C = corner
    S = dense_systems(T)[0]
    x = np.random.default_rng(5).random(T.shape[0])
    approximate = ltcl.solve(C.interreflection, S @ x, "chebyshev", rtol=0.05).x
    assert np.linalg.norm(approximate - x) <= (C.error + 0.05 * np.linalg.cond(S)) * np.linalg.norm(
        x
    )
    with pytest.raises(InputError, match=r"rtol is 0\.0001"):
        ltcl.solve(C.interreflection, x, rtol=1e-4)
    refined = ltcl.solve(C.interreflection, S @ x, rtol=1e-5, exact=T.interreflection).x
    assert np.linalg.norm(refined - x) <= 1e-4 * np.linalg.norm(x)


@pytest.mark.rare
@pytest.mark.parametrize("scene", ["dihedral", "colour"])
def test_a_budget_is_kept_or_refused_with_what_it_takes(scene):
    T = SCENES[scene]()
    bases = ["db2", "haar"]
    free = core_bytes(ltcl.compress(T, 0.02, basis=bases))
    with pytest.raises(InputError, match=rf"budget is {free // 4} .* 0\.02 needs \d+") as refused:
        ltcl.compress(T, 0.02, free // 4, basis=bases)
    needed = int(re.findall(r"needs (\d+)", str(refused.value))[0])
    enough = ltcl.compress(T, 0.02, needed, basis=bases)
    assert enough.error <= 0.02
    assert core_bytes(enough) <= needed
    assert core_bytes(ltcl.compress(T, 0.9, 1000, basis="db2")) <= 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "bases"), [("open box", ("db2", "haar", "db4")), ("sparse", ("pixels",))]
)
def test_smooth_light_is_written_in_wavelets_and_sharp_light_in_pixels(scene, bases):
    (report,) = ltcl.compress(SCENES[scene](), 0.01).compression.channels
    assert report.basis in bases
    assert {trial.basis for trial in report.trials} == {"db2", "haar", "db4", "pixels"}
    assert report.nbytes <= 1.3 * min(trial.nbytes for trial in report.trials if not trial.left)


@pytest.mark.rare
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


class Rows:
    """Rows of a matrix, of so many columns, and so many more than were asked for."""

    def __init__(
        self, matrix: Any, columns: int = 128, more: int = 0, shape: Any = (128, 128)
    ) -> None:
        self.matrix = matrix
        self.columns = columns
        self.more = more
        self.shape = shape

    def rows(self, start: int, stop: int) -> np.ndarray:
        return self.matrix[start : stop + self.more, : self.columns]


NAMES = (
    "bior2.2",
    "dmey",
    "haar columns",
    "",
    "db2 + pixels",
    "pixels rows",
    " rows",
    3,
    [],
    ["db2", 3],
)
ROWS: list[tuple[Any, Any, str]] = [
    (Rows(np.eye(128), columns=3), InputError, r"T.*\(1, 3\).* \(1, 128\)"),
    (Rows(np.eye(128), more=1), InputError, r"T.*\(2, 128\).* \(1, 128\)"),
    (Rows(np.eye(128) * 1j), InputTypeError, r"T.*complex"),
    (Rows(np.eye(128), shape=128), InputError, "T has shape 128"),
    (Rows(np.diag([np.nan] * 128)), InputError, "NaN"),
    ([np.eye(128)] * 2, InputError, "T has 2 channels"),
    (np.eye(128)[:, :5], InputError, r"T has shape \(128, 5\)"),
    (np.zeros((2, 3, 4)), InputError, r"T has shape \(2, 3, 4\)"),
    ("T.npz", InputTypeError, "T is a str"),
]
DARK = np.arange(128) != 2
WORDS = r"first_bounce .* 1 of 128 pixels.*\(0, 2\)"
LinearOperator: Any = scipy.sparse.linalg.LinearOperator
FORWARD = LinearOperator((128, 128), matvec=np.array, dtype=np.float64)
VALUES: list[tuple[str, Any, tuple[Any, ...]]] = [
    ("rtol", InputError, (0, 1, 1.5, -0.1, float("nan"), "much")),
    ("basis", (InputError, InputTypeError), NAMES),
    ("memory", (InputError, InputTypeError), ("1GB", -1, 0, 2.5, True)),
    ("budget", InputError, (0,)),
    ("progress", InputTypeError, (3,)),
    ("grid", InputError, ((1, 1),)),
]
GRID: dict[str, Any] = {"grid": (8, 16)}


@pytest.mark.parametrize(
    ("T", "options", "kind", "words"),
    [
        *(
            ("T", {name: value}, kind, f"{name} is")
            for name, kind, values in VALUES
            for value in values
        ),
        ("C", {}, InputError, "T is compressed already"),
        *(
            (T, GRID | {"first_bounce": F}, *error)
            for T, *error in ROWS
            for F in (None, np.ones(128))
        ),
        *(
            (np.diag(1.0 * DARK), GRID | {"first_bounce": F}, InputError, WORDS)
            for F in (None, DARK)
        ),
        (FORWARD, GRID | {"first_bounce": np.ones(128)}, InputError, "rmatvec"),
        (
            np.eye(6),
            {"grid": (2, 3), "first_bounce": "exact"},
            InputError,
            "first_bounce is 'exact'",
        ),
        (np.eye(6), {"grid": (2, 4)}, InputError, "grid is 2 x 4"),
        (np.eye(6), {}, InputError, "grid is None"),
        (np.eye(6), {"grid": (2, 3), "memory": 100}, MemoryLimitError, "memory is 100 B"),
        (
            ltcl.Transport(np.ones((6, 4)), (2, 2), camera_grid=(2, 3)),
            {},
            InputError,
            "only relight",
        ),
        (
            np.eye(4) + np.eye(4)[::-1],
            {"grid": (2, 2), "basis": "pixels"},
            ConvergenceError,
            "S is singular",
        ),
    ],
)
def test_refusals(corner, T, options, kind, words):
    with pytest.raises(kind, match=words):
        ltcl.compress(
            {"T": corner[0], "C": corner[1]}.get(T, T) if isinstance(T, str) else T, **options
        )


@pytest.mark.rare
@pytest.mark.parametrize("scene", ["sparse", "open box"])
@pytest.mark.parametrize("basis", ["db2", "pixels"])
def test_what_float32_does_not_keep_is_refused_with_what_it_does(scene, basis):
    T = SCENES[scene]()
    with pytest.raises(ToleranceError, match=r"rtol is 1e-07") as refused:
        ltcl.compress(T, 1e-7, basis=basis, norm="worst")
    least = refused.value.least
    assert 1e-7 < least < 1e-3
    for rtol in (least, 1.45 * least):
        assert ltcl.compress(T, rtol, basis=basis, norm="worst").error <= rtol


@pytest.mark.parametrize("command", [ltcl.compress, ltcl.invert])
def test_what_float32_or_the_host_cannot_do_is_refused_at_once(command, corner):
    with pytest.raises(ToleranceError, match="rtol is 1e-12"):
        command(corner[0], 1e-12, progress=lambda text, share: pytest.fail(text))

    def rows(x):
        raise MemoryError("Unable to allocate")

    operator = LinearOperator((64, 64), matvec=rows, rmatvec=rows, rmatmat=rows, dtype=float)
    with pytest.raises(MemoryLimitError, match=r"32 KiB .* 64 "):
        command(ltcl.Transport(operator, (8, 8), first_bounce=np.ones(64)))


@pytest.mark.slow
def test_every_stage_is_announced(corner):
    calls = []
    ltcl.invert(corner[0], 0.05, progress=lambda stage, share: calls.append((stage, share)))
    stages, shares = zip(*calls, strict=True)
    assert {"trying db2", "trying pixels", "done"} < set(stages)
    assert any("norm of S^-1" in stage for stage in stages)
    assert list(shares) == sorted(shares)


@pytest.fixture(scope="module")
def room() -> ltcl.Transport:
    return ltcl.scenes.dihedral(8, albedo=0.8).transport()


CHUNKED = functools.partial(zarr.array, chunks=(30, 50))


@pytest.mark.slow
@pytest.mark.parametrize("holder", [np.asarray, CHUNKED, scipy.sparse.csc_matrix, Rows])
def test_rows_from_elsewhere_give_the_same_bits(holder, room):
    matrix = holder(room.matrices[0])
    direct = ltcl.compress(room, 0.02, basis="db2")
    for memory in (None, 32 * 128 * 16):  # the second is that of the smallest block
        C = ltcl.compress(matrix, 0.02, basis="db2", grid=room.grid, memory=memory)
        np.testing.assert_array_equal(direct.systems[0].R.to_dense(), C.systems[0].R.to_dense())
        np.testing.assert_array_equal(direct.first_bounce, C.first_bounce)


@pytest.mark.parametrize("form", ["csr", "dense", "SciPy's"])
def test_operators_give_their_rows_by_products(form, room, device):
    matrix = room.matrices[0]
    F = room.first_bounce if form == "SciPy's" else None
    operator = (
        FORMATS[form](device, matrix) if F is None else scipy.sparse.linalg.aslinearoperator(matrix)
    )
    C = ltcl.compress(operator, 0.05, basis="db2", grid=room.grid, first_bounce=F, norm="worst")
    np.testing.assert_allclose(C.first_bounce, room.first_bounce, rtol=1e-6)
    assert worst_error(dense_systems(room)[0], C.systems[0].to_dense()) <= C.error <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize("basis", ["db2", "db2 rows", "pixels"])
def test_rows_may_be_dropped_where_no_memory_holds_them(basis, monkeypatch):
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    assert T.systems  # before there is no memory left
    monkeypatch.setattr(checks, "host_memory", lambda: 1 << 20)  # half of it for 512 x 512 numbers
    rtol = {"db2": 0.05, "db2 rows": 0.2, "pixels": 0.6}[basis]
    C = ltcl.compress(T, rtol, basis=basis, memory=1 << 20, norm="worst")
    monkeypatch.undo()
    (S,) = dense_systems(T)
    R = C.systems[0].to_dense()
    (report,) = C.compression.channels
    assert worst_error(S, R) <= C.error <= rtol
    assert np.linalg.norm(R - S) <= report.dropped + report.quantisation + 1e-6 * np.linalg.norm(S)


@pytest.mark.slow
def test_bases_are_compared_in_the_middle_of_a_large_picture():
    S = np.eye(512) + smooth((4, 128))
    T = ltcl.Transport(S, (4, 128), first_bounce=np.ones(512))
    C = ltcl.compress(T, 0.02, norm="worst")
    assert C.compression.window == (4, 64)
    assert len(C.compression.channels[0].trials) == 4
    assert worst_error(S, C.systems[0].to_dense()) <= C.error <= 0.02


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(n=st.integers(1, 60), size=st.sampled_from([0.1, 0.5, 0.9]), seed=st.integers(0, 999))
def test_the_bound_is_never_below(device, n, size, seed):
    R = gallery.signed(n, n, seed).astype(np.float64)
    R *= size / max(np.linalg.norm(R, 2), 1e-9)
    bound = inverse_norm(IdentityPlus(Dense(device, R)), seed=seed)
    exact = norm_of_inverse(np.eye(n) + R)
    assert exact <= bound.upper <= 1.25 * exact
    assert bound.estimate <= 1.01 * exact


@pytest.mark.parametrize("seed", range(12))
def test_solves_that_end_early_widen_the_bound(device, seed):
    """Steps that span all pixels leave no other slack, and solves stop short of the largest x."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    R = Q @ np.diag(0.1 * rng.standard_normal(5)) @ Q.T
    bound = inverse_norm(IdentityPlus(Dense(device, R)), factor=1.00001)
    assert norm_of_inverse(np.eye(5) + R.astype(np.float32)) <= bound.upper


def test_coefficients_that_are_left_out_have_the_norm_of_the_identity(device):
    """The core alone, I + 0.5, has an inverse of norm 2/3."""
    V = SubsetBasis(device, (1, 5), [1, 3])
    S = IdentityPlus(Compressed(Dense(device, 0.5 * np.eye(2)), V, V))
    bound = inverse_norm(S)
    assert norm_of_inverse(S.to_dense()) == pytest.approx(1.0)
    assert 1.0 <= bound.upper <= 1.1
