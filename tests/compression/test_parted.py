# SPDX-License-Identifier: BSD-3-Clause
"""R as sharp parts in pixels and a smooth rest in wavelets, against dense float64."""

from __future__ import annotations

import functools
import re

import numpy as np
import pytest

import ltcl
from ltcl import checks, store
from ltcl.compression import kinds, window
from ltcl.compression.parted import part
from ltcl.compression.sources import source
from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators import Compressed, Sum

RTOL = 0.02
SUM = "db2 + pixels"


def spilled(n: int, spill: float) -> ltcl.Transport:
    """A corner whose pixels light up to `spill` of their own light on each of their neighbours."""
    scene = ltcl.scenes.dihedral(n, albedo=0.8)
    (T,) = scene.matrices()
    index, rng = np.arange(len(T)).reshape(scene.grid), np.random.default_rng(0)
    for shift in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        near = np.roll(index, shift, (0, 1)).ravel()
        T[near, index.ravel()] += spill * scene.first_bounce * rng.random(len(T))
    return ltcl.Transport(T, scene.grid, first_bounce=scene.first_bounce)


def dense(T: ltcl.Transport) -> np.ndarray:
    """S = T F^-1 in float64."""
    return np.asarray(T.matrices[0], np.float64) / T.first_bounce


@functools.cache
def compressed(spill: float, basis: str) -> ltcl.Transport:
    return ltcl.compress(spilled(12, spill), RTOL, basis=basis)


@pytest.mark.parametrize("drop", [0.5, 0.05, 1e-3])
@pytest.mark.parametrize("grid", [(1, 1), (5, 7), (8, 16)])
def test_both_parts_leave_what_they_say(device, grid, drop):
    n = grid[0] * grid[1]
    y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1)
    A = np.exp(-((y[:, None] - y) ** 2 + (x[:, None] - x) ** 2) / n)
    A += (np.random.default_rng(1).random((n, n)) < 0.02) * 0.5
    drop *= np.linalg.norm(A)
    kind = kinds.kind(device, grid, SUM)
    assert kind.out is not None
    assert kind.into is kind.out
    found = part(source("R", A), kind.out, kind.out, drop)
    W = kind.out.to_dense()

    def error(these) -> float:
        P, C = these.parts
        return float(np.linalg.norm(A - P.toarray() - W.T @ C.toarray() @ W))

    assert error(found) == pytest.approx(found.residual, rel=1e-3, abs=1e-6 * float(np.linalg.norm(A)))
    assert found.residual == found.dropped <= drop
    assert np.abs(found.core.data).min(initial=np.inf) >= found.threshold
    fewer = found.above(3 * found.threshold)
    assert fewer.core.nnz <= found.core.nnz
    assert error(fewer) <= fewer.dropped + 1e-6 * np.linalg.norm(A)


def test_planted_numbers_are_found_where_they_are(device):
    grid, rng = (8, 16), np.random.default_rng(2)
    W = kinds.kind(device, grid, SUM).out
    assert W is not None
    P, C = np.zeros((128, 128)), np.zeros((128, 128))
    P[rng.integers(0, 128, 30), rng.integers(0, 128, 30)] = rng.uniform(1, 2, 30)
    C[rng.integers(0, 8, 12), rng.integers(0, 8, 12)] = rng.uniform(4, 8, 12)  # the coarsest come first
    Wd = W.to_dense()
    found = part(source("R", P + Wd.T @ C @ Wd), W, W, 1e-4 * float(np.linalg.norm(C)))
    for planted, half in zip((P, C), found.parts, strict=True):
        np.testing.assert_allclose(half.toarray(), planted, atol=1e-3)


@pytest.mark.parametrize("spill", [0.02, 0.1])
def test_light_that_spills_takes_fewer_bytes_as_a_sum(spill):
    C = ltcl.compress(spilled(12, spill), RTOL, basis=["db2", SUM])
    (told,) = C.compression.channels
    assert told.basis == SUM
    alone = compressed(spill, "db2").compression
    assert told.nbytes < 0.75 * alone.nbytes
    R = C.systems[0].R
    assert isinstance(R, Sum)
    sharp, smooth = R.operators
    assert isinstance(sharp, Compressed)
    assert isinstance(smooth, Compressed)
    assert (sharp.out, sharp.into) == (None, None)
    assert smooth.two_sided
    assert told.nbytes == sharp.core.nbytes + smooth.core.nbytes


