# SPDX-License-Identifier: BSD-3-Clause
"""What the methods that draw random numbers share: how their estimates become a `Solution`.

Their noise falls as one over the square root of the samples, so a tolerance is nothing they can promise. The
true residual of what they found is measured with one product; it decides between CONVERGED and SAMPLED.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import vectors
from ltcl.errors import InputError, InputTypeError
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import Rule, System


@dataclass(frozen=True)
class Estimate:
    """What a method found, in the units of `system.b`, float64; standard errors where it knows them.

    `x` is (N,) or (N, k), or (P,) or (P, k) where it is of some pixels only and has no residual. `reason`
    tells what was sampled, `met` whether the error that was asked for is, `advice` what else to try.
    """

    x: np.ndarray
    standard_error: np.ndarray | None = None
    iterations: int = 1
    whole: bool = True
    reason: str = ""
    met: bool = True
    advice: str = ""


def solution(
    method: Any, system: System, found: Estimate, rule: Rule, in_units: Callable[[np.ndarray], np.ndarray]
) -> Solution:
    """The estimate in the caller's units, with its residual."""
    relative, met = np.nan, False
    if found.whole:
        relative, met = _residual(system, gathered(system, found.x, add=False), rule)
    if rule.callback is not None and found.whole:
        rule.callback(found.iterations, relative)
    error, converged = found.standard_error, met and found.met
    advice = found.advice if found.met and not converged else ""
    return Solution(
        in_units(found.x),
        Status.CONVERGED if converged else Status.SAMPLED,
        found.iterations,
        system.products,
        (1.0, relative) if found.whole else (np.nan,),
        0.0,
        method.name,
        "; ".join(filter(None, (found.reason, advice))),
        lowest=relative if np.isfinite(relative) else np.inf,  # of x, be it worse than the start
        standard_error=None if error is None else in_units(error),
    )


def numbered(callback: Callable[[int, float], object] | None) -> Callable[[int, float], object] | None:
    """A callback that is told of its calls in order, 0, 1, ...: of steps, and of what they made."""
    calls = itertools.count()
    return None if callback is None else lambda _, residual: callback(next(calls), residual)


def watch(rule: Rule) -> Callable[[], object]:
    """Tell the callback of a rule that sampling begins; what comes back tells it of each step, as NaN."""
    callback, steps = rule.callback, itertools.count(1)
    if callback is None:
        return lambda: None
    callback(0, 1.0)
    return lambda: callback(next(steps), np.nan)


def gathered(system: System, x: np.ndarray, *, add: bool = True) -> np.ndarray:
    """Final gather, x + (b - S x) = b - R x, one exact product; or b - S x alone. float64."""
    on_device = system.S.device.upload(x)
    r = system.residual(on_device, on_device.like()).get().astype(np.float64)
    return on_device.get() + r if add else r


def _residual(system: System, r: np.ndarray, rule: Rule) -> tuple[float, bool]:
    norms, left = vectors.norm(system.b), np.linalg.norm(r, axis=0)
    relative = float(np.max(left / np.where(norms > 0, norms, 1.0)))
    return relative, bool(np.all(left <= np.maximum(rule.rtol * norms, rule.atol)))


def within_float32(estimates: np.ndarray) -> np.ndarray:
    """Return what was sampled; refuse what has grown beyond float32, or is NaN."""
    if not np.all(np.abs(estimates) <= np.finfo(np.float32).max):
        raise InputError("what was sampled has grown beyond float32; rescale, or use method='chebyshev'")
    return estimates


def check_whole(options: dict[str, Any]) -> None:
    """Refuse, where a task needs whole pictures, to estimate some pixels only."""
    if "pixels" in options:
        raise InputTypeError("pixels= gives some pixels alone; a picture needs all: leave it out")


def check_seed(seed: Any) -> None:
    """Refuse a seed that does not fit into 64 bits."""
    if checks.count("seed", seed, least=0) >= 1 << 64:
        raise InputError(f"seed is {seed}; it must be below 2^64")


def check_samples(samples: Any) -> None:
    """Refuse a number of samples that 32 bits cannot count."""
    if checks.count("samples", samples) >= 1 << 32:
        raise InputError(f"samples is {samples}; it must be below 2^32")
