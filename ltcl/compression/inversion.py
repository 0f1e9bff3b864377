# SPDX-License-Identifier: BSD-3-Clause
"""`invert`: A = I - S^-1 of a transport, once, so that every further frame costs one product.

R is compressed, as `compress` does, in a basis that both sides share; A is found from its coefficients, as
coefficients again (`iteration`), and stored in as few bytes as its own error allows. With e what solutions
with R~ may be off by and g that of the inverse of S~ = I + R~,

    ||x~ - x|| <= ||x~ - x_R|| + ||x_R - x|| <= (g (1 + e) + e) ||x||,

and what float32 rounds in a product, sqrt(N) units of it, is added.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.compression import cores, kinds
from ltcl.compression.iteration import invert_coefficients
from ltcl.compression.residual import Residual, certify
from ltcl.compression.task import compress
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import CSR, Basis, Compressed, Dense, Host, IdentityPlus, Operator, Tiles, basis_of
from ltcl.operators.interreflection import made_with
from ltcl.solvers import Inverse
from ltcl.theory import two_norm
from ltcl.transport import Transport, require

BASES = ("db2", "haar", "db4", "pixels")
_SHARE = 0.4  # of the tolerance, for R
_ITERATION = 0.9  # of the rest, for A; the last tenth is for rounding its core
_UNIT = 2.0**-24  # rounding of float32
_BOUNCES = 2.0  # |b| and |A| |b|, where A takes no more light than there is
_CONFIDENCE = 1e-6  # what each of two bounds may fail with

Note = Callable[[str, float], object]


def invert(
    T: Transport,
    rtol: float = 1e-2,
    *,
    basis: Any = BASES,
    method: str = "auto",
    progress: Note | None = None,
) -> Inverse:
    """S^-1 = I - A of a transport, to be kept: see `ltcl.solvers.Inverse`.

    Parameters
    ----------
    T : Transport, square
        Measured, or compressed already, in one basis on both sides.
    rtol : float
        Relative error that a solution may have, ``||x~ - x|| <= rtol ||x||`` for every picture.
    basis : str or sequence of str
        In which A and R are written, "pixels" or an orthonormal wavelet; of several, the best. A compressed T
        has its own.
    method : str
        Of `compression.iteration.invert_coefficients`: "auto", "iteration" or "elimination".
    progress : callable(text, share), optional
        Called as the work goes on.

    Returns
    -------
    Inverse
        Its `error` is the bound on solutions, at most `rtol`.

    Raises
    ------
    InputError
        A T that is not square, an rtol below what a compressed T is worth, eigenvalues at or below 0.
    ConvergenceError
        The iteration did not end: S is singular, or nearly so.

    Examples
    --------
    >>> import ltcl, numpy
    >>> T = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    >>> inv = ltcl.invert(T, rtol=1e-2)
    >>> frames = 0.1 * numpy.random.default_rng(0).random((4, 8, 16)) + 0.2
    >>> c = ltcl.compensate(T, frames, inverse=inv)
    >>> c.solution.products, c.error <= 2e-2
    (1, True)
    """
    require(T)
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    note = progress or (lambda text, share: None)
    compressed = any(made_with(matrix) is not None for matrix in T.matrices)
    if compressed and rtol <= T.error:
        raise InputError(
            f"rtol is {rtol:g}, but T is compressed and its solutions may be off by "
            f"{checks.upwards(T.error)}; ask for more than that, or invert what T was compressed from"
        )
    names = _names(basis)
    C = T
    if not compressed and names != [kinds.PIXELS]:  # in pixels T has its numbers itself
        C = compress(T, _SHARE * rtol, basis=names, progress=lambda text, share: note(text, share / 2))
    found, own = [], functools.cache(_anew)
    for channel, S in enumerate(C.systems):
        found.append(_invert(S, rtol, method, own))
        note("inverted", 0.5 + 0.5 * (channel + 1) / C.channels)
    return Inverse(
        [A for A, _ in found],
        [error for _, error in found],
        T.grid,
        T.first_bounce,
        T.mixing,
        confidence=1.0 - 3 * _CONFIDENCE,
    )


@dataclass(frozen=True)
class _Coefficients:
    """R, sparse, in a basis on both sides; None is pixels."""

    matrix: Any
    basis: Basis | None


def _invert(S: IdentityPlus, rtol: float, method: str, own: Callable) -> tuple[Operator, float]:
    """A of one channel, and what solutions may be off by; `own` gives the basis of A for that of R."""
    R, off = _coefficients(S), S.solution_error
    norm = max(1.0, _norm(R.matrix, 1.0, S.device))  # beside active coefficients, S is the identity
    rounding = _UNIT * math.sqrt(S.shape[0]) * norm  # of x relative to x, for every unit of |b| + |A| |b|
    rest = (rtol - off - _BOUNCES * rounding) / (1.0 + off)
    if rest <= 0.0:
        least = checks.upwards(off + _BOUNCES * rounding)
        raise InputError(
            f"rtol is {rtol:g}, but float32 leaves products off by {least}; it must be above that"
        )
    A = invert_coefficients(R.matrix, rtol=_ITERATION * rest, method=method, device=S.device)
    core, error = _stored(R.matrix, A.D, A.error, rest, norm, S.device)
    size = _norm(core.matrix(), -1.0, S.device)
    error = error * (1.0 + off) + off + _BOUNCES * rounding
    # Of X = I - A~ and A~ - A = (I - X S) S^-1, where ||I - X S|| <= error.
    return Compressed(core, own(R.basis), own(R.basis), error=error / (1.0 - error) * size), error


def _stored(
    R: Any, A: Any, error: float, rest: float, norm: float, device: Device
) -> tuple[CSR | Tiles, float]:
    """A in few bytes, and the error of I - A then: at most `rest`."""
    core = cores.best(device, A, (1.0 - _ITERATION) * rest / norm).operator
    if isinstance(core, Tiles):
        bound = certify(Residual(R, core.matrix(), 1.0), device, rest)
        if bound.upper <= rest:
            return core, bound.upper
    return CSR(device, A), error


def _norm(C: Any, sign: float, device: Device) -> float:
    """Upper bound on ||I + sign C||_2, of sparse C on the host."""
    whole = scipy.sparse.csr_array(scipy.sparse.eye_array(C.shape[0]) + sign * C)
    return two_norm(Host(device, whole)).upper


def _coefficients(S: IdentityPlus) -> _Coefficients:
    """R between equal bases, as numbers on the host.

    Raises
    ------
    InputError
        Two bases that differ.
    InputTypeError
        Operators whose numbers are not at hand.
    """
    R, basis = S.R, None
    if isinstance(R, Compressed):
        if R.out is not R.into:
            raise InputError(
                "T is compressed between two bases that differ; it must be in one, such as "
                "ltcl.compress(T, basis='db2') has it, or uncompressed"
            )
        R, basis = R.core, R.out
    if isinstance(R, (CSR, Tiles)):
        matrix = R.matrix().astype(np.float32)
    elif isinstance(R, Dense):
        matrix = scipy.sparse.csr_array(R.to_dense())
    else:
        raise InputTypeError(
            f"R of T is a {type(R).__name__}, whose numbers are not at hand; invert it before"
        )
    return _Coefficients(matrix, basis)


def _anew(W: Basis | None) -> Basis | None:
    """The same basis without the scratch that a compression has left it."""
    return None if W is None else basis_of(W.device, W.to_arrays())


def _names(basis: Any) -> list[str]:
    names = kinds.names(basis)
    for name in names:
        if name.endswith((kinds.ROWS, kinds.SUM)):
            raise InputError(f"basis is {name!r}; an inverse needs one basis on both sides, such as 'db2'")
    return names
