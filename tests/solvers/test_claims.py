# SPDX-License-Identifier: BSD-3-Clause
"""No answer that is quietly wrong: what is claimed is true of the numbers that were given, in float64."""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import resource
import threading
import warnings

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.errors import (
    ConvergenceError,
    InputError,
    InputTypeError,
    MemoryLimitError,
    PhotographMissing,
    ToleranceError,
)
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Wavelet
from ltcl.solvers import auto
from tests.problems import lambertian
from tests.solvers.helpers import ITERATIVE, METHODS, READS_ROWS

KINDS = {
    "array": lambda S: S,
    "scipy": scipy.sparse.csr_array,
    "LinearOperator": aslinearoperator,
}
THIRD = np.array([[1.0, 1.0 / 3.0], [3.0, 1.0 + 1e-6]])  # rounded to float32 it is another S by far


def true_residual(S, x, b):
    """In extended precision, of any scale of b."""
    S, x, b = (np.asarray(part, np.longdouble) for part in (S, x, b))
    left, size = ((part / np.max(np.abs(b))).astype(np.float64) for part in (b - S @ x, b))
    return float(np.linalg.norm(left) / np.linalg.norm(size))


def nearly_singular(seed: int, least: float) -> np.ndarray:
    random = np.random.default_rng(seed)
    n = int(random.integers(2, 9))
    U, sizes, V = np.linalg.svd(random.normal(size=(n, n)))
    return (U * np.where(np.arange(n) == n - 1, least, sizes)) @ V


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", ["direct", "auto"])
def test_direct_factorizes_the_numbers_that_were_given(device, method, kind):
    s = ltcl.solve(KINDS[kind](THIRD), np.ones(2), method)
    assert s.converged
    assert true_residual(THIRD, s.x, np.ones(2)) <= 1e-8


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", KINDS)
def test_nearly_singular_systems_are_solved_or_fail(device, kind, method):
    for seed in range(12):
        S = nearly_singular(seed, 10.0 ** -(1 + seed % 12))
        if method in READS_ROWS and kind == "LinearOperator":
            return
        b = np.random.default_rng(seed).uniform(size=len(S))
        s = ltcl.solve(KINDS[kind](S), b, method, rtol=1e-3, throw=False, maxiter=100)
        assert not s.converged or true_residual(S, s.x, b) <= 1.01e-3, seed


@pytest.mark.parametrize("method", ITERATIVE)
def test_a_residual_of_float32_alone_proves_nothing(device, method):
    """The float32 product of this S with the x of BiCGStab is b; in float64 it misses by 28 %."""
    rows = [[-0.8966292142868042, -0.2433648407459259], [0.3770374655723572, -1.8876547621322632]]
    R = np.array(rows, np.float32)
    b = np.array([1.8, 0.3])
    s = ltcl.solve(IdentityPlus(Dense(device, R)), b, method, rtol=1e-3, throw=False)
    assert not s.converged or true_residual(np.eye(2) + R, s.x, b) <= 1.01e-3


def in_wavelets(device, seed: int, eps: float, both: bool):
    """I + R, nearly singular, with R in wavelets on one side or both; and the same in float64."""
    W = Wavelet(device, (4, 4), "haar")
    H = np.round(4.0 * W.to_dense()) / 4.0  # to the bit
    C = np.random.default_rng(seed).standard_normal((16, 16))
    C = (C + C.T) / 2.0
    eigenvalues = np.asarray(np.linalg.eigvals(H.T @ C @ H if both else C @ H), np.complex128)
    least = np.real(eigenvalues[np.abs(np.imag(eigenvalues)) < 1e-9]).min()
    C = (C / -least * (1.0 - eps)).astype(np.float32)
    S = IdentityPlus(Compressed(Dense(device, C), W if both else None, W))
    return S, np.eye(16) + (H.T @ C @ H if both else C.astype(float) @ H)


@pytest.mark.parametrize(("seed", "eps", "both"), [(26, 1e-6, False), (41, 1e-5, True)])
@pytest.mark.parametrize("method", METHODS)
def test_float32_products_and_transforms_are_no_proof(device, method, seed, eps, both):
    S, truth = in_wavelets(device, seed, eps, both)
    b = np.random.default_rng(seed + 100).standard_normal(16)
    with contextlib.suppress(InputError):  # sweeps read rows
        s = ltcl.solve(S, b, method, rtol=1e-3, throw=False)
        assert not s.converged or true_residual(truth, s.x, b) <= 1.01e-3


