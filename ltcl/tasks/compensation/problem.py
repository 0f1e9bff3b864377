# SPDX-License-Identifier: BSD-3-Clause
"""Compensation as least squares: min ||w (A x - b)||, x = scale * p within the projector's bounds.

Where T = S F, A is S and the scale F: columns near 1, so that few products are needed. Elsewhere
the columns of T are brought to norm 1. Colour channels are one system each, or all of them one
where T couples them: then (3 N, k) arrays hold channel below channel, as `stack_channels` puts
them.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ltcl.device.arrays import round_inwards
from ltcl.errors import InputError
from ltcl.operators import Operator
from ltcl.operators.colour_hats import scale_columns
from ltcl.operators.diagonal_blocks import are_quicker_joined, joined_once
from ltcl.solvers import SolveSettings
from ltcl.solvers.bounded import ROWS_AT_ONCE, Bounded, BoxProblem, minimise_each
from ltcl.transport.transport import Transport

# Pictures (M, k) or light (N, k), one array per system.
Columns = list[np.ndarray]

# Of the width of the bounds: light beyond a bound by rounding counts as inside.
BOUNDS_SLACK = 1e-6
# Brightest pixels: from 1e-38 on float32 has all digits, and some devices have any.
MIN_BRIGHTNESS = 1e-30
MAX_BRIGHTNESS = 1e38


class ChannelSystem(NamedTuple):
    """A, (M, N), of the unknowns x = scale * light; scale, (N,), is 0 if a pixel lights nothing."""

    A: Operator
    scale: np.ndarray


@dataclass(frozen=True, eq=False)
class Limits:
    """The projector's bounds; pixels that are `masked`, (N,), stay dark whatever these are.

    Pixels with a ceiling, (N,) from 0 to 1, reach that part of the way from low to high.
    """

    low: float
    high: float
    masked: np.ndarray
    ceilings: np.ndarray | None = None

    @classmethod
    def in_float32(
        cls, bounds: tuple[float, float], masked: np.ndarray, ceilings: np.ndarray | None = None
    ) -> Limits:
        """Limits of float32 within the bounds, so that a rounded pattern does not exceed them."""
        low, high = round_inwards(*bounds)
        if not -np.inf < low < high < np.inf:
            raise InputError(f"bounds is {bounds}; there must be two numbers of float32 within")
        return cls(float(low), float(high), masked, ceilings)

    @cached_property
    def highest(self) -> np.ndarray:
        """The largest light of each pixel, (N, 1) or (1, 1) float32."""
        if self.ceilings is None:
            return np.full((1, 1), self.high, np.float32)
        highest = self.low + self.ceilings * (self.high - self.low)
        return np.clip(highest.astype(np.float32), self.low, self.high)[:, None]

    def blocks(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Rows whose arrays fit the caches, and the largest light of each, (rows, 1) or (1, 1)."""
        for first in range(0, len(self.masked), ROWS_AT_ONCE):
            rows = slice(first, first + ROWS_AT_ONCE)
            highest = self.highest
            if self.ceilings is not None:
                highest = highest[rows]
            yield rows, highest

    def clip(self, light: np.ndarray) -> np.ndarray:
        """Light (N, k) moved within the bounds, as float32."""
        # What overflows becomes infinite, and then the bound.
        with np.errstate(over="ignore"):
            light = light.astype(np.float32, copy=False)
        light = np.clip(light, np.float32(self.low), self.highest)
        if self.masked.any():
            light[self.masked] = 0.0
        return light

    def exceeded(self, light: np.ndarray) -> np.ndarray | None:
        """The values (N, k) that are outside by more than rounding; None if there are none."""
        slack = BOUNDS_SLACK * (self.high - self.low)
        is_inside = light >= self.low - slack
        is_inside &= light <= self.highest + np.float64(slack)
        is_inside |= self.masked[:, None]
        if is_inside.all():
            return None
        return ~is_inside

    def are_at_bound(self, light: np.ndarray) -> np.ndarray:
        """The values (N, k) that are at a bound up to rounding; masked pixels have none."""
        slack = np.float64(BOUNDS_SLACK * (self.high - self.low))
        are_at_bound = (light <= self.low + slack) | (light >= self.highest - slack)
        return are_at_bound & ~self.masked[:, None]

    def nearer_bound(self, light: np.ndarray) -> np.ndarray:
        """The bound (N, k) that is nearer to each value, as float32."""
        is_low = light - self.low < self.highest - light
        return np.where(is_low, np.float32(self.low), self.highest)


