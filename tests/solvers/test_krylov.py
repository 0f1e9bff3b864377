# SPDX-License-Identifier: BSD-3-Clause
"""Krylov methods: textbook bounds, iterates and breakdowns; columns apart; launches, waits; the kernels."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

import ltcl
from ltcl.device import Array
from ltcl.errors import ConvergenceError, InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from ltcl.solvers.columns import STATE, Columns
from tests import gallery, reference
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import force_groups

random = np.random.default_rng(71)
METHODS = {
    "cg": ("cg", {}),
    "gmres": ("gmres", {}),
    "restarted": ("gmres", {"restart": 3}),
    "bicgstab": ("bicgstab", {}),
}
EACH = pytest.mark.parametrize("method", tuple(METHODS))


def solve(method: str, S, b: np.ndarray, rtol: float = 1e-5, **options) -> ltcl.Solution:
    name, own = METHODS[method]
    return ltcl.solve(S, b, name, rtol=rtol, **own, **options)


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
@pytest.mark.parametrize("size", [1e3, 1e37])
def test_starts_far_off(device, method, size):
    """Squares of the larger leave float32: said, and nothing is claimed."""
    scene, b = enclosure(30, 0.6), random.uniform(size=(30, 3))
    x0 = size * random.uniform(0.5, 1.0, size=(30, 3))
    s = solve(method, as_operator(scene.S, device), b, 1e-3, x0=x0, throw=False)
    assert s.converged == (size == 1e3)
    assert not s.converged or residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-2)


def broken(method: str, S: Any, b: Any, status: Status, device) -> ltcl.Solution:
    """A solve that has to end so, with an x that is no worse than none."""
    S = np.array(S, float)
    with pytest.raises(ConvergenceError) as caught:
        solve(method, as_operator(S, device), np.array(b))
    s = caught.value.solution
    assert s.status is status
    assert residual(S, s.x, np.array(b)) <= 1.0
    return s


TURN, SIGNS = [[0.0, 1.0], [-1.0, 0.0]], np.diag([1.0, -1.0])  # <b, S b> = 0 for b = (1, 1)
ENDS = {
    "cg, negative": ("cg", np.diag([-1.0, -2.0, -3.0]), np.ones(3), Status.INDEFINITE),
    "cg, singular": ("cg", np.diag([0.0, 1.0, 2.0]), [1.0, 0.0, 0.0], Status.INDEFINITE),
    "cg, turn": ("cg", TURN, [1.0, 1.0], Status.INDEFINITE),
    "gmres, singular": ("gmres", np.diag([0.0, 1.0]), [1.0, 1.0], Status.BREAKDOWN),
    "gmres, nilpotent": ("gmres", [[0.0, 1.0], [0.0, 0.0]], [1.0, 0.0], Status.BREAKDOWN),
    "bicgstab, turn": ("bicgstab", TURN, [1.0, 1.0], Status.NO_STEP),
    "bicgstab, signs": ("bicgstab", SIGNS, [1.0, 1.0], Status.NO_STEP),
}


@pytest.mark.parametrize("case", ENDS)
def test_where_no_step_exists_it_ends_and_what_it_advises_works(device, case):
    method, S, b, status = ENDS[case]
    broken(method, S, b, status, device)
    if status is not Status.BREAKDOWN and np.linalg.det(S):
        assert solve("gmres", as_operator(np.array(S), device), np.array(b)).converged


@pytest.mark.parametrize("method", ["cg", "bicgstab"])
def test_a_broken_column_leaves_the_others_their_solution(device, method):
    S = scipy.linalg.block_diag(np.zeros((1, 1)) if method == "cg" else TURN, np.diag([1.0, 2.0, 4.0]))
    n = 1 if method == "cg" else 2
    b = np.stack([np.append(np.zeros(n), np.ones(3)), np.append(np.ones(n), np.zeros(3))], axis=1)
    s = solve(method, as_operator(S, device), b, throw=False)
    assert s.status is (Status.INDEFINITE if method == "cg" else Status.NO_STEP)
    np.testing.assert_allclose(s.x[n:, 0], [1.0, 0.5, 0.25], rtol=1e-4)


# Conjugate gradients.


@pytest.mark.parametrize("rho", [0.8, 4.0, 50.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_energy_of_the_error_falls_as_the_condition_number_tells(device, seed, rho):
    """||e_k|| <= 2 ((sqrt(c) - 1) / (sqrt(c) + 1))^k ||e_0|| in the energy norm (Saad, eq. 6.128)."""
    scene = lambertian(40, rho, seed)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(size=scene.n)
    eigenvalues = np.linalg.eigvals(scene.S).real
    root = np.sqrt(eigenvalues.max() / eigenvalues.min())
    exact = np.linalg.solve(scene.S, b)

    def energy(error: np.ndarray) -> float:
        return float(np.sqrt((scene.weights * error) @ (scene.S @ error)))

    for k in (1, 2, 4, 6):
        s = ltcl.solve(S, b, "cg", weights=2.0**200 * scene.weights, maxiter=k, rtol=1e-6, throw=False)
        bound = 2 * ((root - 1) / (root + 1)) ** s.iterations
        assert energy(exact - s.x) <= (bound + 1e-5 * root) * energy(exact)


@pytest.mark.parametrize("distinct", [1, 2, 4])
def test_as_many_steps_as_distinct_eigenvalues(device, distinct):
    Q = np.linalg.qr(random.normal(size=(30, 30)))[0]
    S = (Q * np.resize(np.linspace(1.0, 3.0, distinct), 30)) @ Q.T
    s = solve("cg", as_operator(S, device), random.normal(size=30))
    assert s.iterations == distinct
    assert s.products == s.iterations + 1


def test_a_transport_brings_its_weights(device):
    """A box of walls from dark to white: self-adjoint with 1 / F, and far from it without."""
    scene = ltcl.scenes.box(6, sides=5, albedo=(0.1, 0.9, 0.3, 0.95, 0.6))
    T = scene.transport(device=device)
    (S,) = T.systems
    dense, n = S.to_dense(), T.shape[1]
    b = dense @ random.uniform(size=n)
    s = ltcl.solve(S, b, "cg", rtol=1e-4)
    assert residual(dense, s.x, b) <= 1e-4 * (1 + 1e-2)
    np.testing.assert_array_equal(ltcl.solve(S, b, "cg", rtol=1e-4, weights=1.0 / T.first_bounce).x, s.x)
    plain = ltcl.solve(S, b, "cg", rtol=1e-4, weights=np.ones(n), throw=False)
    assert not plain.converged or plain.products > s.products


BAD: list[tuple[str, dict[str, Any], type[Exception], str]] = [
    ("cg", {"weights": np.ones(4)}, InputError, r"weights.*\(4,\).*\(3,\)"),
    ("cg", {"weights": [1.0, 0.0, -1.0]}, InputError, "weights has 2 .*positive"),
    ("cg", {"weights": [1.0, np.nan, 1.0]}, InputError, "weights has 1 NaN"),
    ("cg", {"weights": "area"}, InputTypeError, "weights is"),
    *(("gmres", {"restart": value}, InputError, "restart is .* 1") for value in (0, -1, 2.5, "all", None)),
]


@pytest.mark.parametrize(("method", "options", "error", "says"), BAD)
def test_unusable_options_are_refused(method, options, error, says):
    with pytest.raises(error, match=says):
        ltcl.solve(np.eye(3), np.ones(3), method, **options)


# GMRES.


def smallest_residual(S: np.ndarray, b: np.ndarray, k: int) -> float:
    """min ||b - S x|| / ||b|| over the Krylov space of dimension k, in float64 on an orthonormal basis."""
    basis = b[:, None] / np.linalg.norm(b)
    for _ in range(k - 1):
        basis = np.linalg.qr(np.column_stack([basis, S @ basis[:, -1]]))[0]
    return residual(S, basis @ np.linalg.lstsq(S @ basis, b)[0], b)


@pytest.mark.parametrize(
    "make", [lambda: lambertian(40, 4.0, 24).S, lambda: np.eye(40) + random.normal(size=(40, 40)) / 8]
)
@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_no_polynomial_of_that_degree_has_a_smaller_residual(device, make, k):
    S, b = make(), random.normal(size=(40, 2))
    s = ltcl.solve(as_operator(S, device), b, "gmres", maxiter=k, rtol=1e-6, throw=False)
    assert s.iterations == k
    for column, x in zip(b.T, s.x.T, strict=True):
        assert residual(S, x, column) == pytest.approx(smallest_residual(S, column, k), rel=1e-3, abs=1e-7)


@pytest.mark.parametrize("restart", [1, 2, 3, 20])
def test_the_residual_never_grows(device, restart):
    scene = lambertian(60, 9.0, 25, density=0.2)
    b = random.normal(size=(60, 3))
    s = ltcl.solve(as_operator(scene.S, device), b, "gmres", restart=restart, rtol=1e-4)
    assert residual(scene.S, s.x, b) <= 1e-4 * (1 + 1e-2)
    assert all(after <= before * (1 + 1e-4) for before, after in itertools.pairwise(s.residuals))
    assert s.products <= s.iterations + 1  # the end is confirmed, where the recursion does not prove it


def test_a_singular_system_with_a_solution_is_solved(device):
    b = np.array([1.0, 2.0, 0.0])
    s = ltcl.solve(as_operator(np.diag([1.0, 4.0, 0.0]), device), b, "gmres", rtol=1e-5)
    np.testing.assert_allclose(s.x, [1.0, 0.5, 0.0], atol=1e-5)


def test_directions_that_do_not_fit_are_refused_with_their_sizes(device, monkeypatch):
    S = as_operator(scipy.sparse.csr_array(scipy.sparse.eye_array(5000) * 2.0), device)
    monkeypatch.setattr(device, "memory", 10_000_000)
    with pytest.raises(MemoryLimitError, match=r"restart=1000\b.*1001"):
        ltcl.solve(S, random.normal(size=5000), "gmres", restart=10**9)


# BiCGStab.


def textbook(S: np.ndarray, b: np.ndarray, steps: int) -> np.ndarray:
    """van der Vorst's algorithm in float64, from 0 with r_0* = b."""
    x, r, p = np.zeros_like(b), b.copy(), b.copy()
    for _ in range(steps):
        rho, v = r @ b, S @ p
        alpha = rho / (v @ b)
        s = r - alpha * v
        t = S @ s
        omega = (t @ s) / (t @ t)
        x += alpha * p + omega * s
        r = s - omega * t
        p = r + (r @ b) / rho * alpha / omega * (p - omega * v)
    return x


