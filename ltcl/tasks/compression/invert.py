# SPDX-License-Identifier: BSD-3-Clause
"""`invert`: A = I - S^-1 of a transport, once, so that every further frame costs one product.

R is taken in a basis that both sides share: as it is, or compressed. A is found from its
coefficients, as coefficients again (`sparse_inverse`). With x_R of R~, e its error, and g that of
an inverse of S~ = I + R~ or of a compression,

    ||x~ - x|| <= ||x~ - x_R|| + ||x_R - x|| <= g ||x_R|| + e ||x|| <= (g (1 + e) + e) ||x||,

and the rounding of float32 in a product, sqrt(N) units of it, is added.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import ConvergenceError, InputError, ToleranceError
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Operator, Tiles
from ltcl.solvers import Inverse
from ltcl.solvers.result import Status
from ltcl.tasks.compression.basis_pairs import INVERSE_NAMES, basis_names
from ltcl.tasks.compression.coefficients import quantize
from ltcl.tasks.compression.compress import check_rtol, compress_inputs
from ltcl.tasks.compression.goals import ByTolerance, Note
from ltcl.tasks.compression.inputs import inputs_of_transport, memory_errors
from ltcl.tasks.compression.norms import FLOAT32_UNIT, MISS, Starts, fresh_starts
from ltcl.tasks.compression.sparse_inverse import (
    bound_norm,
    invert_coefficients,
    residual_operator,
)
from ltcl.tasks.requirements import check_progress
from ltcl.transport.transport import Transport, check_transport

# Part of the tolerance for compressing R; part of what is left of it for A. The last tenth is for
# rounding the core of A.
SHARE_OF_R = 0.4
SHARE_OF_ITERATION = 0.9
# |b| and |A| |b|, where A takes no more light than there is.
ROUNDED_TERMS = 2.0


def invert(
    T: Transport,
    rtol: float = 1e-2,
    *,
    basis: str | Sequence[str] = INVERSE_NAMES,
    progress: Note | None = None,
) -> Inverse:
    """Find S^-1 = I - A of a transport once, to be kept: see `ltcl.solvers.Inverse`.

    Parameters
    ----------
    T : Transport, square, or of several projectors, whose scene is inverted
        Measured, or compressed already. A T with wavelets on one side alone, or scanned adaptively,
        is first written in one basis, from N products with it, and the error adds both losses.
    rtol : float
        Relative error that a solution may have, ``||x~ - x|| <= rtol ||x||`` for every picture.
    basis : str or sequence of str
        Basis of A and R, "pixels" or an orthonormal wavelet; the best of several. A T that was
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
    T = check_transport(T, square=False).scene
    check_transport(T)
    rounding = FLOAT32_UNIT * math.sqrt(T.shape[0])
    rtol = check_rtol(rtol, ROUNDED_TERMS * rounding)
    if T.is_compressed and rtol <= T.error:
        raise InputError(
            f"rtol is {rtol:g}, but T is compressed and its solutions may be off by "
            f"{checks.upwards(T.error)}; ask for more than that, "
            "or invert the original transport"
        )
    names = basis_names(basis, for_inverse=True)
    note = check_progress(progress)
    starts = fresh_starts("invert")
    bounces = []
    errors = []

    def note_rewriting(text: str, share: float) -> None:
        note(text, share / 2)

    try:
        with memory_errors("invert", T):
            rewritten = _in_one_basis(T, rtol, names, note_rewriting)
            for channel, S in enumerate(rewritten.systems):
                share = 0.5 + 0.5 * channel / T.channels

                def note_channel(text: str, share: float = share) -> None:
                    note(text, share)

                bounce = _invert_channel(S, rtol, starts, note_channel)
                bounces.append(bounce.A)
                errors.append(bounce.error)
        note("done", 1.0)
    except ToleranceError as error:
        least = float(checks.upwards(1.1 * error.least - 0.1 * T.error))
        raise ToleranceError(
            f"rtol is {rtol:g}, but float32 reaches about {least:g} for the inverse of this T",
            least,
        ) from None
    confidence = 1.0 - (rewritten.compressions + T.channels + 1) * MISS
    return Inverse(bounces, errors, T.grid, T.first_bounce, T.mixing, confidence=confidence)


class _Rewritten(NamedTuple):
    """S of every channel, R as numbers in one basis, and the number of compressions before."""

    systems: tuple[Any, ...]
    compressions: int


