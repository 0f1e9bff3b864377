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

    `format` ("tiles"; "csr" where none were made), `width` and `precision` are of the core; of a sum, of the
    coefficients first. `kept` numbers in a row take `nbytes`, and a product of a solve so many `launches`.
    `error` is an upper bound on the 2-norm of R~ - R, rounding included; None where the basis was `left`
    before, and why.
    """

    basis: str
    format: str
    width: int
    precision: str
    kept: float
    nbytes: int
    launches: int
    error: float | None
    left: str = ""


@dataclass(frozen=True, kw_only=True)
class ChannelCompression(Trial):
    """One colour channel: what was taken, of the whole R.

    Attributes
    ----------
    threshold : float
        Numbers below it were dropped.
    dropped : float
        Frobenius norm of all that was dropped; of a sum, and where memory was short, a bound.
    quantisation : float
        Frobenius norm of what rounding of the core changed; of a sum, a bound on it.
    inverse_norm, solution_error : float
        Upper bound on the 2-norm of S~^-1; its product with `error` bounds ``||x~ - x|| / ||x||``.
    confidence : float
        That the bounds of all channels hold, over the random starts of the norms.
    trials : tuple of Trial
    """

    threshold: float
    dropped: float
    quantisation: float
    inverse_norm: float
    solution_error: float
    confidence: float
    trials: tuple[Trial, ...]


@dataclass(frozen=True)
class Compression:
    """How a compressed transport was made; its ``.compression``.

    `rtol` and `budget` are as allowed, `uncompressed` the bytes of T before (of rows, in float32), `window`
    (h, w) the pixels that bases were tried on, and `channels` 1 or 3 `ChannelCompression`.
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
