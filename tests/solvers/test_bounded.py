# SPDX-License-Identifier: BSD-3-Clause
"""Least squares within bounds against `scipy.optimize.lsq_linear`, and certificates that hold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

import ltcl
from ltcl.device import Device
from ltcl.operators import CSR, Dense, IdentityPlus, Operator, Tiles, block_diagonal
from ltcl.solvers import Bounded, Status, bounded
from ltcl.solvers.bounded import BoxProblem, minimise, minimise_each
from ltcl.solvers.column_reductions import ColumnReductions
from tests import gallery, reference
from tests.problems import enclosure, lambertian
from tests.solvers.helpers import force_groups

random = np.random.default_rng(60)
SHAPES = [(1, 1), (1, 5), (53, 5), (257, 3), (5_001, 1)]
NAMES = ("bounded_direction", "vector_dots", "bounded_move", "bounded_look")


def within(
    A: np.ndarray | Operator, b: np.ndarray, lower: Any, upper: Any, x0: Any = 0.0, **options: Any
) -> Bounded:
    """`minimise` with bounds and a start that may be of all pixels alike."""
    n = A.shape[1]
    S = Dense(ltcl.open_device(), A) if isinstance(A, np.ndarray) else A
    lower, upper = (np.broadcast_to(bound, n).astype(float) for bound in (lower, upper))
    return minimise(
        S, b, lower, upper, np.broadcast_to(x0, (n, b.shape[1])).astype(float), **options
    )


def exact(A: np.ndarray, b: np.ndarray, lower: Any, upper: Any) -> np.ndarray:
    """The least squares solution of every column in float64, (N, k)."""
    lower, upper = (np.broadcast_to(bound, A.shape[1]).astype(float) for bound in (lower, upper))
    free = lower < upper  # lsq_linear takes no others
    x = np.repeat(lower[:, None], b.shape[1], axis=1)
    rest = b - A @ x
    for column, left in zip(x.T, rest.T, strict=True):
        bounds = (np.zeros(free.sum()), (upper - lower)[free])
        column[free] += lsq_linear(A[:, free].astype(np.float64), left, bounds, tol=1e-14).x
    return x


def errors(
    A: np.ndarray, x: np.ndarray, b: np.ndarray | float, w: np.ndarray | float = 1.0
) -> np.ndarray:
    return np.linalg.norm(w * (A.astype(np.float64) @ x.astype(np.float64) - b), axis=0)


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "k"), SHAPES)
@pytest.mark.parametrize("group", [1, 100])
def test_kernels_meet_their_twins(device, monkeypatch, rows, k, group):
    force_groups(monkeypatch, device, group)
    lower = np.asarray(gallery.vectors(rows, None, 5))
    upper = lower + np.abs(gallery.vectors(rows, None, 6))
    x = lower[:, None] + (upper - lower)[:, None] * random.random((rows, k)).astype(np.float32)
    x = np.where(random.random((rows, k)) < 0.3, lower[:, None], np.minimum(x, upper[:, None]))
    q, g, d, h, r, Ad, w = (gallery.vectors(rows, k, seed) for seed in range(7, 14))
    q[random.random((rows, k)) < 0.1] = 0
    w = np.square(w)
    Q, G, D, H, R, Y, W, X, L, U = (
        device.upload(part) for part in (q, g, d, h, r, Ad, w, x, lower, upper)
    )
    columns = ColumnReductions(X, *NAMES)
    slices = columns.slices
    tolerance = reference.gamma(rows / 64 + 40) * 8 * rows
    start = np.zeros((4 + 3 * slices, k))
    start[:3] = np.linspace(0.2, 1.0, k), np.linspace(0.5, 1.0, k), np.linspace(0.3, 0.9, k)
    numbers = device.upload(start)
    rest = device.upload(np.zeros(k), np.int32)
    sums = columns.sums(3)
    squares = columns.sums(1)

    box = {"lower": L, "upper": U, "x": X, "numbers": numbers}
    columns.bind("bounded_look", restart=0, q=Q, g=G, h=H, **box)()
    new = np.stack([(-q - g) / start[2], -q])
    gap, zh = reference.bounded_look(lower, upper, x, new[1], new[0])
    looks = numbers.get()[4 : 4 + 2 * slices].reshape(slices, 2, k).sum(axis=0)
    np.testing.assert_allclose(looks, [gap, zh], rtol=0, atol=4 * tolerance)

    columns.bind(
        "bounded_direction", extra=2, slices=slices, resting=rest, g=G, d=D, sums=sums, **box
    )()
    step, (gd, dd, share) = reference.bounded_direction(
        start[0], -looks[1] / start[1], lower, upper, x, new[1], d
    )
    np.testing.assert_allclose(D.get(), step, rtol=0, atol=1e-4)
    found = sums.get().reshape(slices, 3, k)
    np.testing.assert_allclose(found[:, :2].sum(axis=0), [gd, dd], rtol=1e-3, atol=tolerance)
    np.testing.assert_allclose(found[:, 2].max(axis=0), share, rtol=1e-3)

    columns.bind(
        "vector_dots", first=0, pairs=0, weighted=1, weights=W, a=Y, b=Y, c=Y, partials=squares
    )()
    (curvature,) = reference.vector_dots([(Ad, Ad)], w)
    np.testing.assert_allclose(squares.get().sum(axis=0), curvature, rtol=1e-4)

    V = R.like()
    columns.bind(
        "bounded_move",
        extra=4,
        height=rows,
        slices=slices,
        weighted=1,
        sums=sums,
        curvatures=squares,
        d=D,
        w=W,
        Ad=Y,
        r=R,
        u=V,
        **box,
    )()
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.where(gd < 0, np.fmin(-gd / curvature, np.fmax(1 / share, 1)), 0.0)
    moved = reference.bounded_move(length, lower, upper, step, x)
    left = r - length * Ad
    np.testing.assert_allclose(numbers.get()[2], length, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(X.get(), moved, rtol=0, atol=1e-3)
    np.testing.assert_allclose(R.get(), left, rtol=0, atol=1e-3 * (1 + length.max()))
    np.testing.assert_allclose(V.get(), w * R.get(), rtol=1e-6)
    found = numbers.get()[4 + 2 * slices :].sum(axis=0)
    np.testing.assert_allclose(found, reference.vector_dots([(R.get(), R.get())], w)[0], rtol=1e-4)
    assert ((X.get() >= lower[:, None]) & (X.get() <= upper[:, None])).all()


@pytest.mark.parametrize("rho", [0.8, 4.0])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("bright", [0.5, 1.0, 2.0])
# Of the second, lengths and steps once took turns for ever.
@pytest.mark.parametrize("seed", [0, 79])
def test_it_finds_the_least_squares(rho, weighted, bright, seed):
    S = lambertian(60, rho, seed=3).S.astype(np.float32)
    random = np.random.default_rng(seed)
    lower = np.zeros(60)
    upper = random.uniform(0.3, 0.9, 60)
    lower[5] = upper[5] = 0.0  # a masked pixel
    b = bright * (S @ np.clip(random.uniform(-0.5, 1.2, (60, 3)), -0.3, 1.0))
    w = random.uniform(0.0, 2.0, (60, 3)) if weighted else np.ones((60, 3))
    s = within(S, b, lower, upper, weights=w if weighted else None, rtol=1e-5)
    columns = (exact(w[:, [c]] * S, w[:, [c]] * b[:, [c]], lower, upper) for c in range(3))
    solution = np.column_stack(list(columns))
    least = errors(S, solution, b, w)
    scale = np.linalg.norm(w * b, axis=0)
    assert s.status is Status.CONVERGED
    assert s.gap <= 1e-5
    assert (errors(S, s.x, b, w) <= least + 2e-5 * scale).all()
    np.testing.assert_allclose(s.errors, errors(S, s.x, b, w), rtol=1e-4, atol=1e-6)
    assert (s.least <= least + 1e-6 * scale).all()
    # Held are those that the exact solution leaves at a bound; where w is small it hardly matters.
    outside = np.isclose(solution, lower[:, None]) | np.isclose(solution, upper[:, None])
    assert np.mean(s.saturated != (outside & (lower < upper)[:, None])) < 0.03


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    shape=st.sampled_from([(1, 1), (3, 7), (7, 3), (20, 20), (40, 25)]),
    k=st.integers(1, 3),
    scale=st.sampled_from([1e-12, 1.0, 1e9]),
)
def test_never_above_the_start_and_never_certified_too_low(seed, shape, k, scale):
    """Each certificate holds for any matrix, at whatever step the solve is cut off."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=shape).astype(np.float32)
    b = scale * rng.normal(size=(shape[0], k))
    lower = scale * rng.uniform(-1, 0.5, shape[1])
    upper = lower + scale * rng.uniform(0, 1, shape[1])
    x0 = scale * rng.normal(size=(shape[1], k))
    s = within(A, b, lower, upper, x0, rtol=1e-5, maxiter=int(rng.choice([1, 2, 5, 200])))
    rounding = 1e-5 * (np.linalg.norm(b, axis=0) + scale)
    best = errors(A, exact(A / 1.0, b / scale, lower / scale, upper / scale) * scale, b)
    assert (
        errors(A, s.x, b) <= errors(A, np.clip(x0, lower[:, None], upper[:, None]), b) + rounding
    ).all()
    assert (s.least <= best + rounding).all()
    assert (s.x >= lower.astype(np.float32)[:, None]).all()
    assert (s.x <= upper.astype(np.float32)[:, None]).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_bent_direction_starts_conjugacy_anew(seed):
    """Otherwise some of these take ten times as many steps, or do not converge."""
    S = enclosure(60, 0.8, seed=seed).S.astype(np.float32)
    b = S @ np.random.default_rng(seed).uniform(-1, 2, (60, 1))
    assert within(S, b, 0, 1, 0.5, rtol=1e-4, maxiter=40).converged


