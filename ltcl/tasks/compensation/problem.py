# SPDX-License-Identifier: BSD-3-Clause
"""Compensation as least squares: min ||w (A x - b)||, x = scale * p within the projector's bounds.

Where T = S F, A is S and the scale F: columns near 1, so that few products are needed. Elsewhere
the columns of T are brought to norm 1. Colour channels are one system each, or all of them one
where T couples them: then (3 N, k) arrays hold channel below channel, as `join` puts them.
"""

from __future__ import annotations

import dataclasses
import logging
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator, ScaledColumns, as_operator
from ltcl.solvers.bounded import Bounded, inwards, minimise
from ltcl.solvers.solve import METHODS, OPTIONS
from ltcl.transport import frames as layout
from ltcl.transport.transport import Transport

logger = logging.getLogger(__name__)

_OWN = (
    "bounds",
    "background",
    "gain",
    "loss",
    "weights",
    "exact",
    "inverse",
    "clamp",
    "method",
    "rtol",
)
_OPTIONS = (
    "atol",
    "maxiter",
    "callback",
    "throw",
)  # of `ltcl.solve`, that a solve within bounds has, too
_LEAST_LOSS = 1e-6  # a relative error that float32 resolves
_FAR = 4.0  # times the brightest pixel that was reached: the units of desired are not those of T
_PICTURES = (
    1e-30,
    1e38,
)  # brightest pixels; from 1e-38 on float32 has all digits, and some devices any
_PROBES = 16  # of the norms of columns that cannot be read: within a factor of 2, which is enough
_SLACK = 1e-6  # of the width of the bounds: rounding beyond a bound counts as inside
Columns = list[np.ndarray]  # (M, k) or (N, k) of each system


class System(NamedTuple):
    """A, (M, N), of the unknowns x = scale * light; scale, (N,), is 0 where a pixel lights nothing."""

    A: Operator
    scale: np.ndarray


