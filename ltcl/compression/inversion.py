# SPDX-License-Identifier: BSD-3-Clause
"""`invert`: A = I - S^-1 of a transport, once, so that every further frame costs one product.

R is compressed, as `compress` does, in a basis that both sides share, and so is what was compressed in
another form; A is found from its coefficients, as coefficients again (`iteration`), and stored in as few
bytes as its own error allows. With e what solutions with R~ may be off by and g that of the inverse of
S~ = I + R~,

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
from ltcl.compression.iterated import Iterated, NoInverse
from ltcl.compression.iteration import METHODS, invert_coefficients
from ltcl.compression.residual import Residual, certify
from ltcl.compression.rewriting import in_one_basis
from ltcl.device import Device
from ltcl.errors import ConvergenceError, InputError, ToleranceError
from ltcl.operators import CSR, Basis, Compressed, Host, IdentityPlus, Operator, Tiles, basis_of
from ltcl.solvers import Inverse
from ltcl.solvers.result import Status
from ltcl.theory import two_norm
from ltcl.transport import Transport, require

BASES = ("db2", "haar", "db4", "pixels")
_SHARE = 0.4  # of the tolerance, for R
_ITERATION = 0.9  # of the rest, for A; the last tenth is for rounding its core
_UNIT = 2.0**-24  # rounding of float32
_BOUNCES = 2.0  # |b| and |A| |b|, where A takes no more light than there is
_CONFIDENCE = 1e-6  # what each bound on a norm may fail with
_FLOOR = 100.0  # times what rounding leaves: an iteration that ended there has met it
_LOOSER = 1.25  # times the tolerance, where float32 does not keep it

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
        Measured, or compressed already, in any form. What has wavelets on one side alone, is a sum, or was
        scanned adaptively is written anew first, from N products with it; the error adds both losses.
    rtol : float
        Relative error that a solution may have, ``||x~ - x|| <= rtol ||x||`` for every picture.
    basis : str or sequence of str
        In which A and R are written, "pixels" or an orthonormal wavelet; of several, the best. A T that was
        compressed in one basis on both sides keeps it.
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
        A T that is not square, an rtol below what a compressed T is worth or float32 keeps, whose least is
        told and takes a few inversions to find; a singular S, or one with eigenvalues at or below 0 by the
        iteration.
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
    checks.one_of("method", method, METHODS)
    if T.is_compressed and rtol <= T.error:
        raise InputError(
            f"rtol is {rtol:g}, but T is compressed and its solutions may be off by "
            f"{checks.upwards(T.error)}; ask for more than that, or invert what T was compressed from"
        )
    names = _names(basis)
    try:
        return _inverse(T, rtol, names, method, progress or _silent)
    except ToleranceError as error:
        least = _least(T, error.least, lambda looser: _inverse(T, looser, names, method, _silent))
    kept = "nor any below 1" if least is None else f"the least that it does is {least:g}"
    raise ToleranceError(
        f"rtol is {rtol:g}, which float32 does not keep for the inverse of this T; {kept}", least or math.inf
    )


def _silent(text: str, share: float) -> None:
    """Progress that nobody wants, as of what is tried only to tell a tolerance."""


def _least(T: Transport, rtol: float, attempt: Callable[[float], object]) -> float | None:
    """A tolerance that is kept, about the least, from `rtol` on.

    What is told is looser than what was tried, since other times may choose another basis.
    """
    while True:
        looser = T.error + _LOOSER * (rtol - T.error)
        told = float(checks.upwards(looser))
        if not told < 1.0:
            return None
        try:
            attempt(rtol)
        except ToleranceError as error:
            rtol = max(error.least, looser)
        else:
            return told


def _inverse(T: Transport, rtol: float, names: list[str], method: str, note: Note) -> Inverse:
    """As `invert`, of what was checked; a ToleranceError tells about what it takes."""
    try:
        one = in_one_basis(T, _SHARE, rtol, names, lambda text, share: note(text, share / 2))
    except ToleranceError as error:  # of the share of R
        raise ToleranceError(str(error), T.error + error.least * (1.0 + T.error) / _SHARE) from None
    found, own = [], functools.cache(_anew)
    for channel, (S, off) in enumerate(zip(one.systems, one.errors, strict=True)):
        found.append(_invert(S, off, rtol, method, own))
        note("inverted", 0.5 + 0.5 * (channel + 1) / T.channels)
    return Inverse(
        [A for A, _ in found],
        [error for _, error in found],
        T.grid,
        T.first_bounce,
        T.mixing,
        confidence=1.0 - (one.norms + 1) * _CONFIDENCE,
    )


@dataclass(frozen=True)
class _Coefficients:
    """R, sparse, in a basis on both sides; None is pixels."""

    matrix: Any
    basis: Basis | None


def _invert(S: IdentityPlus, off: float, rtol: float, method: str, own: Callable) -> tuple[Operator, float]:
    """A of one channel whose S is `off`, and what solutions may be off by.

    `own` gives the basis of A for that of R.
    """
    R = _coefficients(S)
    norm = max(1.0, _norm(R.matrix, 1.0, S.device))  # beside active coefficients, S is the identity
    rounding = _UNIT * math.sqrt(S.shape[0]) * norm  # of x relative to x, for every unit of |b| + |A| |b|
    least = off + _BOUNCES * rounding
    rest = (rtol - least) / (1.0 + off)
    if rest <= 0.0:
        raise ToleranceError("nothing is left for A", least)
    A = _bounce(R.matrix, _ITERATION * rest, method, S.device)
    _require(A, _FLOOR * rounding, least)
    core, error = _stored(R.matrix, A.D, A.error, rest, norm, S.device)
    size = _norm(core.matrix(), -1.0, S.device)
    error = error * (1.0 + off) + least
    # Of X = I - A~ and A~ - A = (I - X S) S^-1, where ||I - X S|| <= error.
    return Compressed(core, own(R.basis), own(R.basis), error=error / (1.0 - error) * size), error


def _bounce(R: Any, rtol: float, method: str, device: Device) -> Iterated:
    """A of R, within `rtol` or as near as it came, or a refusal in words of T."""
    try:
        return invert_coefficients(R, rtol=rtol, method=method, device=device)
    except NoInverse as error:
        other = "" if "singular" in error.why else ", or give method='elimination', which is dense, N x N"
        raise InputError(f"S of T {error.why}, as of no scene: check the first bounce{other}") from None
    except ConvergenceError as error:
        return error.solution


def _require(A: Iterated, floor: float, least: float) -> None:
    """Refuse an A that did not converge: for float32 where its error is below the `floor`."""
    if A.converged:
        return
    if A.status is Status.STAGNATED or A.error <= floor:
        raise ToleranceError("float32 has no more digits of A", least + A.error)
    ended = f"{A.method} {A.status.name.lower()} after {A.products} products, error {A.error:.2g}"
    raise ConvergenceError(f"S of T was not inverted: {ended}; give method='elimination', or loosen rtol", A)


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
    """R, of which `rewriting.at_hand` holds, as numbers on the host."""
    R, basis = S.R, None
    if isinstance(R, Compressed):
        R, basis = R.core, R.out
    matrix = R.matrix() if isinstance(R, (CSR, Tiles)) else R.to_dense()
    return _Coefficients(scipy.sparse.csr_array(matrix).astype(np.float32), basis)


def _anew(W: Basis | None) -> Basis | None:
    """The same basis without the scratch that a compression has left it."""
    return None if W is None else basis_of(W.device, W.to_arrays())


def _names(basis: Any) -> list[str]:
    names = kinds.names(basis)
    for name in names:
        if name.endswith((kinds.ROWS, kinds.SUM)):
            raise InputError(f"basis is {name!r}; an inverse needs one basis on both sides, such as 'db2'")
    return names
