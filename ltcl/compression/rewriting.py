# SPDX-License-Identifier: BSD-3-Clause
"""R of a transport as numbers in one basis on both sides, whatever form it has.

What has them is taken as it is. Anything else, a sum, wavelets on one side, cells of an adaptive scan, or
somebody's own operator, is written anew from rows that are products with it: R^ = R~ + E, so that with e of
what R~ was compressed from and e' of what is dropped now

    ||x^ - x|| <= ||x^ - x~|| + ||x~ - x|| <= (e' (1 + e) + e) ||x||.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ltcl.compression import kinds
from ltcl.compression.given import as_it_stands
from ltcl.compression.task import compress, written
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Operator, Tiles
from ltcl.transport import Transport

NORMS = 2  # measured for a compression, each a bound that may fail


@dataclass(frozen=True)
class OneBasis:
    """Systems whose R are numbers in one basis, what solutions with each may be off by; norms measured."""

    systems: tuple[IdentityPlus, ...]
    errors: tuple[float, ...]
    norms: int


def in_one_basis(
    T: Transport, share: float, rtol: float, names: Sequence[str], progress: Callable[[str, float], object]
) -> OneBasis:
    """The systems of T for solutions within `rtol`, of which what is dropped here may take a `share`."""
    ready = all(at_hand(S.R) for S in T.systems) if T.is_compressed or names == [kinds.PIXELS] else False
    norms = NORMS if T.error else 0
    if ready:
        return OneBasis(T.systems, tuple(S.solution_error for S in T.systems), norms)
    if not T.is_compressed:
        systems = compress(T, share * rtol, basis=names, progress=progress).systems
        return OneBasis(systems, tuple(S.solution_error for S in systems), NORMS)
    left = share * (rtol - T.error) / (1.0 + T.error)
    systems = written(as_it_stands(T), names, left, progress=progress)[0].systems
    errors = tuple(
        S.solution_error + new.solution_error * (1.0 + S.solution_error)
        for S, new in zip(T.systems, systems, strict=True)
    )
    return OneBasis(systems, errors, norms + NORMS)


def at_hand(R: Operator) -> bool:
    """Whether R is numbers in pixels, or in one isometric basis on both sides.

    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    >>> [at_hand(ltcl.compress(T, 0.1, basis=name).systems[0].R) for name in ("db2", "db2 rows")]
    [True, False]
    """
    if isinstance(R, Compressed) and (R.two_sided or (R.out is None and R.into is None)):
        R = R.core
    return isinstance(R, (CSR, Tiles, Dense))
