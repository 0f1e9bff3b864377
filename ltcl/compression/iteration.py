# SPDX-License-Identifier: BSD-3-Clause
"""The inverse of a sparse matrix of coefficients, as sparse coefficients again: eq. 21 with thresholds.

    bounces added    (I - A)^-1 = I + R      R = A + A R
    bounces undone   (I + R)^-1 = I - A      A = R - R A

Both are D = C - s D C, where (I + s C)^-1 = I - s D: C = R and s = 1 give A, C = A and s = -1 give R. In any
orthonormal basis the identity is the identity, so only C and D are ever stored. What is left to do is

    G = C - D (I + s C),     I - (I - s D)(I + s C) = s G

and eq. 21 adds G to D, which converges where rho(C) < 1. Chebyshev's iteration adds alpha G + beta times
what was added last, costs the same product and converges for every albedo below one; with the spectrum
(1, 1) it is eq. 21. A of a corner of albedo 0.8 takes 3 products to 1 % and 4 to 0.1 %, with eq. 21 5 and 8.
Newton-Schulz doubles the exact terms by two products a step, of denser matrices.

D stands left of the product, so that rows never mix: blocks of them go through it by themselves, and only
what is above a threshold is kept. G is computed from D as it is kept, so nothing that is dropped adds up.
The solution x~ = (I - s D) b of (I + s C) x = b is off by -s G x, so relatively by ||G||_2 at most.
"""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.compression import elimination
from ltcl.compression.extent import extent
from ltcl.compression.iterated import Iterated, NoInverse
from ltcl.compression.residual import Residual, certify
from ltcl.compression.row_blocks import cuts
from ltcl.compression.thresholds import above, norm_2, random_start, threshold_for
from ltcl.compression.weights import Chebyshev
from ltcl.device import Device, open_device
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.solvers.result import Status
from ltcl.theory import TwoNorm

_SHARE = 0.7  # of the tolerance, that the first threshold is to cost
_FINE = 0.1  # of the threshold: what of a correction is too small to be added
_AIM = 0.8  # of the tolerance, at which a lower threshold aims
_LEAST, _MOST = 0.1, 0.7  # what a threshold is lowered by
_GROWTH = 10.0  # times the first residual
METHODS = ("auto", "iteration", "elimination")

Progress = Callable[[int, float], object]


def invert_coefficients(
    C: Any,
    sign: float = 1.0,
    *,
    rtol: float = 1e-2,
    method: str = "auto",
    spectrum: tuple[float, float] | None = None,
    maxiter: int = 60,
    callback: Progress | None = None,
    device: Device | None = None,
    throw: bool = True,
) -> Iterated:
    """D of (I + sign C)^-1 = I - sign D: A from R, or R from A with ``sign=-1``.

    Parameters
    ----------
    C : (N, N) scipy.sparse
        Coefficients in one orthonormal basis on both sides, or pixels; float32 stays float32.
    sign : 1 or -1
    rtol : float
        Relative error that a solution with I - sign D may have, for every right-hand side.
    method : str
        "iteration"; "elimination", dense, on the host; or "auto": whichever is estimated to take less time,
        and, where there is room, elimination of what the iteration cannot invert.
    spectrum : (lower, upper), optional
        Between which the real parts of the eigenvalues of I + sign C lie; found by Arnoldi's method when
        not given. (1, 1) is eq. 21.
    maxiter : int
        Most products.
    callback : callable(products, residual), optional
    device : Device, optional
        Where the random vectors of the bound are kept; the best one when not given.
    throw : bool
        Raise where the tolerance is not met.

    Returns
    -------
    Iterated

    Raises
    ------
    InputError, InputTypeError
        No square sparse matrix; a singular one; eigenvalues at or below 0, which no scene has, where the
        iteration has to do.
    ConvergenceError
        Divergence, or `maxiter` reached; ``.solution`` holds what there is.

    Examples
    --------
    >>> import scipy.sparse
    >>> A = scipy.sparse.csr_array([[0.0, 0.5], [0.5, 0.0]])
    >>> R = invert_coefficients(A, -1, rtol=1e-4).D
    >>> R.toarray().round(2).tolist()
    [[0.33, 0.67], [0.67, 0.33]]
    >>> invert_coefficients(R, rtol=1e-3).D.toarray().round(2).tolist()  # and back
    [[0.0, 0.5], [0.5, 0.0]]
    """
    start = time.perf_counter()
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    maxiter = checks.count("maxiter", maxiter)
    if sign not in (1.0, -1.0):
        raise InputError(f"sign is {sign!r}; it must be 1 for I + C or -1 for I - C")
    if callback is not None and not callable(callback):
        raise InputTypeError(f"callback is {callback!r}; it must be callable(products, residual)")
    checks.one_of("method", method, METHODS)
    C, sign = _square(C), float(sign)
    device = device if device is not None else open_device()
    free = method == "auto" and spectrum is None
    found = None
    if method != "elimination" and not (free and elimination.pays(C)):
        found = _iterated(C, sign, spectrum, rtol, device, maxiter, callback, free and elimination.fits(C))
    if found is None:
        found = elimination.eliminate(C, sign, rtol, device)
        if callback is not None:
            callback(0, found.residuals[-1])
    found = dataclasses.replace(found, seconds=time.perf_counter() - start)
    if throw and not found.converged:
        raise ConvergenceError(str(found), found)
    return found


