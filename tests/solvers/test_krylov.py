# SPDX-License-Identifier: BSD-3-Clause
"""Krylov methods: iterates of the textbook, columns apart; launches, waits; the kernels."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg

import ltcl
from ltcl.device import Array, vectors
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from ltcl.solvers.bounded import minimise
from ltcl.solvers.column_reductions import ColumnReductions
from ltcl.solvers.krylov_state import STATE_ROWS
from tests import gallery, reference
from tests.bases import rotation
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import force_groups

random = np.random.default_rng(71)


@pytest.mark.parametrize(
    ("method", "options"), [("cg", {}), ("gmres", {}), ("gmres", {"restart": 3}), ("bicgstab", {})]
)
def test_columns_do_not_know_of_each_other(device, method, options):
    """Together or alone, a column takes the same steps; one that is solved, or dark, rests."""
    scene = enclosure(40, 0.8, seed=18)
    S = IdentityPlus(Dense(device, scene.R))
    eigenvectors = np.linalg.eigh(scene.S)[1]
    b = np.stack([eigenvectors[:, 3], np.zeros(40), random.normal(size=40), np.ones(40)], axis=1)
    x = ltcl.solve(S, b, method, rtol=1e-5, **options).x
    for together, column in zip(x.T, b.T, strict=True):
        alone = ltcl.solve(S, column, method, rtol=1e-5, **options).x
        np.testing.assert_allclose(together, alone, rtol=0, atol=2e-5)
    assert residual(scene.S, x, b) <= 1e-5 * (1 + 1e-2)


@pytest.mark.parametrize("method", ["cg", "bicgstab"])
def test_a_broken_column_leaves_the_others_their_solution(device, method):
    first = np.zeros((1, 1)) if method == "cg" else [[0.0, 1.0], [-1.0, 0.0]]
    S = scipy.linalg.block_diag(first, np.diag([1.0, 2.0, 4.0]))
    n = len(first)
    b = np.stack([np.append(np.zeros(n), np.ones(3)), np.append(np.ones(n), np.zeros(3))], axis=1)
    s = ltcl.solve(as_operator(S, device), b, method, rtol=1e-5, throw=False)
    assert s.status is (Status.INDEFINITE if method == "cg" else Status.NO_STEP)
    np.testing.assert_allclose(s.x[n:, 0], [1.0, 0.5, 0.25], rtol=1e-4)


def krylov_basis(S: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
    """(N, k), orthonormal in float64, of the space that k - 1 products span."""
    basis = b[:, None] / np.linalg.norm(b)
    for _ in range(k - 1):
        basis = np.linalg.qr(np.column_stack([basis, S @ basis[:, -1]]))[0]
    return basis


def least_energy(S: np.ndarray, b: np.ndarray, k: int, weights: np.ndarray) -> np.ndarray:
    """The iterate of CG: its error is orthogonal to the space in <x, S y> (Saad, section 6.7)."""
    V = krylov_basis(S, b, k)
    left = V.T * weights
    return V @ np.linalg.solve(left @ S @ V, left @ b)


def least_residual(S: np.ndarray, b: np.ndarray, k: int, _: np.ndarray) -> np.ndarray:
    """The iterate of GMRES."""
    V = krylov_basis(S, b, k)
    return V @ np.linalg.lstsq(S @ V, b)[0]


def van_der_vorst(S: np.ndarray, b: np.ndarray, k: int, _: np.ndarray) -> np.ndarray:
    """BiCGStab from 0 with r_0* = b."""
    x = np.zeros_like(b)
    r = b.copy()
    p = b.copy()
    for _step in range(k):
        rho = r @ b
        v = S @ p
        alpha = rho / (v @ b)
        s = r - alpha * v
        t = S @ s
        omega = (t @ s) / (t @ t)
        x += alpha * p + omega * s
        r = s - omega * t
        p = r + (r @ b) / rho * alpha / omega * (p - omega * v)
    return x


TEXTBOOKS: dict[str, tuple[Callable[..., np.ndarray], int]] = {  # products of a step
    "cg": (least_energy, 1),
    "gmres": (least_residual, 1),
    "bicgstab": (van_der_vorst, 2),
}


@pytest.mark.parametrize("steps", [1, 2, 4])
@pytest.mark.parametrize(("method", "rho", "skew"), [
    ("cg", 0.8, 0.0), ("cg", 4.0, 0.0), ("gmres", 4.0, 0.0), ("gmres", 0.5, 1 / 8),
    ("bicgstab", 4.0, 0.0), ("bicgstab", 4.0, 0.1),
])  # fmt: skip
def test_iterates_are_those_of_the_textbook(device, method, rho, skew, steps):
    # Residuals fall at every step: the best iterate is the last one.
    random = np.random.default_rng(1)
    scene = lambertian(40, rho, 29)
    S = scene.S + skew * random.normal(size=(40, 40))
    b = random.normal(size=(40, 2))
    weights = scene.weights
    (iterate, products) = TEXTBOOKS[method]
    options: dict[str, Any] = {"weights": 2.0**200 * weights} if method == "cg" else {}
    s = ltcl.solve(
        as_operator(S, device), b, method, maxiter=steps, rtol=1e-6, throw=False, **options
    )
    assert s.iterations == steps
    assert s.products <= products * (steps + 1) - 1 + s.converged  # whose end is confirmed
    for x, column in zip(s.x.T, b.T, strict=True):
        exact = iterate(S, column, steps, weights)
        np.testing.assert_allclose(x, exact, rtol=0, atol=1e-3 * np.abs(exact).max())


def test_a_transport_brings_its_weights(device):
    """A box of walls from dark to white: self-adjoint with 1 / F, and far from it without."""
    scene = ltcl.scenes.box(6, sides=5, albedo=(0.1, 0.9, 0.3, 0.95, 0.6))
    T = scene.transport(device=device)
    (S,) = T.systems
    dense = S.to_dense()
    n = T.shape[1]
    b = dense @ random.uniform(size=n)
    s = ltcl.solve(S, b, "cg", rtol=1e-4)
    assert residual(dense, s.x, b) <= 1e-4 * (1 + 1e-2)
    np.testing.assert_array_equal(
        ltcl.solve(S, b, "cg", rtol=1e-4, weights=1.0 / T.first_bounce).x, s.x
    )
    plain = ltcl.solve(S, b, "cg", rtol=1e-4, weights=np.ones(n), throw=False)
    assert not plain.converged or plain.products > s.products


@pytest.mark.parametrize("restart", [1, 2, 3, 20])
def test_the_residual_of_gmres_never_grows(device, restart):
    scene = lambertian(60, 9.0, 25, density=0.2)
    b = random.normal(size=(60, 3))
    s = ltcl.solve(as_operator(scene.S, device), b, "gmres", restart=restart, rtol=1e-4)
    assert residual(scene.S, s.x, b) <= 1e-4 * (1 + 1e-2)
    assert all(after <= before * (1 + 1e-4) for before, after in itertools.pairwise(s.residuals))
    # The end is confirmed, where the recursion does not prove it.
    assert s.products <= s.iterations + 1


@pytest.mark.parametrize(
    ("method", "S"),
    [("gmres", np.diag([1.0, 4.0, 0.0])), ("bicgstab", np.eye(3) + np.eye(3, k=-1))],
)
def test_what_stops_the_textbook_is_solved(device, method, S):
    """A singular S; and S b with s = -e_2, S^T b = e_1: r_1 is orthogonal to r_0*, and rho is 0."""
    b = np.array([1.0, 2.0, 0.0]) if method == "gmres" else np.array([1.0, 0.0, 0.0])
    s = ltcl.solve(as_operator(S, device), b, method, rtol=1e-5)
    assert residual(S, s.x, b) <= 1e-5 * (1 + 1e-2)


# Launches, waits and kernels.

STEPS: dict[str, tuple[float, float, dict[str, Any]]] = {  # launches and waits of each, options
    "cg": (3, 0.5, {}),
    "gmres": (5, 1.0, {}),
    "bicgstab": (5, 0.5, {}),
    "richardson": (1.5, 0.5, {"omega": 1e-3}),  # one more adds up norms
    "chebyshev": (1.5, 0.5, {"spectrum": (0.5, 1100.0)}),
    "bounded": (6, 1.0, {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", STEPS)
@pytest.mark.parametrize("k", [1, 3, 5])
def test_launches_waits_and_allocations_of_a_step(device, monkeypatch, method, k):
    launches, waits, options = STEPS[method]
    Q = rotation(200)
    S = IdentityPlus(Dense(device, (Q * np.logspace(0, 3, 200)) @ Q.T - np.eye(200)))
    b = random.normal(size=(200, k))
    weights = random.uniform(0.5, 1.5, (200, k))
    waited = []
    taken = []
    counts = []
    read = Array.get
    write = Array.set
    empty = type(device).empty
    monkeypatch.setattr(Array, "get", lambda array: waited.append(array) or read(array))
    monkeypatch.setattr(
        Array, "set", lambda array, values: waited.append(array) or write(array, values)
    )
    monkeypatch.setattr(
        type(device), "empty", lambda self, *a, **b: taken.append(a) or empty(self, *a, **b)
    )
    for steps in (6, 18):
        waited.clear()
        taken.clear()
        before = device.launches.total()
        if method == "bounded":
            box = np.zeros(200), np.ones(200), np.zeros((200, k))
            s = minimise(S, b, *box, weights=weights, rtol=1e-9, maxiter=steps)
        else:
            s = ltcl.solve(S, b, method, rtol=1e-5, maxiter=steps, throw=False, **options)
        assert s.iterations == steps
        counts.append((device.launches.total() - before, len(waited), len(taken)))
    pieces = 2 if k == 5 else 1  # launches of a product
    products = 2 if method in ("bicgstab", "bounded") else 1
    made, waits_made, allocated = ((last - first) / 12 for first, last in zip(*counts, strict=True))
    assert made <= launches + products * (pieces - 1)
    assert waits_made <= waits
    # What reading residuals and keeping the best iterate take, once in some steps.
    assert allocated <= 0.5


SIZES = pytest.mark.parametrize(("rows", "k"), [(1, 1), (53, 5), (257, 3), (40, 70), (5001, 1)])
GROUPS = pytest.mark.parametrize("group", [1, 100])  # sums in trees work for any size


@pytest.mark.slow
@SIZES
@GROUPS
def test_inner_products_and_subtraction_meet_their_twins(device, monkeypatch, rows, k, group):
    force_groups(monkeypatch, device, group)
    V = np.stack([gallery.vectors(rows, k, seed) for seed in range(6)])
    w, u, weights = (gallery.vectors(rows, k, seed) for seed in range(6, 9))
    on_device = device.upload(np.concatenate([V.reshape(6, -1), np.zeros((1, rows * k))]))
    W = device.upload(w)
    U = device.upload(u)
    weighing = device.upload(weights)
    columns = ColumnReductions(W, "vector_dots", "krylov_subtract")
    tolerance = reference.gamma(rows + 40) * rows * 30
    sums = columns.sums(7)
    plain = {"first": 0, "weighted": 0, "weights": W}
    columns.bind("vector_dots", across=7, pairs=0, a=on_device, b=W, c=W, partials=sums, **plain)()
    found = sums.get().reshape(columns.slices, 7, k).sum(axis=0)
    np.testing.assert_allclose(
        found,
        reference.vector_dots([(v, w) for v in (*V, w)], np.ones_like(w)),
        rtol=0,
        atol=tolerance,
    )

    pairs = columns.sums(2)
    columns.bind(
        "vector_dots",
        across=2,
        first=0,
        pairs=vectors.dot_pairs("ab", "cc"),
        weighted=1,
        weights=weighing,
        a=W,
        b=U,
        c=U,
        partials=pairs,
    )()
    found = pairs.get().reshape(columns.slices, 2, k).sum(axis=0)
    wanted = reference.vector_dots([(w, u), (u, u)], weights)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=tolerance)

    before, h = (device.upload(np.full((7, k), 1e-3)) for _ in range(2))
    small = np.linspace(-1e-3, 1e-3, 7 * k).reshape(7, k).astype(np.float32)
    small[6] = 4.0  # <w, w>
    for again, finish in ((0, 0), (1, 1)):
        out = W.like()
        columns.bind(
            "krylov_subtract",
            extra=8,
            count=6,
            slices=1,
            second_pass=again,
            unit_length=finish,
            partials=device.upload(small),
            first_pass=before,
            h=h,
            V=on_device,
            w=W,
            out=out,
        )()
        wanted = reference.krylov_subtract(V, w, small[:6], small[6] if finish else None)
        np.testing.assert_allclose(out.get(), wanted, rtol=0, atol=1e-5)
        np.testing.assert_allclose(
            h.get()[:6], small[:6] + again * np.float32(1e-3), rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(
            h.get()[6], np.sqrt(4 - np.sum(small[:6] ** 2, axis=0)), rtol=1e-6
        )
    np.testing.assert_array_equal(on_device.get()[6], out.get().ravel())  # the next direction


@pytest.mark.slow
@SIZES
@GROUPS
def test_steps_meet_their_twins(device, monkeypatch, rows, k, group):
    force_groups(monkeypatch, device, group)
    vectors = [gallery.vectors(rows, k, seed) for seed in range(7)]
    columns = ColumnReductions(
        device.upload(vectors[0]), "krylov_cg", "krylov_half", "krylov_bicgstab"
    )
    slices = columns.slices
    rest = np.arange(k) % 3 == 1
    ones = np.ones(k)
    close: dict[str, Any] = {"rtol": 1e-5, "atol": 1e-4}

    def summed(*totals: float) -> tuple[np.ndarray, Array]:
        """Sums (sums, k) that differ by column, and the same in slices on the device."""
        values = np.outer(totals, 1.0 + np.arange(k) / (2 * k))
        return values, device.upload(
            np.repeat(values[None] / slices, slices, axis=0).reshape(-1, k)
        )

    def state(**rows: float) -> Array:
        """Numbers of even steps, by row."""
        numbers = columns.state()
        values = numbers.get()
        for row, value in rows.items():
            values[int(row[1:])] = value
        return numbers.set(values)

    def squares(numbers: Array) -> np.ndarray:
        return numbers.get()[STATE_ROWS : STATE_ROWS + slices].sum(axis=0)

    sums, partials = summed(0.9, 1.3)
    numbers = state(_0=2.0, _1=0.7)
    arrays = [device.upload(v) for v in vectors[:5]]
    resting = device.upload(rest, np.int32)
    shared = {"slices": slices, "iteration": 0, "state": numbers}
    columns.bind(
        "krylov_cg",
        extra=2,
        restart=0,
        resting=resting,
        partials=partials,
        **dict(zip("wpqxr", arrays, strict=True)),
        **shared,
    )()
    alpha, *wanted = reference.krylov_cg(sums, 2.0 * ones, 0.7 * ones, ~rest, *vectors[:5])
    for array, new in zip(arrays[1:], wanted, strict=True):
        np.testing.assert_allclose(array.get(), new, **close)
    # Read by odd steps.
    np.testing.assert_allclose(numbers.get()[5], np.where(rest, 0.7, alpha), rtol=1e-5)
    np.testing.assert_allclose(squares(numbers), np.sum(wanted[-1] ** 2, axis=0), rtol=1e-4)

    r, v, half, t, p, x, g = vectors
    R, V, H, T, P, X, G = (device.upload(u) for u in vectors)
    (sigma, _), two = summed(1.7, 2.0)
    numbers = state(_0=1.2, _9=3.0, _10=2.0)
    shared |= {"state": numbers, "r": R, "v": V, "half_way": H}
    columns.bind("krylov_half", extra=2, partials=two, **shared)()
    half = reference.krylov_half(1.2 * ones, sigma, r, v)
    np.testing.assert_allclose(H.get(), half, **close)
    five, partials = summed(0.8, 1.1, 1.5, 0.6, 2.5)
    more = {"partials": partials, "next_partials": two, "g": G, "t": T, "p": P, "x": X}
    columns.bind("krylov_bicgstab", extra=5, first=0, **more, **shared)()
    rho, *wanted = reference.krylov_bicgstab(five[:4], 1.2 * ones, 1.2 / sigma, half, t, v, p, x)
    np.testing.assert_allclose(numbers.get()[4], rho, rtol=1e-5)
    for array, new in zip((X, R, P), wanted, strict=True):
        np.testing.assert_allclose(array.get(), new, **close)
    np.testing.assert_allclose(squares(numbers), np.sum(wanted[1] ** 2, axis=0), rtol=1e-4)
    following = two.get().reshape(slices, 2, k).sum(axis=0)
    gp = np.sum(g * wanted[2], axis=0)
    np.testing.assert_allclose(following[0], gp, rtol=1e-3, atol=1e-3 * np.sqrt(rows))
    np.testing.assert_allclose(following[1], np.sum(wanted[2] ** 2, axis=0), rtol=1e-4)