@pytest.mark.parametrize("method", ["auto", "direct"])
def test_T_in_float64_is_judged_in_float64(device, method):
    matrix = np.random.default_rng(0).uniform(0.0, 0.01, (48, 48)) + np.diag(np.full(48, 0.5))
    T, b = ltcl.Transport(matrix, (6, 8), device=device), np.random.default_rng(1).uniform(size=48)
    for exact in (None, T.interreflection):
        s = ltcl.solve(T.interreflection, b, method, rtol=1e-12, exact=exact)
        assert true_residual(matrix / np.diag(matrix), s.x, b) <= 1.01e-12


def test_threads_share_one_factorization(device):
    n, failed = 128, []
    S = IdentityPlus(Dense(device, np.random.default_rng(0).uniform(0.0, 1.0 / n, (n, n))))

    def work() -> None:
        solutions = (ltcl.solve(S, np.ones((n, 3)), "direct", throw=False) for _ in range(500))
        failed.extend(s.residual for s in solutions if not s.converged)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed


@pytest.mark.parametrize("method", ["auto", "direct", "gmres"])
@pytest.mark.parametrize("product", [lambda y: (1 + 5j) * y, lambda y: np.ma.masked_less(y, 2.0)])
def test_products_of_a_LinearOperator_are_checked(device, method, product):
    def act(x: np.ndarray) -> np.ndarray:
        return product(np.array([[2.0, 0.5], [0.5, 1.0]]) @ x)

    S = scipy.sparse.linalg.LinearOperator((2, 2), matvec=act, matmat=act, dtype=np.float64)
    with pytest.raises(InputTypeError, match="the product of"):
        ltcl.solve(S, np.ones(2), method)


@pytest.mark.parametrize("rho", [0.5, 0.97])
@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 3e-8, 1e-10])
@pytest.mark.parametrize("method", ITERATIVE)
def test_claims_near_rounding_are_true(device, method, rtol, rho):
    S = lambertian(40, rho).S
    for A in (S, scipy.sparse.csr_array(S)):
        b = np.random.default_rng(1).uniform(size=40)
        s = ltcl.solve(A, b, method, rtol=rtol, throw=False)
        assert not s.converged or true_residual(S, s.x, b) <= 1.01 * rtol
        assert s.converged or rtol < 1e-5


@pytest.mark.parametrize("scales", [(1e10, 1e-30), (1e30, 1e-5), (1e-30, 1e30), (1e-36, 1e3)])
@pytest.mark.parametrize("method", METHODS)
def test_light_beyond_float32_comes_back_in_float64(device, method, scales):
    S, b = np.diag([1.0, 2.0, 3.0]) * scales[0], np.ones(3) * scales[1]
    s = ltcl.solve(S, b, method, rtol=1e-3, throw=False)
    assert not s.converged or true_residual(S, s.x, b) <= 1.01e-3


@pytest.mark.parametrize("method", METHODS)
def test_without_light_x_is_0(device, method):
    """Of any start, whose residual underflows, and of a singular S."""
    x0 = np.array([[1e-24, 0.6], [1e-24, 0.7]])
    s = ltcl.solve(1.5 * np.eye(2), np.array([[0.0, 1.0], [0.0, 1.0]]), method, x0=x0)
    assert not s.x[:, 0].any()
    assert ltcl.solve(1.5 * np.eye(2), np.zeros(2), method, x0=x0[:, 0]).x.tolist() == [0.0, 0.0]
    if method in ("direct", "auto"):
        assert ltcl.solve(np.ones((2, 2)), np.zeros(2), method).x.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("method", ["direct", "auto"])
def test_direct_says_what_it_proves(device, method):
    S, b = lambertian(60, 0.8).S, np.random.default_rng(0).uniform(size=60)
    with pytest.raises(ConvergenceError, match="ask for no less") as caught:
        ltcl.solve(S, b, method, rtol=1e-16)
    least = caught.value.solution.least_rtol
    assert 1e-16 < least < 1e-13
    assert ltcl.solve(S, b, method, rtol=least).converged


