# SPDX-License-Identifier: BSD-3-Clause
"""The polynomial that walks of Monte Carlo sample where the series of eq. 10 does not converge."""

from __future__ import annotations

import math

import numpy as np

from ltcl.errors import InputError
from ltcl.operators.walks import Lengths, whole
from ltcl.solvers.polynomials import bias_in_words, chebyshev_bias, chebyshev_coefficients, chebyshev_degree
from ltcl.solvers.target_error import MOST
from ltcl.theory.walks import noise_of_terms

HIGHEST = 10_000  # degree: walks are as long
USUAL = 256  # samples of a pixel
_LOUDEST = 2.0**63  # noise of a sample whose square float32 still holds


def sampled_terms(
    bounds: tuple[float, float],
    sign: float,
    rtol: float,
    moments: float,
    degree: int | None,
    samples: int | None,
    fixed: bool,
) -> tuple[float, Lengths, str, float]:
    """Chebyshev's, to the degree given, or to that of rtol where noise leaves anything of it.

    Parameters
    ----------
    bounds : (lower, upper)
        Of the spectrum of S = I + sign R.
    sign, rtol : float
    moments : float
        Growth of the second moments of weights in a step.
    degree, samples : int, optional
        As given to the method.
    fixed : bool
        Whether a pixel takes `samples`, and not as many as a standard error needs.

    Returns
    -------
    (c_0, lengths, reason, bias)
        The coefficient of the light itself, the terms that walks estimate, both in words, and what the terms
        left out may add to x, relative to the light.

    Raises
    ------
    InputError
        A degree that is too high, or terms whose noise is.
    """
    given, lower = degree, "raise rtol=" if degree is None else "lower degree="
    degree = max(1, chebyshev_degree(rtol, bounds)) if degree is None else degree
    if degree > HIGHEST:
        raise InputError(
            f"rtol is {rtol:g}, which takes a degree of {degree}; degree= must be at most {HIGHEST}"
        )
    c = chebyshev_coefficients(degree, bounds, lower) * sign ** np.arange(degree + 1)
    most = samples or (USUAL if fixed else MOST)
    noise = noise_of_terms(c, moments) / math.sqrt(most)
    if given is None and not noise < 1.0:
        instead = "or use series='neumann'" if moments < 1.0 else "or use method='chebyshev'"
        raise InputError(
            f"samples is {most}; of the polynomial of degree {degree} that rtol={rtol:g} asks for they "
            f"leave noise of about {noise:.2g} times b: give a lower degree=, more samples=, {instead}"
        )
    if not noise * math.sqrt(most) <= _LOUDEST:
        raise InputError(
            f"degree is {degree}; its terms over this R are beyond float32: {lower}, or use "
            "method='chebyshev'"
        )
    reason = f"Chebyshev series of degree {degree}, which leaves {bias_in_words(degree, bounds)}"
    if fixed:  # else nobody knows how many samples there will be
        reason += f", and noise of about {noise:.2g} times b with {most} samples"
    return float(c[0]), whole(c[1:]), reason, chebyshev_bias(degree, bounds) / bounds[0]
