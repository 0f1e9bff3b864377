# SPDX-License-Identifier: BSD-3-Clause
"""Bounds on the spectrum of sparse matrices, against dense eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.compression.extent import extent
from ltcl.errors import InputError
from tests.problems import enclosure, lambertian


@pytest.mark.parametrize("n", [3, 50, 200])
@pytest.mark.parametrize("rho", [0.3, 4.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_all_eigenvalues_lie_within(n, rho, sign):
    scene = lambertian(n, rho, seed=n)
    C = scene.R if sign > 0 else scene.A
    lower, upper = extent(scipy.sparse.csr_array(C), sign)
    values = np.linalg.eigvals(np.eye(n) + sign * C).real
    assert lower <= values.min()
    assert values.max() <= upper
    width = np.ptp(values)
    assert values.min() - lower <= 0.05 * width
    assert upper - values.max() <= 0.05 * width


def test_a_bright_closed_room():
    C = scipy.sparse.csr_array(enclosure(100, 0.99).A)
    lower, upper = extent(C, -1.0)
    assert 0.0 < lower <= 0.0101
    assert 1.0 < upper < 1.5


def test_nothing_but_the_identity():
    assert extent(scipy.sparse.csr_array((100, 100)), 1.0) == (1.0, 1.0)


def test_no_scene_has_a_negative_eigenvalue():
    C = scipy.sparse.csr_array(np.diag(np.linspace(-1.5, 1.0, 80)))
    with pytest.raises(InputError, match=r"I \+ C has an eigenvalue of real part -0.5; all must be above 0"):
        extent(C, 1.0)
