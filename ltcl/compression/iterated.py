# SPDX-License-Identifier: BSD-3-Clause
"""What an inverse of sparse coefficients is, and how it was found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ltcl.errors import InputError
from ltcl.solvers.result import Status

_ADVICE = {
    Status.MAXITER: "maxiter was reached before the tolerance; raise maxiter, or loosen rtol",
    Status.DIVERGED: "the residual grew; try method='elimination', or a wider spectrum=",
    Status.STAGNATED: "the type of C has no more digits; loosen rtol, or give C in float64",
}


class NoInverse(InputError):
    """I + sign C has none that the method finds; `why` is what was found, without a name before it."""

    def __init__(self, name: str, why: str, advice: str) -> None:
        super().__init__(f"{name} {why}; {advice}")
        self.why = why


@dataclass(frozen=True, eq=False)
class Iterated:
    """What `invert_coefficients` returns.

    Attributes
    ----------
    D : csr_array, (N, N)
        (I + sign C)^-1 = I - sign D.
    error : float
        Bound on ``||I - (I - sign D)(I + sign C)||_2``: of every solution, relative to itself.
    confidence : float
        Of that bound, over the random starts of `theory.two_norm`.
    status : Status
    products : int
        Of sparse matrices, D C each.
    residuals : tuple of float
        Estimates of the same norm, from D = 0 on.
    dropped : tuple of float
        Frobenius norm of what each step dropped.
    threshold : float
        All of D is at least this large.
    method : str
        "iteration" or "elimination".
    spectrum : (lower, upper) or None
        Of I + sign C, that the iteration took.
    seconds : float
    """

    D: Any
    error: float
    confidence: float
    status: Status
    products: int
    residuals: tuple[float, ...]
    dropped: tuple[float, ...]
    threshold: float
    method: str
    spectrum: tuple[float, float] | None = None
    seconds: float = 0.0

    @property
    def converged(self) -> bool:
        """Whether the bound is within the tolerance."""
        return self.status is Status.CONVERGED

    def __str__(self) -> str:
        n = self.D.shape[0]
        advice = "" if self.converged else f": {_ADVICE.get(self.status, self.status.value)}"
        return (
            f"{self.method}: {self.status.name.lower()} after {self.products} products, "
            f"error {self.error:.2g}, {self.D.nnz / n:.3g} numbers a row{advice}"
        )
