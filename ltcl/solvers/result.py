# SPDX-License-Identifier: BSD-3-Clause
"""`Solution`, the result of a solve, and `Status`, how it ended."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks

SERIES_METHODS = ("jacobi", "neumann", "matrix_series")


class Status(enum.Enum):
    """The end of a solve; the value says why, and most say what to try next."""

    CONVERGED = "the true residual is within the tolerance"
    MAXITER = (
        "maxiter was reached before the tolerance; raise maxiter, loosen rtol, or try another "
        "method"
    )
    DIVERGED = "the residual grew"
    STAGNATED = (
        "the residual stopped falling, or rounding may hide more than the tolerance; loosen rtol"
    )
    INDEFINITE = (
        "S is not positive definite in the inner product of cg, which then has no next step; "
        "give the weights= that make S self-adjoint, or try method='gmres' or 'chebyshev'"
    )
    NO_STEP = "breakdown of the method, also after a restart; try method='gmres' or 'direct'"
    SAMPLED = (
        "an estimate with noise; .reason states the accuracy that was reached and what to try next"
    )
    PRECOMPUTED = "one product with an inverse whose error is bounded; no residual was computed"
    BREAKDOWN = "the system is singular; check the first bounce and the transport"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Solution:
    """Result of `ltcl.solve`.

    For three S at once `products` are the sum over the channels, and `residuals` the largest.

    Attributes
    ----------
    x : like b
        The solution; where `converged` is False, the iterate with the smallest residual, or the
        estimate of a method that samples. float32; float64 of "direct", of values beyond float32,
        and where `exact` was refined in float64. With `pixels=` it is (P,) or (P, k), in their
        order; with three S (3, P) or (3, P, k).
    status : Status
    iterations : int
    products : int
        Products with S, including those of checks. "auto" counts all methods that it tried, and
        the survey in the solve that made it, but not the product for the row sums of an operator.
    residuals : tuple of float
        ``||b - S x|| / ||b||`` before each iteration and at the end; the largest over right-hand
        sides.
    seconds : float
        Wall time, including transfers.
    method, reason : str
        The method that ran; why "auto" chose it, or the samples that a random method took. The
        reason of other methods is empty.
    lowest : float, optional
        Residual of the best iterate; the smallest of `residuals` when not given.
    standard_error : like x, optional
        Standard error of "monte_carlo", for the noise of n samples. It falls as 1 / sqrt(n), and as
        1 / n for light that no sample may have met. It does not cover the bias of alias tables,
        which leave out entries drawn less than once in about 2^19 times the entries of their row.
    least_rtol : float, optional
        The smallest rtol that can be claimed for x, if "direct" did not converge.
    error : float, optional
        Bound on the relative error of x, if one is known, as for a precomputed inverse.
    rest : like x, optional
        b - S x, if a task asked for it and the method has it.
    """

    x: np.ndarray
    status: Status
    iterations: int
    products: int
    residuals: tuple[float, ...]
    seconds: float = 0.0
    method: str
    reason: str = ""
    lowest: float | None = None
    standard_error: np.ndarray | None = None
    least_rtol: float | None = None
    error: float | None = None
    rest: np.ndarray | None = None

    @property
    def converged(self) -> bool:
        """True if the tolerance was met, by a true residual or by a bound on the error of x."""
        return self.status in (Status.CONVERGED, Status.PRECOMPUTED)

    @property
    def residual(self) -> float:
        """The relative residual of `x`; infinite if only selected pixels were estimated."""
        finite = [value for value in self.residuals if np.isfinite(value)]
        if not finite:
            return float("inf")
        if self.converged:
            return finite[-1]
        return min(finite) if self.lowest is None else self.lowest

    def with_arrays(self, give: Callable[[np.ndarray], Any]) -> Solution:
        """The same result with arrays of another kind."""
        optional = {"standard_error": self.standard_error, "rest": self.rest}
        arrays = {name: give(array) for name, array in optional.items() if array is not None}
        return dataclasses.replace(self, x=give(self.x), **arrays)

    def __str__(self) -> str:
        if self.error is not None:
            return f"{self.method}: relative error at most {self.error:.2g}: {self.status.value}"
        return f"{self._outcome()}: {self._advice()}"

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.x.shape))
        name = self.status.name.lower()
        end = f"{name} after {self.products} products, residual {self.residual:.2g}"
        return f"<ltcl Solution of {shape} values by {self.method}: {end}>"

    def _outcome(self) -> str:
        """State how the solve ended and the residual that it reached."""
        best = self.residual
        last = self.residuals[-1]
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
        """Say why the solve ended and what else to try, never the method that has just failed."""
        cause = self.status.value
        if self.status is Status.SAMPLED and self.reason:
            return self.reason
        if self.least_rtol is not None:
            hidden = checks.upwards(self.least_rtol)
            return f"rounding may hide up to {hidden} of it; ask for no less"
        if self.status is Status.STAGNATED and self.method != "direct":
            return f"{cause} or try method='direct'"
        if self.status is not Status.DIVERGED:
            return cause
        if self.method in SERIES_METHODS:
            cause += ": the series converges only where the spectral radius of R is below 1"
        alternative = "gmres" if self.method == "chebyshev" else "chebyshev"
        return f"{cause}; try method='{alternative}' or 'direct'"


def join_channels(channels: Sequence[Solution]) -> Solution:
    """Join three channels that were sampled together into one solution, x (3, N) or (3, N, k)."""
    first = channels[0]
    x = []
    standard_errors = []
    reasons: list[str] = []
    status = Status.CONVERGED
    iterations = 0
    products = 0
    residuals = np.zeros(len(first.residuals))
    lowest = 0.0
    for channel in channels:
        x.append(channel.x)
        if channel.standard_error is not None:
            standard_errors.append(channel.standard_error)
        reasons += channel.reason.split("; ")
        if not channel.converged:
            status = Status.SAMPLED
        iterations = max(iterations, channel.iterations)
        products += channel.products
        residuals = np.maximum(residuals, channel.residuals)
        lowest = max(lowest, channel.residual)

    joined = dataclasses.replace(
        first,
        x=np.stack(x),
        status=status,
        iterations=iterations,
        products=products,
        residuals=tuple(residuals.tolist()),
        reason=_join_reasons(reasons),
        lowest=lowest,
        standard_error=None,
    )
    if not standard_errors:
        return joined
    return dataclasses.replace(joined, standard_error=np.stack(standard_errors))


def _join_reasons(reasons: Sequence[str]) -> str:
    """The reasons, each once; empty ones are left out."""
    return "; ".join(filter(None, dict.fromkeys(reasons)))
