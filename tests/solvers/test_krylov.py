# SPDX-License-Identifier: BSD-3-Clause
"""Krylov methods as a table: method, operator, right-hand sides; launches, waits; the kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import ltcl
from ltcl.device import Array
from ltcl.errors import MemoryLimitError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from ltcl.solvers.columns import STATE, Columns
from tests import gallery, reference
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import force_groups

random = np.random.default_rng(71)
METHODS = {
    "cg": ("cg", {}),
    "cgnr": ("cg", {"normal": True}),
    "gmres": ("gmres", {}),
    "restarted": ("gmres", {"restart": 3}),
    "bicgstab": ("bicgstab", {}),
}
EACH = pytest.mark.parametrize("method", METHODS)
KINDS = {
    "dense": lambda device, S: as_operator(S, device),
    "csr": lambda device, S: as_operator(scipy.sparse.csr_array(S), device),
    "I + R": lambda device, S: IdentityPlus(Dense(device, S - np.eye(len(S)))),
    "host": lambda device, S: as_operator(scipy.sparse.linalg.aslinearoperator(S), device),
}


def solve(method: str, S, b: np.ndarray, rtol: float = 1e-5, **options) -> ltcl.Solution:
    name, given = METHODS[method]
    return ltcl.solve(S, b, name, rtol=rtol, **given, **options)


@EACH
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [None, 1, 3, 5])
def test_every_method_on_every_operator(device, method, kind, k):
    scene = enclosure(53, 0.7, seed=4)
    b = random.uniform(size=(53,) if k is None else (53, k))
    s = solve(method, KINDS[kind](device, scene.S), b)
    assert residual(scene.S, s.x, b) <= 1e-5 * (1 + 2e-2)
    exact = np.linalg.solve(scene.S, b)
    assert np.linalg.norm(s.x - exact) <= 2e-5 * np.linalg.cond(scene.S) * np.linalg.norm(exact)


@pytest.mark.parametrize("k", [None, 3])
def test_bicgstab_needs_no_transpose(device, k):
    scene = enclosure(30, 0.7)
    act = lambda x: scene.S @ x  # noqa: E731
    parts: dict[str, Any] = {"shape": (30, 30), "matvec": act, "matmat": act, "dtype": float}
    S = as_operator(scipy.sparse.linalg.LinearOperator(**parts), device)
    b = random.uniform(size=(30,) if k is None else (30, k))
    s = ltcl.solve(S, b, "bicgstab", rtol=1e-5)
    assert residual(scene.S, s.x, b) <= 1e-5 * (1 + 2e-2)
    assert s.products == 2 * s.iterations + 1


@EACH
@pytest.mark.parametrize("group", [1, 7, 64])
@pytest.mark.parametrize("k", [1, 3, 9, 70])
def test_any_work_group_will_do(device, monkeypatch, method, group, k):
    force_groups(monkeypatch, device, group)
    scene = enclosure(40, 0.7, seed=5)
    b = random.uniform(size=(40, k))
    assert residual(scene.S, solve(method, as_operator(scene.S, device), b).x, b) <= 1e-5 * (1 + 2e-2)


@EACH
def test_columns_do_not_know_of_each_other(device, method):
    """Together or alone, a column takes the same steps; one that is solved, or dark, rests."""
    scene = enclosure(40, 0.8, seed=18)
    S = IdentityPlus(Dense(device, scene.R))
    eigenvectors = np.linalg.eigh(scene.S)[1]
    b = np.stack([eigenvectors[:, 3], np.zeros(40), random.normal(size=40), np.ones(40)], axis=1)
    together = solve(method, S, b)
    for column in range(4):
        np.testing.assert_allclose(together.x[:, column], solve(method, S, b[:, column]).x, rtol=0, atol=2e-5)
    assert residual(scene.S, together.x, b) <= 1e-5 * (1 + 1e-2)


@EACH
@pytest.mark.parametrize("start", ["solution", "far", "beyond float32"])
def test_starts(device, method, start):
    scene = enclosure(30, 0.6)
    b = random.uniform(size=(30, 3))
    exact = np.linalg.solve(scene.S, b)
    x0 = {
        "solution": exact,
        "far": 1e3 * random.normal(size=(30, 3)),
        "beyond float32": np.full((30, 3), 1e37),
    }
    s = solve(method, as_operator(scene.S, device), b, 1e-3, x0=x0[start], throw=False)
    if start == "solution":
        assert s.iterations == 0
    if start == "beyond float32":  # squares leave float32: said, and nothing is claimed
        assert not s.converged
    else:
        assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-2)


@EACH
@pytest.mark.parametrize("seed", range(3))
def test_a_far_from_normal_system_is_never_claimed_wrongly(device, method, seed):
    S = np.eye(30) + 3.0 * np.triu(np.random.default_rng(seed).normal(size=(30, 30)), 1)
    b = np.random.default_rng(seed).uniform(size=(30, 2))
    s = solve(method, as_operator(S, device), b, 1e-2, throw=False, maxiter=60)
    assert not s.converged or residual(S.astype(np.float32), s.x, b) <= 1e-2 * (1 + 1e-2)


@pytest.mark.parametrize(
    ("method", "launches", "waits"),
    [("cg", 3, 0.5), ("cgnr", 4, 0.5), ("gmres", 5, 1.0), ("bicgstab", 5, 0.5)],
)
@pytest.mark.parametrize("k", [1, 3, 5])
def test_launches_waits_and_allocations_of_a_step(device, monkeypatch, method, launches, waits, k):
    Q = np.linalg.qr(random.normal(size=(200, 200)))[0]
    S = IdentityPlus(Dense(device, (Q * np.logspace(0, 3, 200)) @ Q.T - np.eye(200)))
    b = random.normal(size=(200, k))
    waited, taken, counts = [], [], []
    read, write, empty = Array.get, Array.set, type(device).empty
    monkeypatch.setattr(Array, "get", lambda array: waited.append(array) or read(array))
    monkeypatch.setattr(Array, "set", lambda array, values: waited.append(array) or write(array, values))
    monkeypatch.setattr(type(device), "empty", lambda self, *a, **b: taken.append(a) or empty(self, *a, **b))
    for steps in (6, 18):
        waited.clear()
        taken.clear()
        with device.profile() as profile:
            s = solve(method, S, b, maxiter=steps, throw=False)
        assert s.iterations == steps
        counts.append((sum(profile.launches.values()), len(waited), len(taken)))
    pieces = 2 if k == 5 else 1  # launches of a product
    products = {"cgnr": 2, "bicgstab": 2}.get(method, 1)
    made, waits_made, allocated = ((last - first) / 12 for first, last in zip(*counts, strict=True))
    assert made <= launches + products * (pieces - 1)
    assert waits_made <= waits
    assert allocated <= 0.5  # what reading residuals and keeping the best iterate take, once in some steps


@pytest.mark.parametrize("restart", [10**9, 30])
def test_a_restart_beyond_all_directions_is_full_gmres(device, restart):
    S, b = lambertian(30, 9.0, 3).S, random.normal(size=30)
    s = ltcl.solve(as_operator(S, device), b, "gmres", restart=restart, rtol=1e-4)
    assert residual(S, s.x, b) <= 1e-4 * (1 + 1e-2)


def test_directions_that_do_not_fit_are_refused_with_their_sizes(device, monkeypatch):
    S = as_operator(scipy.sparse.csr_array(scipy.sparse.eye_array(5000) * 2.0), device)
    monkeypatch.setattr(device, "memory", 10_000_000)
    with pytest.raises(MemoryLimitError, match=r"restart=1000\b.*1001"):
        ltcl.solve(S, random.normal(size=5000), "gmres", restart=10**9)


def test_a_product_beyond_float32_ends_the_solve(device):
    S = np.eye(4) * 1e38
    for method in METHODS:
        s = solve(method, as_operator(S, device), np.ones((4, 2)), throw=False)
        assert not s.converged or np.allclose(s.x, 1e-38)
        assert s.status in (
            Status.DIVERGED,
            Status.CONVERGED,
            Status.BREAKDOWN,
            Status.STAGNATED,
            Status.NO_STEP,
        )


SIZES = pytest.mark.parametrize(("rows", "k"), [(1, 1), (53, 5), (257, 3), (40, 70), (5001, 1)])
GROUPS = pytest.mark.parametrize("group", [1, 7, 256])


@SIZES
@GROUPS
def test_inner_products_and_subtraction_meet_their_twins(device, monkeypatch, rows, k, group):
    force_groups(monkeypatch, device, group)
    V = np.stack([gallery.vectors(rows, k, seed) for seed in range(6)])
    w, u, weights = (gallery.vectors(rows, k, seed) for seed in range(6, 9))
    on_device = device.upload(np.concatenate([V.reshape(6, -1), np.zeros((1, rows * k))]))
    W, U, weighing = device.upload(w), device.upload(u), device.upload(weights)
    columns = Columns(W, "krylov", "krylov_pairs", "krylov_dots", "krylov_subtract")
    tolerance = reference.gamma(rows + 40) * rows * 30
    sums = columns.sums(7)
    columns.bind("krylov_dots", on_device, W, sums, across=7)()
    found = sums.get().reshape(columns.slices, 7, k).sum(axis=0)
    np.testing.assert_allclose(found, reference.krylov_dots(V, w), rtol=0, atol=tolerance)

    pairs = columns.sums(2)
    columns.bind("krylov_pairs", 0b1010_0100, 1, weighing, W, U, U, pairs, across=2)()
    found = pairs.get().reshape(columns.slices, 2, k).sum(axis=0)
    wanted = reference.krylov_pairs([(w, u), (u, u)], weights)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=tolerance)

    before, h = (device.upload(np.full((7, k), 1e-3)) for _ in range(2))
    small = np.linspace(-1e-3, 1e-3, 7 * k).reshape(7, k).astype(np.float32)
    small[6] = 4.0  # <w, w>
    for again, finish in ((0, 0), (1, 1)):
        out, arguments = W.like(), (6, 1, again, finish, device.upload(small), before, h, on_device, W)
        columns.bind("krylov_subtract", *arguments, out, extra=8)()
        wanted = reference.krylov_subtract(V, w, small[:6], small[6] if finish else None)
        np.testing.assert_allclose(out.get(), wanted, rtol=0, atol=1e-5)
        np.testing.assert_allclose(h.get()[:6], small[:6] + again * np.float32(1e-3), rtol=0, atol=1e-9)
        np.testing.assert_allclose(h.get()[6], np.sqrt(4 - np.sum(small[:6] ** 2, axis=0)), rtol=1e-6)
    np.testing.assert_array_equal(on_device.get()[6], out.get().ravel())  # the next direction


@SIZES
@GROUPS
def test_steps_meet_their_twins(device, monkeypatch, rows, k, group):
    force_groups(monkeypatch, device, group)
    vectors = [gallery.vectors(rows, k, seed) for seed in range(7)]
    columns = Columns(device.upload(vectors[0]), "krylov", "krylov_cg", "krylov_half", "krylov_bicgstab")
    slices, rest, ones = columns.slices, np.arange(k) % 3 == 1, np.ones(k)
    close: dict[str, Any] = {"rtol": 1e-5, "atol": 1e-4}

    def summed(*totals: float) -> tuple[np.ndarray, Array]:
        """Sums (sums, k) that differ by column, and the same in slices on the device."""
        values = np.outer(totals, 1.0 + np.arange(k) / (2 * k))
        return values, device.upload(np.repeat(values[None] / slices, slices, axis=0).reshape(-1, k))

    def state(**rows: float) -> Array:
        """Numbers of even steps, by row."""
        numbers = columns.state()
        values = numbers.get()
        for row, value in rows.items():
            values[int(row[1:])] = value
        return numbers.set(values)

    def squares(numbers: Array) -> np.ndarray:
        return numbers.get()[STATE : STATE + slices].sum(axis=0)

    sums, partials = summed(0.9, 1.3)
    numbers, arrays = state(_0=2.0, _1=0.7), [device.upload(v) for v in vectors[:6]]
    resting = device.upload(rest, np.int32)
    columns.bind("krylov_cg", slices, 0, 0, 0, resting, partials, numbers, *arrays, extra=2)()
    alpha, *wanted = reference.krylov_cg(sums, 2.0 * ones, 0.7 * ones, ~rest, *vectors[:6])
    for array, new in zip(arrays[2:], wanted, strict=True):
        np.testing.assert_allclose(array.get(), new, **close)
    np.testing.assert_allclose(numbers.get()[5], np.where(rest, 0.7, alpha), rtol=1e-5)  # read by odd steps
    np.testing.assert_allclose(squares(numbers), np.sum(wanted[-1] ** 2, axis=0), rtol=1e-4)

    r, v, half, t, p, x, g = vectors
    R, V, H, T, P, X, G = (device.upload(u) for u in vectors)
    (sigma, _), two = summed(1.7, 2.0)
    numbers = state(_0=1.2, _9=3.0, _10=2.0)
    columns.bind("krylov_half", slices, 0, two, numbers, R, V, H, extra=2)()
    half = reference.krylov_half(1.2 * ones, sigma, r, v)
    np.testing.assert_allclose(H.get(), half, **close)
    five, partials = summed(0.8, 1.1, 1.5, 0.6, 2.5)
    arguments = (slices, 0, partials, numbers, two, G, H, T, V, P, X, R)
    columns.bind("krylov_bicgstab", *arguments, extra=5)()
    rho, *wanted = reference.krylov_bicgstab(five[:4], 1.2 * ones, 1.2 / sigma, half, t, v, p, x)
    np.testing.assert_allclose(numbers.get()[4], rho, rtol=1e-5)
    for array, new in zip((X, R, P), wanted, strict=True):
        np.testing.assert_allclose(array.get(), new, **close)
    np.testing.assert_allclose(squares(numbers), np.sum(wanted[1] ** 2, axis=0), rtol=1e-4)
    following = two.get().reshape(slices, 2, k).sum(axis=0)
    gp = np.sum(g * wanted[2], axis=0)
    np.testing.assert_allclose(following[0], gp, rtol=1e-3, atol=1e-3 * np.sqrt(rows))
    np.testing.assert_allclose(following[1], np.sum(wanted[2] ** 2, axis=0), rtol=1e-4)
