# SPDX-License-Identifier: BSD-3-Clause
"""The largest threshold whose error stays within a goal, by the 2-norm of the difference to R itself.

What is dropped has a known Frobenius norm f. Its 2-norm is at most that, and far less where it is noise: how
much less changes slowly with f, so that a few measured norms find the f that is wanted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ltcl.compression import cores, sums
from ltcl.compression.coefficients import Coefficients, coefficients
from ltcl.compression.cores import Core
from ltcl.compression.kinds import Kind
from ltcl.compression.magnitudes import Magnitudes
from ltcl.compression.parted import Parted, part
from ltcl.compression.sources import RowSource
from ltcl.device import Device
from ltcl.operators import CSR, Compressed, Operator, Sum, active
from ltcl.theory import TwoNorm, two_norm

_STEPS = 6
_CLOSE = 0.85  # of the goal is good enough
_AIM = 0.94
_FACTOR = 1.06  # between the bounds of a norm
_MISLED = 1.25  # times the Frobenius norm that was to be dropped: a sample was not like the rest
_BINDS = 0.5  # of the numbers that are to be kept at most
_ROUNDING = 1e-6  # of coefficients that went through transforms in float32


@dataclass(frozen=True)
class Problem:
    """R (N, N), on a grid: its rows, and products with it on a device."""

    R: RowSource
    operator: Operator
    grid: tuple[int, int]
    memory: int | None = None
    whole: int | None = None  # pixels of that which this is a window of

    @property
    def device(self) -> Device:
        """Where the products run."""
        return self.operator.device

    @property
    def pixels(self) -> int:
        """N."""
        return self.R.shape[0]


@dataclass(frozen=True)
class Fit:
    """R between the bases of a kind, with a 2-norm of the error as measured."""

    kind: Kind
    coefficients: Coefficients
    norm: TwoNorm
    places: np.ndarray | None = None  # of the coefficients of the basis that are left, where not all

    def active(self) -> Fit:
        """The same R~ on the coefficients that its core acts on, where these are few and of both sides."""
        kind, C = self.kind, self.coefficients.core
        if kind.sum or kind.into is None or kind.out is not kind.into:
            return self
        places = active(C)
        if places is None:
            return self
        kept = dataclasses.replace(self.coefficients, core=scipy.sparse.csr_array(C[places][:, places]))
        return Fit(kind.only(places), kept, self.norm, places)

    def operator(self, core: Operator) -> Compressed | Sum:
        """R~ with a core that stands for the coefficients; or a sum that does, of which it has the cores."""
        if isinstance(core, Sum):
            return sums.summed(self.kind, *sums.parts(core), error=self.norm.upper)
        return Compressed(core, self.kind.out, self.kind.into, error=self.norm.upper)

    def best(self, device: Device, allowance: float, budget: float) -> Core:
        """As `cores.best`; of a kind that is a sum, as `sums.best`."""
        kept = self.coefficients
        if isinstance(kept, Parted):
            return sums.best(device, self.kind, *kept.parts, allowance, budget)
        return cores.best(device, kept.core, allowance, budget)


def gather(
    problem: Problem,
    kind: Kind,
    drop: float,
    most: int | None = None,
    progress: Callable[[float], object] | None = None,
) -> Coefficients:
    """Coefficients to fit: all but about the Frobenius norm `drop`, and at most about `most`.

    The threshold comes from a sample; where that has misled, all is read again.
    """
    if kind.sum:
        assert kind.out is not None and kind.into is not None  # noqa: S101, PT018 - they are wavelets
        return part(problem.R, kind.out, kind.into, drop, problem.memory, progress)
    wanted = drop
    while True:
        found = coefficients(
            problem.R,
            *kind.transforms,
            drop=wanted,
            most=most,
            memory=problem.memory,
            progress=progress,
        )
        bound = most is not None and found.core.nnz >= _BINDS * most
        if found.second <= _MISLED * drop or bound or found.threshold == 0.0:
            return found
        wanted *= drop / found.second


def fit(problem: Problem, kind: Kind, found: Coefficients, goal: float, start: float | None = None) -> Fit:
    """The coefficients of largest threshold whose error has a 2-norm of at most `goal`.

    Parameters
    ----------
    problem : Problem
    kind : Kind
    found : Coefficients
        Of which the largest are kept.
    goal : float
        Above 0.
    start : float, optional
        A guess of the Frobenius norm to drop.

    Returns
    -------
    Fit
        Its norm is above the goal where that of `found` itself is.
    """
    sizes, best = Magnitudes.of(found.core.data), None
    low, high, f = 0.0, math.inf, 2.0 * goal if start is None else start
    for _ in range(_STEPS):
        threshold = sizes.threshold(math.sqrt(max(f * f - found.dropped**2, 0.0)))
        trial = measure(problem, kind, found.above(threshold))
        if trial.norm.upper <= goal:
            best, low = trial, f
            if trial.norm.upper >= _CLOSE * goal or trial.coefficients.core.nnz == 0:
                return trial
        else:
            high = f
            if trial.coefficients.core.nnz == found.core.nnz:
                return trial
        f = _next(f, _AIM * goal / trial.norm.upper, low, high)
        if high < 1.05 * low:
            break
    return best if best is not None else measure(problem, kind, found)


def measure(problem: Problem, kind: Kind, kept: Coefficients) -> Fit:
    """The 2-norm of R~ - R with these coefficients."""
    R = exact(problem.device, kind, kept)
    return Fit(kind, kept, two_norm(problem.operator, R, factor=_FACTOR, frobenius=certain(kept)))


def exact(device: Device, kind: Kind, kept: Coefficients) -> Compressed | Sum:
    """R~ of these coefficients as they are."""
    if isinstance(kept, Parted):
        P, C = kept.parts
        return sums.summed(kind, CSR(device, P), CSR(device, C))
    return Compressed(CSR(device, kept.core), kind.out, kind.into)


def certain(kept: Coefficients) -> float:
    """A bound on the Frobenius norm of R~ - R: what was dropped, and rounding of the transforms."""
    return kept.dropped + _ROUNDING * float(np.linalg.norm(kept.core.data.astype(np.float64)))


def _next(f: float, ratio: float, low: float, high: float) -> float:
    """f times the ratio of norms, kept between what was too little and too much."""
    guess = f * ratio
    if not low < guess < high:
        guess = (
            math.sqrt(low * high) if low > 0.0 and high < math.inf else 0.5 * high if low == 0 else 2 * low
        )
    return guess