@pytest.mark.parametrize(("low", "high"), [(0.1, 0.9), (0.0, 0.1), (-0.7, 0.3), (0.1, 0.1)])
def test_bounds_hold_in_float64(low, high):
    """Float32 rounds 0.1 up and 0.7 down; bounds that hold no float32 are met by the nearest."""
    b = np.array([[-9.0], [9.0], [9.0], [-9.0]])
    x = within(np.eye(4) + 0.1, b, low, high, rtol=1e-6).x.astype(np.float64)
    if low < high:
        assert (x >= low).all() and (x <= high).all()  # noqa: PT018
    np.testing.assert_allclose(np.sort(x.ravel()), [low, low, high, high], atol=1e-7)


@pytest.mark.parametrize("far", [1e3, 1e9, 1e30])
def test_a_bound_that_means_none_hides_nothing(far):
    """The certificate is worth little then, the answer is not."""
    S = lambertian(30, 2.0).S.astype(np.float32)
    b = S @ random.uniform(-0.5, 1.0, (30, 1))
    s = within(S, b, 0, far, rtol=1e-4)
    best = errors(S, exact(S, b, 0, 10), b)
    assert (errors(S, s.x, b) <= best * (1 + 1e-4)).all()
    assert (s.least <= best * (1 + 1e-6)).all()


