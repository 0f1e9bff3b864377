# SPDX-License-Identifier: BSD-3-Clause
"""Jacobi, the Neumann series, Richardson, Chebyshev; relaxation, row by row; the whole inverse.

Jacobi to Chebyshev take one launch a step (`Operator.stepper`), with x the iterate and r its
residual:

    x += d,   r -= S d,   d = keep d + gain r

Jacobi (eq. 20), keep = 0 and gain = 1: from zero, k steps are the k-term inverse Neumann series
(eq. 10), whose next term is the residual; the forward dual (eq. 18) is the same on I - A. Both need
rho(R) < 1.

Richardson, gain = omega, converges for every albedo below one. On a spectrum in [a, b] the best
omega is 2 / (a + b) (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., example 4.1).

Chebyshev (Saad, algorithm 12.1, whose numbers are in comments): the best polynomial in S for a
spectrum in an interval, here the free bounds, drawn in by a few steps of GMRES. Where they leave
out eigenvalues, the residual grows: more steps of GMRES find those, and the iteration goes on with
wider bounds. Not for spectra with large imaginary parts, nor with eigenvalues on both sides of 0.

Gauss-Seidel, SOR, block Gauss-Seidel and Southwell relax one row or block of rows after the other:

    l_i += omega (l_out_i - sum_(j<i) S_ij l_j^(k+1) - sum_(j>=i) S_ij l_j^(k)) / S_ii,  row i after
    row i l_B += (S_BB)^-1 (l_out - S l)_B,  block B after block i = argmax |r_i|,  l_i += r_i /
    S_ii,  r -= S[:, i] r_i / S_ii

Where S is self-adjoint, sweeps converge for every albedo (Saad, theorem 4.10). The residual of an
iterate comes with the next sweep: k iterations take k + 1, each about one product. Southwell takes
the largest residual first, as progressive radiosity does (Cohen et al., SIGGRAPH 1988).
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.device import Array, vectors
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Operator, as_operator
from ltcl.operators.relaxation import INVERTED, Steps, Sweeps, relaxation
from ltcl.solvers import krylov
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import GROWTH, SLOTS, Monitor, System

# times what a residual should be in theory: above what weights of surfaces may do to norms
_BEYOND = 10.0
_SEEN = (
    1e-4  # relative residual down to which bounds are judged: below, rounding has its part in it
)
_REPAIRS = 3  # times that bounds are widened before the monitor alone decides
_REPAIR_STEPS = 5
_FIRST_STEPS = 2
_DEEPER = 4.0  # what a lower bound that failed is divided by: small eigenvalues are found last
# of the width of the Ritz values, added on both sides: the outermost are not found at once
_MARGIN = 0.25
_SAFETY = 1.05
_STEPS = (
    64  # of an iteration of Southwell's, where `rows` is not given and there are that many pixels
)
_CHUNK = 64  # columns of the matrix series in one product


def steps(
    system: System,
    x: Array,
    r: Array,
    monitor: Monitor,
    coefficients: Iterator[tuple[float, float]],
) -> Iterator[None]:
    """Take steps with (keep, gain), the first for d = gain r alone, until the monitor ends it.

    Yields after each reading of residuals that does not end the solve.
    """
    stepper = system.S.stepper(x, r, SLOTS)
    keep, gain = next(coefficients)
    stepper.start(gain)
    length = abs(gain) * monitor.norms  # of d, at most
    while True:
        queued = list(itertools.islice(coefficients, monitor.steps_ahead()))
        for keep, gain in queued:
            stepper.step(keep, gain)
        system.products += len(queued)
        norms, travelled = stepper.norms(), np.zeros_like(length)
        for (keep, gain), norm in zip(queued, norms, strict=True):
            travelled += length
            length = abs(keep) * length + abs(gain) * norm
        if monitor.check(x, r, norms, travelled):
            return
        yield


@dataclass(frozen=True)
class Jacobi:
    """No options."""

    name: ClassVar[str] = "jacobi"
    omega: ClassVar[float | None] = 1.0

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        omega = self.omega
        if omega is None:
            lower, upper = theory.free_bounds(system.S)
            # Row sums that leave float32 tell nothing; a first step without damping shows that S
            # does, too.
            omega = 2.0 / (lower + upper) if math.isfinite(upper) else 1.0
        for _ in steps(system, x, r, monitor, itertools.repeat((0.0, float(omega)))):
            pass


@dataclass(frozen=True)
class Neumann(Jacobi):
    """The series is Jacobi's iteration started from zero; no options."""

    name: ClassVar[str] = "neumann"


