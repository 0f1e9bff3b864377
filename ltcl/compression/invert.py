# SPDX-License-Identifier: BSD-3-Clause
"""`invert`: A = I - S^-1 of a transport, once, so that every further frame costs one product.

R is taken in a basis that both sides share: as it is, or compressed, or, where T was compressed in another
form, written anew from rows that are products with it. A is found from its coefficients, as coefficients
again (`sparse_inverse`), and stored in as few bytes as its own error allows. Errors add up: x_R being what R~
gives, e what that is off by, and g the error of an inverse of S~ = I + R~, or of a further compression,

    ||x~ - x|| <= ||x~ - x_R|| + ||x_R - x|| <= g ||x_R|| + e ||x|| <= (g (1 + e) + e) ||x||,

and what float32 rounds in a product, sqrt(N) units of it, is added.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.compression.bases import INVERSE_NAMES, PIXELS, quantize, validate_names
from ltcl.compression.compress import compress_inputs
from ltcl.compression.norms import MISS, Starts, fresh_starts
from ltcl.compression.sources import from_products, validate_inputs
from ltcl.compression.sparse_inverse import METHODS, SparseInverse, invert_coefficients, residual_norm
from ltcl.errors import ConvergenceError, InputError, ToleranceError
from ltcl.operators import CSR, Compressed, Dense, Host, IdentityPlus, Operator, Tiles
from ltcl.solvers import Inverse
from ltcl.solvers.result import Status
from ltcl.theory import two_norm
from ltcl.transport import Transport, require

_SHARE = 0.4  # of the tolerance, for R
_ITERATION = 0.9  # of the rest, for A; the last tenth is for rounding its core
_UNIT = 2.0**-24  # rounding of float32
_BOUNCES = 2.0  # |b| and |A| |b|, where A takes no more light than there is
_FLOOR = 100.0  # times what rounding leaves: an iteration that ended there has met it

Note = Callable[[str, float], object]


def invert(
    T: Transport,
    rtol: float = 1e-2,
    *,
    basis: str | Sequence[str] = INVERSE_NAMES,
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
        Of `compression.invert_coefficients`: "auto", "iteration" or "elimination".
    progress : callable(text, share), optional
        Called as the work goes on.

    Returns
    -------
    Inverse
        Its `error` is the bound on solutions, at most `rtol`.

    Raises
    ------
    InputError
        T is not square; rtol is below what a compressed T or float32 allows; S is singular.
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
    names = validate_names(basis, for_inverse=True)
    note = progress or (lambda text, share: None)
    try:
        systems, compressions = _in_one_basis(T, rtol, names, lambda text, share: note(text, share / 2))
        bounces, errors = [], []
        starts = fresh_starts("invert")
        for channel, S in enumerate(systems):
            A, error = _bounce(S, rtol, method, starts)
            bounces.append(A)
            errors.append(error)
            note("inverted", 0.5 + 0.5 * (channel + 1) / T.channels)
    except ToleranceError as error:
        least = float(checks.upwards(1.1 * error.least - 0.1 * T.error))
        raise ToleranceError(
            f"rtol is {rtol:g}, which float32 does not keep for the inverse of this T; about {least:g} is "
            "what it does",
            least,
        ) from None
    # Of every compression, of the iterations of all channels, and of the norms below.
    confidence = 1.0 - (compressions + T.channels + 1) * MISS
    return Inverse(bounces, errors, T.grid, T.first_bounce, T.mixing, confidence=confidence)


def _in_one_basis(
    T: Transport, rtol: float, names: list[str], note: Note
) -> tuple[Sequence[IdentityPlus], int]:
    """S of every channel, whose R are numbers in one basis, and how many compressions are behind them."""
    compressions = 1 if T.error else 0
    if (T.is_compressed or names == [PIXELS]) and all(_has_coefficients(S.R) for S in T.systems):
        return T.systems, compressions
    inputs = from_products(T) if T.is_compressed else validate_inputs(T)
    left = _SHARE * (rtol - T.error) / (1.0 + T.error)
    starts = fresh_starts("rewrite" if T.error else "compress")
    try:
        systems = compress_inputs(inputs, names, left, starts, progress=note)[0].systems
    except ToleranceError as error:
        raise ToleranceError(str(error), T.error + error.least * (1.0 + T.error) / _SHARE) from None
    before = [S.solution_error for S in T.systems] if T.is_compressed else [0.0] * T.channels
    errors = [e + S.solution_error * (1.0 + e) for e, S in zip(before, systems, strict=True)]
    systems = [IdentityPlus(S.R, solution_error=e) for e, S in zip(errors, systems, strict=True)]
    return systems, compressions + 1


def _has_coefficients(R: Operator) -> bool:
    """Whether R is numbers in pixels, or in one isometric basis on both sides."""
    if isinstance(R, Compressed) and (R.two_sided or (R.out is None and R.into is None)):
        R = R.core
    return isinstance(R, (CSR, Tiles, Dense))


def _bounce(S: IdentityPlus, rtol: float, method: str, starts: Starts) -> tuple[Operator, float]:
    """A of one channel, and what solutions with it may be off by."""
    R, W = (S.R.core, S.R.out) if isinstance(S.R, Compressed) else (S.R, None)
    C: Any = R.matrix() if isinstance(R, (CSR, Tiles)) else R.to_dense()
    C = scipy.sparse.csr_array(C).astype(np.float32)
    norm = max(1.0, _norm(C, 1.0, S, starts))  # S is the identity on coefficients that C leaves out
    off, rounding = S.solution_error, _UNIT * math.sqrt(S.shape[0]) * norm  # of x, for each unit of b and A b
    least = off + _BOUNCES * rounding
    rest = (rtol - least) / (1.0 + off)
    if rest <= 0.0:
        raise ToleranceError("nothing is left for A", least + _BOUNCES * rounding)
    try:
        found = invert_coefficients(C, rtol=_ITERATION * rest, method=method, device=S.device)
    except ConvergenceError as failed:
        found: SparseInverse = failed.solution
        if found.status is Status.STAGNATED or found.error <= _FLOOR * rounding:
            least += (1.0 + off) * found.error / _ITERATION
            raise ToleranceError("float32 has no more digits of A", least) from None
        raise ConvergenceError(f"S of T was not inverted by {found}", found) from None
    core = Tiles(S.device, quantize(found.D, (1.0 - _ITERATION) * rest / norm))
    error = residual_norm(C, core.matrix(), 1.0, S.device, rest, starts).upper
    if error > rest:
        core, error = Tiles(S.device, quantize(found.D, 0.0)), found.error
    error = error * (1.0 + off) + least
    # Of X = I - A~: A~ - A = (I - X S) S^-1, ||I - X S|| <= error, and so ||S^-1|| <= ||X|| / (1 - error).
    size = error / (1.0 - error) * _norm(core.matrix(), -1.0, S, starts)
    return Compressed(core, W, W, error=size), error


def _norm(C: Any, sign: float, S: IdentityPlus, starts: Starts) -> float:
    """Upper bound on ||I + sign C||_2."""
    whole = scipy.sparse.csr_array(scipy.sparse.eye_array(C.shape[0]) + sign * C)
    return two_norm(Host(S.device, whole), **next(starts)).upper
