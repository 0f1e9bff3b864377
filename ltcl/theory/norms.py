# SPDX-License-Identifier: BSD-3-Clause
"""The 2-norm of an operator, or of the difference of two, with an upper bound of stated confidence.

Golub-Kahan steps from a random unit vector v_1,

    A v_j = b_(j-1) u_(j-1) + a_j u_j,    A^T u_j = a_j v_j + b_j v_(j+1),

give orthonormal v_(j+1) = p_j(A^T A) v_1, with p_j of degree j. Let s be the norm, x its right
singular vector and g = <x, v_1>. The parts <x, v_(j+1)> = p_j(s^2) g have squares that sum to at
most one:

    g^2 (p_0^2 + p_1^2 + ... + p_k^2)(s^2) <= 1

Beyond the largest Ritz value the sum grows, so that g^2 >= d^2 bounds s from above. The probability
that g^2 is below d^2 is a Beta distribution, whatever A is; the probability that it is so for all
of several independent starts is the product of theirs. The largest of their bounds then holds,
after any number of steps.

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
STARTS = 8
MAX_STEPS = 48
# Bisections of a bound, in the logarithm.
BISECTIONS = 20
# Rounding of float32.
FLOAT32_ROUNDING = 2.0**-24


@dataclass(frozen=True)
class TwoNorm:
    """||A||_2.

    Attributes
    ----------
    estimate, upper : float
        A lower bound, up to rounding, and an upper one.
    confidence : float
        Confidence of the upper bound; 1 if it is a Frobenius norm, which is certain.
    products : int
        Number of products with A and with A^T, each with all starts at once.
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
    starts: int = STARTS,
    maxsteps: int = MAX_STEPS,
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
        Limit of interest: steps end also when it is clear whether the norm is at most this.
    frobenius : float
        ||A - minus||_F or an upper bound on it, if known: it is the result if it is smaller.
    starts, maxsteps, seed : int
        Number of random vectors, multiplied together as columns; largest number of steps; random
        seed.

    Returns
    -------
    TwoNorm
        The upper bound includes the rounding of float32 sums of N products: sqrt(N) units of the
        size of A and of `minus`.

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
    confidence = checks.number("confidence", confidence, above=0.0, below=1.0)
    factor = checks.number("factor", factor, above=1.0)
    starts = checks.count("starts", starts)
    maxsteps = checks.count("maxsteps", maxsteps)
    overlap = _least_overlap(A.shape[1], confidence, starts)
    process = _Bidiagonalization(A, minus, starts, seed)
    estimate = 0.0
    upper = math.inf
    for _ in range(maxsteps):
        process.step()
        estimate, bound = process.bounds(overlap)
        upper = min(upper, bound)
        if upper <= factor * estimate or process.has_ended:
            break
        if below is not None and (min(upper, frobenius) <= below or estimate > below):
            break
    upper += process.rounding
    is_certain = frobenius <= upper
    if is_certain:
        confidence = 1.0
    return TwoNorm(
        estimate=min(estimate, frobenius),
        upper=min(upper, frobenius),
        confidence=confidence,
        products=process.products,
    )


def _least_overlap(n: int, confidence: float, starts: int) -> float:
    """The <x, v>^2 that some of the random unit vectors v (n,) has with this `confidence`."""
    if n == 1:
        return 1.0
    # Every start has less with this probability.
    probability = (1.0 - confidence) ** (1.0 / starts)
    return float(scipy.special.betaincinv(0.5, 0.5 * (n - 1), probability))