def test_black_is_reached_by_the_darkest_light():
    """b = 0 has no norm to be relative to."""
    S = lambertian(30, 0.8).S.astype(np.float32)
    s = within(S, np.zeros((30, 1)), 0.1, 1, 1)
    assert s.converged
    assert s.errors[0] <= 1.01 * errors(S, np.full((30, 1), 0.1), 0.0)[0]


@pytest.mark.parametrize("brightness", [1e-10, 1e-20, 1e-30])
def test_a_target_far_below_the_bounds_is_as_a_black_one(brightness):
    S = lambertian(30, 0.8).S.astype(np.float32)
    b = brightness * random.uniform(1.0, 2.0, (30, 1))
    s = within(S, b, 0.2, 1.0, 1.0, rtol=1e-6)
    least = errors(S, np.full((30, 1), 0.2), b)
    np.testing.assert_allclose(s.errors, least, rtol=1e-6)
    assert np.isfinite(s.gap)
    assert s.saturated.all()


def test_what_ends_a_solve():
    S = lambertian(40, 4.0).S.astype(np.float32)
    seen = []
    b = S @ random.uniform(-1, 2, (40, 1))
    s = within(S, b, 0, 1, rtol=1e-4, maxiter=3, callback=lambda i, gap: seen.append(gap))
    assert (s.status, s.iterations, len(seen)) == (Status.MAXITER, 3, 4)
    assert s.residuals[-1] < s.residuals[0]
    s = within(S, b, 0, 1, rtol=1e-12)
    assert s.status is Status.STAGNATED  # float32 cannot certify that
    assert s.gap < 1e-5
    assert (errors(S, s.x, b) <= errors(S, exact(S, b, 0, 1), b) * (1 + 1e-6)).all()


@pytest.mark.parametrize("seed", range(12))
def test_a_column_that_float32_has_lost_is_not_certified(device, seed):
    """S = T F^-1 with F far above T: for x = F p, rounding of S x hides more than the residual."""
    rng = np.random.default_rng(seed)
    T = rng.uniform(0.0, 0.3, (2, 2)) + np.diag(rng.uniform(0.2, 1.0, 2))
    F = np.diagonal(T) * (1e6, 1e-6)
    b = rng.uniform(0.0, 1.0, (2, 1))
    s = within(IdentityPlus(Dense(device, T / F - np.eye(2))), b, 0, F, 0.5 * F[:, None], rtol=1e-3)
    assert (s.least <= errors(T, exact(T, b, 0, 1), b) + 1e-6).all()
    assert (errors(T, s.x / F[:, None], b) <= s.least + s.gap * np.linalg.norm(b) + 1e-6).all()


