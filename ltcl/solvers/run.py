# SPDX-License-Identifier: BSD-3-Clause
"""How one method is run on checked input, and "auto" on one after the other.

Each column of b is solved in a unit of its own, near its largest value.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ltcl.device import Array
from ltcl.operators import Operator
from ltcl.solvers import auto, coefficients, double, refinement, sampled, units
from ltcl.solvers.direct import Direct
from ltcl.solvers.hybrid import Hybrid
from ltcl.solvers.monte_carlo import MonteCarlo
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.sampled import Channel
from ltcl.solvers.stopping import Monitor, Rule, System


@dataclasses.dataclass(frozen=True)
class Problem:
    """S x = b with b (N,) or (N, k), where to start and when to stop; `guess` is like b, None for zero.

    `exact` is what a compressed S stands for, None where S itself is solved.
    """

    S: Operator
    b: np.ndarray
    guess: np.ndarray | None
    rule: Rule
    exact: Operator | None = None


def automatic(given: Problem) -> Solution:
    """The first method of the plan that converges, else the best iterate; all products are counted."""
    attempts: list[Solution] = []
    reasons, products = [], 0
    reached = min(wanted(given.b, given.rule), 0.5)
    reached = reached if given.exact is None else refinement.step_tolerance(given.S)
    for choice in auto.plan(given.S, reached, given.b[0].size):
        reasons.append(choice.why)
        attempts.append(run(choice.method, given))
        products += choice.products + attempts[-1].products
        if attempts[-1].converged:
            break
        reasons.append(f"{attempts[-1].method} ended {attempts[-1].status.name.lower()}")
    best = attempts[-1] if attempts[-1].converged else min(attempts, key=lambda one: one.residual)
    return dataclasses.replace(best, products=products, reason="; ".join(filter(None, reasons)))


def wanted(b: np.ndarray, rule: Rule) -> float:
    """The relative residual that all columns have to reach; infinite where all are dark."""
    if not np.any(rule.atol):
        return rule.rtol if np.any(units.largest(b) > 0.0) else np.inf
    norms = np.linalg.norm(b.astype(np.float64), axis=0)
    least = np.maximum(rule.rtol, rule.atol / np.where(norms > 0.0, norms, 1.0))
    return float(np.min(np.where(norms > 0.0, least, np.inf)))


def run(method: Any, given: Problem) -> Solution:
    """One method, by itself."""
    if isinstance(method, Direct) and given.exact is None:
        return _run_direct(method, given.S, given.b, given.rule)
    if isinstance(method, MonteCarlo | Hybrid):
        return sample(method, [given])[0]
    found = _in_double(method, given)
    if found is not None:
        return found
    light, guess, rule, unit = _uploaded(given)
    if given.exact is None:
        x, monitor = coefficients.iterate(method, given.S, light, guess, rule)
    else:
        x, monitor = refinement.iterate(method, given.S, given.exact, light, guess, rule)
    return _solution(method, units.restored(x.get(), unit), monitor)


def _in_double(method: Any, given: Problem) -> Solution | None:
    """Refined in float64, where the tolerance asks for that and the numbers of the exact S are at hand."""
    if given.exact is None or wanted(given.b, given.rule) >= refinement.FINE:
        return None
    product = double.product(given.exact)
    if product is None:
        return None
    unit = units.of(given.b)
    guess = None if given.guess is None else given.guess / unit
    rule = dataclasses.replace(given.rule, atol=given.rule.atol / unit)
    x, monitor = refinement.iterate_in_double(
        method, given.S, given.exact, product, given.b / unit, guess, rule
    )
    return _solution(method, x * unit, monitor)


def _solution(method: Any, x: np.ndarray, monitor: Monitor) -> Solution:
    assert monitor.status is not None  # noqa: S101 - iterate returns only when the monitor said so
    return Solution(
        x,
        monitor.status,
        monitor.iterations,
        monitor.system.products,
        tuple(monitor.residuals),
        0.0,
        method.name,
        lowest=monitor.lowest,
    )


def sample(method: MonteCarlo | Hybrid, channels: Sequence[Problem]) -> list[Solution]:
    """A method that samples, on colour channels of one size at once; one solution a channel.

    The callback hears of one beginning, of every step, and of one end: the largest residual.
    """
    told = sampled.numbered(channels[0].rule.callback)
    begun = [_begin(given, told) for given in channels]
    solved = [
        sampled.solution(method, one, found, functools.partial(units.restored, unit=one.unit))
        for one, found in zip(begun, method.estimate(begun), strict=True)
    ]
    largest = float(np.max([one.residuals[-1] for one in solved]))
    if told is not None and not np.isnan(largest):  # of some pixels alone there is none
        told(1, largest)
    return solved


def _begin(given: Problem, callback: Callable[[int, float], object] | None) -> Channel:
    light, guess, rule, unit = _uploaded(given)
    system, rule = System(given.S, light), dataclasses.replace(rule, callback=callback)
    return Channel(system, *coefficients.start(system, guess), rule, unit)


def _uploaded(given: Problem) -> tuple[Array, Array | None, Rule, np.ndarray]:
    """b and the guess on the device and the rule, all in the unit of each column; the units."""
    unit, device = units.of(given.b), given.S.device
    guess = None if given.guess is None else device.upload(given.guess / unit)
    rule = dataclasses.replace(given.rule, atol=given.rule.atol / unit)
    return device.upload(units.scaled(given.b, unit)), guess, rule, unit


def _run_direct(method: Direct, S: Operator, b: np.ndarray, rule: Rule) -> Solution:
    b = b.astype(np.float64)
    try:
        x, residual = method.solve(S, b)
    except np.linalg.LinAlgError:
        return Solution(np.zeros(b.shape), Status.BREAKDOWN, 0, 0, (1.0,), 0.0, method.name)
    norms = np.linalg.norm(b, axis=0)
    left = np.linalg.norm(residual, axis=0)
    relative = float(np.max(left / np.where(norms > 0, norms, 1.0)))
    met = np.all(left <= np.maximum(rule.rtol * norms, rule.atol))
    if rule.callback is not None:
        rule.callback(0, 1.0)
        rule.callback(1, relative)
    return Solution(x, Status.CONVERGED if met else Status.STAGNATED, 1, 0, (1.0, relative), 0.0, method.name)
