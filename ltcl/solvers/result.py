# SPDX-License-Identifier: BSD-3-Clause
"""What a solve returns: the iterate, and what happened."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


class Status(enum.Enum):
    """How a solve ended; the value says why, and most say what to try next."""

    CONVERGED = "the true residual is within the tolerance"
    MAXITER = "maxiter was reached before the tolerance; raise maxiter, loosen rtol, or try another method"
    DIVERGED = "the residual grew"
    STAGNATED = (
        "the residual stopped falling, or the tolerance is below what float32 products can tell, about 1e-6; "
        "loosen rtol"
    )
    INDEFINITE = (
        "S is not positive definite in the inner product of cg, which then has no next step; "
        "give the weights= that make S self-adjoint, normal=True, or try method='gmres' or 'chebyshev'"
    )
    NO_STEP = (
        "the method has no next step here, not even started anew; "
        "try method='gmres', 'cg' with normal=True, or 'direct'"
    )
    SAMPLED = "the samples are spent; .reason tells what to try next"
    PRECOMPUTED = "one product with an inverse whose error is bounded; no residual was computed"
    BREAKDOWN = "the system is singular; check the first bounce and the transport"


_SERIES = ("jacobi", "neumann", "matrix_iteration", "matrix_series")


def _advice(status: Status, method: str) -> str:
    """Why a solve ended and what else to try: never the method that just failed."""
    if status is Status.STAGNATED and method != "direct":
        return f"{status.value} or try method='direct'"
    if status is not Status.DIVERGED:
        return status.value
    series = ": the series converges only where the spectral radius of R is below 1"
    other = "gmres" if method == "chebyshev" else "chebyshev"
    return f"{status.value}{series if method in _SERIES else ''}; try method='{other}' or 'direct'"


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of `ltcl.solve`; of three S at once `products` are those of all, and `residuals` the largest.

    Attributes
    ----------
    x : like b, float32 (float64 of "direct", of values beyond float32 or too small for it, and of what
        `exact` refined in float64)
        The solution; where `converged` is False, the iterate with the smallest residual, or what was sampled.
        Of `pixels=` (P,) or (P, k), in their order; of three S (3, P) or (3, P, k).
    status : Status
    iterations : int
    products : int
        Products with S, those for checks included; of "auto" those of all methods tried, and of the survey
        in the solve that made it. Not the one that finds the row sums, once in the life of an operator.
    residuals : tuple of float
        ``||b - S x|| / ||b||`` before each iteration and at the end; the largest over right-hand sides.
    seconds : float
        Wall time, transfers included.
    method : str
        The one that ran; for "auto" the one chosen.
    reason : str
        Why "auto" chose it, or what a method that samples has sampled, else empty.
    lowest : float, optional
        Residual of the best iterate; the least of `residuals` when not given.
    standard_error : like x, optional
        Of "monte_carlo": of the noise of n samples, without the bias of alias tables, which leave out entries
        drawn less than once in about 2^19 times the entries of their row. Its first part, of the spread of
        samples, falls as 1 / sqrt(n); that of light which they may not have met as 1 / n (by the rule of
        three about 1.7 |R_i| max |b| / n), and is the larger one where few pixels hold most of the light.
    error : float, optional
        Bound on the relative error of x, where one is known: of a precomputed inverse.
    rest : like x, optional
        b - S x, where a task asked for it and the method has it.
    """

    x: np.ndarray
    status: Status
    iterations: int
    products: int
    residuals: tuple[float, ...]
    seconds: float
    method: str
    reason: str = ""
    lowest: float | None = None
    standard_error: np.ndarray | None = None
    error: float | None = None
    rest: np.ndarray | None = None

    @property
    def converged(self) -> bool:
        """Whether the tolerance was met, by a true residual or by a bound on the error of x."""
        return self.status in (Status.CONVERGED, Status.PRECOMPUTED)

    @property
    def residual(self) -> float:
        """The relative residual of `x`; infinite of some pixels alone, which have none."""
        finite = [value for value in self.residuals if np.isfinite(value)]
        if self.converged or not finite:
            return finite[-1] if finite else float("inf")
        return min(finite) if self.lowest is None else self.lowest

    def __str__(self) -> str:
        if self.error is not None:
            return f"{self.method}: relative error at most {self.error:.2g}: {self.status.value}"
        best, last = self.residual, self.residuals[-1]
        residual = f"{best:.2g}"
        if np.isnan(last) and self.status is Status.SAMPLED:
            residual = "unknown of some pixels alone"
        elif last > best:
            residual += f" at best and {last:.2g} at the end"
        why = _advice(self.status, self.method)
        if self.status is Status.SAMPLED and self.reason:
            why = f"{why.partition(';')[0]}: {self.reason}"
        return (
            f"{self.method}: {self.status.name.lower()} after {self.iterations} iterations, "
            f"{self.products} products, relative residual {residual}: {why}"
        )


def joined(channels: Sequence[Solution]) -> Solution:
    """One solution of what was sampled together, x (3, N) or (3, N, k)."""
    first, reasons = channels[0], [part for one in channels for part in one.reason.split("; ")]
    errors = [one.standard_error for one in channels if one.standard_error is not None]
    return dataclasses.replace(
        first,
        x=np.stack([one.x for one in channels]),
        status=Status.CONVERGED if all(one.converged for one in channels) else Status.SAMPLED,
        iterations=max(one.iterations for one in channels),
        products=sum(one.products for one in channels),
        residuals=tuple(map(max, zip(*(one.residuals for one in channels), strict=True))),
        reason="; ".join(dict.fromkeys(filter(None, reasons))),  # what all have in common once
        lowest=max(one.residual for one in channels),
        standard_error=np.stack(errors) if errors else None,
    )
