# SPDX-License-Identifier: BSD-3-Clause
"""What a few products tell of S, found once and kept as long as S lives.

Arnoldi steps from a seeded random picture: their Ritz values estimate the spectrum, the residuals that GMRES
would have had on the way tell how fast Krylov methods converge, and their directions whether S is
self-adjoint.
"""

from __future__ import annotations

import math
import weakref
from dataclasses import dataclass

import numpy as np

from ltcl import theory
from ltcl.device import Array
from ltcl.operators import Operator
from ltcl.solvers import arnoldi
from ltcl.solvers.hessenberg import Hessenberg

STEPS = 3
_MARGIN = 0.25  # of the width of the Ritz values, added on both sides: the outermost are not found at once
_SAFETY = 0.05
_SELF_ADJOINT = 0.02  # defect of R up to which inner products are nearly those of a self-adjoint one
_ONE_SIDED = 0.5  # defect beyond which R sends light one way: its eigenvalues are hardly real
_SLENDER = 0.25  # of the smallest real part: imaginary parts that an interval may leave out
_found: weakref.WeakKeyDictionary[Operator, Survey] = weakref.WeakKeyDictionary()


@dataclass(frozen=True)
class Survey:
    """Estimates of the spectrum of S and of how fast methods converge.

    Attributes
    ----------
    ritz : complex ndarray
        Ritz values.
    spectrum : (lower, upper)
        The free bounds drawn in to a margin around the real parts of the Ritz values, and out to hold them.
    falls : tuple of float
        Relative residual of GMRES after 0, 1, ... products, on a random picture.
    defect : float
        Part of R that is not self-adjoint in the inner product of `S.weights`, or the plain one: 0 where it
        is, 1 of a rotation.
    products : int
        Made to find this.
    """

    ritz: np.ndarray
    spectrum: tuple[float, float]
    falls: tuple[float, ...]
    defect: float
    products: int

    @property
    def imaginary(self) -> float:
        """Largest imaginary part."""
        return float(np.max(np.abs(np.imag(self.ritz)), initial=0.0))

    @property
    def in_an_interval(self) -> bool:
        """Whether all eigenvalues seem to lie near some interval of positive numbers."""
        least = float(np.min(np.real(self.ritz), initial=np.inf))
        return least > 0.0 and self.imaginary <= _SLENDER * least and self.defect <= _ONE_SIDED

    @property
    def self_adjoint(self) -> bool:
        """Whether cg will work as in theory."""
        return self.defect <= _SELF_ADJOINT

    def krylov_products(self, rtol: float) -> float:
        """Products of a Krylov method to `rtol`, one to confirm the end included; infinite where it stalls.

        >>> Survey(np.zeros(0), (1.0, 1.0), (1.0, 0.5, 0.1), 0.0, 2).krylov_products(0.01)
        5.0
        """
        for step, residual in enumerate(self.falls):
            if residual <= rtol:
                return step + 1.0
        factor = self.falls[-1] / self.falls[-2]
        if not factor < 1.0:
            return math.inf
        left = math.log(rtol / self.falls[-1]) / math.log(factor)
        return float(len(self.falls) + math.ceil(left))


def survey(S: Operator) -> Survey:
    """The survey of S; products are made at the first call only."""
    if S not in _found:
        _found[S] = _explore(S)
    return _found[S]


def known(S: Operator) -> bool:
    """Whether the survey of S is there already."""
    return S in _found


def _explore(S: Operator) -> Survey:
    start = np.random.default_rng(0).uniform(size=S.shape[0])
    basis = [S.device.upload(start / np.linalg.norm(start))]
    problem, falls, columns = Hessenberg(np.ones(1), STEPS), [1.0], []
    for _ in range(min(STEPS, S.shape[0])):
        h = arnoldi.extend(basis, S.apply(basis[-1]), np.ones(1, bool))
        columns.append(h[0])
        problem.extend(h)
        falls.append(float(problem.residuals[0]))
        if not h[0, -1] > 0.0:
            break
    ritz = problem.ritz_values()
    spectrum = refined(theory.free_bounds(S), ritz)
    return Survey(ritz, spectrum, tuple(falls), _defect(S, basis, columns), len(columns))


def _defect(S: Operator, basis: list[Array], columns: list[np.ndarray]) -> float:
    """||G - G^T|| / 2 ||G|| of G = V^T W R V, from S V = V H: products that are made already."""
    steps = len(columns)
    H = np.zeros((steps + 1, steps))
    for j, column in enumerate(columns):
        H[: j + 2, j] = column
    V = np.stack([v.get() for v in basis], axis=1).astype(np.float64)
    R = H - np.eye(steps + 1, steps)
    G = (V[:, :steps].T * (1.0 if S.weights is None else S.weights)) @ V @ R
    whole = 2.0 * float(np.linalg.norm(G))
    return float(np.linalg.norm(G - G.T)) / whole if whole > 0.0 else 0.0


def refined(bounds: tuple[float, float], ritz: np.ndarray) -> tuple[float, float]:
    """Bounds drawn in to a margin around the Ritz values, which lie inside the spectrum of self-adjoint S.

    >>> refined((0.5, 5.0), np.array([1.0, 2.0]))
    (0.75, 2.25)
    """
    if len(ritz) < 2:
        return bounds
    least, most = float(np.min(np.real(ritz))), float(np.max(np.real(ritz)))
    margin = _MARGIN * (most - least)
    inner = max(bounds[0], least - margin), min(bounds[1], most + margin)
    return widened(inner if inner[0] < inner[1] else bounds, ritz)


def widened(bounds: tuple[float, float], ritz: np.ndarray) -> tuple[float, float]:
    """Bounds drawn out to hold the Ritz values; those on the wrong side of 0 no interval can hold.

    >>> widened((0.5, 1.0), np.array([0.75, 5.0, -1.0]))
    (0.5, 5.25)
    """
    real = np.real(ritz)
    positive = real[real > 0.0]
    if not len(positive):
        return bounds
    least, most = float(np.min(positive)), float(np.max(positive))
    lower = bounds[0] if least >= bounds[0] else least / (1.0 + _SAFETY)
    upper = bounds[1] if most <= bounds[1] else most * (1.0 + _SAFETY)
    return lower, upper
