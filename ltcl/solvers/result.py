# SPDX-License-Identifier: BSD-3-Clause
"""What a solve returns: the iterate, and what happened."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl import checks


class Status(enum.Enum):
    """How a solve ended; the value says why, and most say what to try next."""

    CONVERGED = "the true residual is within the tolerance"
    MAXITER = "maxiter was reached before the tolerance; raise maxiter, loosen rtol, or try another method"
    DIVERGED = "the residual grew"
    STAGNATED = (
        "the residual stopped falling, or rounding may hide more than the tolerance; loosen rtol"
    )
    INDEFINITE = (
        "S is not positive definite in the inner product of cg, which then has no next step; "
        "give the weights= that make S self-adjoint, or try method='gmres' or 'chebyshev'"
    )
    NO_STEP = (
        "the method has no next step here, not even started anew; try method='gmres' or 'direct'"
    )
    SAMPLED = "an estimate with noise; .reason tells what was reached and what to try next"
    PRECOMPUTED = "one product with an inverse whose error is bounded; no residual was computed"
    BREAKDOWN = "the system is singular; check the first bounce and the transport"


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """Result of `ltcl.solve`; of three S at once `products` are those of all, and `residuals` the largest.

    Attributes
    ----------
    x : like b, float32 (float64 of "direct", of values beyond float32, and where `exact` was so
    refined)
        The solution; where `converged` is False, the iterate with the smallest residual, or what
        was sampled. Of `pixels=` (P,) or (P, k), in their order; of three S (3, P) or (3, P, k).
    status : Status
    iterations : int
    products : int
        Products with S, those for checks included; of "auto" those of all methods tried, and of the
        survey in the solve that made it, but not the one for the row sums of an operator.
    residuals : tuple of float
        ``||b - S x|| / ||b||`` before each iteration and at the end; the largest over right-hand sides.
    seconds : float
        Wall time, transfers included.
    method, reason : str
        The one that ran; why "auto" chose it, or what a method that samples has sampled, else
        empty.
    lowest : float, optional
        Residual of the best iterate; the least of `residuals` when not given.
    standard_error : like x, optional
        Of "monte_carlo": of the noise of n samples, without the bias of alias tables, which leave
        out entries drawn less than once in about 2^19 times the entries of their row. It falls as 1
        / sqrt(n), and as 1 / n for light that no sample may have met.
    least_rtol : float, optional
        Of "direct" that did not converge: the smallest rtol that this x can be claimed to meet.
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
    least_rtol: float | None = None
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
        return f"{self._outcome()}: {self._advice()}"

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.x.shape))
        end = f"{self.status.name.lower()} after {self.products} products, residual {self.residual:.2g}"
        return f"<ltcl Solution of {shape} values by {self.method}: {end}>"

    def _outcome(self) -> str:
        best, last = self.residual, self.residuals[-1]
        residual = f"{best:.2g}"
        if np.isnan(last) and self.status is Status.SAMPLED:
            residual = "not known for selected pixels only"
        elif last > best:
            residual += f" at best and {last:.2g} at the end"
        return (
            f"{self.method}: {self.status.name.lower()} after {self.iterations} iterations, "
            f"{self.products} products, relative residual {residual}"
        )

    def _advice(self) -> str:
        """Why a solve ended and what else to try: never the method that just failed."""
        why, method = self.status.value, self.method
        if self.status is Status.SAMPLED:
            return self.reason or why
        if self.least_rtol is not None:
            return (
                f"rounding may hide up to {checks.upwards(self.least_rtol)} of it; ask for no less"
            )
        if self.status is Status.STAGNATED and method != "direct":
            return f"{why} or try method='direct'"
        if self.status is not Status.DIVERGED:
            return why
        if method in ("jacobi", "neumann", "matrix_series"):
            why += ": the series converges only where the spectral radius of R is below 1"
        return (
            f"{why}; try method='{'gmres' if method == 'chebyshev' else 'chebyshev'}' or 'direct'"
        )


def joined(channels: Sequence[Solution]) -> Solution:
    """One solution of what was sampled together, x (3, N) or (3, N, k)."""
    reasons = [reason for channel in channels for reason in channel.reason.split("; ") if reason]
    errors = [channel.standard_error for channel in channels if channel.standard_error is not None]
    return dataclasses.replace(
        channels[0],
        x=np.stack([channel.x for channel in channels]),
        status=Status.CONVERGED
        if all(channel.converged for channel in channels)
        else Status.SAMPLED,
        iterations=max(channel.iterations for channel in channels),
        products=sum(channel.products for channel in channels),
        residuals=tuple(map(max, zip(*(channel.residuals for channel in channels), strict=True))),
        reason="; ".join(dict.fromkeys(reasons)),  # what all have in common once
        lowest=max(channel.residual for channel in channels),
        standard_error=np.stack(errors) if errors else None,
    )
