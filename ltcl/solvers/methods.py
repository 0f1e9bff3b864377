# SPDX-License-Identifier: BSD-3-Clause
"""Methods by name, and their options."""

from __future__ import annotations

import dataclasses
from typing import Any

from ltcl.errors import InputTypeError
from ltcl.solvers import sampled
from ltcl.solvers.bicgstab import BiCGStab
from ltcl.solvers.block_gauss_seidel import BlockGaussSeidel
from ltcl.solvers.cg import CG
from ltcl.solvers.chebyshev import Chebyshev
from ltcl.solvers.direct import Direct
from ltcl.solvers.gauss_seidel import GaussSeidel
from ltcl.solvers.gmres import GMRES
from ltcl.solvers.hybrid import Hybrid
from ltcl.solvers.jacobi import Jacobi
from ltcl.solvers.monte_carlo import MonteCarlo
from ltcl.solvers.neumann import Neumann
from ltcl.solvers.richardson import Richardson
from ltcl.solvers.sor import SOR
from ltcl.solvers.southwell import Southwell

ITERATIVE = {
    method.name: method
    for method in (
        Jacobi,
        Neumann,
        Richardson,
        Chebyshev,
        GaussSeidel,
        SOR,
        BlockGaussSeidel,
        Southwell,
        CG,
        GMRES,
        BiCGStab,
    )
}
SAMPLED = {method.name: method for method in (MonteCarlo, Hybrid)}
KINDS: dict[str, Any] = {**ITERATIVE, **SAMPLED, Direct.name: Direct}
METHODS: tuple[str, ...] = (*KINDS, "auto")


def method(name: str, options: dict[str, Any]) -> Any:
    """The method with its options, None of "auto"; an unknown option is named, with those there are."""
    sampled.check_method(name, options, SAMPLED)
    if name == "auto":
        if options:
            raise InputTypeError(f"unknown option {next(iter(options))!r}; name a method to give it options")
        return None
    kind = KINDS[name]
    known = [field.name for field in dataclasses.fields(kind)]
    for option in options:
        if option not in known:
            has = f"has {', '.join(known)}" if known else "has none"
            raise InputTypeError(f"unknown option {option!r}; method {name!r} {has}")
    return kind(**options)
