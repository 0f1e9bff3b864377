# SPDX-License-Identifier: BSD-3-Clause
"""Row sums of one bounce against A itself; what noise leaves below zero."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl import energy
from tests.problems import enclosure, lambertian

FORMS = pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])


def check(device, T, F, form=np.asarray):
    transport = ltcl.Transport(form(T), (1, len(F)), first_bounce=F, device=device)
    return energy.check(transport.matrices[0], F, transport.systems[0])


@FORMS
@pytest.mark.parametrize("rho", [0.2, 0.9, 4.0])
def test_row_sums_are_those_of_A(device, form, rho):
    scene = lambertian(50, rho)
    found = check(device, scene.T, scene.F, form)
    sums = scene.A.sum(axis=1)
    assert found.bounce_highest == pytest.approx(sums.max(), abs=1e-3 * (1 + rho))
    assert found.bounce_lowest == pytest.approx(sums.min(), abs=1e-3 * (1 + rho))
    column = scene.R.sum(axis=0).max()
    assert found.albedo_from_columns == pytest.approx(column / (1 + column), rel=1e-5)
    assert (found.negative_entries, found.negative_light) == (0.0, 0.0)


@pytest.mark.parametrize("albedo", [0.3, 0.62, 0.9])
def test_a_closed_room_tells_its_albedo(device, albedo):
    box = enclosure(40, albedo)
    found = check(device, box.T, box.F)
    assert found.bounce_highest == pytest.approx(albedo, abs=2e-3)
    assert found.albedo_from_columns == pytest.approx(albedo, abs=1e-5)
    assert found.conserved


def test_a_surface_that_returns_more_than_it_gets_is_found(device):
    box = enclosure(40, 0.6)
    A = box.A.copy()
    A[3] *= 2.0  # albedo 1.2
    scene = dataclasses.replace(box, A=A)
    found = check(device, scene.T, scene.F)
    assert found.bounce_highest == pytest.approx(1.2, abs=0.01)
    assert not found.conserved


@FORMS
def test_negative_entries_are_counted_and_weighed(device, form):
    T = np.eye(10)
    T[0, 1], T[2, 3], T[4, 5] = -0.5, -1.5, 2.0
    found = check(device, T, np.ones(10), form)
    assert found.negative_entries == pytest.approx(0.02)
    assert found.negative_light == pytest.approx(2.0 / 14.0)


def test_hidden_entries_leave_what_products_tell(device):
    scene = lambertian(30, 0.5)
    found = check(device, scene.T, scene.F, aslinearoperator)
    assert found.bounce_highest == pytest.approx(scene.A.sum(axis=1).max(), abs=2e-3)
    assert all(
        math.isnan(x) for x in (found.albedo_from_columns, found.negative_entries, found.negative_light)
    )


def test_where_the_solve_fails_nothing_is_claimed(device):
    found = check(device, [[1.0, -1.0], [-1.0, 1.0]], np.ones(2))  # singular
    assert math.isnan(found.bounce_highest)
    assert not found.conserved
