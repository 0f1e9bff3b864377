# SPDX-License-Identifier: BSD-3-Clause
"""Compensation as least squares: min ||w (A x - b)||, x = scale * p within the projector's bounds.

Where T = S F, A is S and the scale F, the first bounce: columns near 1, so that few products are needed.
Elsewhere the columns of T are brought to norm 1. Colour channels are one system each, or all of them one
where T couples them: then (3 N, k) arrays hold channel below channel, as `Transport.join` puts them.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.device import Device
from ltcl.operators import Operator, ScaledColumns, as_operator
from ltcl.solvers.bounded import Bounded, minimise
from ltcl.transport import Transport

_PROBES = 16  # of the norms of columns that cannot be seen: within a factor of 2, which is enough


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

    def clip(self, light: np.ndarray) -> np.ndarray:
        """Light (N, k) moved within the bounds."""
        return np.where(self.masked[:, None], 0.0, np.clip(light, self.low, self.high))

    def touched(self, light: np.ndarray) -> np.ndarray:
        """Where light within the bounds is at one of them."""
        return (light <= self.low) | (light >= self.high)

    def exceeded(self, light: np.ndarray) -> np.ndarray:
        """Where light is outside; the slack counts rounding at a bound as inside."""
        slack = 1e-6 * (self.high - self.low)
        beyond = (light < self.low - slack) | (light > self.high + slack)
        return beyond & ~self.masked[:, None]


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be seen, T p + dark = gain * desired, weighted by w; each a list of (M, k), one a system."""

    systems: tuple[System, ...]
    desired: list[np.ndarray]
    dark: list[np.ndarray]
    weights: list[np.ndarray] | None
    limits: Limits
    rules: dict[str, Any] = field(default_factory=dict)  # of `minimise`
    products: Counter[int] = field(default_factory=Counter)  # so far, of each system

    def weighted(self, parts: list[np.ndarray]) -> list[np.ndarray]:
        """w times each part."""
        return parts if self.weights is None else [w * p for w, p in zip(self.weights, parts, strict=True)]

    def norm(self, parts: list[np.ndarray]) -> float:
        """Of all parts together, weighted."""
        return float(self.norms(parts, 1)[0])

    def norms(self, parts: list[np.ndarray], frames: int) -> np.ndarray:
        """The same of each frame, (frames,); its columns, one a colour, stand side by side."""
        squares = (np.square(p, dtype=np.float64).reshape(len(p), frames, -1) for p in self.weighted(parts))
        return np.sqrt(np.sum([np.sum(square, axis=(0, 2)) for square in squares], axis=0))

    def target(self, gain: float) -> list[np.ndarray]:
        """gain * desired - dark: what the projector has to add."""
        return [gain * wanted - dark for wanted, dark in zip(self.desired, self.dark, strict=True)]

    def nearest(self, which: int, gain: float, start: np.ndarray, **rules: Any) -> tuple[np.ndarray, Bounded]:
        """The light (N, k) of one system within the limits that comes nearest to the target.

        Where a gain is searched for, the solve counts the products of all before it.
        """
        system, limits = self.systems[which], self.limits
        scale = np.where(limits.masked, 0.0, system.scale)
        lower, upper = ((scale * bound).astype(np.float32) for bound in (limits.low, limits.high))
        found = minimise(
            system.A,
            self.target(gain)[which],
            lower,
            upper,
            system.to_x(start),
            weights=None if self.weights is None else self.weights[which],
            **{**self.rules, **rules},
        )
        self.products[which] += found.products
        found = dataclasses.replace(found, products=self.products[which])
        light = system.to_light(found.x)  # rounded; what is at a bound is to stay there
        light = np.where(found.x <= lower[:, None], limits.low, light)
        light = np.where(found.x >= upper[:, None], np.where(scale > 0, limits.high, 0.0)[:, None], light)
        return limits.clip(light), found


def systems(T: Transport) -> tuple[System, ...]:
    """The systems of T, uploaded here if they were not yet."""
    if T.is_square and not T.couples:
        F = np.atleast_2d(T.first_bounce)
        return tuple(System(S, f) for S, f in zip(T.systems, F, strict=True))
    if not T.couples:
        pairs = zip(T.matrices, T.operators, strict=True)
        return tuple(_scaled(A, _column_norms(matrix, A.device)) for matrix, A in pairs)
    (A,) = T.operators
    if T.blocks is not None:
        squares = [[_column_norms(block, A.device) ** 2 for block in row] for row in T.blocks]
        return (_scaled(A, np.sqrt(np.sum(squares, axis=0)).ravel()),)
    squares = np.stack([_column_norms(matrix, A.device) ** 2 for matrix in T.matrices])
    mixing = np.eye(3) if T.mixing is None else T.mixing
    return (_scaled(A, np.sqrt(np.square(mixing).T @ squares).ravel()),)


def _scaled(A: Operator, norms: np.ndarray) -> System:
    return System(ScaledColumns(A, np.divide(1.0, norms, out=np.zeros_like(norms), where=norms > 0)), norms)


def _column_norms(matrix: Any, device: Device) -> np.ndarray:
    """Euclidean norms of the columns, (N,) float64; of products alone, with random signs v, E (A^T v)^2."""
    if isinstance(matrix, np.ndarray):
        return np.sqrt(np.einsum("ij,ij->j", matrix, matrix, dtype=np.float64))
    if hasattr(matrix, "row_blocks"):
        return np.sqrt(sum(_squares(block) for _, block in matrix.row_blocks()))
    if isinstance(matrix, scipy.sparse.csr_array):
        return np.sqrt(_squares(matrix))
    A = as_operator(matrix, device)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (A.shape[0], _PROBES))
    return np.sqrt(np.mean(np.square(A.T @ signs, dtype=np.float64), axis=1))


def _squares(matrix: Any) -> np.ndarray:
    """Of the entries of each column of a csr_array, their sum."""
    return np.bincount(matrix.indices, matrix.data.astype(np.float64) ** 2, minlength=matrix.T.shape[0])