@pytest.mark.parametrize("steps", [1, 2, 4])
@pytest.mark.parametrize("skew", [0.0, 0.1])
def test_the_iterates_of_bicgstab_are_the_textbooks(device, skew, steps):
    random = np.random.default_rng(1)  # the residual falls at every step: the best iterate is the last one
    S = lambertian(40, 4.0, 29).S + skew * random.normal(size=(40, 40))
    b = random.normal(size=(40, 2))
    s = ltcl.solve(as_operator(S, device), b, "bicgstab", maxiter=steps, rtol=1e-6, throw=False)
    assert s.iterations == steps
    for column in range(2):
        x = textbook(S, b[:, column], steps)
        np.testing.assert_allclose(s.x[:, column], x, rtol=0, atol=1e-3 * np.abs(x).max())


def test_a_vanished_rho_starts_anew(device):
    """s = b - S b = -e_2 and S^T b = e_1: r_1 is orthogonal to r_0* = b, the textbook would divide by 0."""
    S, b = np.array([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1.0]]), np.array([1.0, 0.0, 0.0])
    s = ltcl.solve(as_operator(S, device), b, "bicgstab", rtol=1e-4)
    assert residual(S, s.x, b) <= 1e-4 * (1 + 1e-2)


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


# Launches, waits and kernels.

