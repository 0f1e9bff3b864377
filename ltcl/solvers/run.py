# SPDX-License-Identifier: BSD-3-Clause
"""How one method is run on checked input, and "auto" on one after the other.

Each column of b is solved in a unit of its own, near its largest value.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ltcl.operators import Operator
from ltcl.solvers import auto, sampled
from ltcl.solvers.direct import Direct
from ltcl.solvers.hybrid import Hybrid
from ltcl.solvers.monte_carlo import MonteCarlo
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.sampled import Channel
from ltcl.solvers.stopping import Monitor, Rule, System


@dataclasses.dataclass(frozen=True)
class Problem:
    """S x = b with b (N,) or (N, k), where to start and when to stop; `guess` is like b, None for zero."""

    S: Operator
    b: np.ndarray
    guess: np.ndarray | None
    rule: Rule


def automatic(given: Problem) -> Solution:
    """The first method of the plan that converges, else the best iterate; all products are counted."""
    attempts: list[Solution] = []
    reasons, products = [], 0
    for choice in auto.plan(given.S, _wanted(given.b, given.rule), given.b[0].size):
        reasons.append(choice.why)
        attempts.append(run(choice.method, given))
        products += choice.products + attempts[-1].products
        if attempts[-1].converged:
            break
        reasons.append(f"{attempts[-1].method} ended {attempts[-1].status.name.lower()}")
    best = attempts[-1] if attempts[-1].converged else min(attempts, key=lambda one: one.residual)
    return dataclasses.replace(best, products=products, reason="; ".join(filter(None, reasons)))


def _wanted(b: np.ndarray, rule: Rule) -> float:
    """The relative residual that all columns have to reach."""
    norms = np.linalg.norm(b.astype(np.float64), axis=0)
    wanted = np.maximum(rule.rtol, rule.atol / np.where(norms > 0.0, norms, np.inf))
    return min(float(np.min(np.where(norms > 0.0, wanted, 0.5))), 0.5)


def run(method: Any, given: Problem) -> Solution:
    """One method, by itself."""
    if isinstance(method, Direct):
        return _run_direct(method, given.S, given.b, given.rule)
    if isinstance(method, MonteCarlo | Hybrid):
        return sample(method, [given])[0]
    begun = _begin(given)
    monitor = Monitor(begun.system, begun.rule)
    method.iterate(begun.system, begun.x, begun.r, monitor)
    best = begun.x if monitor.status is Status.CONVERGED or monitor.best is None else monitor.best
    assert monitor.status is not None  # noqa: S101 - iterate returns only when the monitor said so
    return Solution(
        _in_units(best.get(), begun.unit),
        monitor.status,
        monitor.iterations,
        begun.system.products,
        tuple(monitor.residuals),
        0.0,
        method.name,
        lowest=monitor.lowest,
    )


def sample(method: MonteCarlo | Hybrid, channels: Sequence[Problem]) -> list[Solution]:
    """A method that samples, on colour channels of one size at once; one solution a channel."""
    begun = [_begin(given) for given in channels]
    return [
        sampled.solution(method, one, found, functools.partial(_in_units, unit=one.unit))
        for one, found in zip(begun, method.estimate(begun), strict=True)
    ]


def _begin(given: Problem) -> Channel:
    unit, device = _unit(given.b), given.S.device
    system = System(given.S, device.upload(given.b / unit))
    rule = dataclasses.replace(given.rule, atol=given.rule.atol / unit)
    if given.guess is None:  # the residual of zero is b and costs no product
        return Channel(
            system, device.upload(np.zeros(given.b.shape, np.float32)), system.b.copy(), rule, unit
        )
    x = device.upload(given.guess / unit)
    return Channel(system, x, system.residual(x, x.like()), rule, unit)


def _unit(b: np.ndarray) -> np.ndarray:
    """A power of two for each column, near its largest value: in such units norms stay inside float32."""
    largest = np.max(np.abs(b, dtype=np.float64), axis=0)
    return np.exp2(np.floor(np.log2(np.where(largest > 0.0, largest, 1.0))))


def _in_units(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """x times its unit in float32, or in float64 where it is beyond float32."""
    wide = x * unit
    return wide if np.any(np.abs(wide) > np.finfo(np.float32).max) else wide.astype(np.float32)


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
