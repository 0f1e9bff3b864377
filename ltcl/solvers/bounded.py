# SPDX-License-Identifier: BSD-3-Clause
"""Least squares within bounds: min ||w (A x - b)|| over lower <= x <= upper.

Only products with A and A^T are needed. A is (M, N), x (N, k), b and w (M, k). Projected conjugate
directions: with r = w (b - A x), g = -A^T w r, and z = -g but for what the bounds forbid,

    p = z + beta d,   d' = clip(x + alpha p) - x,   x' = x + lambda d'

where beta makes p conjugate to the last d, alpha is the step of Barzilai and Borwein, and lambda is
exact along d' or as far as the bounds allow: conjugate gradients on a face of the box, and many
bounds at once (Moré and Toraldo, SIAM J. Optimization 1, 1991). If the last lambda was short, or
0, p = z. A step is two products.

The certificate: with the Frank-Wolfe gap sum_i max(g_i (x_i - lower_i), g_i (x_i - upper_i)), by
Cauchy and Schwarz

    ||r*|| >= r.r* / ||r|| >= ||r|| - gap / ||r||,

and the largest of these bounds so far is kept. Done when the error is within the tolerance, of 0 or
of that bound, with what rounding of A x may hide. Known limit: for S = I + R, whose columns may be
far below 1, that is at least the rounding of x itself.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ltcl.device import Array, vectors
from ltcl.device.arrays import round_inwards
from ltcl.device.kernels import Launch
from ltcl.operators import Operator
from ltcl.solvers.column_reductions import ColumnReductions, safe_ratio
from ltcl.solvers.result import Solution, Status

# An error is not told from the least one by less than this part of ||w b||.
ROUNDING_SHARE = 2.0**-22

# A bound beyond this, in units of b, means that there is none; it is within float32.
FARTHEST_BOUND = 1e30

# Rounding hides any further gain after so many steps without a better certificate.
PATIENCE = 50

# Rounding of a step, in units of that of A x: its way is from one place in the box to another.
WAY_OF_STEP = 4.0

# Rows of numbers that the kernels keep, before the partial sums: alpha, the curvature of the last
# direction, lambda, and one that is free.
NUMBER_ROWS = 4

_DIRECTION = "bounded_direction"
_DOTS = "vector_dots"
_MOVE = "bounded_move"
_LOOK = "bounded_look"

# Rows of x that the host works on at once.
ROWS_AT_ONCE = 1 << 14

# lower, upper (N,)
Box = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Bounded(Solution):
    """Result of `minimise`: a `Solution` with its certificate; errors in the units of w b.

    Attributes
    ----------
    errors, least : (k,) float64
        ``||w (A x - b)||`` of every column, and a lower bound on it for all x within the bounds.
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
        text = f"{self._outcome()}, at most {self.gap:.2g} above the least"
        return text if self.converged else f"{text}: {self.status.value}"