@dataclass(frozen=True, eq=False)
class Limits:
    """The projector's bounds; pixels that are `masked`, (N,), stay dark whatever these are."""

    low: float
    high: float
    masked: np.ndarray

    @classmethod
    def in_float32(cls, bounds: tuple[float, float], masked: np.ndarray) -> Limits:
        """The numbers of float32 within the bounds, so that a rounded pattern does not exceed them."""
        low, high = inwards(*bounds)
        if not -np.inf < low < high < np.inf:
            raise InputError(f"bounds is {bounds}; there must be two numbers of float32 within")
        return cls(float(low), float(high), masked)

    def clip(self, light: np.ndarray) -> np.ndarray:
        """Light (N, k) moved within the bounds, as float32."""
        with np.errstate(over="ignore"):  # becomes infinite, and then the bound
            light = np.clip(light.astype(np.float32), np.float32(self.low), np.float32(self.high))
        if self.masked.any():
            light[self.masked] = 0.0
        return light

    def exceeded(self, light: np.ndarray) -> np.ndarray | None:
        """Where light is outside by more than rounding; None where it is nowhere."""
        slack = _SLACK * (self.high - self.low)
        within = light >= self.low - slack
        within &= light <= self.high + slack
        within |= self.masked[:, None]
        return None if within.all() else ~within


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
        return not any(dark[: 1 if dark.strides[0] == 0 else None].any() for dark in self.dark)

    def weighted(self, pictures: Columns) -> Columns:
        """w times each picture."""
        if self.weights is None:
            return pictures
        return [w * c for w, c in zip(self.weights, pictures, strict=True)]

    def norms(self, pictures: Columns) -> list[np.ndarray]:
        """Of each column, weighted, (k,) float64 of each system."""
        weighted = self.weighted(pictures)
        return [np.sqrt(np.einsum("mk,mk->k", c, c, dtype=np.float64)) for c in weighted]

    def scaled(self, gain: float) -> Columns:
        """gain * desired."""
        return self.desired if gain == 1.0 else [gain * d for d in self.desired]

    def target(self, gain: float) -> Columns:
        """gain * desired - dark: what the projector has to add."""
        if self.is_dark:
            return self.scaled(gain)
        return [d - dark for d, dark in zip(self.scaled(gain), self.dark, strict=True)]

    def nearest(
        self, which: int, gain: float, start: np.ndarray, **rules: Any
    ) -> tuple[np.ndarray, Bounded]:
        """The light (N, k) of one system within the limits nearest to the target; products add up."""
        (A, scale), limits = self.systems[which], self.limits
        free = np.where(limits.masked, 0.0, scale)[:, None]
        lower, upper = ((free * bound).astype(np.float32) for bound in (limits.low, limits.high))
        solution = minimise(
            A,
            self.target(gain)[which],
            lower[:, 0],
            upper[:, 0],
            scale[:, None] * start,
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
        x = solution.x
        light = np.divide(x, free, out=np.zeros(x.shape), where=free > 0)
        # Rounded: what is at a bound is to stay there.
        light = np.where(x <= lower, limits.low, light)
        light = np.where(x >= upper, np.where(free > 0, limits.high, 0.0), light)
        return limits.clip(light), solution


def join(channels: Columns, systems: int) -> Columns:
    """One (N, k) a channel as so many systems take them."""
    return channels if len(channels) == systems else [np.concatenate(channels)]


def systems(T: Transport) -> tuple[System, ...]:
    """The systems of T, uploaded here if they were not yet."""
    if T.is_square and not T.couples:
        F = np.atleast_2d(T.first_bounce)
        return tuple(map(System, T.systems, F))
    rows = [T.matrices] if T.blocks is None else T.blocks
    squares = np.sum(
        [[_squared_columns(matrix, T.device) for matrix in row] for row in rows], axis=0
    )
    if T.mixing is not None:
        squares = np.square(T.mixing).T @ squares
    norms = np.sqrt(squares.reshape(len(T.operators), -1))  # of one system where colours mix
    inverses = np.divide(1.0, norms, out=np.zeros_like(norms), where=norms > 0)
    scaled = map(ScaledColumns, T.operators, inverses)
    return tuple(map(System, scaled, norms))


def _squared_columns(matrix: Any, device: Device) -> np.ndarray:
    """Squared norms of the columns, (N,) float64; by products alone, with random signs v, E (A^T v)^2."""
    columns = matrix.shape[1]
    if isinstance(matrix, np.ndarray):
        return np.einsum("ij,ij->j", matrix, matrix, dtype=np.float64)
    if isinstance(matrix, scipy.sparse.csr_array):
        return np.bincount(matrix.indices, matrix.data.astype(np.float64) ** 2, minlength=columns)
    A = as_operator(matrix, device)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (A.shape[0], _PROBES))
    return np.mean(np.square(A.T @ signs, dtype=np.float64), axis=1)


def gain(value: Any, loss: Any) -> float | None:
    """The gain, None of "auto"; a loss is checked, too."""
    if not isinstance(value, str):
        number = checks.number("gain", value, above=0.0)
        if loss is not None:
            raise InputError(
                f"loss is {loss!r}, but gain is {value!r}; a loss belongs to gain='auto' only"
            )
        return number
    if value != "auto":
        raise InputError(f"gain is {value!r}; it must be 'auto' or a finite number above 0")
    if loss is not None:
        checks.number("loss", loss, least=_LEAST_LOSS, below=1.0)
    return None


def check_range(problem: Problem, gain: float) -> None:
    """Refuse pictures that float32 does not resolve, or does not hold."""
    light = max(abs(problem.limits.low), abs(problem.limits.high))
    column = max(float(scale.max()) for _, scale in problem.systems)
    pictures = {
        "T reaches": column,
        "desired reaches": gain
        * max(max(float(d.max()), -float(d.min())) for d in problem.desired),
        f"light of {light:.3g}, as bounds allow it, makes": light * column,
    }
    least, most = _PICTURES
    for what, brightest in pictures.items():
        if 0.0 < brightest < least or brightest > most:
            raise InputError(
                f"{what} {brightest:.3g}; it must be from {least:g} to {most:g}: scale T, desired or bounds"
            )


