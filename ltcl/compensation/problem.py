# SPDX-License-Identifier: BSD-3-Clause
"""Compensation as least squares: min ||w (A x - b)||, x = scale * p within the projector's bounds.

Arguments of `compensate` are checked here before anything is uploaded; pictures become (M, k) a channel.
Where T = S F, A is S and the scale F, the first bounce: columns near 1, so that few products are needed.
Elsewhere the columns of T are brought to norm 1. Colour channels are one system each, or all of them one
where T couples them: then (3 N, k) arrays hold channel below channel, as `Transport.join` puts them.
"""

from __future__ import annotations

import dataclasses
import logging
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks, layout
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator, ScaledColumns, as_operator
from ltcl.solvers import monte_carlo
from ltcl.solvers.bounded import Bounded, minimise
from ltcl.solvers.solve import KINDS, METHODS, SAMPLED
from ltcl.transport import Transport

logger = logging.getLogger(__name__)

_OWN = ("bounds", "background", "gain", "loss", "weights", "exact", "inverse", "clamp", "method", "rtol")
_OPTIONS = ("atol", "maxiter", "callback", "throw")  # of `ltcl.solve`, that a solve within bounds has, too
_LEAST_LOSS = 1e-6  # a relative error that float32 resolves
_FAR = 4.0  # times the brightest pixel that was reached: the units of desired are not those of T
_UNITS = "it is taken as linear radiance in the units of T: use ltcl.images.read, or divide"
_PROBES = 16  # of the norms of columns that cannot be read: within a factor of 2, which is enough
_SLACK = 1e-6  # of the width of the bounds: rounding beyond a bound counts as inside
Columns = list[np.ndarray]  # (M, k) or (N, k) of each system


@dataclass(frozen=True, eq=False)
class System:
    """A, (M, N), and the scale (N,) float64 of its unknowns; 0 where a projector pixel lights nothing."""

    A: Operator
    scale: np.ndarray

    def to_x(self, light: np.ndarray) -> np.ndarray:
        """x of projector light, (N, k)."""
        return self.scale[:, None] * light

    def to_light(self, x: np.ndarray) -> np.ndarray:
        """Projector light of x, (N, k) float64; 0 where it lights nothing."""
        scale = self.scale[:, None]
        return np.divide(x, scale, out=np.zeros(x.shape), where=scale > 0)


@dataclass(frozen=True, eq=False)
class Limits:
    """The projector's bounds; pixels that are `masked`, (N,), stay dark whatever these are."""

    low: float
    high: float
    masked: np.ndarray

    @classmethod
    def in_float32(cls, bounds: tuple[float, float], masked: np.ndarray) -> Limits:
        """The numbers of float32 within the bounds, so that a rounded pattern does not exceed them."""
        low, high = (np.float32(bound) for bound in bounds)
        low = np.nextafter(low, np.float32(np.inf)) if float(low) < bounds[0] else low
        high = np.nextafter(high, np.float32(-np.inf)) if float(high) > bounds[1] else high
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(f"bounds is {bounds}; there must be two numbers of float32 within")
        return cls(float(low), float(high), masked)

    def clip(self, light: np.ndarray) -> np.ndarray:
        """Light (N, k) moved within the bounds, as float32."""
        with np.errstate(over="ignore"):  # becomes infinite, and then the bound
            light = np.clip(light.astype(np.float32), np.float32(self.low), np.float32(self.high))
        light[self.masked] = 0.0
        return light

    def touched(self, light: np.ndarray) -> np.ndarray:
        """Where light within the bounds is at one of them."""
        return (light <= self.low) | (light >= self.high)

    def exceeded(self, light: np.ndarray) -> np.ndarray | None:
        """Where light is outside by more than rounding; None where it is nowhere."""
        slack = _SLACK * (self.high - self.low)
        if self.low - slack <= light.min() and light.max() <= self.high + slack:
            return None
        beyond = ~((light >= self.low - slack) & (light <= self.high + slack))
        beyond &= ~self.masked[:, None]
        return beyond if beyond.any() else None


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be seen, T p + dark = gain * desired, weighted by w; lists of (M, k), one a system."""

    systems: tuple[System, ...]
    desired: Columns
    dark: Columns
    weights: Columns | None
    limits: Limits
    rules: dict[str, Any] = field(default_factory=dict)  # of `minimise`
    unit: float = 1.0  # of the weights
    products: Counter[int] = field(default_factory=Counter)  # so far, of each system

    @cached_property
    def is_dark(self) -> bool:
        """Whether there is no light but the projector's; one number for all pixels is looked at once."""
        return not any(part[: 1 if part.strides[0] == 0 else None].any() for part in self.dark)

    def weighted(self, parts: Columns) -> Columns:
        """w times each part."""
        return parts if self.weights is None else [w * p for w, p in zip(self.weights, parts, strict=True)]

    def norm(self, parts: Columns) -> float:
        """Of all parts together, weighted."""
        return float(np.linalg.norm(self.norms(parts, 1)))

    def norms(self, parts: Columns, frames: int) -> np.ndarray:
        """The same of each frame, (frames,); its columns, one a colour, stand side by side."""
        squares = np.zeros(frames)
        for part in self.weighted(parts):
            values = part.reshape(len(part), frames, -1)  # (M, frames, colours)
            squares += np.einsum("mfc,mfc->f", values, values, dtype=np.float64)
        return np.sqrt(squares)

    def scaled(self, gain: float) -> Columns:
        """gain * desired."""
        return self.desired if gain == 1.0 else [gain * part for part in self.desired]

    def target(self, gain: float) -> Columns:
        """gain * desired - dark: what the projector has to add."""
        if self.is_dark:
            return self.scaled(gain)
        return [wanted - dark for wanted, dark in zip(self.scaled(gain), self.dark, strict=True)]

    def nearest(self, which: int, gain: float, start: np.ndarray, **rules: Any) -> tuple[np.ndarray, Bounded]:
        """The light (N, k) of one system within the limits that comes nearest to the target.

        Where a gain is searched for, the solve counts the products of all before it.
        """
        system, limits = self.systems[which], self.limits
        scale = np.where(limits.masked, 0.0, system.scale)
        lower, upper = ((scale * bound).astype(np.float32) for bound in (limits.low, limits.high))
        solution = minimise(
            system.A,
            self.target(gain)[which],
            lower,
            upper,
            system.to_x(start),
            weights=None if self.weights is None else self.weights[which],
            **{**self.rules, **rules},
        )
        self.products[which] += solution.products
        solution = dataclasses.replace(
            solution,
            products=self.products[which],
            errors=solution.errors * self.unit,
            least=solution.least * self.unit,
        )
        light = system.to_light(solution.x)  # rounded; what is at a bound is to stay there
        light = np.where(solution.x <= lower[:, None], limits.low, light)
        light = np.where(solution.x >= upper[:, None], np.where(scale > 0, limits.high, 0.0)[:, None], light)
        return limits.clip(light), solution