def _in_one_basis(T: Transport, rtol: float, names: list[str], note: Note) -> _Rewritten:
    """S of every channel in one basis: as it is, or compressed."""
    compressions = 0
    purpose = "compress"
    if T.error:
        compressions = 1
        purpose = "rewrite"
    may_keep_basis = T.is_compressed or names == ["pixels"]
    if may_keep_basis and all(_has_coefficients(S.R) for S in T.systems):
        return _Rewritten(T.systems, compressions)
    share = SHARE_OF_R * (rtol - T.error) / (1.0 + T.error)
    goal = ByTolerance("worst", share)
    try:
        inputs = inputs_of_transport(T)
        C, _ = compress_inputs(inputs, names, goal, fresh_starts(purpose), note)
    except ToleranceError as error:
        least = T.error + error.least * (1.0 + T.error) / SHARE_OF_R
        raise ToleranceError(str(error), least) from None
    systems = []
    for channel, S in enumerate(C.systems):
        earlier = T.systems[channel].solution_error if T.is_compressed else 0.0
        error = earlier + S.solution_error * (1.0 + earlier)
        systems.append(IdentityPlus(S.R, solution_error=error))
    return _Rewritten(tuple(systems), compressions + 1)


def _has_coefficients(R: Any) -> bool:
    """True if R is numbers in pixels, or in one isometric basis on both sides."""
    if isinstance(R, Compressed) and (R.two_sided or R.out is R.into is None):
        R = R.core
    return isinstance(R, (CSR, Tiles, Dense))


class _Bounce(NamedTuple):
    """A of one channel, and the relative error of solutions with it."""

    A: Operator
    error: float


def _invert_channel(
    S: IdentityPlus, rtol: float, starts: Starts, progress: Callable[[str], object]
) -> _Bounce:
    """A of one channel."""
    core = S.R
    W = None
    if isinstance(core, Compressed):
        W = core.out
        core = core.core
    matrix = core.matrix() if isinstance(core, (CSR, Tiles)) else core.to_dense()
    C: Any = scipy.sparse.csr_array(matrix).astype(np.float32)
    eye = scipy.sparse.eye_array(C.shape[0])

    # 1. Part of the tolerance that rounding and the compression of R leave for A.
    # S is the identity on coefficients that C leaves out.
    norm = max(1.0, bound_norm(eye + C, S.device, starts))
    earlier = S.solution_error
    # Rounding of x, for each unit of b and A b.
    rounding = FLOAT32_UNIT * math.sqrt(S.shape[0]) * norm
    least = earlier + ROUNDED_TERMS * rounding
    allowance = (rtol - least) / (1.0 + earlier)
    if allowance <= 0.0:
        raise ToleranceError("nothing is left for A", least + ROUNDED_TERMS * rounding)

    # 2. The coefficients of A.
    try:
        inverse = invert_coefficients(
            C, rtol=SHARE_OF_ITERATION * allowance, device=S.device, progress=progress
        )
    except ConvergenceError as failed:
        if failed.solution.status is not Status.STAGNATED:
            raise ConvergenceError(
                f"S of T was not inverted by {failed}", failed.solution
            ) from None
        least += (1.0 + earlier) * failed.solution.error / SHARE_OF_ITERATION
        raise ToleranceError("float32 has no more digits of A", least) from None

    # 3. Their precision, and the error with it.
    progress("choosing the precision of A")
    rounding_allowance = (1.0 - SHARE_OF_ITERATION) * allowance / norm
    tiles = Tiles(S.device, quantize(inverse.D, rounding_allowance))
    residual = residual_operator(C, tiles.matrix())
    error = bound_norm(residual, S.device, starts, allowance)
    if error > allowance:
        tiles = Tiles(S.device, quantize(inverse.D, 0.0))
        error = inverse.error
    error = error * (1.0 + earlier) + least
    # With X = I - A~: A~ - A = (I - X S) S^-1, ||I - X S|| <= error, and so
    # ||S^-1|| <= ||X|| / (1 - error).
    norm_of_X = bound_norm(eye - tiles.matrix(), S.device, starts)
    norm_of_inverse = norm_of_X / (1.0 - error)
    A = Compressed(tiles, W, W, error=error * norm_of_inverse)
    return _Bounce(A, error)
