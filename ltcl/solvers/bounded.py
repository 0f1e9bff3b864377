# SPDX-License-Identifier: BSD-3-Clause
"""Least squares within bounds: min ||w (A x - b)|| over lower <= x <= upper, by products with A and A^T.

Projected conjugate directions. With r = w (b - A x), g = -A^T w r, and z = -g but for what the bounds forbid,
a step is

    p = z + beta d,   d' = clip(x + alpha p) - x,   x' = x + lambda d'

with beta that makes p conjugate to the last d, alpha the step of Barzilai and Borwein, and lambda exact along
d' or as far as the bounds allow. On a face of the box these are conjugate gradients, which need few products
because R has few large eigenvalues; clipping changes many active bounds at once, as projected gradients do
(Moré and Toraldo, SIAM J. Optimization 1, 1991, take the two in turns). Where the last lambda was
short, or 0 as p did not descend, p = z. Every step takes two products: in closed boxes of rho(R) = 0.8
and 4, with 5 to 50 % of the pixels at a bound, 14 and 36 of them to a certificate of 0.1 %, where FISTA with
restarts takes 22 and 50 and MPRGP (Dostál) 26 and 50.

A certificate comes with the gradient. For all y in the box g.(y - x) >= -gap with the Frank-Wolfe gap
sum_i max(g_i (x_i - lower_i), g_i (x_i - upper_i)); hence of the least error ||r*||, by Cauchy and Schwarz,

    ||r*|| >= r.r* / ||r|| >= ||r|| - gap / ||r||,

and the largest of these bounds so far is kept. Done when the error is within the tolerance, of 0 or of that.
An iteration is six launches, and one wait for the few sums of this certificate.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ltcl.device import vectors
from ltcl.operators import Operator
from ltcl.solvers.columns import Columns, ratio
from ltcl.solvers.result import Solution, Status

_KERNELS = ("bounded_direction", "bounded_weigh", "bounded_move", "bounded_look")
_ROUNDING = 2.0**-22  # of ||w b||: an error is not told from the least one by less
_FAR = 1e30  # in units of b: a bound where none was meant, inside float32
Box = tuple[np.ndarray, np.ndarray]  # lower, upper (N,)
_PATIENCE = 50  # steps without a better certificate: rounding has the say


@dataclass(frozen=True, kw_only=True, eq=False)
class Bounded(Solution):
    """Result of `minimise`: a `Solution` with its certificate; errors in the units of w b.

    Attributes
    ----------
    errors, least : (k,) float64
        ``||w (A x - b)||`` of every column, and what no x within the bounds is below.
    held : (N, k) bool
        Where x is at a bound or all but there, and a step beyond would lower the error.
    gap : float
        Largest ``(errors - least) / ||w b||``; `residuals` holds the largest ``errors / ||w b||``.
    """

    errors: np.ndarray
    least: np.ndarray
    held: np.ndarray
    gap: float

    def __str__(self) -> str:
        advice = "" if self.converged else f": {self.status.value}"
        return (
            f"bounded: {self.status.name.lower()} after {self.iterations} iterations, "
            f"{self.products} products, relative error {self.residuals[-1]:.2g}, "
            f"at most {self.gap:.2g} above the least{advice}"
        )


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

    Parameters
    ----------
    A : (M, N) Operator
        With columns of like size, for instance S.
    b, weights : (M, k)
        The weights are not negative; ones when not given.
    lower, upper : (N,)
        Finite, of all columns alike; x is within them as float64 numbers, too.
    x0 : (N, k)
        Start; what lies outside the bounds is moved there.
    rtol, atol : float
        Done when the error, or what it is above the least possible one, is at most
        ``max(rtol ||w b||, atol)`` in every column. Where b = 0, rtol is of the error at the start.
    maxiter : int
    callback : callable(iteration, relative gap), optional

    Examples
    --------
    >>> import ltcl
    >>> from ltcl.operators import Dense
    >>> A = Dense(ltcl.open_device(), [[1.0, 0.5], [0.5, 1.0]])
    >>> s = minimise(A, np.array([[1.0], [0.0]]), np.zeros(2), np.ones(2), np.zeros((2, 1)), rtol=1e-4)
    >>> print(s.x.ravel().round(2), s.held.ravel())  # without bounds 4/3 and -2/3
    [0.8 0. ] [False  True]
    """
    start = time.perf_counter()
    largest = float(np.max(np.abs(b)))
    unit = _power(largest or max(float(np.max(np.abs(part))) for part in (lower, upper)))
    unit_w = 1.0 if weights is None else _power(float(np.max(weights)))
    box = inwards(*(np.clip(np.asarray(part, np.float64) / unit, -_FAR, _FAR) for part in (lower, upper)))
    first = np.clip((x0 / unit).astype(np.float32), *(part[:, None] for part in box))
    descent = _Descent(A, b / unit, None if weights is None else weights / unit_w, box, first)
    initial, _ = descent.read()
    scale = np.where(descent.scale > 0.0, descent.scale, np.where(initial > 0.0, initial, 1.0))
    tolerance, least = np.maximum(rtol * scale, atol / (unit * unit_w)), np.zeros_like(scale)

    def excess(errors: np.ndarray) -> np.ndarray:  # over the least, at most, (k,)
        return np.where(np.isfinite(errors), np.maximum(errors - least, _ROUNDING * scale), np.inf)

    residuals: list[float] = []
    lowest, lowest_at, status = np.inf, 0, None
    while True:
        errors, gap = descent.read()
        least = np.fmax(least, np.minimum(errors - ratio(gap, errors, errors > 0.0), errors))
        unsolved, steps = excess(errors) > tolerance, len(residuals)
        status = Status.STAGNATED if steps - lowest_at > _PATIENCE else None
        status = Status.MAXITER if steps >= maxiter else status
        status = status if unsolved.any() else Status.CONVERGED
        if status is not None and not descent.true:  # to be said only of a true residual
            descent.refresh()
            continue
        above = float(np.max(excess(errors) / scale))
        if above < lowest:
            lowest, lowest_at = above, steps
        if callback is not None:
            callback(steps, above)
        residuals.append(float(np.max(errors / scale)))
        if status is not None:
            break
        descent.step(unsolved)
    x, worse = descent.x.get(), ~(errors <= initial)  # rounding alone can do that
    errors, held = np.where(worse, initial, errors), np.where(worse, False, descent.held(x))
    x = (np.where(worse, first, x) * unit).astype(np.float32)
    return Bounded(
        x=np.clip(x, *(part[:, None] for part in inwards(lower, upper))),
        status=status,
        iterations=len(residuals) - 1,
        products=descent.products,
        residuals=tuple(residuals),
        seconds=time.perf_counter() - start,
        method="bounded",
        errors=errors * unit * unit_w,
        least=least * unit * unit_w,
        held=held,
        gap=float(np.max(excess(errors) / scale)),
    )


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
    """The iterate and, on the device, r = w (b - A x), g = -A^T w r, d, and h = A^T w^2 A d."""

    def __init__(self, A: Operator, b: np.ndarray, w: np.ndarray | None, box: Box, x: np.ndarray) -> None:
        device, (lower, upper) = A.device, box
        self.A, self.products, self._box = A, 0, box
        self.scale = np.linalg.norm(b if w is None else w * b, axis=0)
        self.b, self.x, lower, upper = (device.upload(part) for part in (b, x, lower, upper))
        columns = Columns(self.x, "bounded", *_KERNELS)
        k, slices, weighted = columns.k, columns.slices, int(w is not None)
        self._slices, self._resting = slices, np.zeros(k, bool)
        self._rest = device.upload(self._resting, np.int32)
        numbers = np.zeros((4 + 3 * slices, k))
        numbers[0] = 1.0  # the first alpha
        self._numbers = numbers = device.upload(numbers)
        sums, shares, curvatures, self._norms = (columns.sums(count) for count in (2, 1, 1, 1))
        self.r, Ad = self.b.like(), self.b.like()
        self._u = self.r.like() if weighted else self.r  # w r
        W = self.r if w is None else device.upload(w)
        self.g, self._q, d, h = (vectors.fill(self.x.like(), 0.0) for _ in range(4))
        bounds, rows = (lower, upper, self.x), b.shape[0]
        weigh_Ad, self._weigh_r = (
            columns.bind(_KERNELS[1], how, W, v, self._u, found, rows=rows)
            for how, v, found in ((weighted, Ad, curvatures), (2 * weighted, self.r, self._norms))
        )
        look, self._look_anew = (
            columns.bind(_KERNELS[3], anew, *bounds, self._q, self.g, h, numbers) for anew in (0, 1)
        )
        direction = (slices, self._rest, numbers, *bounds, self.g, d, sums, shares)
        sizes, found = (rows, slices, weighted), (sums, shares, curvatures)
        move = (*sizes, numbers, *found, lower, upper, d, self.x, W, Ad, self.r, self._u)
        self._queued = (
            columns.bind(_KERNELS[0], *direction, extra=2),
            A.bind(d, Ad),
            weigh_Ad,
            columns.bind(_KERNELS[2], *move, extra=4),
            A.bind(self._u, self._q, transpose=True),
            look,
        )
        self.refresh()

    def refresh(self) -> None:
        """r and g from x itself, instead of by recursion."""
        self.A.apply(self.x, self.r, scale=-1.0, add=self.b)
        self._weigh_r()
        self._numbers.set_rows(4 + 2 * self._slices, self._norms)
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
        found = self._numbers.get().astype(np.float64)
        self._alpha = found[0]
        looks, squares = found[4 : 4 + 2 * self._slices], found[4 + 2 * self._slices :]
        return np.sqrt(squares.sum(axis=0)), looks[::2].sum(axis=0)

    def held(self, x: np.ndarray) -> np.ndarray:
        """Entries that a step along -g takes beyond a bound; some come close to it without touching."""
        lower, upper = (part[:, None] for part in self._box)
        beyond = x - self._alpha * self.g.get()
        return (lower < upper) & ((beyond < lower) | (beyond > upper))


def _power(largest: float) -> float:
    """A power of two near `largest`: in such units squares stay inside float32."""
    return float(np.exp2(np.floor(np.log2(largest)))) if largest > 0.0 else 1.0