def warn_of_units(target: Columns, appearance: Columns) -> None:
    """A warning where the largest value of the target is far beyond that of the best appearance."""
    highest, reached = (max(float(c.max()) for c in columns) for columns in (target, appearance))
    if highest > _FAR * reached:
        units = layout.UNITS % 255
        logger.warning("desired reaches %.3g, the scene %.3g at most; %s", highest, reached, units)


def background(value: Any, T: Transport, shape: layout.PictureLayout, like: Columns) -> Columns:
    """Of every channel: none, one number, one for all frames, or one per frame."""
    if value is None or np.ndim(value) == 0:
        level = np.float32(0) if value is None else checks.number("background", value)
        return [np.broadcast_to(level, d.shape) for d in like]
    return _alike("background", value, T, shape, like)


def weights(
    value: Any, T: Transport, shape: layout.PictureLayout, like: Columns
) -> tuple[Columns | None, float]:
    """Of every channel, in a unit that keeps their squares inside float64; None where all are alike."""
    if value is None:
        if not T.masked.any():
            return None, 1.0
        return [np.broadcast_to(~T.masked[:, None], d.shape).astype(np.float64) for d in like], 1.0
    value = checks.real("weights", value).astype(np.float64, copy=False)
    channels = _alike("weights", value, T, shape, like)
    least, most = min(float(w.min()) for w in channels), max(float(w.max()) for w in channels)
    if least < 0.0 or most == 0.0:
        raise InputError(
            f"weights range from {least:.3g} to {most:.3g}; they must be at least 0, not all 0"
        )
    unit = float(np.ldexp(1.0, int(np.frexp(most)[1]) - 1))
    return [w / unit for w in channels], unit


def rules(T: Transport, method: str, rtol: float, options: dict[str, Any]) -> dict[str, Any]:
    """Options of a solve within the bounds; a T without S has no others."""
    checks.one_of("method", method, METHODS)
    if not T.is_square and method != "auto":
        raise InputError(
            f"method is {method!r}, but this T has no S for it to solve; it must be 'auto'"
        )
    known = [*_OPTIONS, *(["x0"] if T.is_square else []), *OPTIONS.get(method, ())]
    for name in options:
        if name not in known or name == "pixels":  # a picture needs all of them
            owners = [key for key, own in OPTIONS.items() if name in own]
            theirs = f"{name} is an option of method={' and '.join(map(repr, owners))}"
            problem = theirs if owners and name != "pixels" else f"unknown option {name!r}"
            has = ", ".join([*_OWN, *known])
            raise InputTypeError(f"{problem}; compensate with method {method!r} has {has}")
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", options.get("atol", 0.0), least=0.0)
    if rtol == 0.0 and atol == 0.0:
        also = " where atol is 0" if "atol" in options else ""
        raise InputError(f"rtol is 0; it must be above 0 and below 1{also}")
    checked = {"rtol": rtol, "atol": atol, "callback": options.get("callback")}
    if options.get("maxiter") is not None:
        checked["maxiter"] = checks.count("maxiter", options["maxiter"])
    return checked


def _alike(
    name: str, value: Any, T: Transport, shape: layout.PictureLayout, like: Columns
) -> Columns:
    """Columns of a picture that has as many frames and colours as `like`, which has `shape`, or one."""
    columns, own = layout.unpack(name, value, T.camera_grid, T.channels)
    # (M, frames, colours): one frame or one grey serves all.
    have, want = (
        (len(like[0]), size.frames or 1, 3 if size.colour and T.channels == 1 else 1)
        for size in (own, shape)
    )
    try:
        return [np.broadcast_to(c.reshape(have), want).reshape(c.shape[0], -1) for c in columns]
    except ValueError:
        raise InputError(
            f"{name} has {have[1]} frame(s) of {have[2]} colour(s), desired {want[1]} of {want[2]}; "
            f"{name} must have as many, or one"
        ) from None