@pytest.mark.parametrize("spill", [0.0, 0.1])
def test_the_bounds_hold_and_solutions_are_within_them(spill):
    T, C = spilled(12, spill), compressed(spill, SUM)
    S, found, (told,) = dense(T), C.systems[0].to_dense(), C.compression.channels
    assert np.linalg.norm(found - S, 2) <= told.error == C.systems[0].R.error
    # Exact but for the rounding of cores, though both parts may drop the same light.
    assert np.linalg.norm(found - S) == pytest.approx(told.dropped, rel=1e-5, abs=told.quantisation)
    assert np.linalg.norm(np.linalg.solve(found, found - S), 2) <= C.error <= RTOL
    b = np.random.default_rng(5).random(len(S))
    x = np.linalg.solve(S, b)
    y = ltcl.solve(C.interreflection, b, "gmres", rtol=RTOL).x
    assert np.linalg.norm(y - x) <= (C.error + RTOL * np.linalg.cond(S)) * np.linalg.norm(x)
    refined = ltcl.solve(C.interreflection, b, rtol=1e-5, exact=T.interreflection).x
    np.testing.assert_allclose(refined, x, atol=1e-3 * np.abs(x).max())


def test_the_diagonal_is_that_of_what_was_compressed():
    T, C = spilled(12, 0.1), compressed(0.1, SUM)
    np.testing.assert_allclose(C.systems[0].R.diagonal(), np.diagonal(dense(T)) - 1, atol=1e-5)


def test_sums_are_saved_and_loaded_to_the_bit(tmp_path):
    C = compressed(0.1, SUM)
    store.save(tmp_path / "C.npz", C)
    again = ltcl.load(tmp_path / "C.npz")
    b = np.random.default_rng(1).random((5, *C.grid))
    np.testing.assert_array_equal(again @ b, C @ b)
    assert again.error == C.error
    assert again.systems[0].R.error == C.systems[0].R.error


def test_a_budget_that_only_a_sum_keeps():
    T = spilled(12, 0.1)
    least, alone = (compressed(0.1, basis).compression.nbytes for basis in (SUM, "db2"))
    C = ltcl.compress(T, RTOL, budget=(least + alone) // 2, basis=["db2", SUM])
    assert C.compression.channels[0].basis == SUM
    assert C.compression.nbytes <= (least + alone) // 2
    with pytest.raises(InputError, match=r"budget is \d+ bytes, but rtol 0.02 needs \d+") as refused:
        ltcl.compress(T, RTOL, budget=least // 2, basis=SUM)
    allowed = re.search(r"allows rtol ([\d.]+)", str(refused.value))
    assert allowed is not None
    looser = ltcl.compress(T, float(allowed[1]), budget=least // 2, basis=SUM)
    assert looser.compression.nbytes <= least // 2


def test_without_room_on_the_host_a_sum_is_left_or_refused(monkeypatch):
    T = spilled(8, 0.1)
    assert T.systems
    monkeypatch.setattr(checks, "host_memory", lambda: 300_000)  # 4 of 128 x 128 numbers
    (told,) = ltcl.compress(T, 0.1, basis=["haar", SUM]).compression.channels
    assert told.basis == "haar"
    assert "R of 128 pixels in two parts needs 320 KiB" in told.trials[1].left
    with pytest.raises(MemoryLimitError, match="R of 128 pixels in two parts"):
        ltcl.compress(T, 0.1, basis=SUM)


def test_room_is_asked_for_the_whole_and_not_for_a_window(monkeypatch):
    T = spilled(8, 0.1)
    monkeypatch.setattr(window, "SIDE", 8)
    C = ltcl.compress(T, 0.05, basis=SUM)
    assert C.compression.window == (8, 8)
    assert np.linalg.norm(C.systems[0].to_dense() - dense(T), 2) <= C.systems[0].R.error
    monkeypatch.setattr(checks, "host_memory", lambda: 300_000)
    with pytest.raises(MemoryLimitError, match="R of 128 pixels in two parts"):
        ltcl.compress(T, 0.05, basis=SUM)


def test_sums_are_inverted_in_one_basis():
    C = compressed(0.1, SUM)
    assert isinstance(C.systems[0].R, Sum)
    inverse = ltcl.invert(C, 0.4)
    S = dense(spilled(12, 0.1))
    assert np.linalg.norm(np.eye(len(S)) - inverse.systems[0].to_dense() @ S, 2) <= inverse.error <= 0.4
    with pytest.raises(InputError, match=re.escape(f"basis is {SUM!r}; an inverse needs one basis")):
        ltcl.invert(spilled(4, 0.1), basis=SUM)


@pytest.mark.parametrize("name", ["db2 rows + pixels", "db2 + pixels rows", "pixels + pixels", " + pixels"])
def test_names_of_no_sum_are_refused(name):
    with pytest.raises(InputError, match=re.escape(f"basis is {name!r}; it must be pixels")):
        ltcl.compress(spilled(2, 0.1), basis=name)
