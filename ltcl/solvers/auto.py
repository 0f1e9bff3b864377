# SPDX-License-Identifier: BSD-3-Clause
"""Choosing a method from what is known of S before the first step, and saying why.

Row sums tell whether the plain iteration is best; else a survey of three products, kept with S, tells which
method needs fewest. All count products, where most of the time goes; of equals, Chebyshev waits least.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import theory
from ltcl.errors import InputError
from ltcl.operators import IdentityPlus, Operator
from ltcl.operators.rows import RowOperator
from ltcl.solvers import direct
from ltcl.solvers.cg import CG
from ltcl.solvers.chebyshev import Chebyshev
from ltcl.solvers.direct import Direct
from ltcl.solvers.gmres import GMRES
from ltcl.solvers.jacobi import Jacobi
from ltcl.solvers.survey import Survey, known, survey

SMALL = 512  # pixels: below, a dense factorization takes less time than launching kernels
LARGEST_DIRECT = 8192  # pixels: above, a dense factorization is no help in need any more
_PRECISE = 1e-6  # relative residual that float32 products reach for certain

# Rough, for the choice between them only: float64 LAPACK on a few cores, and what memory gives.
_FLOPS = 5e10
_BYTES = {True: 2e10, False: 2e12}  # by whether the device is a CPU
_AT_ONCE = 8  # right-hand sides in one product


@dataclass(frozen=True)
class Choice:
    """A method to try next, why in words, and the products that it took to know."""

    method: Any
    why: str = ""
    products: int = 0


def plan(S: Operator, rtol: float, columns: int = 1) -> Iterator[Choice]:
    """The methods to try for S x = b to `rtol`, `columns` right-hand sides at once, in order.

    Each next one is for the case that those before failed.
    """
    n = S.shape[0]
    if n <= SMALL:
        yield Choice(Direct(), f"{n} pixels are few enough for a dense factorization")
        return
    if rtol < _PRECISE:
        yield Choice(Direct(), f"rtol={rtol:g} is below what float32 products reach")
        return
    rho = float(np.max(np.abs(S.row_sums() - 1.0)))
    if not math.isfinite(rho):
        yield Choice(GMRES(), "row sums of S leave float32")
        return
    plain = theory.series_products(rho, rtol)
    chebyshev = theory.chebyshev_products(*theory.free_bounds(S), rtol)
    if plain <= chebyshev:
        why = f"row sums of R are at most {rho:.2g}: {plain} products, chebyshev {chebyshev}"
        yield Choice(Jacobi(), why)
    yield from _surveyed(S, rtol, columns)


def _surveyed(S: Operator, rtol: float, columns: int) -> Iterator[Choice]:
    """The method with the fewest products after a survey of S, then those that ask for less."""
    before = known(S)
    found = survey(S)
    spent = 0 if before else found.products
    first, why, products = _fewest(found, rtol)
    part = _direct_part(S, products, columns)
    if part < 1.0:
        share = f"a factorization takes {part:.2g} of the time of {products:g} products for each"
        yield Choice(Direct(), f"{why}; {columns} right-hand side(s): {share}", spent)
        why, spent = "", 0
    yield Choice(first, why, spent)
    if not isinstance(first, GMRES):
        yield Choice(GMRES())
    if _has_transpose(S):
        yield Choice(CG(normal=True), products=1)
    if S.shape[0] <= LARGEST_DIRECT and part >= 1.0:
        yield Choice(Direct())


def _fewest(found: Survey, rtol: float) -> tuple[Any, str, float]:
    """The method, the reason and the products foreseen."""
    krylov = found.krylov_products(rtol)
    least, most = np.min(np.real(found.ritz), initial=np.inf), np.max(np.real(found.ritz), initial=-np.inf)
    seen = f"{found.products} Arnoldi steps see eigenvalues of S from {least:.2g} to {most:.2g}"
    if not found.in_an_interval:
        shape = f"imaginary parts up to {found.imaginary:.2g}, {found.defect:.0%} of R not self-adjoint"
        return GMRES(), f"{seen}, {shape}: gmres needs no bounds on them", krylov
    chebyshev, products = _chebyshev(found, rtol)
    other = CG() if found.self_adjoint else GMRES()
    how = (
        f"R is self-adjoint to {found.defect:.1g}"
        if found.self_adjoint
        else f"{found.defect:.0%} of R is not self-adjoint"
    )
    forecast = f"chebyshev {products} products, {other.name} {krylov:g}"
    method, fewest = (other, krylov) if krylov < products else (chebyshev, products)
    return method, f"{seen}, {how}: {forecast}", fewest


def _chebyshev(found: Survey, rtol: float) -> tuple[Chebyshev, int]:
    """Chebyshev within the spectrum found, begun by two steps of GMRES where that saves products."""
    plain = theory.chebyshev_products(*found.spectrum, rtol)
    if len(found.falls) < 3:
        return Chebyshev(found.spectrum), plain
    left = rtol / found.falls[2] if found.falls[2] > rtol else 1.0
    begun = 3 + (theory.chebyshev_products(*found.spectrum, left) if left < 1.0 else 0)
    if plain <= begun:  # of equals the one without inner products
        return Chebyshev(found.spectrum), plain
    return Chebyshev(found.spectrum, arnoldi=2), begun


def _direct_part(S: Operator, products: float, columns: int) -> float:
    """Time of a dense factorization over that of so many products, roughly; infinite where there is none."""
    n, R = S.shape[0], S.R if isinstance(S, IdentityPlus) else S
    if n > LARGEST_DIRECT or not isinstance(R, RowOperator):
        return math.inf
    factorize = 0.0 if direct.known(S) else 2.0 / 3.0 * n**3
    memory = _BYTES[S.device.is_cpu]
    taken = (factorize + 4.0 * n * n * columns) / _FLOPS + 16.0 * n * n / _BYTES[True]
    return taken * memory / (products * S.nbytes * math.ceil(columns / _AT_ONCE))


def _has_transpose(S: Operator) -> bool:
    """Whether products with S^T can be had, found by trying one."""
    try:
        S.apply_transpose(S.device.upload(np.zeros(S.shape[0])))
    except InputError:
        return False
    return True