class _Bidiagonalization:
    """Golub-Kahan steps of every start, orthogonalized against all earlier vectors."""

    def __init__(self, A: Operator, minus: Operator | None, starts: int, seed: int) -> None:
        self.A = A
        self.minus = minus
        random = np.random.default_rng(checks.count("seed", seed, least=0))
        v = random.standard_normal((A.shape[1], starts))
        self.vs = [v / np.linalg.norm(v, axis=0)]
        self.us: list[np.ndarray] = []
        # a_j and b_j, (steps, starts).
        self.alphas = np.zeros((0, starts))
        self.betas = np.zeros((0, starts))
        self.products = 0
        # Largest norm of a term of a product, whose rounding remains.
        self._size = 0.0

    @property
    def has_ended(self) -> bool:
        """True if the vectors of every start span all that A does to it."""
        return not np.any(self.betas[-1])

    @property
    def rounding(self) -> float:
        """Uncertainty of the norm by float32 products."""
        return math.sqrt(max(self.A.shape)) * FLOAT32_ROUNDING * self._size

    def step(self) -> None:
        """Add a vector on each side."""
        u = _orthogonalize(self._product(self.vs[-1], transpose=False), self.us)
        u, alpha = self._normalize(u)
        self.us.append(u)
        self.alphas = np.vstack([self.alphas, alpha])
        v = _orthogonalize(self._product(self.us[-1], transpose=True), self.vs)
        v, beta = self._normalize(v)
        self.vs.append(v)
        self.betas = np.vstack([self.betas, beta])

    def _normalize(self, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors and their lengths; both are 0 where only rounding is left."""
        length = np.linalg.norm(vectors, axis=0)
        length[length <= FLOAT32_ROUNDING * self._size] = 0.0
        unit = np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)
        return unit, length

    def _product(self, x: np.ndarray, transpose: bool) -> np.ndarray:
        """(A - minus) x, or its transpose, float64."""
        self.products += 1
        product, size = _multiply(self.A, x, transpose)
        if self.minus is not None:
            term, term_size = _multiply(self.minus, x, transpose)
            product = product - term
            size += term_size
        self._size = max(self._size, size)
        return product

    def bounds(self, overlap: float) -> tuple[float, float]:
        """Bounds on the norm by all starts together, of which one has this `overlap` (squared)."""
        lowest = 0.0
        highest = 0.0
        for alphas, betas in zip(self.alphas.T, self.betas.T, strict=True):
            lower, upper = _bounds(alphas, betas, overlap)
            lowest = max(lowest, lower)
            highest = max(highest, upper)
        return lowest, highest


def _multiply(operator: Operator, x: np.ndarray, transpose: bool) -> tuple[np.ndarray, float]:
    """A product in float64, and the largest norm of its columns."""
    apply = operator.apply_transpose if transpose else operator.apply
    product = apply(operator.device.upload(x)).get().astype(np.float64)
    return product, float(np.linalg.norm(product, axis=0).max())


def _orthogonalize(x: np.ndarray, basis: list[np.ndarray]) -> np.ndarray:
    """X without its parts along the unit vectors of `basis`, column by column; twice is enough."""
    for _ in range(2):
        for v in basis:
            x = x - v * np.einsum("nk,nk->k", v, x)
    return x


def _bounds(alphas: np.ndarray, betas: np.ndarray, overlap: float) -> tuple[float, float]:
    """(lower, upper) bound of one start from its bidiagonal matrix."""
    steps = len(alphas)
    zeros = np.flatnonzero((alphas == 0.0) | (betas == 0.0))
    has_ended = len(zeros) > 0
    if has_ended:
        # A^T A maps the span of the first vectors into itself.
        steps = int(zeros[0]) + 1
    B = np.diag(alphas[:steps]) + np.diag(betas[: steps - 1], 1)
    lower = float(np.linalg.norm(B, 2))
    if has_ended or lower == 0.0:
        return lower, lower
    a = alphas.tolist()
    b = betas.tolist()
    limit = 1.0 / overlap
    # Bracket the square of the bound, then bisect.
    inside = lower**2
    outside = 4.0 * lower**2
    while not _exceeds(outside, a, b, limit):
        inside = outside
        outside = 4.0 * outside
    for _ in range(BISECTIONS):
        middle = math.sqrt(inside * outside)
        if _exceeds(middle, a, b, limit):
            outside = middle
        else:
            inside = middle
    return lower, math.sqrt(outside)


def _exceeds(x: float, alphas: list[float], betas: list[float], limit: float) -> bool:
    """True if p_0(x)^2 + ... + p_k(x)^2 > `limit`, by the recurrence of orthonormal polynomials."""
    # p_(j+1) = ((x - a_j^2 - b_(j-1)^2) p_j - a_(j-1) b_(j-1) p_(j-1)) / (a_j b_j)
    previous = 0.0
    current = 1.0
    total = 1.0
    coupling = 0.0
    last_beta = 0.0
    for a, b in zip(alphas, betas, strict=True):
        following = ((x - a * a - last_beta * last_beta) * current - coupling * previous) / (a * b)
        previous = current
        current = following
        total += current * current
        coupling = a * b
        last_beta = b
        # The sum only grows, perhaps beyond what a float holds.
        if total > limit:
            return True
    return False
