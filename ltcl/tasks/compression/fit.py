# SPDX-License-Identifier: BSD-3-Clause
"""`Fit`: R~ of one channel in some bases, with what is known of its error, and its report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.operators import Compressed, IdentityPlus, Tiles
from ltcl.tasks.compression.basis_pairs import Bases
from ltcl.tasks.compression.coefficients import Coefficients
from ltcl.tasks.compression.inputs import CompressionProblem
from ltcl.tasks.compression.norms import MISS
from ltcl.tasks.compression.pictures import PictureError
from ltcl.theory import TwoNorm, two_norm

# Part of coefficients that went through transforms in float32 which rounding may change.
TRANSFORM_ROUNDING = 1e-6


@dataclass(frozen=True)
class Trial:
    """R in one basis, tried on a window of pixels or on the whole.

    Attributes
    ----------
    basis : str
    format : str
        Format of the core, "tiles"; "csr" where none were made.
    width, precision : int, str
        Width of a tile and precision of its numbers.
    kept : float
        Numbers kept in a row.
    nbytes : int
        Bytes of the core.
    error : float or None
        Upper bound on the 2-norm of R~ - R, rounding included; None where pictures chose, or the
        basis was left before.
    left : str
        Why the basis was left, empty where it was not.
    """

    basis: str
    format: str
    width: int
    precision: str
    kept: float
    nbytes: int
    error: float | None
    left: str = ""


@dataclass(frozen=True, kw_only=True)
class ChannelCompression(Trial):
    """The compression of one colour channel, of the whole R.

    Attributes
    ----------
    threshold : float
        Numbers below it were dropped, times the weights of columns, at least 1, unless the norm is
        "worst".
    dropped : float
        Frobenius norm of these products, so a bound on that of all dropped numbers.
    quantisation : float
        Frobenius norm of the changes by rounding of the core.
    inverse_norm : float
        Upper bound on the 2-norm of S~^-1.
    error_bound : float
        Upper bound on ``||x~ - x|| / ||x||``: `inverse_norm` times `error`.
    solution_error : float
        The error that the norm states: `error_bound`, or that of `pictures`.
    pictures : PictureError or None
        Measured losses of pictures, with a share and confidence of their own.
    confidence : float
        Confidence that the bounds of all channels hold, over the random starts of the norms.
    trials : tuple of Trial
    """

    threshold: float
    dropped: float
    quantisation: float
    inverse_norm: float
    solution_error: float
    error_bound: float
    pictures: PictureError | None
    confidence: float
    trials: tuple[Trial, ...]


@dataclass(frozen=True, repr=False)
class Compression:
    """Record of how a compressed transport was made; its ``.compression``.

    Attributes
    ----------
    rtol, norm, budget : as asked for
    uncompressed : int
        Bytes of T before; of rows, in float32.
    window : (h, w)
        The pixels that bases were tried on.
    seconds : float
    channels : tuple of 1 or 3 ChannelCompression
    """

    rtol: float | str
    norm: str
    budget: int | None
    uncompressed: int
    window: tuple[int, int]
    seconds: float
    channels: tuple[ChannelCompression, ...]

    def __repr__(self) -> str:
        bases = ", ".join(channel.basis for channel in self.channels)
        size = checks.size(self.uncompressed)
        return f"<ltcl Compression of {size} to rtol {self.rtol} in {bases}>"


@dataclass(frozen=True, kw_only=True)
class Fit:
    """R~ in some bases: the largest `numbers` of the `candidates`, rounded.

    Attributes
    ----------
    bases : Bases
    candidates, numbers : Coefficients
    R : Compressed, of Tiles
    norm : TwoNorm or None
        Norm of R~ - R, where that was measured.
    inverse : float
        Upper bound on the norm of S~^-1, or a guess where nothing confirms it.
    pictures : PictureError or None
        Losses of pictures, where they were measured.
    risk : float
        Estimated squared error of pictures, where noise decides.
    """

    bases: Bases
    candidates: Coefficients
    numbers: Coefficients
    R: Any
    norm: TwoNorm | None = None
    inverse: float
    pictures: PictureError | None = None
    risk: float = 0.0

    @property
    def nbytes(self) -> int:
        """Bytes of the core, without a transpose that products made."""
        return self.R.core.packed.nbytes

    @property
    def rows(self) -> int:
        """Rows of the core, before those that it does not touch are left out."""
        return len(self.numbers.core.indptr) - 1

    @property
    def error(self) -> float:
        """Upper bound on the 2-norm of R~ - R, infinite where it was not measured."""
        if self.norm is None:
            return math.inf
        return self.norm.upper

    @property
    def error_bound(self) -> float:
        """Upper bound on ||x~ - x|| / ||x||."""
        return self.error * self.inverse

    @property
    def solution_error(self) -> float:
        """The error that the norm states."""
        if self.pictures is not None:
            return self.pictures.error
        return self.error_bound

    def system(self, problem: CompressionProblem) -> IdentityPlus:
        """S~ as it is handed out: its errors, the diagonal of R, and a core without a transpose."""
        try:
            diagonal = problem.operator.diagonal()
        except InputError:  # an operator of the user may have none
            diagonal = None
        core = Tiles(self.R.device, self.R.core.packed)
        R = Compressed(core, self.R.out, self.R.into, error=self.error, diagonal=diagonal)
        S = IdentityPlus(R, solution_error=self.solution_error)
        S.error_bound = self.error_bound
        return S

    def trial(self) -> Trial:
        """The report of it as one of several."""
        return Trial(**self._facts())

    def report(self, trials: Sequence[Trial]) -> ChannelCompression:
        """The report of a channel that was compressed so."""
        return ChannelCompression(
            **self._facts(),
            threshold=self.numbers.threshold,
            dropped=self.numbers.dropped,
            quantisation=self.R.core.quantisation,
            inverse_norm=self.inverse,
            solution_error=self.solution_error,
            error_bound=self.error_bound,
            pictures=self.pictures,
            confidence=1.0 - MISS,
            trials=tuple(trials),
        )

    def _facts(self) -> dict[str, Any]:
        """The fields of a Trial."""
        core = self.R.core
        return {
            "basis": self.bases.name,
            "format": "tiles",
            "width": core.width,
            "precision": core.precision,
            "kept": self.numbers.core.nnz / self.rows,
            "nbytes": self.nbytes,
            "error": None if self.norm is None else self.norm.upper,
        }


def error_norm(
    problem: CompressionProblem, numbers: Coefficients, R: Any, factor: float, **start: Any
) -> TwoNorm:
    """||R~ - R||_2, bounded by what is certain of its Frobenius norm."""
    size = float(np.linalg.norm(numbers.core.data.astype(np.float64)))
    frobenius = numbers.dropped + TRANSFORM_ROUNDING * size + R.core.quantisation
    return two_norm(problem.operator, R, factor=factor, frobenius=frobenius, **start)