@dataclass(frozen=True)
class Richardson(Jacobi):
    """Options: ``omega``, the damping; the best one for the free bounds of S when not given."""

    name: ClassVar[str] = "richardson"
    omega: float | None = None  # pyright: ignore[reportIncompatibleVariableOverride]

    def __post_init__(self) -> None:
        if self.omega is not None:
            checks.number("omega", self.omega, above=0.0)


def chebyshev_steps(lower: float, upper: float) -> Iterator[tuple[float, float]]:
    """(keep, gain) of one step after the other, for a spectrum of S in [lower, upper], 0 < lower.

    With lower = upper it is Richardson's iteration, with both 1 the Neumann series.

    >>> steps = chebyshev_steps(0.5, 1.5)
    >>> next(steps), [round(number, 3) for number in next(steps)]
    ((0.0, 1.0), [0.143, 1.143])
    """
    centre, radius = (upper + lower) / 2.0, (upper - lower) / 2.0
    gain, rho = 1.0 / centre, radius / centre  # 2.
    yield 0.0, gain
    while True:
        gain = 2.0 / (2.0 * centre - radius * rho)
        previous, rho = rho, radius * gain / 2.0  # 6.
        yield previous * rho, gain  # 7.


def chebyshev_rate(lower: float, upper: float) -> float:
    """What a step leaves of a residual at last, sigma - sqrt(sigma^2 - 1), sigma = centre / radius."""
    share = (upper - lower) / (upper + lower)  # 1 / sigma
    return share / (1.0 + math.sqrt(1.0 - share**2))


@dataclass(frozen=True)
class Chebyshev:
    """Options: ``spectrum`` of S, and ``arnoldi``, steps of GMRES to begin with, which refine it."""

    name: ClassVar[str] = "chebyshev"
    spectrum: tuple[float, float] | None = None
    arnoldi: int | None = None

    def __post_init__(self) -> None:
        if self.arnoldi is not None and checks.count("arnoldi", self.arnoldi, least=0) == 1:
            raise InputError(
                "arnoldi is 1; it must be 0 or at least 2, since one step tells no width"
            )
        if self.spectrum is None:
            return
        try:
            lower, upper = self.spectrum
        except (TypeError, ValueError):
            raise InputError(f"spectrum is {self.spectrum!r}; it must be (lower, upper)") from None
        checks.number("spectrum[1]", upper, least=checks.number("spectrum[0]", lower, above=0.0))

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        S, bounds = system.S, self.spectrum or theory.free_bounds(system.S)
        first = self.arnoldi if self.arnoldi is not None else 0 if self.spectrum else _FIRST_STEPS
        if first:
            space = krylov.cycle(system, x, r, monitor, first)
            bounds = drawn_in(bounds, S, space.ritz_values())
        for limit in (*[_BEYOND] * _REPAIRS, math.inf):
            if monitor.status is not None:
                return
            start, initial = monitor.iterations, max(monitor.residuals[-1], monitor.lowest)
            monitor.factor, has_grown = chebyshev_rate(*bounds), False
            for _ in steps(system, x, r, monitor, chebyshev_steps(*bounds)):
                left = monitor.factor ** (monitor.iterations - start)
                expected = initial * 2.0 * left / (1.0 + left**2)  # 1 / T_k(sigma) of it
                if has_grown := monitor.residuals[-1] > max(limit * expected, _SEEN):
                    break
            if not has_grown and not (math.isfinite(limit) and monitor.resume(x, r)):
                return
            # What has grown are the eigenvectors that the bounds leave out; few steps find their
            # eigenvalues.
            space = krylov.cycle(system, x, r, monitor, _REPAIR_STEPS)
            lower, upper = _hull(bounds, [*theory.free_bounds(S), *_positive(space.ritz_values())])
            bounds = lower / _DEEPER, upper