def _iterated(
    C: Any,
    sign: float,
    spectrum: Any,
    rtol: float,
    device: Device,
    maxiter: int,
    callback: Progress | None,
    optional: bool,
) -> Iterated | None:
    """By the iteration; None where it is `optional` and does not get there."""
    try:
        bounds = extent(C, sign) if spectrum is None else _given(spectrum)
    except NoInverse:
        if optional:
            return None
        raise
    found = _Run(C, sign, bounds, rtol, device).until(maxiter, callback)
    return None if optional and not found.converged else found


class _Run:
    """The state of an iteration: D, and what was added to it last, as blocks of rows."""

    def __init__(self, C: Any, sign: float, bounds: tuple[float, float], rtol: float, device: Device) -> None:
        n, signed = C.shape[0], C.dtype.type(sign)
        self.C, self.sign, self.rtol, self.device = C, sign, rtol, device
        self.S: Any = scipy.sparse.csr_array(scipy.sparse.eye_array(n, dtype=C.dtype) + signed * C)
        self.cuts = list(cuts(C))
        self.D: Any = scipy.sparse.csr_array(C.shape, dtype=C.dtype)
        self.added: list[Any] = [None] * len(self.cuts)
        self.bounds, self.weights = bounds, Chebyshev(bounds)
        self.threshold = threshold_for(C, _SHARE * rtol)
        self.witness = random_start(n)  # of the largest residual so far
        self.residuals: list[float] = []
        self.dropped: list[float] = []
        self.bound: TwoNorm | None = None
        self._look()

    def until(self, maxiter: int, callback: Progress | None) -> Iterated:
        """Iterate to the end."""
        while True:
            if callback is not None:
                callback(len(self.dropped), self.residuals[-1])
            status = self._judge(maxiter)
            if status is not None:
                return self._found(status)
            self._step()

    def _found(self, status: Status) -> Iterated:
        if self.bound is None or status is not Status.CONVERGED:
            self.bound = self._certify()
        return Iterated(
            self.D,
            self.bound.upper,
            self.bound.confidence,
            status,
            len(self.dropped),
            tuple(self.residuals),
            tuple(self.dropped),
            self.threshold,
            "iteration",
            self.bounds,
        )

    def _certify(self) -> TwoNorm:
        return certify(Residual(self.C, self.D, self.sign), self.device, self.rtol)

    def _judge(self, maxiter: int) -> Status | None:
        last = self.residuals[-1]
        if last <= self.rtol:
            self.bound = self._certify()
            if self.bound.upper <= self.rtol:
                return Status.CONVERGED
        if not last <= _GROWTH * self.residuals[0]:
            return Status.DIVERGED
        if len(self.dropped) >= maxiter:
            return Status.MAXITER
        if self.dropped and last > (1.0 + self.weights.shrinks) / 2.0 * self.residuals[-2]:
            # What was dropped is most of the residual, or the step would have lowered it: drop less.
            self.threshold *= min(max(_AIM * self.rtol / last, _LEAST), _MOST)
        return None

    def _step(self) -> None:
        alpha, beta = next(self.weights)

        def block(place: int) -> tuple[Any, float]:
            return self._block(place, alpha, beta)

        with ThreadPoolExecutor(os.cpu_count()) as pool:  # SciPy's products run side by side
            parts, lost = zip(*pool.map(block, range(len(self.cuts))), strict=True)
        self.D = scipy.sparse.vstack(parts, format="csr")
        self.dropped.append(math.sqrt(math.fsum(lost)))
        self._look()

    def _block(self, place: int, alpha: float, beta: float) -> tuple[Any, float]:
        """Some rows of the next D, and the squares of what was dropped of them."""
        rows = slice(*self.cuts[place])
        D = self.D[rows]
        G, _ = above(self.C[rows] - D @ self.S, _FINE * self.threshold)
        G.sort_indices()  # so that sums have one order, however rows are cut
        added = alpha * G
        if beta:
            added = added + beta * self.added[place]
        self.added[place] = added  # d of 4.
        return above(scipy.sparse.csr_array(D + added), self.threshold)

    def _look(self) -> None:
        G = Residual(self.C, self.D, self.sign)
        norm, self.witness = norm_2(G.matvec, G.rmatvec, self.witness)
        self.residuals.append(norm)


def _square(C: Any) -> Any:
    C = checks.csr("C", C)
    if C.shape[0] != C.shape[1]:
        raise InputError(f"C has shape {C.shape}; it must be square, (N, N)")
    return C if C.dtype in (np.float32, np.float64) else C.astype(np.float64)


def _given(spectrum: Any) -> tuple[float, float]:
    try:
        lower, upper = spectrum
    except (TypeError, ValueError):
        raise InputError(f"spectrum is {spectrum!r}; it must be (lower, upper)") from None
    lower = checks.number("spectrum[0]", lower, above=0.0)
    return lower, checks.number("spectrum[1]", upper, least=lower)