@pytest.mark.slow
@pytest.mark.parametrize("form", [CSR, Dense, Tiles])
@pytest.mark.parametrize("k", [1, 3])
def test_a_step_is_six_launches(shaped: Device, form: Any, k: int) -> None:
    """In the shapes of CPUs and GPUs; dense transposes of many rows are one launch, too."""
    n = 300
    G: Any = 0.45 * (scipy.sparse.eye_array(n, k=-1) + scipy.sparse.eye_array(n, k=1))
    G = G.tocsr()
    S = IdentityPlus(form(shaped, G.toarray() if form is Dense else G))
    b = random.random((n, k))
    counts = []
    for steps in (6, 6, 14):
        before = shaped.launches.total()
        minimise(S, b, np.full(n, 0.2), np.full(n, 0.5), np.zeros((n, k)), rtol=1e-9, maxiter=steps)
        counts.append(shaped.launches.total() - before)
    # The first solve also times variants of kernels.
    assert counts[2] - counts[1] == 8 * 6


@pytest.mark.parametrize("rows", [1, 53, 700])
@pytest.mark.parametrize("weighted", [False, True])
def test_several_problems_at_once_end_as_one_by_one(
    shaped: Device, rows: int, weighted: bool
) -> None:
    operators: list[Operator] = []
    problems = []
    # The light of one is a million times that of another, and one has its target within reach.
    for brightness, reach in ((1.0, 0.4), (1e6, 0.5), (1e-3, 2.0)):
        matrix = np.eye(rows) + 0.5 * random.random((rows, rows)) / rows
        operators.append(Dense(shaped, matrix.astype(np.float32)))
        b = brightness * (0.2 + random.random((rows, 1)))
        lower = np.where(random.random(rows) < 0.1, 0.0, -0.1 * brightness)
        upper = np.full(rows, reach * brightness)
        weights = None
        if weighted:
            weights = brightness * (0.1 + random.random((rows, 1)))
        x0 = 0.5 * b
        problems.append(BoxProblem(b=b, lower=lower, upper=upper, x0=x0, weights=weights))
    together = minimise_each(block_diagonal(operators), problems, rtol=1e-4)
    for A, problem, solution in zip(operators, problems, together, strict=True):
        alone = minimise_each(A, [problem], rtol=1e-4)[0]
        assert solution.status is alone.status is Status.CONVERGED
        # One may take a step more, below the tolerance.
        allowed = 1e-3 * np.linalg.norm(problem.b)
        assert np.linalg.norm(solution.x - alone.x) <= allowed
        weighted_b = problem.b if problem.weights is None else problem.weights * problem.b
        size = float(np.linalg.norm(weighted_b))
        np.testing.assert_allclose(solution.errors, alone.errors, rtol=0, atol=2e-4 * size)
        assert np.all(solution.least <= solution.errors)
        assert np.all(solution.x >= problem.lower.astype(np.float32)[:, None])
        assert np.all(solution.x <= problem.upper.astype(np.float32)[:, None])
        assert solution.gap <= 1e-4


def test_problems_at_once_have_their_own_outcomes(device: Device) -> None:
    # A column of S that is nearly zero cannot be solved in so few steps; the other is solved.
    hard = Dense(device, np.array([[1.0, 0.999], [0.999, 1.0]], np.float32))
    easy = Dense(device, np.eye(2, dtype=np.float32))
    lower = np.full(2, -1e4)
    target = np.array([[1.0], [-1.0]])
    problem = BoxProblem(b=target, lower=lower, upper=-lower, x0=np.zeros((2, 1)))
    dark = BoxProblem(b=0.0 * target, lower=lower, upper=-lower, x0=np.zeros((2, 1)))
    both = minimise_each(block_diagonal([hard, easy]), [problem, dark], rtol=1e-6, maxiter=1)
    assert both[0].status is Status.MAXITER
    assert both[1].status is Status.CONVERGED
    assert not both[1].x.any()


def test_a_stagnated_problem_does_not_end_the_others(device: Device, monkeypatch: Any) -> None:
    """The light of one is so large that rounding hides its error; the other takes more steps."""
    monkeypatch.setattr(bounded, "PATIENCE", 10)
    size = 60
    ones = np.ones(size - 1)
    chain = np.eye(size) - 0.48 * (np.diag(ones, 1) + np.diag(ones, -1))
    dim = Dense(device, 1e-5 * np.eye(size, dtype=np.float32))
    slow = Dense(device, chain.astype(np.float32))
    zeros = np.zeros((size, 1))
    target = chain @ np.random.default_rng(0).uniform(-0.5, 1.5, (size, 1))
    far = np.full((size, 1), 1e5)
    hidden = BoxProblem(b=zeros + 1.0, lower=zeros[:, 0], upper=2.0 * far[:, 0], x0=far)
    solved = BoxProblem(b=target, lower=zeros[:, 0], upper=np.ones(size), x0=zeros)
    both = minimise_each(block_diagonal([dim, slow]), [hidden, solved], rtol=1e-5)
    assert [each.status for each in both] == [Status.STAGNATED, Status.CONVERGED]
    assert both[1].iterations > 20