@dataclass(frozen=True, kw_only=True, eq=False)
class BoxProblem:
    """min ||w (A x - b)|| over lower <= x <= upper, for some A.

    Attributes
    ----------
    b, weights : (M, k)
        The weights w are at least 0; ones when None.
    lower, upper : (N,)
        Finite bounds.
    x0 : (N, k)
        The start, which is moved within the bounds.
    """

    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    x0: np.ndarray
    weights: np.ndarray | None = None

    def in_units(self) -> _ScaledProblem:
        """The problem in units in which squares stay within float32."""
        # A x is about as large as the x nearest to 0, however dark the target is.
        largest = max(_largest(self.b), float(np.max(self.lower)), -float(np.min(self.upper)))
        if largest == 0.0:
            largest = max(_largest(self.lower), _largest(self.upper))
        unit = power_of_two(largest)
        weight_unit = 1.0
        weights = self.weights
        if weights is not None:
            weight_unit = power_of_two(float(np.max(weights)))
            weights = weights / weight_unit
        with np.errstate(over="ignore"):
            lower = self.lower / unit
            upper = self.upper / unit
        for bounds in (lower, upper):
            np.clip(bounds, -FARTHEST_BOUND, FARTHEST_BOUND, out=bounds)
        box = round_inwards(lower, upper)
        return _ScaledProblem(
            unit=unit,
            weight_unit=weight_unit,
            b=self.b / unit,
            weights=weights,
            box=box,
            first=_clip((self.x0 / unit).astype(np.float32), box),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _ScaledProblem:
    """A `BoxProblem` in units; `first` is the start within the bounds."""

    unit: float
    weight_unit: float
    b: np.ndarray
    weights: np.ndarray | None
    box: Box
    first: np.ndarray


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
    """Find the x within the bounds for which A x is nearest to b.

    Done when the error, or its distance from the least possible one, is at most
    ``max(rtol ||w b||, atol)`` in every column; if b = 0, rtol is relative to the error at the
    start. STAGNATED if rounding hides any further gain.

    Parameters
    ----------
    A : (M, N) Operator
        With columns of similar size, for instance S.
    b, weights : (M, k)
        The weights w are at least 0; ones when not given.
    lower, upper : (N,)
        Finite bounds.
    x0 : (N, k)
        The start, which is moved within the bounds.
    callback : callable(iteration, relative gap), optional
        Called after each step.
    """
    problem = BoxProblem(b=b, lower=lower, upper=upper, x0=x0, weights=weights)
    solved = minimise_each(A, [problem], rtol=rtol, atol=atol, maxiter=maxiter, callback=callback)
    return solved[0]


def minimise_each(
    A: Operator,
    problems: Sequence[BoxProblem],
    *,
    rtol: float = 1e-2,
    atol: float = 0.0,
    maxiter: int = 1000,
    callback: Callable[[int, float], object] | None = None,
) -> tuple[Bounded, ...]:
    """Solve several problems at the same time, as `minimise` solves one.

    Parameters
    ----------
    A : Operator
        diag(A_1, ..., A_c) of the matrices of all problems, as `ltcl.operators.block_diagonal`
        makes it.
    problems : sequence of BoxProblem
        Several have one column each, equal shapes, and weights all or none.
    """
    start = time.perf_counter()
    scaled = [problem.in_units() for problem in problems]
    weights = None
    all_weights = [each.weights for each in scaled if each.weights is not None]
    if all_weights:
        weights = _stacked(all_weights)
    lower = _stacked([each.box[0] for each in scaled])
    upper = _stacked([each.box[1] for each in scaled])
    columns = problems[0].b.shape[1]
    descent = Descent(A, columns, weights, (lower, upper), planes=len(problems))
    descent.b.set(_stacked([each.b for each in scaled]))
    descent.x.set(_stacked([each.first for each in scaled]))
    descent.begin()
    error_units = np.array([each.unit * each.weight_unit for each in scaled])
    search = Search(descent, rtol, atol / error_units, maxiter, callback)
    search.run()
    search.fall_back()
    seconds = time.perf_counter() - start
    solved = []
    for number in range(len(problems)):
        end = search.of_plane(number)
        x = np.where(end.is_worse, scaled[number].first, end.x) * scaled[number].unit
        box = round_inwards(problems[number].lower, problems[number].upper)
        solved.append(
            Bounded(
                x=_clip(x.astype(np.float32, copy=False), box),
                status=end.status,
                iterations=len(search.history) - 1,
                products=descent.products,
                residuals=end.residuals,
                seconds=seconds,
                method="bounded",
                errors=end.errors * error_units[number],
                least=end.least * error_units[number],
                saturated=end.saturated,
                gap=end.gap,
            )
        )
    return tuple(solved)


class SearchEnd(NamedTuple):
    """The end of a search in one plane, or in all columns where there is one plane; in its units.

    x and saturated are (N, k); is_worse, errors and least are (k,).
    """

    x: np.ndarray
    saturated: np.ndarray
    is_worse: np.ndarray
    errors: np.ndarray
    least: np.ndarray
    residuals: tuple[float, ...]
    gap: float
    status: Status


class Search:
    """The search for the least error, and its certificate.

    With a `deadline`, a time of `time.perf_counter`, it ends where another step would be late.

    Attributes, of the last iterate and by columns: `errors`, the bound `least` on the least error,
    `hidden`, what rounding hides of the errors, `excess`, the error above the least one,
    `unsolved`, where that is above the tolerance, and `is_stagnant`, where rounding hides any
    further gain. `history` has the relative errors of all steps.
    """

    def __init__(
        self,
        descent: Descent,
        rtol: float,
        atol: float | np.ndarray = 0.0,
        maxiter: int = 1000,
        callback: Callable[[int, float], object] | None = None,
        deadline: float = math.inf,
    ) -> None:
        self.descent = descent
        self.deadline = deadline
        self.maxiter = maxiter
        self.callback = callback
        self.initial, _ = descent.read()
        start_scale = np.where(self.initial > 0.0, self.initial, 1.0)
        self.scale = np.where(descent.norms > 0.0, descent.norms, start_scale)
        self.tolerance = np.maximum(rtol * self.scale, atol)
        self.errors = self.initial
        self.least = np.zeros_like(self.scale)
        self.excess = self.initial
        self.hidden = descent.rounding()
        self.unsolved = np.ones(len(self.scale), bool)
        self.status = Status.MAXITER
        self.history: list[np.ndarray] = []
        self.is_stagnant = np.zeros(len(self.scale), bool)
        self._lowest = np.full(len(self.scale), np.inf)
        self._lowest_at = np.zeros(len(self.scale), int)
        self._last_time = time.perf_counter()
        self._step_seconds = 0.0

    def run(self) -> None:
        """Take steps until the search ends.

        Its end is said of a residual computed from x alone, or of one that differs from it by so
        little rounding that the end is the same.
        """
        descent = self.descent
        while True:
            self._measure()
            self.unsolved = self.excess > self.tolerance
            status = self._judge()
            if status is not None and not self._is_certain(status):
                descent.refresh()
                self.hidden = descent.rounding()
                continue
            self._record()
            if status is not None:
                self.status = status
                return
            descent.step(self.unsolved & ~self.is_stagnant)

    def _is_certain(self, status: Status) -> bool:
        """Return False if the residual has to be computed from x before the search may end."""
        descent = self.descent
        if descent.has_true_residual or self._is_late():
            return True
        if status is not Status.CONVERGED:
            return False
        # Each step rounds by a product with its way, which is within the box as x is.
        hidden = (1.0 + WAY_OF_STEP * descent.steps) * descent.rounding()
        excess = self.excess + 2.0 * (hidden - self.hidden)
        if np.any(excess > self.tolerance):
            return False
        self.hidden = hidden
        self.excess = excess
        return True

    def _is_late(self) -> bool:
        """True if there is no time for as long a step as the last one."""
        now = time.perf_counter()
        return now + self._step_seconds > self.deadline

    def _measure(self) -> None:
        """Read the errors, and raise the bound on the least one."""
        self.errors, gap = self.descent.read()
        distance = safe_ratio(gap, self.errors, self.errors > 0.0)
        bound = np.minimum(self.errors - distance, self.errors)
        self.least = np.fmax(self.least, bound)
        excess = self._excess_above_least(self.errors)
        self.excess = np.where(np.isfinite(self.errors), excess, np.inf)

    def _excess_above_least(self, errors: np.ndarray) -> np.ndarray:
        """Return what errors are above the least one, with all that rounding may hide."""
        excess = errors - self.least + 2.0 * self.hidden
        return np.maximum(excess, ROUNDING_SHARE * self.scale)

    def _judge(self) -> Status | None:
        """Return how the search ends, or None while it goes on."""
        steps = len(self.history)
        if not self.unsolved.any():
            return Status.CONVERGED
        if steps >= self.maxiter or self._is_late():
            return Status.MAXITER
        if self.is_stagnant[self.unsolved].all():
            return Status.STAGNATED
        return None

    def _record(self) -> None:
        """Keep the history of the errors and the time of a step, and call the callback."""
        now = time.perf_counter()
        self._step_seconds = now - self._last_time
        self._last_time = now
        steps = len(self.history)
        relative_excess = self.excess / self.scale
        is_lower = relative_excess < self._lowest
        self._lowest[is_lower] = relative_excess[is_lower]
        self._lowest_at[is_lower] = steps
        self.is_stagnant |= steps - self._lowest_at >= PATIENCE
        if self.callback is not None:
            self.callback(steps, float(np.max(relative_excess)))
        self.history.append(self.errors / self.scale)

    @property
    def is_worse(self) -> np.ndarray:
        """Columns (k,) that are worse than at the start, which rounding alone can make them."""
        return ~(self.errors <= self.initial)

    def fall_back(self) -> None:
        """Read x, and take back the facts of the start in columns that are worse."""
        self.x = self.descent.x.get()
        is_worse = self.is_worse
        saturated = self.descent.saturated(self.x)
        self.saturated = saturated & ~self.descent.along_x(is_worse)
        initial_excess = self._excess_above_least(self.initial)
        self.excess = np.where(is_worse, initial_excess, self.excess)
        self.worse_columns = is_worse
        self.errors = np.where(is_worse, self.initial, self.errors)

    def of_plane(self, number: int) -> SearchEnd:
        """The facts of one plane, after `fall_back`."""
        planes = self.descent.planes
        columns = slice(None)
        if planes > 1:
            columns = slice(number, number + 1)
        status = self.status
        if not self.unsolved[columns].any():
            # Other planes decided how the search ended.
            status = Status.CONVERGED
        elif self.is_stagnant[columns].all():
            status = Status.STAGNATED
        least = np.maximum(self.least - self.hidden, 0.0)
        relative_excess = self.excess / self.scale
        residuals = [float(np.max(errors[columns])) for errors in self.history]
        return SearchEnd(
            x=np.split(self.x, planes)[number],
            saturated=np.split(self.saturated, planes)[number],
            is_worse=self.worse_columns[columns],
            errors=self.errors[columns],
            least=least[columns],
            residuals=tuple(residuals),
            gap=float(np.max(relative_excess[columns])),
            status=status,
        )


class Target(NamedTuple):
    """A target b (M, k) on the device, with u = w^2 b and q = A^T u."""

    b: Array
    u: Array
    q: Array


class Descent:
    """The iterate and, on the device, r = b - A x, u = w^2 r, g = -A^T u, d, and h = A^T w^2 A d.

    The caller writes b (M, k) and x (N, k), within the bounds, on the device, and begins; this may
    be done again and again.

    With several planes A is the diagonal of as many matrices, and b and x have one column; each
    plane of it is solved as a column of its own. Numbers of columns are then those of planes.

    Attributes
    ----------
    b, x : Array
    norms : (k,)
        Those of w b.
    steps : int
        Steps since r was computed from x itself.
    """

    def __init__(
        self, A: Operator, columns: int, w: np.ndarray | None, box: Box, planes: int = 1
    ) -> None:
        device = A.device
        rows, width = A.shape
        self.A = A
        self.planes = planes
        self.products = 0
        self.steps = 0
        self._has_residual = False
        self._box = box
        self.b = device.empty((rows, columns))
        self.x = device.empty((width, columns))
        self.r = self.b.like()
        self.norms = np.zeros(columns * planes)
        if w is None:
            self._largest_weights = np.ones(1)
            self._u = self.r
            # The kernels do not read them.
            self._weights = self.r
        else:
            self._largest_weights = w.reshape(planes, -1).max(axis=1)
            self._u = self.r.like()
            self._weights = device.upload(np.square(w))
        self.g = self.x.like()
        # A^T u
        self._q = self.x.like()
        self._is_weighted = w is not None
        self._allocate()
        self._bind()

    @property
    def has_true_residual(self) -> bool:
        """True if r was computed from x itself."""
        return self._has_residual and self.steps == 0

    def _allocate(self) -> None:
        """Allocate the vectors and numbers that stay on the device."""
        device = self.A.device
        kernels = (_DIRECTION, _DOTS, _MOVE, _LOOK)
        self._columns = ColumnReductions(self.x, *kernels, planes=self.planes)
        k = self._columns.k
        self._slices = self._columns.slices
        self._is_resting = np.zeros(k, bool)
        self._resting = device.upload(self._is_resting, np.int32)
        self._first_numbers = np.zeros((NUMBER_ROWS + 3 * self._slices, k), np.float32)
        # The first alpha.
        self._first_numbers[0] = 1.0
        self._numbers = device.upload(self._first_numbers)
        self._sums = self._columns.sums(3)
        self._curvatures = self._columns.sums(1)
        self._limits: dict[str, Any] = {
            "lower": device.upload(self._box[0]),
            "upper": device.upload(self._box[1]),
        }
        self._d = self.x.like()
        self._h = self.x.like()
        self._Ad = self.b.like()
        self._zeros = [
            vectors.bind_fill(array, 0.0) for array in (self.g, self._q, self._d, self._h)
        ]

    def _bind(self) -> None:
        """Bind the launches of a step, and those that start anew."""
        self._look_anew = self._bind_look(restart=1)
        # Without slices nothing moves, and r is weighted alone.
        self._weigh_r = self._bind_move(slices=0)
        self._launches = (
            self._bind_direction(),
            self.A.bind(self._d, self._Ad),
            self._bind_squares(self._Ad, self._is_weighted),
            self._bind_move(slices=self._slices),
            self.A.bind(self._u, self._q, transpose=True),
            self._bind_look(restart=0),
        )

    def _bind_direction(self) -> Launch:
        """Bind the kernel of the next d."""
        return self._columns.bind(
            _DIRECTION,
            extra=2,
            slices=self._slices,
            resting=self._resting,
            numbers=self._numbers,
            x=self.x,
            g=self.g,
            d=self._d,
            sums=self._sums,
            **self._limits,
        )

    def _bind_squares(self, values: Array, is_weighted: bool) -> Launch:
        """Bind the sums of the squares of values, (N, k) or (M, k); with w^2, of a picture."""
        return self._columns.bind(
            _DOTS,
            rows=values.shape[0] // self.planes,
            first=0,
            pairs=0,
            weighted=int(is_weighted),
            weights=self._weights,
            a=values,
            b=values,
            c=values,
            partials=self._curvatures,
        )

    def _bind_move(self, slices: int) -> Launch:
        """Bind the kernel that moves x along d, and r and u with it."""
        return self._columns.bind(
            _MOVE,
            extra=4,
            height=self.b.shape[0] // self.planes,
            slices=slices,
            weighted=int(self._is_weighted),
            numbers=self._numbers,
            sums=self._sums,
            curvatures=self._curvatures,
            d=self._d,
            x=self.x,
            w=self._weights,
            Ad=self._Ad,
            r=self.r,
            u=self._u,
            **self._limits,
        )

    def _bind_look(self, restart: int) -> Launch:
        """Bind the kernel of g and h, and of the sums that depend on them."""
        return self._columns.bind(
            _LOOK,
            restart=restart,
            x=self.x,
            q=self._q,
            g=self.g,
            h=self._h,
            numbers=self._numbers,
            **self._limits,
        )

    def set_box(self, box: Box) -> None:
        """Take other bounds, within which the caller writes x before it begins."""
        self._box = box
        self._limits["lower"].set(box[0])
        self._limits["upper"].set(box[1])

    def begin(self) -> None:
        """Start anew from b and x as they are on the device; waits."""
        self.forget()
        self.refresh()

    def forget(self) -> None:
        """Forget all steps, and take b as it is on the device; waits."""
        for launch in self._zeros:
            launch()
        self._numbers.set(self._first_numbers)
        self.norms = self.norm_of(self.b)

    def norm_of(self, picture: Array) -> np.ndarray:
        """||w picture|| of a picture (M, k) on the device, (k,); waits."""
        return self._norm_by(self._bind_squares(picture, self._is_weighted))

    def _norm_by(self, squares: Launch) -> np.ndarray:
        squares()
        sums = self._curvatures.get().astype(np.float64)
        return np.sqrt(sums.sum(axis=0)).ravel()

    def measure(self) -> np.ndarray:
        """||w (b - A x)|| of x as it is on the device, (k,), by one product; waits."""
        self.A.apply(self.x, self.r, scale=-1.0, add=self.b)
        self.products += 1
        return self.norm_of(self.r)

    def refresh(self) -> None:
        """Compute r and g from x itself, instead of by recursion."""
        self.A.apply(self.x, self.r, scale=-1.0, add=self.b)
        self.products += 1
        self.take_residual()

    def take_residual(self) -> None:
        """Take r = b - A x as it is on the device, of x itself, and compute g."""
        self._weigh_r()
        self.A.apply_transpose(self._u, self._q)
        self._look_anew()
        self.products += 1
        self.steps = 0
        self._has_residual = True

    def shift(self, change: float, direction: Target) -> None:
        """Add `change` times another target to b, without a product; `read` needs a step first."""
        vectors.axpy(change, direction.b, self.b)
        vectors.axpy(change, direction.b, self.r)
        if self._is_weighted:
            vectors.axpy(change, direction.u, self._u)
        vectors.axpy(change, direction.q, self._q)
        self._look_anew()

    def scale(self, factor: float) -> None:
        """Multiply b and x by `factor`, without a product; `read` needs a step first."""
        scaled = [self.b, self.x, self.r, self._q]
        if self._is_weighted:
            scaled.append(self._u)
        for values in scaled:
            vectors.axpby(factor, values, 0.0, values, values)
        self._look_anew()

    def product_with(self, target: Array) -> np.ndarray:
        """<w r, w b> of every column for another target b, which waits."""
        return vectors.dot(self._u, target)

    def step(self, unsolved: np.ndarray) -> None:
        """Lower the error in the columns `unsolved`: six launches."""
        if np.any(self._is_resting == unsolved):
            self._is_resting = ~unsolved
            self._resting.set(self._is_resting)
        for launch in self._launches:
            launch()
        self.products += 2
        self.steps += 1

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Read the error and the Frank-Wolfe gap of every column, which waits."""
        numbers = self._numbers.get().astype(np.float64)
        self._alpha = numbers[0]
        end_of_looks = NUMBER_ROWS + 2 * self._slices
        # Partial sums of the gap and of z.h take turns.
        gaps = numbers[NUMBER_ROWS:end_of_looks:2]
        squares = numbers[end_of_looks:]
        return np.sqrt(squares.sum(axis=0)), gaps.sum(axis=0)

    def rounding(self) -> np.ndarray:
        """Return what rounding hides of the errors, if columns of A have size 1 at most."""
        size = self._norm_by(self._bind_squares(self.x, is_weighted=False))
        return ROUNDING_SHARE * self._largest_weights * size

    def along_x(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers of columns as an array that broadcasts to x."""
        if self.planes == 1:
            return numbers
        rows = self.x.shape[0] // self.planes
        return np.repeat(numbers, rows)[:, None]

    def saturated(self, x: np.ndarray) -> np.ndarray:
        """Return the entries that a step along -g takes beyond a bound, touched or not."""
        g = self.g.get()
        alpha = np.broadcast_to(self.along_x(self._alpha), x.shape)
        lower, upper = _as_columns(self._box)
        is_saturated = np.empty(x.shape, bool)
        # What is between fits the caches.
        for first in range(0, len(x), ROWS_AT_ONCE):
            rows = slice(first, first + ROWS_AT_ONCE)
            low = lower[rows]
            high = upper[rows]
            stepped = x[rows] - alpha[rows] * g[rows]
            is_saturated[rows] = (low < high) & ((stepped < low) | (stepped > high))
        return is_saturated


def _stacked(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays one below the other; one alone is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _as_columns(box: Box) -> Box:
    """Return bounds (N, 1), which broadcast to x."""
    lower, upper = box
    return lower[:, None], upper[:, None]


def _clip(x: np.ndarray, box: Box) -> np.ndarray:
    lower, upper = _as_columns(box)
    return np.clip(x, lower, upper)


def _largest(values: np.ndarray) -> float:
    """Return the largest size of values."""
    return float(np.maximum(np.max(values), -np.min(values)))


def power_of_two(largest: float) -> float:
    """Return a power of two near `largest`: in such units squares stay within float32."""
    if not largest > 0.0:
        return 1.0
    return float(np.exp2(np.floor(np.log2(largest))))
