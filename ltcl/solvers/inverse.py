# SPDX-License-Identifier: BSD-3-Clause
"""S^-1 = I - A, kept: a solution is one product, x = b - A b, and its error was bounded when A was made.

A is one physical bounce of the scene (eq. 4 and 6), sparser than R = A + A^2 + ...; by
`ltcl.invert`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import InputError
from ltcl.operators import IdentityPlus, Operator, stored
from ltcl.operators.interreflection import nbytes
from ltcl.solvers.bounded import inwards
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import scale_rhs, unscale
from ltcl.transport import frames as layout
from ltcl.transport.matrices import check_mixing

_ARRAYS = ("grid", "first_bounce", "errors", "confidence")


class Inverse:
    """S^-1 = I - A of every channel of a transport, on the device; `ltcl.invert` makes it.

    Parameters
    ----------
    bounces : sequence of 1 or 3 Operator, (N, N)
        A of each channel.
    errors, confidence : sequence of float, float
        Bound on ``||x~ - x|| / ||x||`` of every solution in each channel; confidence of each of these, over
        the random starts of `theory.two_norm`.
    grid, first_bounce, mixing
        As of `ltcl.Transport`; F (N,) or (channels, N) is 0 at masked pixels.

    Examples
    --------
    >>> import ltcl
    >>> inverse = ltcl.invert(ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2)))
    >>> inverse.solve([0.6, 0.6]).x.round(2).tolist()  # of S = [[1, 0.2], [0.2, 1]]
    [0.5, 0.5]
    >>> inverse.pattern([[0.3, 0.3]]).round(2).tolist()  # T makes [0.3, 0.3] of it
    [[0.5, 0.5]]
    """

    def __init__(
        self,
        bounces: Sequence[Operator],
        errors: Sequence[float],
        grid: tuple[int, int],
        first_bounce: np.ndarray,
        mixing: np.ndarray | None = None,
        confidence: float = 1.0,
    ) -> None:
        if len(bounces) not in (1, 3) or len(errors) != len(bounces):
            raise InputError(
                f"an inverse has {len(bounces)} A and {len(errors)} errors; both must be 1 or 3"
            )
        self.systems = tuple(IdentityPlus(A, sign=-1) for A in bounces)
        self._arrays, self._index = dict[str, np.ndarray](), ""  # of an unpickled one
        n = bounces[0].shape[0]
        self.grid = checks.grid("grid", grid, n)
        self.errors = tuple(checks.number("error", error, least=0.0) for error in errors)
        F = checks.finite("first_bounce", checks.real("first_bounce", first_bounce)).astype(
            np.float64
        )
        self._F = checks.shape("first_bounce", np.atleast_2d(F), (len(bounces), n))
        self.mixing = (
            None if mixing is None else check_mixing(mixing, len(bounces), has_blocks=False)
        )
        self.confidence = checks.number("confidence", confidence, above=0.0, most=1.0)

    def __repr__(self) -> str:
        (h, w), kind, size = (
            self.grid,
            {1: "grey", 3: "colour"}[self.channels],
            checks.size(self.nbytes),
        )
        shape = f"{h * w} x {h * w}, {kind}, grid {h} x {w}"
        return f"<ltcl Inverse {shape}, {size} with an error of {self.error:.2g}>"

    def __getstate__(self) -> dict[str, Any]:
        """For `pickle` and `copy.deepcopy`: numbers, and the index of the device."""
        state = dict(vars(self))
        if systems := state.pop("systems", None):
            state |= {"_arrays": stored.to_arrays(systems), "_index": self.device.description.index}
        return state

    @cached_property
    def systems(self) -> tuple[IdentityPlus, ...]:
        """I - A of each channel; of an unpickled inverse uploaded at the first use."""
        return tuple(stored.from_arrays(open_device(self._index), self._arrays))

    @property
    def channels(self) -> int:
        """1 for grey, 3 for colour."""
        return len(self.errors)

    @property
    def device(self) -> Device:
        """Where A lies."""
        return self.systems[0].device

    @property
    def A(self) -> Operator | tuple[Operator, ...]:
        """One bounce: the operator itself, or three of them in colour."""
        bounces = tuple(X.R for X in self.systems)
        return bounces[0] if self.channels == 1 else bounces

    @property
    def error(self) -> float:
        """What a solution may be off by, relative to itself, in the worst channel."""
        return max(self.errors)

    @property
    def first_bounce(self) -> np.ndarray:
        """Diagonal of F: (N,) float64, or (3, N) in colour; 0 at masked pixels."""
        return self._F[0] if self.channels == 1 else self._F

    @property
    def nbytes(self) -> int:
        """Bytes on the device; what channels share counts once."""
        return nbytes(self.systems)

    def solve(self, b: Any, channel: int = 0, *, rtol: float | None = None) -> Solution:
        """x = b - A b of b, (N,) or (N, k), by one product; no residual is computed.

        `rtol` is the relative error of x that is allowed: an InputError where that of the inverse
        is above. The status is PRECOMPUTED, `error` the bound.
        """
        start = time.perf_counter()
        self.refuse_beyond(rtol)
        if checks.count("channel", channel, least=0) >= self.channels:
            raise InputError(f"channel is {channel}; it must be below {self.channels}")
        X = self.systems[channel]
        light, unit = scale_rhs(b, X.shape[0])
        x = unscale(X.apply(X.device.upload(light)).get(), unit)
        spent, error = time.perf_counter() - start, self.errors[channel]
        return Solution(x, Status.PRECOMPUTED, 1, 1, (math.nan,), spent, "precomputed", error=error)

    def pattern(
        self,
        desired: Any,
        *,
        bounds: tuple[float, float] = (0.0, 1.0),
        background: float = 0.0,
        gain: float = 1.0,
    ) -> np.ndarray:
        """The projector pattern for a picture or frames of a video, by one product a channel.

        l_in = F^-1 (b - A b) of b = gain * desired - background, float32, clamped to the bounds,
        which other pixels do not make up for; `ltcl.compensate`, whose options these are, does.
        `background` is a number.
        """
        low, high = checks.interval("bounds", bounds)
        gain, dark = checks.number("gain", gain, above=0.0), checks.number("background", background)
        columns, shape = layout.unpack("desired", desired, self.grid, self.channels)
        solved = [self.solve(gain * b - dark, channel).x for channel, b in enumerate(columns)]
        light = layout.to_light(solved, self._F, self.mixing)
        limited = [np.clip(p.astype(np.float32), *inwards(low, high)) for p in light]
        lit = [
            np.where(f[:, None] > 0.0, p, np.float32(0))
            for p, f in zip(limited, self._F, strict=True)
        ]
        return shape.pack(lit, self.grid)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays by name, as files hold them; `from_arrays` makes the same of them, to the bit."""
        own = dict(zip(_ARRAYS, (self.grid, self._F, self.errors, self.confidence), strict=True))
        own |= {} if self.mixing is None else {"mixing": self.mixing}
        return {name: np.array(value) for name, value in own.items()} | stored.to_arrays(
            self.systems
        )

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], device: Device | str | None = None
    ) -> Inverse:
        """Of what `to_arrays` gave, on a device that is opened at once; InputError where they do not fit."""
        for name in _ARRAYS:
            if name not in arrays:
                raise InputError(f"an inverse has the array {name!r}, which is missing")
        systems = stored.from_arrays(open_device(device), arrays)
        if any(X.sign != -1.0 for X in systems):
            raise InputError("the operators are I + R; those of an inverse are I - A")
        errors, F = np.ravel(arrays["errors"]).tolist(), arrays["first_bounce"]
        grid = checks.shape("grid", arrays["grid"], (2,)).tolist()
        confidence = float(checks.shape("confidence", arrays["confidence"], ()))
        return cls([X.R for X in systems], errors, grid, F, arrays.get("mixing"), confidence)

    def refuse_beyond(self, rtol: float | None) -> None:
        """Refuse a tolerance that is below the error."""
        if rtol is not None and checks.number("rtol", rtol, least=0.0, below=1.0) < self.error:
            raise InputError(
                f"rtol is {rtol:g}, but what this inverse gives may be off by {checks.upwards(self.error)}; "
                "ask for no less, or make a better one with ltcl.invert(T, rtol=...)"
            )
