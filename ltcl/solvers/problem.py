# SPDX-License-Identifier: BSD-3-Clause
"""A request to solve S x = b: `SolveSettings`, and `LinearProblem`, whose parts are checked.

S is (N, N), b (N,) or (N, k). Each column of b, of the start and of atol is divided by a power of
two near its largest value: squares of any light then stay in float32, and no digit is lost.
Bad input is refused before anything is uploaded.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Operator
from ltcl.operators.conversion import as_exact_operator
from ltcl.solvers.stopping import StoppingRule

# Rows that are reduced side by side: NumPy reduces an axis of few columns slowly.
ROWS_AT_ONCE = 256
LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
SMALLEST_NORMAL_FLOAT32 = 2.0**-126


@dataclass(frozen=True, kw_only=True)
class SolveSettings:
    """The settings that all methods of `ltcl.solve` share; `ltcl.solve` describes them.

    `with_residual` asks for b - S x in `Solution.rest`, where it costs little.

    Raises
    ------
    InputError, InputTypeError
        A tolerance or `maxiter` out of range, or a callback that cannot be called.

    Examples
    --------
    >>> SolveSettings(rtol=1e-3).rtol
    0.001
    """

    rtol: float = 1e-2
    atol: float = 0.0
    maxiter: int = 1000
    callback: Callable[[int, float], object] | None = None
    throw: bool = True
    with_residual: bool = False

    def __post_init__(self) -> None:
        rtol = checks.number("rtol", self.rtol, least=0.0, below=1.0)
        atol = checks.number("atol", self.atol, least=0.0)
        if rtol == 0.0 and atol == 0.0:
            raise InputError("rtol is 0; it must be above 0 and below 1, or atol above 0")
        if self.callback is not None and not callable(self.callback):
            raise InputTypeError(
                f"callback is {self.callback!r}; it must be callable(iteration, relative residual)"
            )
        checks.count("maxiter", self.maxiter)


@dataclass(frozen=True, kw_only=True)
class LinearProblem:
    """S x = b with checked parts, in units of each column; `from_arrays` makes it.

    Attributes
    ----------
    S : (N, N) Operator
    b : (N,) or (N, k), on the host
        In units of `unit`.
    x0 : like b, optional
        Start in the same units; zero when None.
    exact : (N, N) Operator, optional
        The operator that judges residuals, if S is its compressed form.
    unit : () or (k,) float64
        Powers of two; b times them is what the caller gave.
    rule : StoppingRule
        The tolerance, its atol in units of each column.
    required_rtol : float
        Relative residual that every column has to reach; infinite if all of them are dark.
    with_residual : bool
        Whether b - S x is asked for.
    """

    S: Operator
    b: np.ndarray
    x0: np.ndarray | None = None
    exact: Operator | None = None
    unit: np.ndarray
    rule: StoppingRule
    required_rtol: float
    with_residual: bool = False

    @classmethod
    def from_arrays(
        cls,
        S: Any,
        b: Any,
        settings: SolveSettings | None = None,
        *,
        x0: Any = None,
        exact: Any = None,
    ) -> LinearProblem:
        """Check the arguments of `ltcl.solve`, then upload S where it is not an operator.

        Raises
        ------
        InputError, InputTypeError
            Shapes that do not fit, NaN, or a tolerance below the error of a compressed S.

        Examples
        --------
        >>> problem = LinearProblem.from_arrays([[1.0, 0.5], [0.5, 1.0]], [3.0, 1.0])
        >>> problem.b.tolist(), float(problem.unit)
        ([1.5, 0.5], 2.0)
        """
        if settings is None:
            settings = SolveSettings()
        rows = check_square("S", S)[0]
        b, unit = scale_rhs(b, rows)
        if x0 is not None:
            x0 = checks.finite("x0", checks.real("x0", x0))
            x0 = checks.shape("x0", x0, b.shape)
            # A column without light is solved by zero, whatever its start.
            x0 = np.where(np.any(b, axis=0), x0 / unit, 0.0)

        atol = float(settings.atol)
        scaled_atol = 0.0
        if atol:
            scaled_atol = atol / unit
        rule = StoppingRule(
            rtol=float(settings.rtol),
            atol=scaled_atol,
            maxiter=int(settings.maxiter),
            callback=settings.callback,
        )
        required_rtol = _required_rtol(b, rule, has_atol=bool(atol))
        operator = S if isinstance(S, Operator) else as_exact_operator(S)
        if exact is not None:
            exact = _exact_operator(exact, operator)
        elif required_rtol < operator.solution_error:
            _refuse_below_error(settings, operator)
        return cls(
            S=operator,
            b=b,
            x0=x0,
            exact=exact,
            unit=unit,
            rule=rule,
            required_rtol=required_rtol,
            with_residual=settings.with_residual,
        )


@contextlib.contextmanager
def naming_channel(number: int) -> Iterator[None]:
    """Add the number of a colour channel to what is refused within."""
    try:
        yield
    except (InputError, MemoryLimitError) as error:
        raise type(error)(f"in channel {number}: {error}") from None


def check_square(name: str, S: Any) -> tuple[int, ...]:
    """Return the shape of S before it becomes an operator; refuse all but (N, N)."""
    # Asked of the object instead of its type, the property would upload the transport.
    if hasattr(type(S), "interreflection"):
        advice = "give its operator, T.interreflection"
        if not S.is_square:
            advice = "it has no S to solve with; ltcl.compensate undoes its light"
        elif S.channels == 3:
            advice = "solve with each of its three operators, T.systems"
        raise InputTypeError(f"{name} is a {type(S).__name__}; {advice}")
    shape = getattr(S, "shape", None)
    if not shape:
        shape = checks.real(name, S).shape
    if len(shape) != 2 or shape[0] != shape[1]:
        raise InputError(f"{name} has shape {shape}; it must be square, (N, N)")
    return shape


def scale_rhs(b: Any, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return b, (rows,) or (rows, k), in units near the largest value of each column, and these.

    float32 stays float32.
    """
    b = checks.finite("b", checks.real("b", b))
    if b.ndim not in (1, 2) or b.shape[0] != rows or b.size == 0:
        raise InputError(f"b has shape {b.shape}; it must be ({rows},) or ({rows}, k)")
    largest = _largest_values(b)
    unit = np.exp2(np.floor(np.log2(np.where(largest > 0.0, largest, 1.0))))
    stays_float32 = b.dtype == np.float32 and np.all(unit >= SMALLEST_NORMAL_FLOAT32)
    if stays_float32:
        return b / unit.astype(np.float32), unit
    return b / unit, unit