STATIONARY = [("richardson", 1.5, 0.5), ("chebyshev", 1.5, 0.5)]  # one more adds up norms
METHODS["richardson"] = "richardson", {"omega": 1e-3}
METHODS["chebyshev"] = "chebyshev", {"spectrum": (0.5, 1100.0)}


@pytest.mark.parametrize(
    ("method", "launches", "waits"),
    [("cg", 3, 0.5), ("gmres", 5, 1.0), ("bicgstab", 5, 0.5), *STATIONARY],
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
        before = device.launches.total()
        s = solve(method, S, b, maxiter=steps, throw=False)
        assert s.iterations == steps
        counts.append((device.launches.total() - before, len(waited), len(taken)))
    pieces = 2 if k == 5 else 1  # launches of a product
    products = 2 if method == "bicgstab" else 1
    made, waits_made, allocated = ((last - first) / 12 for first, last in zip(*counts, strict=True))
    assert made <= launches + products * (pieces - 1)
    assert waits_made <= waits
    assert allocated <= 0.5  # what reading residuals and keeping the best iterate take, once in some steps


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
    columns = Columns(W, "krylov", "krylov_pairs", "krylov_subtract")
    tolerance = reference.gamma(rows + 40) * rows * 30
    sums = columns.sums(7)
    columns.bind("krylov_pairs", 0, 0, W, on_device, W, W, sums, across=7)()
    found = sums.get().reshape(columns.slices, 7, k).sum(axis=0)
    np.testing.assert_allclose(
        found, reference.krylov_pairs([(v, w) for v in (*V, w)], np.ones_like(w)), rtol=0, atol=tolerance
    )

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
    numbers, arrays = state(_0=2.0, _1=0.7), [device.upload(v) for v in vectors[:5]]
    resting = device.upload(rest, np.int32)
    columns.bind("krylov_cg", slices, 0, 0, resting, partials, numbers, *arrays, extra=2)()
    alpha, *wanted = reference.krylov_cg(sums, 2.0 * ones, 0.7 * ones, ~rest, *vectors[:5])
    for array, new in zip(arrays[1:], wanted, strict=True):
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