def systems(T: Transport) -> tuple[System, ...]:
    """The systems of T, uploaded here if they were not yet."""
    if T.is_square and not T.couples:
        F = np.atleast_2d(T.first_bounce)
        return tuple(System(S, f) for S, f in zip(T.systems, F, strict=True))
    if not T.couples:
        pairs = zip(T.matrices, T.operators, strict=True)
        return tuple(_normalised(A, _squared_columns(matrix, A.device)) for matrix, A in pairs)
    (A,) = T.operators
    if T.blocks is not None:
        squares = [[_squared_columns(block, A.device) for block in row] for row in T.blocks]
        return (_normalised(A, np.sum(squares, axis=0).ravel()),)
    squares = np.stack([_squared_columns(matrix, A.device) for matrix in T.matrices])
    mixing = np.eye(3) if T.mixing is None else T.mixing
    return (_normalised(A, (np.square(mixing).T @ squares).ravel()),)


def _normalised(A: Operator, squares: np.ndarray) -> System:
    norms = np.sqrt(squares)
    return System(ScaledColumns(A, np.divide(1.0, norms, out=np.zeros_like(norms), where=norms > 0)), norms)


def _squared_columns(matrix: Any, device: Device) -> np.ndarray:
    """Squared norms of the columns, (N,) float64; by products alone, with random signs v, E (A^T v)^2."""
    columns = matrix.shape[1]
    if isinstance(matrix, np.ndarray):
        return np.einsum("ij,ij->j", matrix, matrix, dtype=np.float64)
    if isinstance(matrix, scipy.sparse.csr_array) or hasattr(matrix, "row_blocks"):
        blocks = [(0, matrix)] if isinstance(matrix, scipy.sparse.csr_array) else matrix.row_blocks()
        total = np.zeros(columns)
        for _, block in blocks:
            total += np.bincount(block.indices, block.data.astype(np.float64) ** 2, minlength=columns)
        return total
    A = as_operator(matrix, device)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (A.shape[0], _PROBES))
    return np.mean(np.square(A.T @ signs, dtype=np.float64), axis=1)


def bounds(value: Any) -> tuple[float, float]:
    """(low, high), finite and in this order."""
    try:
        low, high = value
    except (TypeError, ValueError):
        raise InputError(f"bounds is {_shown(value)}; it must be (low, high)") from None
    for place, bound in enumerate((low, high)):
        if np.ndim(bound):
            raise InputError(
                f"bounds[{place}] is {_shown(bound)}; it must be one number, the same for all pixels"
            )
    low = checks.number("bounds[0]", low)
    return low, checks.number("bounds[1]", high, above=low)


def gain(value: Any, loss: Any) -> float | None:
    """The gain, None of "auto"; a loss is checked, too."""
    if isinstance(value, str) and value == "auto":
        if loss is not None and checks.number("loss", loss, above=0.0, below=1.0) < _LEAST_LOSS:
            raise InputError(f"loss is {loss!r}; in float32 it must be at least {_LEAST_LOSS:g}")
        return None
    try:
        number = None if np.ndim(value) else checks.number("gain", value, above=0.0)
    except InputError:
        number = None
    if number is None:
        raise InputError(f"gain is {_shown(value)}; it must be 'auto' or a finite number above 0")
    if loss is not None:
        raise InputError(f"loss is {loss!r}, but gain is {value!r}; a loss belongs to gain='auto' only")
    return number


