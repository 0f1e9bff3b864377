# SPDX-License-Identifier: BSD-3-Clause
"""The 2-norm of an operator, or of what two differ by, with an upper bound of stated confidence.

Golub-Kahan steps A v_j = b_(j-1) u_(j-1) + a_j u_j, A^T u_j = a_j v_j + b_j v_(j+1) from a random
unit vector v_1 give orthonormal v_(j+1) = p_j(A^T A) v_1, p_j of degree j. With s the norm, x the
right singular vector of it and g = <x, v_1>, the parts <x, v_(j+1)> = p_j(s^2) g have squares that
sum to at most one:

    g^2 (p_0^2 + p_1^2 + ... + p_k^2)(s^2) <= 1

Beyond the largest Ritz value the sum grows, so that g^2 >= d^2 bounds s from above. How likely g^2
is below d^2 is a Beta distribution, whatever A is; of several independent starts one at least has
g^2 >= d^2 but for the product of these probabilities. The largest of their bounds then holds, after
any number of steps.

For one start and p_k alone this is the bound of van Dorsselaer, Hochstenbach and van der Vorst,
SIAM J. Matrix Anal. Appl. 22 (2000).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.special

from ltcl import checks
from ltcl.errors import InputError
from ltcl.operators import Operator
from ltcl.theory.spectrum import require_operator

CONFIDENCE = 1.0 - 1e-6
_STARTS, _STEPS = 8, 48
_UNIT = 2.0**-24  # rounding of float32


@dataclass(frozen=True)
class TwoNorm:
    """||A||_2.

    Attributes
    ----------
    estimate, upper : float
        A lower bound, up to rounding, and an upper one.
    confidence : float
        Of the upper bound; 1 where it is a Frobenius norm, which is certain.
    products : int
        With A and with A^T, each with all starts at once.
    """

    estimate: float
    upper: float
    confidence: float
    products: int


def two_norm(
    A: Operator,
    minus: Operator | None = None,
    *,
    confidence: float = CONFIDENCE,
    factor: float = 1.1,
    below: float | None = None,
    frobenius: float = math.inf,
    starts: int = _STARTS,
    maxsteps: int = _STEPS,
    seed: int = 0,
) -> TwoNorm:
    """||A||_2, or ||A - minus||_2, with an upper bound that holds with the given confidence.

    Parameters
    ----------
    A, minus : Operator, (M, N)
        Products of each run on its device in float32; they are subtracted and orthogonalized in
        float64.
    confidence : float
        The bound fails with probability 1 - confidence over the random starts, whatever A is.
    factor : float
        Steps end when the upper bound is within this factor of the lower one, or after `maxsteps`.
    below : float, optional
        They end also when it is clear whether the norm is at most this.
    frobenius : float
        ||A - minus||_F or more, where it is known: taken where it is smaller.
    starts, maxsteps, seed : int
        Random vectors, multiplied together as columns.

    Returns
    -------
    TwoNorm
        What float32 sums of N products may round is added: sqrt(N) units of A's and `minus`'s own
        size.

    Raises
    ------
    InputError
        Shapes that differ, a confidence outside (0, 1), a factor that is not above 1.

    Examples
    --------
    >>> import numpy
    >>> from ltcl.operators import as_operator
    >>> n = two_norm(as_operator(numpy.diag([3.0, 2.0, 1.0])))
    >>> round(n.estimate, 3), n.upper < 3.3
    (3.0, True)
    """
    require_operator("A", A)
    if minus is not None and require_operator("minus", minus).shape != A.shape:
        raise InputError(f"minus has shape {minus.shape}; it must be that of A, {A.shape}")
    miss = 1.0 - checks.number("confidence", confidence, above=0.0, below=1.0)
    factor = checks.number("factor", factor, above=1.0)
    starts, maxsteps = checks.count("starts", starts), checks.count("maxsteps", maxsteps)
    # A random unit vector in n dimensions has <x, v>^2 < `least` with probability miss^(1 /
    # starts).
    n, least = A.shape[1], 1.0
    if n > 1:
        least = float(scipy.special.betaincinv(0.5, 0.5 * (n - 1), miss ** (1.0 / starts)))
    process = _Bidiagonal(A, minus, starts, seed)
    estimate, upper = 0.0, math.inf
    for _ in range(maxsteps):
        process.step()
        estimate, bound = process.bounds(least)
        upper = min(upper, bound)
        if upper <= factor * estimate or process.ended:
            break
        if below is not None and (min(upper, frobenius) <= below or estimate > below):
            break
    upper += process.rounding
    certain = frobenius <= upper
    return TwoNorm(
        min(estimate, frobenius),
        min(upper, frobenius),
        1.0 if certain else confidence,
        process.products,
    )


class _Bidiagonal:
    """Golub-Kahan steps of every start, orthogonalized against all earlier vectors."""

    def __init__(self, A: Operator, minus: Operator | None, starts: int, seed: int) -> None:
        self.A, self.minus = A, minus
        v = np.random.default_rng(checks.count("seed", seed, least=0)).standard_normal(
            (A.shape[1], starts)
        )
        self.vs, self.us = [v / np.linalg.norm(v, axis=0)], []
        self.alphas, self.betas = np.zeros((0, starts)), np.zeros((0, starts))  # (steps, starts)
        self.products, self._size = 0, 0.0

    @property
    def ended(self) -> bool:
        """Whether the vectors of every start span all that A does to it."""
        return not np.any(self.betas[-1])

    @property
    def rounding(self) -> float:
        """What float32 leaves uncertain of the norm."""
        return math.sqrt(max(self.A.shape)) * _UNIT * self._size

    def step(self) -> None:
        """One more vector on each side."""
        u = _orthogonal(self._product(self.vs[-1], transpose=False), self.us)
        self.us.append(self._append("alphas", u))
        v = _orthogonal(self._product(self.us[-1], transpose=True), self.vs)
        self.vs.append(self._append("betas", v))

    def _append(self, name: str, vector: np.ndarray) -> np.ndarray:
        """Keep the length of `vector`; returns it as a unit vector, zero where only rounding is left."""
        length = np.linalg.norm(vector, axis=0)
        length[length <= _UNIT * self._size] = 0.0
        setattr(self, name, np.vstack([getattr(self, name), length]))
        return np.divide(vector, length, out=np.zeros_like(vector), where=length > 0.0)

    def _product(self, x: np.ndarray, transpose: bool) -> np.ndarray:
        self.products += 1
        product, size = np.zeros(1), 0.0
        for operator, sign in ((self.A, 1.0), (self.minus, -1.0)):
            if operator is not None:
                apply = operator.apply_transpose if transpose else operator.apply
                term = apply(operator.device.upload(x)).get().astype(np.float64)
                size += float(np.linalg.norm(term, axis=0).max())
                product = product + sign * term
        self._size = max(self._size, size)
        return product

    def bounds(self, least: float) -> tuple[float, float]:
        """Bounds on the norm by all starts together, where one has an overlap of `least` (squared)."""
        pairs = [_bounds(a, b, least) for a, b in zip(self.alphas.T, self.betas.T, strict=True)]
        return max(lower for lower, _ in pairs), max(upper for _, upper in pairs)


def _orthogonal(x: np.ndarray, basis: list[np.ndarray]) -> np.ndarray:
    """X without its parts along the unit vectors of `basis`, column by column; twice is enough."""
    for _ in range(2):
        for v in basis:
            x = x - v * np.einsum("nk,nk->k", v, x)
    return x


def _bounds(alphas: np.ndarray, betas: np.ndarray, least: float) -> tuple[float, float]:
    """(lower, upper) bound of one start from its bidiagonal matrix."""
    steps = len(alphas)
    ended = np.flatnonzero((alphas == 0.0) | (betas == 0.0))
    if len(ended):  # A^T A maps the span of the first vectors into itself
        steps = int(ended[0]) + 1
    B = np.diag(alphas[:steps]) + np.diag(betas[: steps - 1], 1)
    lower = float(np.linalg.norm(B, 2))
    if len(ended) or lower == 0.0:
        return lower, lower
    inside, outside = lower**2, 4.0 * lower**2
    a, b = alphas.tolist(), betas.tolist()
    while not _exceeds(outside, a, b, 1.0 / least):
        inside, outside = outside, 4.0 * outside
    for _ in range(20):
        middle = math.sqrt(inside * outside)
        if _exceeds(middle, a, b, 1.0 / least):
            outside = middle
        else:
            inside = middle
    return lower, math.sqrt(outside)


def _exceeds(x: float, alphas: list[float], betas: list[float], limit: float) -> bool:
    """Whether p_0(x)^2 + ... + p_k(x)^2 > `limit`, of the orthonormal polynomials by their recurrence."""
    earlier, now, total, link, beta = 0.0, 1.0, 1.0, 0.0, 0.0
    for a, b in zip(alphas, betas, strict=True):
        earlier, now = now, ((x - a * a - beta * beta) * now - link * earlier) / (a * b)
        total, link, beta = total + now * now, a * b, b
        if total > limit:  # the sum only grows, perhaps beyond what a float holds
            return True
    return False
