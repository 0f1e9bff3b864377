# SPDX-License-Identifier: BSD-3-Clause
"""What is given to `solve`, checked before anything is uploaded."""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator, as_operator
from ltcl.solvers import methods, refinement, units
from ltcl.solvers.monte_carlo import MonteCarlo
from ltcl.solvers.run import Problem, wanted
from ltcl.solvers.stopping import Rule

_MAXITER = 1000


def channels(name: str, value: Any, rows: int) -> np.ndarray:
    """An argument of three colour channels, (3, N) or (3, N, k)."""
    array = checks.real(name, value)
    if array.ndim not in (2, 3) or array.shape[:2] != (3, rows):
        raise InputError(
            f"{name} has shape {array.shape}; of three S it must be (3, {rows}) or (3, {rows}, k)"
        )
    return array


def problem(
    S: Any,
    b: Any,
    method: str,
    *,
    rtol: float = 1e-2,
    atol: float = 0.0,
    maxiter: int | None = None,
    x0: Any = None,
    callback: Any = None,
    exact: Any = None,
    **options: Any,
) -> tuple[Any, Problem]:
    """The method, None of "auto", and what it is to solve; nothing was uploaded where it is refused."""
    b_host = checks.finite("b", checks.real("b", b))
    shape = shape_of(S)
    rule = _rule(shape, b_host, rtol, atol, maxiter, callback)
    guess = _guess(x0, b_host)
    chosen = methods.method(method, options)
    if exact is not None and method in methods.SAMPLED:
        raise InputTypeError(f"exact= corrects iterates, but method {method!r} samples; leave it out")
    if isinstance(chosen, MonteCarlo):
        chosen.check(shape[0])
    S = as_operator(S)
    if exact is None:
        refinement.refuse_beyond(S, rule, wanted(b_host, rule))
    else:
        exact = refinement.exact_operator(exact, S)
    return chosen, Problem(S, b_host, guess, rule, exact)


def is_several(S: Any) -> bool:
    """Whether S is Operators, one per colour channel."""
    return isinstance(S, (tuple, list)) and any(isinstance(part, Operator) for part in S)


def refuse_matrices(S: Any) -> None:
    """Refuse several S that are no Operators."""
    several = isinstance(S, (tuple, list)) and S and not is_several(S)
    if several and all(len(getattr(part, "shape", ())) == 2 for part in S):
        raise InputTypeError(
            f"S is {len(S)} matrices; of three colour channels it must be three Operators, such as "
            "T.interreflection"
        )


def shape_of(S: Any) -> tuple[int, ...]:
    """The shape of whatever was given for S, before it becomes an operator on a device."""
    if hasattr(type(S), "interreflection"):
        raise InputTypeError(
            f"S is a {type(S).__name__}; give its interreflection operator, T.interreflection"
        )
    return getattr(S, "shape", None) or checks.real("S", S).shape


def _rule(
    shape: tuple[int, ...], b: np.ndarray, rtol: float, atol: float, maxiter: int | None, callback: Any
) -> Rule:
    if len(shape) != 2 or shape[0] != shape[1]:
        raise InputError(f"S has shape {shape}; it must be square, (N, N)")
    rows = shape[0]
    if b.ndim not in (1, 2) or b.shape[0] != rows or b.size == 0:
        raise InputError(f"b has shape {b.shape}; it must be ({rows},) or ({rows}, k)")
    largest = float(np.max(units.largest(b)))
    if largest > float(np.finfo(np.float32).max):
        raise InputError(f"b reaches {largest:.3g}; it must be within float32, at most 3.4e+38")
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", atol, least=0.0)
    if rtol == 0.0 and atol == 0.0:
        raise InputError("rtol and atol are both 0; one of them must be positive")
    if callback is not None and not callable(callback):
        raise InputTypeError(f"callback is {callback!r}; it must be callable(iteration, relative residual)")
    return Rule(rtol, atol, _MAXITER if maxiter is None else checks.count("maxiter", maxiter), callback)


def _guess(x0: Any, b: np.ndarray) -> np.ndarray | None:
    if x0 is None:
        return None
    return checks.shape("x0", checks.finite("x0", checks.real("x0", x0)), b.shape)