@dataclass(frozen=True, kw_only=True, eq=False)
class CompensationProblem:
    """The pictures to be seen: T p + background = gain * desired, weighted by w.

    Lists hold (M, k) arrays, one per system. `weight_unit` is the unit of the weights, which keeps
    their squares inside float64. `settings` are those of a solve within the bounds, with atol in
    that unit. `products` counts the products of each system so far.
    """

    systems: tuple[ChannelSystem, ...]
    desired: Columns
    background: Columns
    weights: Columns | None
    weight_unit: float
    limits: Limits
    settings: SolveSettings
    products: Counter[int] = field(default_factory=Counter)

    @cached_property
    def has_background(self) -> bool:
        """True if there is light besides the projector's."""
        for background in self.background:
            if background.strides[0] == 0:
                # One number for all pixels.
                background = background[:1]
            if background.any():
                return True
        return False

    @property
    def counts_masked_pixels(self) -> bool:
        """True if the weights let some masked pixel count."""
        if self.weights is None:
            return False
        return any(w[self.limits.masked].any() for w in self.weights)

    def weighted(self, pictures: Columns) -> Columns:
        """w times each picture."""
        if self.weights is None:
            return pictures
        return [w * c for w, c in zip(self.weights, pictures, strict=True)]

    def norms(self, pictures: Columns) -> list[np.ndarray]:
        """Weighted norms of the columns, (k,) float64 of each system."""
        norms = []
        for c in self.weighted(pictures):
            squares = np.einsum("mk,mk->k", c, c, dtype=np.float64)
            norms.append(np.sqrt(squares))
        return norms

    def target(self, gain: float) -> Columns:
        """gain * desired."""
        if gain == 1.0:
            return self.desired
        return multiply(gain, self.desired)

    def light_to_add(self, gain: float) -> Columns:
        """gain * desired - background: the light that the projector has to add."""
        target = self.target(gain)
        if not self.has_background:
            return target
        return subtract(target, self.background)

    def check_range(self, gain: float) -> None:
        """Refuse pictures that float32 does not resolve, or does not hold."""
        brightest_light = max(abs(self.limits.low), abs(self.limits.high))
        largest_scale = max(float(scale.max()) for _, scale in self.systems)
        brightest_desired = max(max(float(d.max()), -float(d.min())) for d in self.desired)
        light = f"light of {brightest_light:.3g}, as bounds allow it, makes"
        pictures = {
            "T reaches": largest_scale,
            "desired reaches": gain * brightest_desired,
            light: brightest_light * largest_scale,
        }
        for subject, brightest in pictures.items():
            if 0.0 < brightest < MIN_BRIGHTNESS or brightest > MAX_BRIGHTNESS:
                raise InputError(
                    f"{subject} {brightest:.3g}; it must be from {MIN_BRIGHTNESS:g} to "
                    f"{MAX_BRIGHTNESS:g}: scale T, desired or bounds"
                )

    def nearest_each(
        self, gain: float, starts: dict[int, np.ndarray], settings: SolveSettings
    ) -> dict[int, tuple[np.ndarray, Bounded]]:
        """The light (N, k) within the limits that comes nearest to the target, from these starts.

        It is found for each system that has a start, by the system's index. Small systems are
        solved at the same time, so that a launch serves all colours. A solve counts the products of
        all solves of its system before, too.
        """
        targets = self.light_to_add(gain)
        problems = []
        for index, start in starts.items():
            problems.append(self._box_problem(index, targets[index], start))
        operators = [self.systems[index].A for index in starts]
        rules = {"rtol": settings.rtol, "atol": settings.atol, "maxiter": settings.maxiter}
        solutions: list[Bounded] = []
        if len(starts) > 1 and settings.callback is None and self.may_join:
            solutions += minimise_each(joined_once(operators), problems, **rules)
        else:
            for A, problem in zip(operators, problems, strict=True):
                solutions += minimise_each(A, [problem], callback=settings.callback, **rules)
        nearest = {}
        for index, problem, solution in zip(starts, problems, solutions, strict=True):
            nearest[index] = self._light_of_solution(index, problem, solution)
        return nearest

    @property
    def may_join(self) -> bool:
        """True if the systems of all colours may be solved as one, at less cost."""
        if any(desired.shape[1] != 1 for desired in self.desired):
            return False
        return are_quicker_joined([system.A for system in self.systems])

    def box(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest unknowns of a system within the limits, (N,) float32."""
        limits = self.limits
        lower = np.empty(len(limits.masked), np.float32)
        upper = np.empty(len(limits.masked), np.float32)
        for rows, highest in limits.blocks():
            free_scale = self._free_scale(index, rows)
            lower[rows] = free_scale * limits.low
            upper[rows] = free_scale * highest[:, 0]
        return lower, upper

    def _free_scale(self, index: int, rows: slice) -> np.ndarray:
        """The unknowns of some pixels of a system for their light, 0 where they are masked."""
        return np.where(self.limits.masked[rows], 0.0, self.systems[index].scale[rows])

    def _box_problem(self, index: int, target: np.ndarray, start: np.ndarray) -> BoxProblem:
        """The unknowns of one system within the limits, from a start (N, k) of light."""
        lower, upper = self.box(index)
        weights = None
        if self.weights is not None:
            weights = self.weights[index]
        return BoxProblem(
            b=target,
            lower=lower,
            upper=upper,
            x0=self.systems[index].scale[:, None] * start,
            weights=weights,
        )

    def _light_of_solution(
        self, index: int, problem: BoxProblem, solution: Bounded
    ) -> tuple[np.ndarray, Bounded]:
        """The light (N, k) of a system's unknowns, and the solve in units of the pictures."""
        self.products[index] += solution.products
        solution = dataclasses.replace(
            solution,
            products=self.products[index],
            errors=solution.errors * self.weight_unit,
            least=solution.least * self.weight_unit,
        )
        light = self.light_of(index, solution.x, problem.lower[:, None], problem.upper[:, None])
        return light, solution

    def light_of(
        self, index: int, x: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> np.ndarray:
        """The light (N, k) of one system of unknowns x, from lower to upper, (N, 1) float32."""
        limits = self.limits
        nearest = np.empty(x.shape, np.float32)
        for rows, highest in limits.blocks():
            block = x[rows]
            free_scale = self._free_scale(index, rows)[:, None]
            is_free = free_scale > 0
            light = np.divide(block, free_scale, out=np.zeros(block.shape), where=is_free)
            # Division rounds: values at a bound are to stay there.
            light = np.where(block <= lower[rows], limits.low, light)
            light = np.where(block >= upper[rows], np.where(is_free, highest, 0.0), light)
            # What overflows becomes infinite, and then the bound.
            with np.errstate(over="ignore"):
                nearest[rows] = light
        return limits.clip(nearest)


def multiply(factor: float, columns: Columns) -> Columns:
    """`factor` times each array."""
    return [factor * c for c in columns]


def subtract(a: Columns, b: Columns) -> Columns:
    """a - b, array by array."""
    return [x - y for x, y in zip(a, b, strict=True)]


def inner_product(a: Columns, b: Columns) -> float:
    """The sum of all products, in float64."""
    total = 0.0
    for x, y in zip(a, b, strict=True):
        total += float(np.sum(x * y, dtype=np.float64))
    return total


def stack_channels(channels: Columns, systems: int) -> Columns:
    """Arrays (N, k) of each channel as one per system: themselves, or channel below channel."""
    if len(channels) == systems:
        return channels
    return [np.concatenate(channels)]


def _direct_norms(first_bounce: np.ndarray, mixing: np.ndarray) -> np.ndarray:
    """Norms of the columns of direct light whose colours are mixed, (1, 3 N)."""
    squares = np.square(mixing).T @ np.square(first_bounce)
    return np.sqrt(squares).reshape(1, -1)


def channel_systems(T: Transport) -> tuple[ChannelSystem, ...]:
    """The systems of T, uploaded here if they were not yet."""
    if T.is_square and not T.couples:
        F = np.atleast_2d(T.first_bounce)
        return tuple(map(ChannelSystem, T.systems, F))
    if T.is_square and T.mixing is not None:
        # Direct light has about these norms, which take products to estimate.
        norms = _direct_norms(T.first_bounce, T.mixing)
    else:
        norms = T.column_norms
    inverses = np.divide(1.0, norms, out=np.zeros_like(norms), where=norms > 0)
    operators = map(scale_columns, T.operators, inverses)
    return tuple(map(ChannelSystem, operators, norms))