def unscale(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return x times its unit: float32 if x is and float32 holds the product, else float64."""
    if x.dtype == np.float32 and np.all(unit >= SMALLEST_NORMAL_FLOAT32):
        with np.errstate(all="ignore"):
            product = x * unit.astype(np.float32)
        sizes = np.abs(product)
        may_be_flushed = x[sizes < SMALLEST_NORMAL_FLOAT32]
        if np.max(sizes) <= LARGEST_FLOAT32 and not np.any(may_be_flushed):
            return product
    return x * unit


def _largest_values(b: np.ndarray) -> np.ndarray:
    """Return the largest absolute value of each column, () or (k,) float64."""
    whole = len(b) // ROWS_AT_ONCE * ROWS_AT_ONCE
    side_by_side = np.abs(b[:whole]).reshape(ROWS_AT_ONCE, -1).max(axis=0)
    largest = side_by_side.reshape(-1, *b.shape[1:]).max(axis=0, initial=0)
    remainder = np.abs(b[whole:]).max(axis=0, initial=0)
    return np.maximum(largest, remainder).astype(np.float64)


def _required_rtol(b: np.ndarray, rule: StoppingRule, *, has_atol: bool) -> float:
    """Return the relative residual that all columns have to reach; infinite if b is dark."""
    if not np.any(b):
        return math.inf
    if not has_atol:
        return rule.rtol
    norms = np.atleast_1d(np.linalg.norm(b.astype(np.float64), axis=0))
    is_lit = norms > 0.0
    targets = rule.target(norms)[is_lit]
    return float(np.min(targets / norms[is_lit], initial=np.inf))


def _exact_operator(exact: Any, S: Operator) -> Operator:
    """Return `exact` as an operator on the device of S, checked."""
    shape = check_square("exact", exact)
    if shape != S.shape:
        raise InputError(f"exact has shape {shape}; it must be that of S, {S.shape}")
    operator = as_exact_operator(exact, S.device)
    if operator.device is not S.device:
        raise InputError(f"exact is on another device, {operator.device}; it must be on {S.device}")
    return operator


def _refuse_below_error(settings: SolveSettings, S: Operator) -> None:
    """Refuse a tolerance that asks for more than a compressed S tells of the solution."""
    tolerance = f"rtol is {settings.rtol:g}"
    if settings.atol:
        tolerance += f" and atol {settings.atol:g}"
    error = checks.upwards(S.solution_error)
    raise InputError(
        f"{tolerance}; S is compressed and its solutions may be off by {error}: "
        "ask for no less, or give exact=T, the uncompressed one"
    )