def drawn_in(bounds: tuple[float, float], S: Operator, ritz: np.ndarray) -> tuple[float, float]:
    """Bounds drawn in to a quarter of the width of the Ritz values around these, and out to hold them.

    With them the mean row sum: near the eigenvalue that dominates R, which a picture may have no
    part of.
    """
    values = _positive(np.append(ritz, theory.row_sum_range(S)[1]))
    if len(ritz) < 2 or not len(values):
        return _hull(bounds, values)
    low, high = float(np.min(values)), float(np.max(values))
    margin = _MARGIN * (high - low)
    lower, upper = max(bounds[0], low - margin), min(bounds[1], high + margin)
    return _hull((lower, upper) if lower < upper else bounds, values)


def _positive(ritz: np.ndarray) -> np.ndarray:
    real = np.real(ritz)
    return real[(real > 0.0) & np.isfinite(real)]


def _hull(bounds: tuple[float, float], values: Any) -> tuple[float, float]:
    """Bounds drawn out, where they have to be, to hold the values and a little more."""
    lower, upper = bounds
    least, most = float(np.min(values, initial=lower)), float(np.max(values, initial=upper))
    return lower if least >= lower else least / _SAFETY, upper if most <= upper else most * _SAFETY


@dataclass(frozen=True)
class BlockGaussSeidel:
    """Options: ``block``, rows of a block, which changes the iterates; inverses take 4 N block bytes.

    With blocks of one row it is Gauss-Seidel, with one block the direct solution.
    """

    name: ClassVar[str] = "block_gauss_seidel"
    block: int | None = INVERTED
    omega: ClassVar[float | None] = None

    def __post_init__(self) -> None:
        if self.block is not None or self.omega is None:
            checks.count("block", self.block)
        if self.omega is not None:
            checks.number("omega", self.omega, above=0.0, below=2.0)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it with one of the iterates."""
        sweeps = Sweeps(relaxation(system.S, self.name, self.block, self.omega), x, system.b, r)
        sweeps.sweep()
        system.products += 1
        _repeat(sweeps.sweep, system, sweeps.before, r, monitor)
        x.copy_from(sweeps.before)


@dataclass(frozen=True)
class GaussSeidel(BlockGaussSeidel):
    """Options: ``block``, rows of a block; it changes the speed, not the iterates."""

    name: ClassVar[str] = "gauss_seidel"
    block: int | None = None
    omega: ClassVar[float | None] = 1.0


@dataclass(frozen=True)
class SOR(GaussSeidel):
    """Options: ``omega`` in (0, 2), and ``block`` as of Gauss-Seidel, which SOR is with omega = 1."""

    name: ClassVar[str] = "sor"
    omega: float = 1.0  # pyright: ignore[reportIncompatibleVariableOverride]


@dataclass(frozen=True)
class Southwell:
    """Options: ``rows`` relaxed in one step; a 64th of the picture when not given.

    With ``rows=1`` it converges for every self-adjoint S. With more, as many equal pieces of the
    picture relax their largest residuals at once, which may diverge. An iteration relaxes N rows:
    one product.
    """

    name: ClassVar[str] = "southwell"
    rows: int | None = None

    def __post_init__(self) -> None:
        if self.rows is not None:
            checks.count("rows", self.rows)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        n = x.shape[0]
        rows = min(max(1, n // _STEPS) if self.rows is None else self.rows, n)
        steps = Steps(system.S, self.name, x, r, rows)

        def relax_all() -> None:
            for _ in range(-(-n // rows)):
                steps.step()
            steps.step(picks=False)

        _repeat(relax_all, system, x, r, monitor)


def _repeat(
    iteration: Callable[[], None], system: System, x: Array, r: Array, monitor: Monitor
) -> None:
    """Queue iterations, each of which leaves `r` of `x`, until the monitor ends it; few readings of norms."""
    squares = x.device.empty((SLOTS, x.columns))
    while True:
        ahead = monitor.steps_ahead()
        for slot in range(ahead):
            iteration()
            vectors.queue_dot(r, r, squares, slot)
        system.products += ahead
        norms = np.sqrt(squares.get()[:ahead].astype(np.float64))
        if monitor.check(x, r, norms, travelled=np.inf):
            return


def matrix_series(
    S: Any, *, rtol: float = 1e-2, steps: int | None = None, maxiter: int = 1000, throw: bool = True
) -> Solution:
    """S^-1 = I - R + R^2 - ... (eq. 10), or (I - A)^-1 = I + A + A^2 + ... (eq. 8), term by term: N^3 each.

    The paper's baseline; its matrix iteration Sinv_k = I - R Sinv_(k-1) (eq. 21) gives the same.

    Parameters
    ----------
    S : (N, N) Operator, or anything `solve` takes
        ``T.interreflection`` inverts light transport, ``IdentityPlus(A, sign=-1)`` makes it from
        one bounce.
    rtol : float
        Done when ``||e_j - S x_j|| <= rtol`` for every column x_j.
    steps : int, optional
        Make exactly so many and judge nothing; `maxiter` and `throw` are those of `solve`.

    Returns
    -------
    Solution
        `x` is the inverse, (N, N) float32; `products` counts those of N x N matrices, one for the
        residual.

    Raises
    ------
    MemoryLimitError, ConvergenceError
        Two N x N iterates do not fit the device; divergence, or `maxiter` reached.

    Examples
    --------
    >>> matrix_series([[1.0, 0.5], [0.5, 1.0]], steps=1).x.tolist()
    [[1.0, -0.5], [-0.5, 1.0]]
    """
    start = time.perf_counter()
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    most = (
        checks.count("maxiter", maxiter) if steps is None else checks.count("steps", steps, least=0)
    )
    S = as_operator(S)
    n, device = S.shape[1], S.device
    if S.shape[0] != n:
        raise InputError(f"S has shape {S.shape}; it must be square, (N, N)")
    # Columns never mix: the device works on some of them at a time.
    what = f"a matrix series for N = {n}, two N x N iterates,"
    device.require(2 * 4 * n * n + 4 * n * _CHUNK, what)
    checks.fits_host(what, 2 * 4 * n * n)
    starts = range(0, n, _CHUNK)
    x = [device.upload(np.eye(n, min(_CHUNK, n - first), -first, np.float32)) for first in starts]
    r = [S.apply(e, scale=-1.0, add=e) for e in x]
    residuals: list[float] = []
    status = None
    while status is None:
        if residuals:
            for chunk, rs in enumerate(r):
                vectors.axpy(1.0, rs, x[chunk])
                r[chunk] = S.apply(rs, scale=-1.0, add=rs)  # the next term, -R r = r - S r
        residual = float(
            max(vectors.norm(columns).max() for columns in r)
        )  # columns of I have norm 1
        residuals.append(residual)
        if steps is None and residual <= rtol:
            status = Status.CONVERGED
        elif steps is None and not (np.isfinite(residual) and residual <= GROWTH * residuals[0]):
            status = Status.DIVERGED
        elif len(residuals) > most:
            status = Status.MAXITER
    inverse, count = np.concatenate([columns.get() for columns in x], axis=1), len(residuals)
    facts = status, count - 1, count, tuple(residuals), time.perf_counter() - start
    solution = Solution(inverse, *facts, "matrix_series")
    if throw and steps is None and not solution.converged:
        raise ConvergenceError(str(solution), solution)
    return solution


METHODS = (Jacobi, Neumann, Richardson, Chebyshev, GaussSeidel, SOR, BlockGaussSeidel, Southwell)
