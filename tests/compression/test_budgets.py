# SPDX-License-Identifier: BSD-3-Clause
"""Budgets are kept where anything fits into them, and refused with the best that does."""

from __future__ import annotations

import functools
import re

import pytest

import ltcl
from ltcl.compression.budgets import _least
from ltcl.errors import InputError

STEP = 1.16  # between neighbouring tolerances of two digits, at most


@functools.cache
def corner() -> ltcl.Transport:
    return ltcl.scenes.dihedral(16, albedo=0.6).transport()


@functools.cache
def colours() -> ltcl.Transport:
    """A box whose red channel takes more than a third of all."""
    return ltcl.scenes.box(6, sides=3, albedo=[(0.7, 0.5, 0.3)]).transport()


def refusal(T: ltcl.Transport, rtol: float, budget: int, basis: str) -> tuple[int, float]:
    """What it says is needed, and allowed."""
    with pytest.raises(InputError, match=r"needs \d+ .*; it allows rtol [\d.]+$") as refused:
        ltcl.compress(T, rtol, budget, basis=basis)
    found = re.search(rf"rtol {rtol:g} needs (\d+) .*allows rtol ([\d.]+)", str(refused.value))
    assert found is not None
    return int(found[1]), float(found[2])


@pytest.mark.parametrize("rtol", [0.9, 0.3])
def test_what_takes_few_coefficients_fits(rtol):
    C = ltcl.compress(corner(), rtol, 1000, basis="db2")
    assert C.error <= rtol
    assert C.compression.nbytes <= 1000


@pytest.mark.parametrize("tuned", ["0", "1"])
def test_channels_share_a_budget_as_they_need_it(tuned, monkeypatch):
    T = colours()
    free = ltcl.compress(T, 0.05, basis="haar").compression
    assert 3 * free.channels[0].nbytes > 1.2 * free.nbytes
    monkeypatch.setenv("LTCL_TUNE", tuned)
    C = ltcl.compress(T, 0.05, int(1.05 * free.nbytes), basis="haar")
    assert C.compression.nbytes <= 1.05 * free.nbytes
    assert C.error <= 0.05


def test_what_a_refusal_says_is_needed_is_enough():
    T = colours()
    needed, _ = refusal(T, 0.05, 8000, "haar")
    assert ltcl.compress(T, 0.05, needed, basis="haar").compression.nbytes == needed


@pytest.mark.parametrize(("make", "basis", "budget"), [(corner, "db2", 3000), (colours, "haar", 5000)])
def test_the_best_that_fits_does_and_is_the_best(make, basis, budget):
    T = make()
    _, allowed = refusal(T, 0.01, budget, basis)
    C = ltcl.compress(T, allowed, budget, basis=basis)
    assert C.error <= allowed
    assert C.compression.nbytes <= budget
    assert refusal(T, allowed / STEP, budget, basis)[1] == allowed


def test_the_best_does_not_depend_on_what_was_asked_for():
    found = {refusal(corner(), rtol, 3000, "db2")[1] for rtol in (2e-3, 0.03)}
    assert len(found) == 1


@pytest.mark.parametrize("least", [0.001, 0.0305, 0.1, 0.5, 0.985])
def test_searches_end_beside_the_least(least):
    tried = []

    def fits(rtol: float) -> bool:
        tried.append(rtol)
        return rtol >= least

    found = _least(fits)
    assert found is not None
    assert least <= found <= STEP * least
    assert len(tried) <= 12


def test_where_nothing_fits_one_trial_tells():
    tried = []
    assert _least(lambda rtol: bool(tried.append(rtol))) is None
    assert tried == [0.99]
