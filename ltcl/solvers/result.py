# SPDX-License-Identifier: BSD-3-Clause
"""What a solve returns: the iterate, and what happened."""

from __future__ import annotations

import enum
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
    SAMPLED = (
        "the samples are spent, what is left is noise, told by .standard_error; try more "
        "samples=, or gather=True"
    )
    PRECOMPUTED = "one product with an inverse whose error is bounded; no residual was computed"
    BREAKDOWN = "the system is singular; check the first bounce and the transport"


_SERIES = ("jacobi", "neumann", "matrix_iteration", "matrix_series")


def _advice(status: Status, method: str) -> str:
    """Why a solve ended and what else to try: never the method that just failed.

    >>> _advice(Status.DIVERGED, "chebyshev")
    "the residual grew; try method='gmres' or 'direct'"
    """
    if status is Status.STAGNATED and method != "direct":
        return f"{status.value} or try method='direct'"
    if status is not Status.DIVERGED:
        return status.value
    series = ": the series converges only where the spectral radius of R is below 1"
    other = "gmres" if method == "chebyshev" else "chebyshev"
    return f"{status.value}{series if method in _SERIES else ''}; try method='{other}' or 'direct'"


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of `ltcl.solve`.

    Attributes
    ----------
    x : (N,) or (N, k) float32 (float64 of method "direct", and of values beyond float32)
        The solution; where `converged` is False, the iterate with the smallest residual.
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
        Residual of the best iterate; the least of `residuals` when not given. Residuals that gmres foresees
        are no iterate's.
    standard_error : like x, optional
        Of a method that samples, where it knows it.
    error : float, optional
        Bound on the relative error of x, where one is known: of a precomputed inverse.
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

    @property
    def converged(self) -> bool:
        """Whether the tolerance was met, by a true residual or by a bound on the error of x."""
        return self.status in (Status.CONVERGED, Status.PRECOMPUTED)

    @property
    def residual(self) -> float:
        """The relative residual of `x`."""
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
        if last > best:
            residual += f" at best and {last:.2g} at the end"
        return (
            f"{self.method}: {self.status.name.lower()} after {self.iterations} iterations, "
            f"{self.products} products, relative residual {residual}: {_advice(self.status, self.method)}"
        )
