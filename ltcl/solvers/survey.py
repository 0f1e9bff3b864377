# SPDX-License-Identifier: BSD-3-Clause
"""A survey of S (N, N): three steps of GMRES from a random picture, made once in the life of S.

Ritz values estimate the spectrum, residuals tell how fast Krylov methods converge, and the
directions tell whether S is self-adjoint.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from ltcl import theory
from ltcl.device import vectors
from ltcl.operators import Operator
from ltcl.solvers.chebyshev import tighten_bounds
from ltcl.solvers.krylov_space import KrylovSpace

STEPS = 3

# Inner products of R are nearly those of a self-adjoint operator up to this defect.
MAX_SELF_ADJOINT_DEFECT = 0.02

# Imaginary parts that an interval may leave out, relative to the smallest real part.
MAX_IMAGINARY_RATIO = 0.25


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """Estimates of the spectrum of S, and of the convergence of Krylov methods.

    Attributes
    ----------
    ritz : (steps,) complex
        Ritz values.
    spectrum : (float, float)
        An interval around their real parts, within the free bounds.
    residuals : tuple of float
        Relative residuals of GMRES after 0, 1, ... products.
    defect : float
        The part of R that is not self-adjoint in the inner product of `S.weights`, or the plain
        one: 0 for a self-adjoint R, 1 for a rotation.
    """

    ritz: np.ndarray
    spectrum: tuple[float, float]
    residuals: tuple[float, ...]
    defect: float

    @property
    def in_an_interval(self) -> bool:
        """True if all eigenvalues seem to lie near some interval of positive numbers."""
        smallest = float(np.min(np.real(self.ritz), initial=np.inf))
        largest_imaginary = np.max(np.abs(np.imag(self.ritz)), initial=0.0)
        return smallest > 0.0 and bool(largest_imaginary <= MAX_IMAGINARY_RATIO * smallest)

    @property
    def self_adjoint(self) -> bool:
        """True if cg will work as in theory."""
        return self.defect <= MAX_SELF_ADJOINT_DEFECT

    def krylov_products(self, rtol: float) -> float:
        """Return the products of a Krylov method to `rtol`; infinite if it stalls."""
        last = self.residuals[-1]
        products = len(self.residuals) - 1
        if last <= rtol:
            # Residuals never grow: the first one within rtol.
            return float(np.argmax(np.array(self.residuals) <= rtol))
        factor = last / self.residuals[-2]
        if factor >= 1.0:
            return math.inf
        missing = math.log(rtol / last) / math.log(factor)
        return products + float(np.ceil(missing))

    def __str__(self) -> str:
        real = np.real(self.ritz)
        lowest = np.min(real, initial=np.inf)
        highest = np.max(real, initial=-np.inf)
        spectrum = f"eigenvalues of S seen between {lowest:.2g} and {highest:.2g}"
        if not self.in_an_interval:
            spectrum += f" with imaginary parts up to {np.max(np.imag(self.ritz)):.2g}"
        products = len(self.residuals) - 1
        return f"{self.defect:.2g} of R is not self-adjoint, {spectrum} by {products} products"


def survey(S: Operator) -> Survey:
    """Return the survey of S, which is made at the first call."""
    if S.known.survey is None:
        S.known.survey = _take_survey(S)
    return S.known.survey


def _take_survey(S: Operator) -> Survey:
    picture = np.random.default_rng(0).uniform(size=S.shape[0])
    start = S.device.upload(picture)
    space = KrylovSpace(S, start, np.ones(1), min(STEPS, S.shape[0]))
    residuals = [1.0]
    is_invariant = False
    while space.count < space.steps and not is_invariant:
        is_invariant = bool(space.extend()[0])
        residuals.append(float(space.residuals[0]))
    ritz = space.ritz_values()
    return Survey(
        ritz=ritz,
        spectrum=tighten_bounds(theory.free_bounds(S), S, ritz),
        residuals=tuple(residuals),
        defect=_self_adjoint_defect(S, space),
    )


def _self_adjoint_defect(S: Operator, space: KrylovSpace) -> float:
    """Return ||G - G^T|| / 2 ||G|| of G = V^T W R V, from the products S V = V H that are there."""
    steps = space.count
    basis = []
    for j in range(steps + 1):
        basis.append(dataclasses.replace(space.V.rows(j, 1), shape=S.shape[:1]))

    # <v_i, W v_j> of all pairs, in one reading.
    gram = S.device.empty((steps * (steps + 1), 1))
    weights = None
    if S.weights is not None:
        weights = S.device.upload(S.weights / np.max(S.weights))
    for j, v in enumerate(basis[:steps]):
        weighted = v if weights is None else vectors.scale_rows(weights, v, v.like())
        for i, u in enumerate(basis):
            vectors.queue_dot(u, weighted, gram, j * (steps + 1) + i)

    # R V = V (H - I), with one row more than columns.
    R = space.H[0, : steps + 1, :steps] - np.eye(steps + 1, steps)
    G = gram.get().reshape(steps, steps + 1).astype(np.float64) @ R
    norm = float(np.linalg.norm(G))
    if norm == 0.0:
        return 0.0
    return float(np.linalg.norm(G - G.T) / (2.0 * norm))
