# SPDX-License-Identifier: BSD-3-Clause
"""What a compression reports: what was tried, what was taken, and what it may cost."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from ltcl import checks


@dataclass(frozen=True)
class Trial:
    """One way to write R, tried on a window of pixels or on the whole.

    Attributes
    ----------
    basis : str
        "pixels", "hilbert", a wavelet for both sides, or one with " rows" or " + pixels" behind it.
    format, width, precision : str, int, str
        Of the core: "csr" or "tiles"; neighbouring columns of a tile; of its numbers. Of a sum, where they
        differ, that of the coefficients and that of pixels, "tiles + csr"; the width is of the coefficients.
    kept : float
        Numbers in a row.
    nbytes : int
        Of the core.
    error : float or None
        Upper bound on the 2-norm of R~ - R, before rounding of the core; None where it was left before.
    seconds : float or None
        A product in a solve took; None where nothing was timed.
    left : str
        Why it was left before a core was made; empty otherwise.
    """

    basis: str
    format: str
    width: int
    precision: str
    kept: float
    nbytes: int
    error: float | None
    seconds: float | None
    left: str = ""


@dataclass(frozen=True)
class ChannelCompression:
    """One colour channel.

    Attributes
    ----------
    basis, format, width, precision, kept, nbytes, seconds
        As of a `Trial`, of the whole R.
    threshold : float
        Numbers below it were dropped.
    dropped : float
        Frobenius norm of all that was dropped; a bound where `dropped_between` is above 0.
    dropped_between : float
        The part of it that was dropped between the passes over rows and columns.
    quantisation : float
        Frobenius norm of what rounding of the core changed; of a sum, a bound on it.
    error, error_estimate : float
        Upper bound on the 2-norm of R~ - R, rounding included, and an estimate of it from below.
    inverse_norm : float
        Upper bound on the 2-norm of S~^-1.
    solution_error : float
        Their product: bound on ``||x~ - x|| / ||x||`` for every picture.
    confidence : float
        That the bounds hold, over the random starts of the norms.
    trials : tuple of Trial
    """

    basis: str
    format: str
    width: int
    precision: str
    kept: float
    nbytes: int
    seconds: float | None
    threshold: float
    dropped: float
    dropped_between: float
    quantisation: float
    error: float
    error_estimate: float
    inverse_norm: float
    solution_error: float
    confidence: float
    trials: tuple[Trial, ...]


@dataclass(frozen=True)
class Compression:
    """How a compressed transport was made; its ``.compression``.

    Attributes
    ----------
    rtol : float
        The error of the solution that was allowed.
    budget : int or None
        Bytes of all cores that were allowed.
    uncompressed : int
        Bytes of T as it was; of rows, in float32.
    window : (h, w)
        The pixels that bases were tried on.
    seconds : float
        It took.
    channels : tuple of 1 or 3 ChannelCompression
    """

    rtol: float
    budget: int | None
    uncompressed: int
    window: tuple[int, int]
    seconds: float
    channels: tuple[ChannelCompression, ...]

    @property
    def nbytes(self) -> int:
        """Bytes of all cores."""
        return sum(channel.nbytes for channel in self.channels)

    def __str__(self) -> str:
        """In a line."""
        now, before = checks.size(self.nbytes), checks.size(self.uncompressed)
        size = f"{now} of {before}" if self.nbytes < self.uncompressed else f"{now}, more than T's {before}"
        bases = ", ".join(dict.fromkeys(channel.basis for channel in self.channels))
        error = max(channel.solution_error for channel in self.channels)
        return f"{size}, in {bases}, solutions within {checks.upwards(error)}"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and dicts for JSON."""
        return {**dataclasses.asdict(self), "nbytes": self.nbytes}
