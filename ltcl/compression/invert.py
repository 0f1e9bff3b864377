# SPDX-License-Identifier: BSD-3-Clause
"""`invert`: A = I - S^-1 of a transport, once, so that every further frame costs one product.

R is taken in a basis that both sides share: as it is, or compressed. A is found from its coefficients, as
coefficients again (`sparse_inverse`), in few bytes. Errors add up: x_R being what R~ gives, e the error of
that, and g that of an inverse of S~ = I + R~, or of a further compression,

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
from ltcl.compression.compress import Goal, compress_inputs, validate_progress, validate_rtol
from ltcl.compression.norms import MISS, Starts, fresh_starts
from ltcl.compression.sources import memory_errors, of_transport
from ltcl.compression.sparse_inverse import invert_coefficients, residual_norm
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


def invert(
    T: Transport,
    rtol: float = 1e-2,
    *,
    basis: str | Sequence[str] = INVERSE_NAMES,
    progress: Callable[[str, float], object] | None = None,
) -> Inverse:
    """S^-1 = I - A of a transport, to be kept: see `ltcl.solvers.Inverse`.

    Parameters
    ----------
    T : Transport, square
        Measured, or compressed already; with wavelets on one side alone, or scanned adaptively, it is written
        anew first, from N products with it, and the error adds both losses.
    rtol : float
        Relative error that a solution may have, ``||x~ - x|| <= rtol ||x||`` for every picture.
    basis : str or sequence of str
        In which A and R are written, "pixels" or an orthonormal wavelet; of several, the best. A T that was
        compressed in one basis on both sides keeps it.
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
    MemoryLimitError
        R, A or their coefficients do not fit into the memory of the host.

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
    rtol = validate_rtol(rtol, _BOUNCES * _UNIT * math.sqrt(T.shape[0]))
    if T.is_compressed and rtol <= T.error:
        raise InputError(
            f"rtol is {rtol:g}, but T is compressed and its solutions may be off by "
            f"{checks.upwards(T.error)}; ask for more than that, or invert what T was compressed from"
        )
    names = validate_names(basis, for_inverse=True)
    note, starts = validate_progress(progress), fresh_starts("invert")
    bounces, errors = [], []
    try:
        with memory_errors("invert", T):
            systems, compressions = _in_one_basis(T, rtol, names, lambda text, share: note(text, share / 2))
            for channel, S in enumerate(systems):
                begun = 0.5 + 0.5 * channel / T.channels
                A, error = _bounce(S, rtol, starts, lambda text, begun=begun: note(text, begun))
                bounces.append(A)
                errors.append(error)
        note("done", 1.0)
    except ToleranceError as error:
        least = float(checks.upwards(1.1 * error.least - 0.1 * T.error))
        message = f"rtol is {rtol:g}, but float32 reaches about {least:g} for the inverse of this T"
        raise ToleranceError(message, least) from None
    confidence = 1.0 - (compressions + T.channels + 1) * MISS
    return Inverse(bounces, errors, T.grid, T.first_bounce, T.mixing, confidence=confidence)


def _in_one_basis(
    T: Transport, rtol: float, names: list[str], progress: Callable[[str, float], object]
) -> tuple[Sequence[IdentityPlus], int]:
    """S of every channel, whose R are numbers in one basis, and how many compressions are behind them."""
    compressions = 1 if T.error else 0
    if (T.is_compressed or names == [PIXELS]) and all(_has_coefficients(S.R) for S in T.systems):
        return T.systems, compressions
    share = _SHARE * (rtol - T.error) / (1.0 + T.error)
    starts = fresh_starts("rewrite" if T.error else "compress")
    try:
        systems = compress_inputs(of_transport(T), names, Goal("worst", share), starts, progress)[0].systems
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


def _bounce(
    S: IdentityPlus, rtol: float, starts: Starts, progress: Callable[[str], object]
) -> tuple[Operator, float]:
    """A of one channel, and the relative error of solutions with it."""
    R, W = (S.R.core, S.R.out) if isinstance(S.R, Compressed) else (S.R, None)
    C: Any = R.matrix() if isinstance(R, (CSR, Tiles)) else R.to_dense()
    C = scipy.sparse.csr_array(C).astype(np.float32)
    norm = max(1.0, _norm(C, 1.0, S, starts))  # S is the identity on coefficients that C leaves out
    earlier = S.solution_error
    rounding = _UNIT * math.sqrt(S.shape[0]) * norm  # of x, for each unit of b and A b
    least = earlier + _BOUNCES * rounding
    allowance = (rtol - least) / (1.0 + earlier)
    if allowance <= 0.0:
        raise ToleranceError("nothing is left for A", least + _BOUNCES * rounding)
    try:
        inverse = invert_coefficients(C, rtol=_ITERATION * allowance, device=S.device, progress=progress)
    except ConvergenceError as failed:
        if failed.solution.status is not Status.STAGNATED:
            raise ConvergenceError(f"S of T was not inverted by {failed}", failed.solution) from None
        least += (1.0 + earlier) * failed.solution.error / _ITERATION
        raise ToleranceError("float32 has no more digits of A", least) from None
    progress("choosing the precision of A")
    core = Tiles(S.device, quantize(inverse.D, (1.0 - _ITERATION) * allowance / norm))
    error = residual_norm(C, core.matrix(), S.device, allowance, starts)
    if error > allowance:
        core, error = Tiles(S.device, quantize(inverse.D, 0.0)), inverse.error
    error = error * (1.0 + earlier) + least
    # Of X = I - A~: A~ - A = (I - X S) S^-1, ||I - X S|| <= error, and so ||S^-1|| <= ||X|| / (1 - error).
    size = error / (1.0 - error) * _norm(core.matrix(), -1.0, S, starts)
    return Compressed(core, W, W, error=size), error


def _norm(C: Any, sign: float, S: IdentityPlus, starts: Starts) -> float:
    """Upper bound on ||I + sign C||_2."""
    whole = scipy.sparse.csr_array(scipy.sparse.eye_array(C.shape[0]) + sign * C)
    return two_norm(Host(S.device, whole), **next(starts)).upper
