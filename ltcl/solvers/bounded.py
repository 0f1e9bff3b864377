# SPDX-License-Identifier: BSD-3-Clause
"""Least squares within bounds: min ||w (A x - b)|| over lower <= x <= upper, by products with A and A^T.

Projected conjugate directions. With r = w (b - A x), g = -A^T w r, and z = -g but for what the
bounds forbid,

    p = z + beta d,   d' = clip(x + alpha p) - x,   x' = x + lambda d'

with beta that makes p conjugate to the last d, alpha the step of Barzilai and Borwein, and lambda
exact along d' or as far as the bounds allow: conjugate gradients on a face of the box, and many
bounds at once (Moré and Toraldo, SIAM J. Optimization 1, 1991). Where the last lambda was short, or
0, p = z. A step is two products.

The certificate: with the Frank-Wolfe gap sum_i max(g_i (x_i - lower_i), g_i (x_i - upper_i)), by
Cauchy and Schwarz

    ||r*|| >= r.r* / ||r|| >= ||r|| - gap / ||r||,

and the largest of these bounds so far is kept. Done when the error is within the tolerance, of 0 or
of that, with what rounding of A x may hide: of S = I + R, whose columns may be far below 1, at
least that of x itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ltcl.device import vectors
from ltcl.operators import Operator
from ltcl.solvers.krylov import Columns, ratio
from ltcl.solvers.result import Solution, Status

_KERNELS = ("bounded_direction", "vector_dots", "bounded_move", "bounded_look")
_ROUNDING = 2.0**-22  # of ||w b||: an error is not told from the least one by less
_FAR = 1e30  # in units of b: a bound where none was meant, inside float32
Box = tuple[np.ndarray, np.ndarray]  # lower, upper (N,)
_PATIENCE = 50  # steps without a better certificate: rounding has the say


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Bounded(Solution):
    """Result of `minimise`: a `Solution` with its certificate; errors in the units of w b.

    Attributes
    ----------
    errors, least : (k,) float64
        ``||w (A x - b)||`` of every column, and what no x within the bounds is below.
    saturated : (N, k) bool
        Where x is at a bound or all but there, and a step beyond would lower the error.
    gap : float
        Largest ``(errors - least) / ||w b||``; `residuals` holds the largest ``errors / ||w b||``.
    """

    errors: np.ndarray
    least: np.ndarray
    saturated: np.ndarray
    gap: float

    def __str__(self) -> str:
        why = "" if self.converged else f": {self.status.value}"
        return f"{self._outcome()}, at most {self.gap:.2g} above the least{why}"


def minimise(
    A: Operator,
    b: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    x0: np.ndarray,
    *,
    weights: np.ndarray | None = None,
    rtol: float = 1e-2,
    atol: float = 0.0,
    maxiter: int = 1000,
    callback: Callable[[int, float], object] | None = None,
) -> Bounded:
    """The x within the bounds for which A x is nearest to b; STAGNATED where rounding hides any further gain.

    A is (M, N) with columns of like size, for instance S; b and the weights w >= 0, ones when not
    given, are (M, k), the finite bounds (N,), and the start x0 (N, k) is moved within. Done when
    the error, or what it is above the least possible one, is at most ``max(rtol ||w b||, atol)`` in
    every column; where b = 0, rtol is of the error at the start. ``callback(iteration, relative
    gap)`` is called after each step.
    """
    start = time.perf_counter()
    largest = float(np.max(np.abs(b)))
    unit = _power(largest or float(np.max(np.abs([lower, upper]))))
    unit_w = 1.0 if weights is None else _power(float(np.max(weights)))
    box = inwards(
        *(np.clip(np.asarray(bound, np.float64) / unit, -_FAR, _FAR) for bound in (lower, upper))
    )
    first = np.clip((x0 / unit).astype(np.float32), *(bound[:, None] for bound in box))
    descent = _Descent(A, b / unit, None if weights is None else weights / unit_w, box, first)
    initial, _ = descent.read()
    scale = np.where(descent.scale > 0.0, descent.scale, np.where(initial > 0.0, initial, 1.0))
    tolerance, least = np.maximum(rtol * scale, atol / (unit * unit_w)), np.zeros_like(scale)
    residuals: list[float] = []
    lowest, lowest_at, hidden = np.inf, 0, descent.rounding()
    while True:
        errors, gap = descent.read()
        least = np.fmax(least, np.minimum(errors - ratio(gap, errors, errors > 0.0), errors))
        excess = np.maximum(errors - least + 2.0 * hidden, _ROUNDING * scale)  # over the least
        excess = np.where(np.isfinite(errors), excess, np.inf)
        unsolved, steps, above = excess > tolerance, len(residuals), float(np.max(excess / scale))
        status = Status.STAGNATED if steps - lowest_at > _PATIENCE else None
        status = Status.MAXITER if steps >= maxiter else status
        status = status if unsolved.any() else Status.CONVERGED
        if status is not None and not descent.true:  # to be said only of a true residual
            descent.refresh()
            hidden = descent.rounding()
            continue
        if above < lowest:
            lowest, lowest_at = above, steps
        if callback is not None:
            callback(steps, above)
        residuals.append(float(np.max(errors / scale)))
        if status is not None:
            break
        descent.step(unsolved)
    x, worse = descent.x.get(), ~(errors <= initial)  # rounding alone can do that
    errors, saturated = (
        np.where(worse, initial, errors),
        np.where(worse, False, descent.saturated(x)),
    )
    excess = np.where(worse, np.maximum(initial - least + 2.0 * hidden, _ROUNDING * scale), excess)
    x = (np.where(worse, first, x) * unit).astype(np.float32)
    x = np.clip(x, *(bound[:, None] for bound in inwards(lower, upper)))
    history = len(residuals) - 1, descent.products, tuple(residuals), time.perf_counter() - start
    least = np.maximum(least - hidden, 0.0) * unit * unit_w
    certificate = {
        "errors": errors * unit * unit_w,
        "least": least,
        "gap": float(np.max(excess / scale)),
    }
    return Bounded(x, status, *history, "bounded", saturated=saturated, **certificate)


def least_squares(
    A: Operator,
    b: np.ndarray,
    free: np.ndarray,
    weights: np.ndarray,
    *,
    rtol: float,
    maxiter: int = 100,
) -> np.ndarray:
    """The x (N, ...), 0 but where `free`, for which w A x is nearest to w b (M, ...), by conjugate gradients.

    Each column has free entries and weights of its own, which broadcast to x and b. Done when the
    gradient of every column is at most rtol times the first one, or after `maxiter` steps of two
    products.
    """

    def product(matrix: Any, a: np.ndarray) -> np.ndarray:
        return (matrix @ a.reshape(len(a), -1).astype(np.float32)).reshape(-1, *b.shape[1:])

    r, size, first = b, np.ones(b.shape[1:]), np.ones(b.shape[1:])
    x = p = np.zeros((A.shape[1], *b.shape[1:]))
    for step in range(maxiter):
        s, before = free * product(A.T, weights**2 * r), size
        size = np.sum(s**2, axis=0)
        first = first if step else size
        if (size <= rtol**2 * first).all():
            break
        p = s + ratio(size, before, before > 0.0) * p
        Ap = product(A, p)
        curvature = np.sum((weights * Ap) ** 2, axis=0)
        alpha = ratio(size, curvature, curvature > 0.0)
        x, r = x + alpha * p, r - alpha * Ap
    return x


def inwards(lower: ArrayLike, upper: ArrayLike) -> Box:
    """Bounds in float32, rounded into the interval; where it holds no float32, the nearest one.

    >>> low, high = inwards(0.1, 0.7)
    >>> bool(np.float32(0.7) > 0.7 >= high), bool(low >= 0.1)
    (False, True)
    """
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    nearest = low, high = lower.astype(np.float32), upper.astype(np.float32)
    low = np.where(low < lower, np.nextafter(low, np.float32(np.inf)), low)
    high = np.where(high > upper, np.nextafter(high, np.float32(-np.inf)), high)
    return np.where(low > high, nearest[0], low), np.where(low > high, nearest[0], high)


class _Descent:
    """The iterate and, on the device, r = b - A x, u = w^2 r, g = -A^T u, d, and h = A^T w^2 A d."""

    def __init__(
        self, A: Operator, b: np.ndarray, w: np.ndarray | None, box: Box, x: np.ndarray
    ) -> None:
        device, self.A, self.products, self._box = A.device, A, 0, box
        self.scale = np.linalg.norm(b if w is None else w * b, axis=0)
        self._largest_weight = 1.0 if w is None else float(np.max(w))
        self.b, self.x, *bounds = (device.upload(values) for values in (b, x, *box))
        columns = Columns(self.x, *_KERNELS)
        k, slices, weighted = columns.k, columns.slices, int(w is not None)
        self._slices, self._resting = slices, np.zeros(k, bool)
        self._rest = device.upload(self._resting, np.int32)
        numbers = np.zeros((4 + 3 * slices, k))
        numbers[0] = 1.0  # the first alpha
        self._numbers = numbers = device.upload(numbers)
        sums, curvatures = columns.sums(3), columns.sums(1)
        self.r, Ad = self.b.like(), self.b.like()
        self._u = self.r.like() if weighted else self.r
        W = self.r if w is None else device.upload(np.square(w))
        self.g, self._q, d, h = (vectors.fill(self.x.like(), 0.0) for _ in range(4))
        around, rows, (direction, dots, move, look) = (*bounds, self.x), b.shape[0], _KERNELS
        self._look_anew = columns.bind(look, 1, *around, self._q, self.g, h, numbers)
        to_d = (slices, self._rest, numbers, *around, self.g, d, sums)
        to_x = (weighted, numbers, sums, curvatures, *bounds, d, self.x, W, Ad, self.r, self._u)
        self._weigh_r = columns.bind(move, rows, 0, *to_x, extra=4)
        self._queued = (
            columns.bind(direction, *to_d, extra=2),
            A.bind(d, Ad),
            columns.bind(dots, 0, 0, weighted, W, Ad, Ad, Ad, curvatures, rows=rows),
            columns.bind(move, rows, slices, *to_x, extra=4),
            A.bind(self._u, self._q, transpose=True),
            columns.bind(look, 0, *around, self._q, self.g, h, numbers),
        )
        self.refresh()

    def refresh(self) -> None:
        """r and g from x itself, instead of by recursion."""
        self.A.apply(self.x, self.r, scale=-1.0, add=self.b)
        self._weigh_r()
        self.A.apply_transpose(self._u, self._q)
        self._look_anew()
        self.products += 2
        self.true = True

    def step(self, unsolved: np.ndarray) -> None:
        """Lower the error in the columns `unsolved`: six launches."""
        if np.any(self._resting == unsolved):
            self._resting = ~unsolved
            self._rest.set(self._resting)
        for launch in self._queued:
            launch()
        self.products += 2
        self.true = False

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """The error and the Frank-Wolfe gap of every column; the wait."""
        numbers = self._numbers.get().astype(np.float64)
        self._alpha = numbers[0]
        looks, squares = numbers[4 : 4 + 2 * self._slices], numbers[4 + 2 * self._slices :]
        return np.sqrt(squares.sum(axis=0)), looks[::2].sum(axis=0)

    def rounding(self) -> np.ndarray:
        """What rounding of w A x hides of the errors, where columns of A are of size 1 at most."""
        return _ROUNDING * self._largest_weight * np.asarray(vectors.norm(self.x))

    def saturated(self, x: np.ndarray) -> np.ndarray:
        """Entries that a step along -g takes beyond a bound; some come close to it without touching."""
        lower, upper = (bound[:, None] for bound in self._box)
        beyond = x - self._alpha * self.g.get()
        return (lower < upper) & ((beyond < lower) | (beyond > upper))


def _power(largest: float) -> float:
    """A power of two near `largest`: in such units squares stay inside float32."""
    return float(np.exp2(np.floor(np.log2(largest)))) if largest > 0.0 else 1.0
