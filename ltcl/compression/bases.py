# SPDX-License-Identifier: BSD-3-Clause
"""Bases in which R is written, by name, and R~ in one of them as the device has it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.compression.coefficients import (
    Coefficients,
    Progress,
    coefficients,
    on_host,
    sparse_plus_wavelet,
)
from ltcl.compression.norms import estimate_norm
from ltcl.compression.sources import Problem
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    Basis,
    Chained,
    Compressed,
    SubsetBasis,
    Sum,
    Tiles,
    Wavelet,
    basis,
    multiresolution_order,
    restrict_to_support,
    smallest,
)
from ltcl.operators.packing import Packed, pack
from ltcl.operators.wavelets import filters

PIXELS, ROWS, SUM = "pixels", " rows", " + pixels"
INVERSE_NAMES = ("db2", "haar", "db4", PIXELS)
NAMES = (*INVERSE_NAMES, f"db2{SUM}")  # compared where none is named, in this order
_TRANSFORM = 4  # launches of a wavelet transform, all levels


@dataclass(frozen=True)
class Bases:
    """R = out^T C into; None is pixels. Of a sum, R = P + out^T C into, P sparse."""

    name: str
    out: Basis | None
    into: Basis | None

    @property
    def is_sum(self) -> bool:
        """Whether sharp parts stay in pixels."""
        return self.name.endswith(SUM)

    @property
    def launches(self) -> int:
        """Of a product in a solve, which runs on the core alone where both sides have one basis."""
        if self.out is self.into and not self.is_sum:
            return 1
        return 2 * _TRANSFORM + 2 if self.is_sum else _TRANSFORM + 1

    def gather(
        self, problem: Problem, drop: float, most: int | None = None, progress: Progress | None = None
    ) -> Coefficients:
        """All of R but at most the Frobenius norm `drop`, or `most` numbers, which a sum ignores."""
        R, options = problem.R, {"memory": problem.R.memory, "progress": progress}
        if self.is_sum and self.into is not None:
            return sparse_plus_wavelet(R, self.into, drop, **options)
        return coefficients(R, on_host(self.out), on_host(self.into), drop=drop, most=most, **options)


def validate_names(names: Any, *, for_inverse: bool = False) -> list[str]:
    """Names of one way to write R or of several, as a list."""
    names = [names] if isinstance(names, str) else names
    if not isinstance(names, (list, tuple)):
        raise InputTypeError(f"basis is {names!r}; it must be a name, such as {', '.join(NAMES)}, or a list")
    if not names:
        raise InputError("basis is empty; it must name at least one")
    for name in names:
        if not isinstance(name, str):
            raise InputTypeError(f"basis is {name!r}; it must be a name, such as {', '.join(NAMES)}")
        if for_inverse and name.endswith((ROWS, SUM)):
            raise InputError(f"basis is {name!r}; an inverse needs one basis on both sides, such as 'db2'")
        try:
            if name != PIXELS:
                filters(_wavelet(name))
        except InputError as error:
            raise InputError(
                f"basis is {name!r}; it must be pixels, or an orthonormal wavelet such as haar, db2 or db4, "
                "with ' rows' behind it for rows alone, or ' + pixels' for a sum of both"
            ) from error
    return list(names)


def make_bases(device: Device, grid: tuple[int, int], name: str) -> Bases:
    """Those of a name, on a grid."""
    W = basis(device, grid, _wavelet(name))
    if isinstance(W, Wavelet):  # large coefficients then lie side by side, in fewer tiles
        order = multiresolution_order(grid, W.levels)
        W = Chained(SubsetBasis(device, grid, order, "relatives"), W)
    return Bases(name, None if name.endswith(ROWS) else W, W)


def _wavelet(name: str) -> str:
    return name.removesuffix(ROWS) if name.endswith(ROWS) else name.removesuffix(SUM)


@dataclass(frozen=True)
class Stored:
    """Numbers of R~ as tiles between bases: C, and P of a sum before it."""

    device: Device
    cores: list[Packed]
    out: Basis | None
    into: Basis | None

    @property
    def nbytes(self) -> int:
        """Bytes of the numbers, without what transposed products will add."""
        return sum(core.nbytes for core in self.cores)

    @property
    def quantisation(self) -> float:
        """Frobenius norm of what rounding changed; of a sum, a bound on it."""
        return math.fsum(core.difference[0] for core in self.cores)

    @property
    def precision(self) -> str:
        """Of the numbers; of a sum, where they differ, those of the coefficients first."""
        return " + ".join(dict.fromkeys(core.precision for core in reversed(self.cores)))

    def operator(self, error: float = 0.0, diagonal: np.ndarray | None = None) -> Compressed | Sum:
        """R~ on the device; the `error` and the `diagonal` (N,) of R become those of R~."""
        *sharp, C = (Tiles(self.device, core) for core in self.cores)
        if not sharp:
            return Compressed(C, self.out, self.into, error=error, diagonal=diagonal)
        rest = None if diagonal is None else diagonal - sharp[0].diagonal()
        smooth = Compressed(C, self.out, self.into, error=error, diagonal=rest)
        return Sum(Compressed(sharp[0], None, None, error=0.0), smooth)


def store(device: Device, bases: Bases, kept: Coefficients, allowance: float) -> Stored:
    """R~ of coefficients, in the tiles of fewest bytes whose rounding has about the 2-norm `allowance`.

    Where both sides have one basis, its coefficients that the core does not touch are left out.
    """
    parts, (out, into) = kept.parts(), (bases.out, bases.into)
    if out is into and into is not None and not bases.is_sum:
        core, out = restrict_to_support(parts[0], into)
        parts, into = [core], out
    return Stored(device, [quantize(part, allowance / len(parts)) for part in parts], out, into)


def quantize(C: scipy.sparse.csr_array, allowance: float) -> Packed:
    """C in the tiles of fewest bytes whose rounding has a 2-norm of at most about `allowance`.

    That norm is estimated; who hands out the tiles measures what they are worth.
    """
    size = float(np.linalg.norm(C.data.astype(np.float64)))
    frobenius = allowance * math.sqrt(len(C.indptr) - 1)  # or less: the 2-norm of rounding is far below
    while True:
        width, precision = smallest(C, frobenius / size if size else 0.0)
        packed = pack(C, width, precision)
        if precision == "float32" or packed.difference[1] <= allowance:
            return packed
        if estimate_norm(scipy.sparse.csr_array(packed.matrix() - C))[0] <= allowance:
            return packed
        frobenius = 0.5 * packed.difference[0]
