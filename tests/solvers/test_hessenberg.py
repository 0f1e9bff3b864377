# SPDX-License-Identifier: BSD-3-Clause
"""The small problems of GMRES against NumPy's least squares."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.solvers.gmres import Hessenberg

random = np.random.default_rng(21)


def small(k: int, m: int) -> np.ndarray:
    """k upper Hessenberg matrices (m + 1, m)."""
    return np.triu(random.normal(size=(k, m + 1, m)), -1)


@pytest.mark.parametrize("m", [1, 2, 7])
@pytest.mark.parametrize("k", [1, 3])
def test_every_step_is_the_least_squares_solution(k, m):
    H, beta = small(k, m), random.uniform(0.5, 1.0, k)
    problem = Hessenberg(beta)
    for j in range(m):
        assert problem.extend(H[:, : j + 2, j]).all()
        y = problem.solve()
        for column in range(k):
            part, right = H[column, : j + 2, : j + 1], beta[column] * np.eye(j + 2)[0]
            wanted = np.linalg.lstsq(part, right)[0]
            np.testing.assert_allclose(y[column], wanted, rtol=1e-9)
            left = np.linalg.norm(right - part @ wanted)
            assert problem.residuals[column] == pytest.approx(left, rel=1e-9)


def test_a_column_that_rests_keeps_its_solution():
    H, beta = small(2, 4), np.ones(2)
    problem = Hessenberg(beta)
    for j in range(2):
        problem.extend(H[:, : j + 2, j])
    y, left = problem.solve(), problem.residuals
    for j in range(2, 4):
        taken = problem.extend(H[:, : j + 2, j] * [[1.0], [0.0]])
        assert taken.tolist() == [True, False]
    np.testing.assert_allclose(problem.solve()[1], [*y[1], 0.0, 0.0], rtol=1e-12)
    assert problem.residuals[1] == pytest.approx(left[1])


def test_a_singular_matrix_makes_no_step():
    problem = Hessenberg(np.ones(1))
    assert problem.extend(np.array([[0.0, 1.0]])).all()
    assert not problem.extend(np.array([[0.0, 0.0, 0.0]])).any()
    assert problem.residuals.tolist() == [1.0]
    assert problem.solve().tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("m", [1, 2, 5])
def test_ritz_values_are_eigenvalues_of_the_square_parts(m):
    H = small(2, m)
    problem = Hessenberg(np.ones(2))
    for j in range(m):
        problem.extend(H[:, : j + 2, j] * ([[1.0], [1.0]] if j < 3 else [[1.0], [0.0]]))
    wanted = [np.linalg.eigvals(H[0, :m, :m]), np.linalg.eigvals(H[1, : min(m, 3), : min(m, 3)])]
    found = sorted(problem.ritz_values(), key=lambda z: (z.real, z.imag))
    np.testing.assert_allclose(
        found, sorted(np.concatenate(wanted), key=lambda z: (z.real, z.imag)), rtol=1e-9
    )
