# SPDX-License-Identifier: BSD-3-Clause
"""S^-1 = I - A, prepared once: a solution is one product, x = b - A b, with a known error bound.

A is one physical bounce of the scene (eq. 4 and 6), sparser than R = A + A^2 + ...; `ltcl.invert`
computes it.
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
from ltcl.device.arrays import round_inwards
from ltcl.errors import InputError
from ltcl.operators import IdentityPlus, Operator, stored
from ltcl.operators.interreflection import nbytes
from ltcl.solvers.problem import scale_rhs, unscale
from ltcl.solvers.result import Solution, Status
from ltcl.transport import frames as layout
from ltcl.transport.matrices import check_mixing

_ARRAYS = ("grid", "first_bounce", "errors", "confidence")


class Inverse:
    """S^-1 = I - A of every channel of a transport, on the device; `ltcl.invert` computes it.

    Parameters
    ----------
    bounces : sequence of 1 or 3 Operator, (N, N)
        A of each channel.
    errors, confidence : sequence of float, float
        Bound on ``||x~ - x|| / ||x||`` of every solution in each channel; confidence of each bound,
        over the random starts of `theory.two_norm`.
    grid, first_bounce, mixing
        The same as in `ltcl.Transport`; F (N,) or (channels, N) is 0 at masked pixels.

    Raises
    ------
    InputError
        Neither 1 nor 3 channels, or arrays that do not fit these.

    Examples
    --------
    >>> import ltcl
    >>> inverse = ltcl.invert(ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2)))
    >>> inverse.solve([0.6, 0.6]).x.round(2).tolist()  # of S = [[1, 0.2], [0.2, 1]]
    [0.5, 0.5]
    >>> inverse.pattern([[0.3, 0.3]]).round(2).tolist()  # T turns it into [0.3, 0.3]
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
        channels = len(bounces)
        if channels not in (1, 3) or len(errors) != channels:
            raise InputError(
                f"an inverse has {channels} A and {len(errors)} errors; both must be 1 or 3"
            )
        self.systems = tuple(IdentityPlus(A, sign=-1) for A in bounces)
        # The arrays and the device of an unpickled inverse.
        self._arrays = dict[str, np.ndarray]()
        self._index: str | None = ""
        n = bounces[0].shape[0]
        self.grid = checks.grid("grid", grid, n)
        self.errors = tuple(checks.number("error", error, least=0.0) for error in errors)
        F = checks.finite("first_bounce", checks.real("first_bounce", first_bounce))
        F = np.atleast_2d(F.astype(np.float64))
        self._F = checks.shape("first_bounce", F, (channels, n))
        self.mixing = None
        if mixing is not None:
            self.mixing = check_mixing(mixing, channels, has_blocks=False)
        self.confidence = checks.number("confidence", confidence, above=0.0, most=1.0)

    def __repr__(self) -> str:
        h, w = self.grid
        kind = "grey" if self.channels == 1 else "colour"
        shape = f"{h * w} x {h * w}, {kind}, grid {h} x {w}"
        size = checks.size(self.nbytes)
        return f"<ltcl Inverse {shape}, {size} with an error of {self.error:.2g}>"

    def __getstate__(self) -> dict[str, Any]:
        """Return numbers, and the index of the device, for `pickle` and `copy.deepcopy`."""
        state = dict(vars(self))
        systems = state.pop("systems", None)
        if systems:
            state["_arrays"] = stored.to_arrays(systems)
            state["_index"] = self.device.description.index
        return state

    def forget_device(self) -> None:
        """Let an unpickled inverse open the default device where it is, at its first use."""
        self._index = None

    @cached_property
    def systems(self) -> tuple[IdentityPlus, ...]:
        """I - A of each channel; an unpickled inverse uploads them at the first use."""
        return tuple(stored.from_arrays(open_device(self._index), self._arrays))

    @property
    def channels(self) -> int:
        """1 for grey, 3 for colour."""
        return len(self.errors)

    @property
    def device(self) -> Device:
        """The device of A."""
        return self.systems[0].device

    @property
    def A(self) -> Operator | tuple[Operator, ...]:
        """The first bounce: the operator itself, or three of them in colour."""
        bounces = tuple(system.R for system in self.systems)
        return bounces[0] if self.channels == 1 else bounces

    @property
    def error(self) -> float:
        """Bound on the relative error of a solution, in the worst channel."""
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
        """Compute x = b - A b for b, (N,) or (N, k), by one product; no residual is computed.

        `rtol` is the relative error of x that is allowed: an InputError if the error of the inverse
        is above it. The status is PRECOMPUTED, `error` the bound.
        """
        start = time.perf_counter()
        self.refuse_beyond(rtol)
        if checks.count("channel", channel, least=0) >= self.channels:
            raise InputError(f"channel is {channel}; it must be below {self.channels}")
        system = self.systems[channel]
        light, unit = scale_rhs(b, system.shape[0])
        product = system.apply(system.device.upload(light))
        x = unscale(product.get(), unit)
        return Solution(
            x=x,
            status=Status.PRECOMPUTED,
            iterations=1,
            products=1,
            residuals=(math.nan,),
            seconds=time.perf_counter() - start,
            method="precomputed",
            error=self.errors[channel],
        )

    def pattern(
        self,
        desired: Any,
        *,
        bounds: tuple[float, float] = (0.0, 1.0),
        background: float = 0.0,
        gain: float = 1.0,
    ) -> np.ndarray:
        """Compute the projector pattern for a picture or a video, by one product a channel.

        l_in = F^-1 (b - A b) for b = gain * desired - background, float32, clamped to the bounds.
        Other pixels do not make up for what the bounds cut; `ltcl.compensate`, whose options these
        are, does that. `background` is a number.
        """
        low, high = checks.interval("bounds", bounds)
        gain = checks.number("gain", gain, above=0.0)
        dark = checks.number("background", background)
        columns, shape = layout.unpack("desired", desired, self.grid, self.channels)
        solved = []
        for channel, b in enumerate(columns):
            solved.append(self.solve(gain * b - dark, channel).x)

        lowest, highest = round_inwards(low, high)
        patterns = []
        light = layout.to_light(solved, self._F, self.mixing)
        for p, f in zip(light, self._F, strict=True):
            clipped = np.clip(p.astype(np.float32), lowest, highest)
            patterns.append(np.where(f[:, None] > 0.0, clipped, np.float32(0)))
        return shape.pack(patterns, self.grid)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return plain arrays by name, as files hold them; `from_arrays` restores every bit."""
        values = (self.grid, self._F, self.errors, self.confidence)
        arrays = {name: np.array(value) for name, value in zip(_ARRAYS, values, strict=True)}
        if self.mixing is not None:
            arrays["mixing"] = np.array(self.mixing)
        return arrays | stored.to_arrays(self.systems)

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], device: Device | str | None = None
    ) -> Inverse:
        """Restore the inverse of `to_arrays`, on a device that is opened at once.

        InputError if the arrays do not fit.
        """
        for name in _ARRAYS:
            if name not in arrays:
                raise InputError(f"an inverse has the array {name!r}, which is missing")
        systems = stored.from_arrays(open_device(device), arrays)
        if any(system.sign != -1.0 for system in systems):
            raise InputError("the operators are I + R; those of an inverse are I - A")
        grid = checks.shape("grid", arrays["grid"], (2,)).tolist()
        confidence = checks.shape("confidence", arrays["confidence"], ())
        return cls(
            [system.R for system in systems],
            np.ravel(arrays["errors"]).tolist(),
            grid,
            arrays["first_bounce"],
            arrays.get("mixing"),
            confidence=float(confidence),
        )

    def refuse_beyond(self, rtol: float | None) -> None:
        """Refuse a tolerance that is below the error."""
        if rtol is None:
            return
        if checks.number("rtol", rtol, least=0.0, below=1.0) < self.error:
            error = checks.upwards(self.error)
            raise InputError(
                f"rtol is {rtol:g}, but what this inverse gives may be off by {error}; "
                "ask for no less, or make a better one with ltcl.invert(T, rtol=...)"
            )