def test_auto_refines_where_a_factorization_has_no_room(device, monkeypatch):
    def refused(*_):
        raise MemoryLimitError("no room")

    n = auto.SMALL + 8
    monkeypatch.setattr(scipy.linalg, "lu_solve", refused)
    R = scipy.sparse.random_array((n, n), density=0.01, rng=np.random.default_rng(0)) * 0.1
    S, b = scipy.sparse.eye_array(n) + R, np.random.default_rng(1).uniform(size=n)
    assert true_residual(S.toarray(), ltcl.solve(S, b, rtol=1e-9).x, b) <= 1.01e-9


def test_steps_that_leave_float32_are_divergence(device):
    S = np.eye(6) + np.triu(np.full((6, 6), 10.0))
    s = ltcl.solve(S, np.ones(6), "neumann", x0=np.full(6, 1e6), throw=False)
    assert not s.converged


@pytest.mark.parametrize("method", METHODS)
def test_no_warning_leaks(device, method):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ltcl.solve(np.eye(2), np.full(2, 1e-30), method, x0=np.full(2, 1e300), throw=False)
        ltcl.solve(np.eye(2), np.full(2, 1e-300), method, atol=1e300)
        for S in (
            THIRD,
            np.eye(2) * 1e30,
            [[0.0, 1.0], [1.0, 0.0]],
            np.ones((2, 2)),
            [[1.0, 3e38], [3e38, 1.0]],
        ):
            with contextlib.suppress(InputError):  # sweeps divide by the diagonal
                ltcl.solve(np.array(S), np.array([1e30, 0.0]), method, throw=False)


def test_auto_factorizes_no_more_than_it_can(device, monkeypatch):
    """Beyond, it refines in float64 by the numbers of S, or says what the least tolerance is."""
    monkeypatch.setattr(auto, "LARGEST_DIRECT", auto.SMALL)
    n = auto.SMALL + 8
    R = scipy.sparse.random_array((n, n), density=0.01, rng=np.random.default_rng(0)) * 0.1
    b = np.random.default_rng(1).uniform(size=n)
    s = ltcl.solve(IdentityPlus(CSR(device, R)), b, rtol=1e-9)
    assert s.method != "direct"
    assert true_residual(np.eye(n) + R.toarray(), s.x, b) <= 1.01e-9
    with pytest.raises(ToleranceError, match="rtol is 1e-09") as caught:
        ltcl.solve(IdentityPlus(Compressed(CSR(device, R), None, None)), b, rtol=1e-9)
    assert caught.value.least == 1e-6


class _NoTranspose(scipy.sparse.linalg.LinearOperator):
    """A one-way ring, which no polynomial in S solves, whose transpose does not fit."""

    def _matvec(self, x):
        return x + 3.0 * np.roll(x.ravel(), 1).reshape(x.shape)

    def _rmatvec(self, x):
        raise MemoryLimitError("no room")


def test_a_transpose_that_does_not_fit_keeps_the_best_iterate(device, monkeypatch):
    monkeypatch.setattr(auto, "LARGEST_DIRECT", auto.SMALL)
    S = _NoTranspose(np.float64, (auto.SMALL + 8,) * 2)
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(S, np.random.default_rng(0).uniform(size=S.shape[0]))
    assert caught.value.solution.residual <= 1.0


def test_direct_under_a_memory_limit_is_refused_in_our_words(device):
    S = np.eye(3000) + 1e-4
    ltcl.solve(S[:600, :600], np.ones(600), "direct")  # whatever is allocated once
    with open("/proc/self/statm", encoding="ascii") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + (100 << 20), hard))
    try:
        with pytest.raises(MemoryLimitError):
            ltcl.solve(S, np.ones(3000), "direct")
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def test_errors_with_attributes_unpickle(device):
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(np.eye(2) * 5.0, np.ones(2), "jacobi")
    for error, name in (
        (caught.value, "solution"),
        (ToleranceError("rtol is 1e-9", 1e-6), "least"),
        (PhotographMissing("number 3 is missing", 3), "number"),
    ):
        back = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
        assert type(back) is type(error)
        assert str(back) == str(error)
        assert type(getattr(back, name)) is type(getattr(error, name))
    assert pickle.loads(pickle.dumps(caught.value)).solution.residual == caught.value.solution.residual  # noqa: S301


def _fail(_: int) -> None:
    raise ToleranceError("rtol is 1e-9", 1e-6)


def test_they_come_back_from_another_process():
    with multiprocessing.get_context("spawn").Pool(1) as pool, pytest.raises(InputError) as caught:
        pool.apply_async(_fail, (0,)).get(60)
    assert isinstance(caught.value, ToleranceError)
    assert caught.value.least == 1e-6