def clamp(value: Any, T: Transport) -> None:
    """Refuse what is no yes or no, and a T whose light is found by a solve within the bounds only."""
    if not isinstance(value, bool):
        raise InputTypeError(f"clamp is {_shown(value)}; it must be True or False")
    if value and not T.is_square:
        raise InputError("clamp is True, but this T has no S; its light is found within the bounds only")


def desired(value: Any, T: Transport) -> tuple[Columns, layout.Layout]:
    """Of every channel; a warning where it looks like a picture that was not decoded."""
    array = checks.real("desired", value)
    if array.dtype.kind in "iu" and array.size and array.max() > 1:
        logger.warning("desired holds %s, up to %d; %s", array.dtype, array.max(), _UNITS)
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.float64)
    return layout.unpack("desired", array, T.camera_grid, T.channels)


def warn_of_units(value: Any, target: float, appearance: float) -> None:
    """A warning where the largest value of the target is far beyond that of the best appearance."""
    if target > _FAR * appearance and np.asarray(value).dtype.kind == "f":
        logger.warning("desired reaches %.3g, the scene %.3g at most; %s", target, appearance, _UNITS)


def background(value: Any, T: Transport, shape: layout.Layout, like: Columns) -> Columns:
    """Of every channel: none, one number, one for all frames, or one per frame."""
    if value is None or np.ndim(value) == 0:
        level = np.float32(0) if value is None else checks.number("background", value)
        return [np.broadcast_to(level, part.shape) for part in like]
    return _alike("background", value, T, shape, like)


def weights(value: Any, T: Transport, shape: layout.Layout, like: Columns) -> tuple[Columns | None, float]:
    """Of every channel, in units of a power of two near the largest; no weights where all pixels count alike.

    In these units their squares stay far inside float64.
    """
    if value is None:
        if not T.masked.any():
            return None, 1.0
        return [np.broadcast_to(~T.masked[:, None], part.shape).astype(np.float64) for part in like], 1.0
    counts = _alike("weights", value, T, shape, like)
    least, most = min(float(part.min()) for part in counts), max(float(part.max()) for part in counts)
    if least < 0.0 or most == 0.0:
        raise InputError(f"weights range from {least:.3g} to {most:.3g}; they must be at least 0, not all 0")
    unit = float(np.ldexp(1.0, int(np.frexp(most)[1]) - 1))
    return [part / unit for part in counts], unit


def rules(T: Transport, method: str, rtol: float, options: dict[str, Any]) -> dict[str, Any]:
    """Options of a solve within the bounds; a T without S has no others."""
    checks.one_of("method", method, METHODS)
    if not T.is_square and method != "auto":
        raise InputError(f"method is {method!r}, but this T has no S for it to solve; it must be 'auto'")
    if options:
        monte_carlo.check_whole(options)
        monte_carlo.check_method(method, options, SAMPLED)
    known = list(_OPTIONS)
    if T.is_square:
        kind = KINDS.get(method)
        known += ["x0", *(field.name for field in (dataclasses.fields(kind) if kind else ()))]
    for name in options:
        if name not in known:
            raise InputTypeError(f"unknown option {name!r}; compensate has {', '.join([*_OWN, *known])}")
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", options.get("atol", 0.0), least=0.0)
    if rtol == 0.0 and atol == 0.0:
        raise InputError("rtol and atol are both 0; one of them must be positive")
    checked = {"rtol": rtol, "atol": atol, "callback": options.get("callback")}
    if options.get("maxiter") is not None:
        checked["maxiter"] = checks.count("maxiter", options["maxiter"])
    return checked


def _shown(value: Any) -> str:
    """A value in one line; of arrays the shape."""
    if isinstance(value, (tuple, list)) and any(np.ndim(part) for part in value):
        return f"a {type(value).__name__} of {len(value)} arrays"
    return f"an array of shape {np.shape(value)}" if isinstance(value, np.ndarray) else repr(value)


def _alike(name: str, value: Any, T: Transport, shape: layout.Layout, like: Columns) -> Columns:
    """Columns of a picture that has as many frames and colours as `like`, which has `shape`, or one."""
    columns, own = layout.unpack(name, value, T.camera_grid, T.channels)
    # (M, frames, colours): one frame or one grey serves all.
    have, want = (
        (len(like[0]), part.frames or 1, 3 if part.colour and T.channels == 1 else 1) for part in (own, shape)
    )
    try:
        return [np.broadcast_to(c.reshape(have), want).reshape(c.shape[0], -1) for c in columns]
    except ValueError:
        raise InputError(
            f"{name} has {have[1]} frame(s) of {have[2]} colour(s), desired {want[1]} of {want[2]}; "
            f"{name} must have as many, or one"
        ) from None
