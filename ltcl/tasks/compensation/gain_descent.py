# SPDX-License-Identifier: BSD-3-Clause
"""The gain as a variable of one bounded solve.

The residual of light x at the gain s is r = W (s d - background - A x). With A^T W^2 d at hand,
another gain changes r and the gradient by two sums of vectors, without a product. So the gain
moves at each step of the projected conjugate directions of `ltcl.solvers.bounded`, for all colours
and frames at once, and the directions stay conjugate. Every residual is a certificate: with
u = A^T W r, for all light x' within the bounds and all gains s' = 1 / t

    min ||W (s' d - c')|| / s' >= a + b t,   a = r.Wd / ||r||,   b = -max (u.x' + r.W bg) / ||r||,

a line below the least relative error, and no gain within a loss exceeds -b / (a - loss ||W d||).

The closest picture has the gain at which r is perpendicular to its own picture. The largest gain
is the zero of

    q(s) = min ||W (s d - c)||^2 - loss^2 s^2 ||W d||^2,

which is piecewise quadratic and convex: the next gain is the zero of the parabola with the value
and the slope of q here, and its value at the closest picture.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ltcl.device.arrays import round_inwards
from ltcl.solvers.bounded import Descent, Target, power_of_two
from ltcl.tasks.compensation.gain_trials import GainTrials, PictureDirection, combined_direction
from ltcl.tasks.compensation.problem import Columns, CompensationProblem

# Steps of each of the two searches; the picture that needs more is left to trials.
MAX_STEPS = 48
# Smaller errors are lost in the rounding of a residual that is not computed anew.
MIN_RESOLVED_ERROR = 1e-3
# The least slope of the error over the gain, beyond the loss, that rounding leaves certain.
MIN_RISE = 0.01
# Relative rounding of a certificate.
ROUNDING = 1e-4
# Of the gain that is expected: a little less, so that its light is within the loss.
SAFE_GAIN = 0.997
# A smaller relative change of the gain is left out.
MIN_CHANGE = 1e-3
# The gain changes by this factor at most in a step, or in a jump.
MAX_STEP = 1.3
MAX_JUMP = 1.5
# A change of the gain is lengthened, at first and at most, as light that follows asks for more.
FIRST_LENGTHENING = 3.0
MAX_LENGTHENING = 16.0
# Steps of the light after a change of the gain.
RESTING_STEPS = 2
# The error at a gain is known well enough for a jump to another one.
KNOWN_ERROR = 1.005
# Values of light from which the first gains are guessed.
MAX_SAMPLES = 1 << 13
# Gains around the least one that reaches a bound, in octaves.
OCTAVES = np.arange(-2.0, 8.0, 0.25)
# A guess at the gain of the closest picture is below the first one that costs light.
GUESS_FACTOR = 0.8
GUESS_TOLERANCE = 1.02

# Lines a + b t below the least relative error over t = 1 / gain.
Tangents = list[tuple[float, float]]


def lowest_of_tangents(tangents: Tangents, *ends: float) -> tuple[float, float]:
    """Find where up to the last end the largest of the tangents is lowest, and how low."""
    a, b = np.array(tangents).T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = ((a[:, None] - a) / (b - b[:, None])).ravel()
    is_inside = (crossings > 0.0) & (crossings < ends[-1])
    candidates = np.concatenate([ends, crossings[is_inside]])
    heights = np.max(a + b * candidates[:, None], axis=1)
    lowest = np.argmin(heights)
    return float(candidates[lowest]), float(heights[lowest])


class LargestGain(NamedTuple):
    """A gain within the loss, its light, and a gain that none within the loss exceeds."""

    gain: float
    light: Columns
    high: float


class _Residual(NamedTuple):
    """Sums over all systems: r.r, r.Wd, and the Frank-Wolfe gap."""

    square: float
    along: float
    gap: float


class LightGuess:
    """Light as it would be without bounds, slope * gain - shift, and what clipping it costs.

    `systems` hold (slope, shift, low, high, weight) of some pixels, times their direct light.
    """

    def __init__(self, problem: CompensationProblem, slopes: Columns, shifts: Columns) -> None:
        values = sum(slope.size for slope in slopes)
        stride = max(1, values // MAX_SAMPLES)
        limits = problem.limits
        self.systems = []
        self.square = 0.0
        self.first_bound = np.inf
        for index, (slope, shift) in enumerate(zip(slopes, shifts, strict=True)):
            is_used = (problem.systems[index].scale > 0.0) & ~limits.masked
            is_rising = (slope > 0.0) & is_used[:, None]
            if is_rising.any():
                highest = np.broadcast_to(limits.highest, slope.shape)[is_rising]
                ends = (highest + shift[is_rising]) / slope[is_rising]
                self.first_bound = min(self.first_bound, float(np.min(ends)))
            weight = problem.systems[index].scale[:, None]
            if problem.weights is not None and len(problem.weights[index]) == len(slope):
                weight = weight * problem.weights[index]
            rows = np.flatnonzero(is_used)[::stride]
            sampled = np.broadcast_to(weight, slope.shape)[rows]
            highest = np.broadcast_to(limits.highest, slope.shape)[rows]
            self.systems.append((slope[rows], shift[rows], highest, sampled))
            self.square += float(np.sum(np.square(sampled * slope[rows])))
        self.limits = limits

    def square_error(self, gain: float) -> float:
        """The square of the relative error that clipping costs at this gain."""
        total = 0.0
        for slope, shift, highest, weight in self.systems:
            light = gain * slope - shift
            clipped = np.clip(light, self.limits.low, highest)
            total += float(np.sum(np.square(weight * (clipped - light))))
        return total / (gain * gain * self.square)

    def closest_gain(self) -> float:
        """The largest gain that hardly costs more light than the best one."""
        gains = self.first_bound * np.exp2(OCTAVES)
        errors = np.sqrt([self.square_error(gain) for gain in gains])
        is_good = errors <= GUESS_TOLERANCE * errors.min()
        return GUESS_FACTOR * float(gains[is_good].max())

    def largest_gain(self, start: float, start_error: float, loss: float) -> float:
        """The gain above `start`, where the error is `start_error`, at which the loss is reached.

        If `start` is 0, the guess alone decides.
        """
        known = 0.0
        low = self.first_bound / MAX_STEP
        if start > 0.0:
            known = start_error**2 - self.square_error(start)
            low = start
        high = 2.0 * low
        while known + self.square_error(high) <= loss**2 and high < low * 2.0**30:
            high *= 2.0
        for _ in range(10):
            middle = np.sqrt(low * high)
            if known + self.square_error(middle) <= loss**2:
                low = middle
            else:
                high = middle
        return float(low)


class _SystemDescent:
    """The descent of one system; light, pictures and gains in the units of `GainDescent`."""

    def __init__(
        self, problem: CompensationProblem, index: int, desired_unit: float, unit: float
    ) -> None:
        self.problem = problem
        self.index = index
        self.A = problem.systems[index].A
        limits = problem.limits
        scale = problem.systems[index].scale
        self.unit = unit
        free_scale = np.where(limits.masked, 0.0, scale)
        highest = free_scale * limits.highest[:, 0]
        self.box = round_inwards(free_scale * limits.low / unit, highest / unit)
        self.desired = problem.desired[index] / desired_unit
        self.background = problem.background[index] / unit
        weights = None
        weighted = self.desired
        if problem.weights is not None:
            weights = problem.weights[index]
            weighted = self.desired * np.square(weights)
        device = self.A.device
        u = device.upload(weighted)
        self.target = Target(device.upload(self.desired), u, self.A.apply_transpose(u))
        self._count(1)
        self.gain = 0.0
        columns = self.desired.shape[1]
        self.descent = Descent(self.A, columns, weights, self.box)
        self._all = np.ones(columns, bool)

    def start(self, x: np.ndarray, gain: float) -> None:
        """Start anew from this x, (N, k), moved within the bounds."""
        lower, upper = self.box
        first = np.clip(x.astype(np.float32), lower[:, None], upper[:, None])
        self.descent.b.set(gain * self.desired - self.background)
        self.descent.x.set(first)
        self.descent.begin()
        self._count(2)
        self.gain = gain

    def read(self) -> _Residual:
        errors, gaps = self.descent.read()
        along = self.descent.product_with(self.target.b)
        return _Residual(float(np.sum(errors**2)), float(np.sum(along)), float(np.sum(gaps)))

    def shift(self, gain: float) -> None:
        """Go to another gain with the same light."""
        self.descent.shift(gain - self.gain, self.target)
        self.gain = gain

    def rescale(self, gain: float) -> None:
        """Go to a smaller gain with less light, where darkness is within the bounds."""
        self.descent.scale(gain / self.gain)
        self.gain = gain

    def step(self) -> None:
        self.descent.step(self._all)
        self._count(2)

    def light(self) -> np.ndarray:
        """The light (N, k), within the bounds."""
        x = self.descent.x.get() * self.unit
        lower = np.float32(self.unit) * self.box[0][:, None]
        upper = np.float32(self.unit) * self.box[1][:, None]
        return self.problem.light_of(self.index, x, lower, upper)

    def _count(self, products: int) -> None:
        self.problem.products[self.index] += products


class GainDescent:
    """The searches for the closest picture, and for the largest gain within a loss.

    Attributes
    ----------
    gain_unit : float
        Unit of the gains inside.
    tangents : list of (a, b)
        Lines below the least relative error, over t = 1 / gain.
    closest : (gain, error), optional
        The closest picture, once it was found.
    """

    def __init__(
        self, trials: GainTrials, slopes: Columns, shifts: Columns, tolerance: float
    ) -> None:
        problem = trials.problem
        self.trials = trials
        self.problem = problem
        self.tolerance = tolerance
        self.guess = LightGuess(problem, slopes, shifts)
        first_bound = self.guess.first_bound
        self.is_usable = 0.0 < first_bound < np.inf and self.guess.square > 0.0
        if not self.is_usable:
            return
        brightest = max(float(np.max(np.abs(desired))) for desired in problem.desired)
        desired_unit = power_of_two(brightest)
        picture_unit = power_of_two(first_bound * desired_unit)
        self.gain_unit = picture_unit / desired_unit
        self.systems = []
        self.slopes = []
        self.shifts = []
        for index, system in enumerate(problem.systems):
            scale = system.scale[:, None] / picture_unit
            self.systems.append(_SystemDescent(problem, index, desired_unit, picture_unit))
            self.slopes.append(slopes[index] * scale * self.gain_unit)
            self.shifts.append(shifts[index] * scale)
        self.desired_norm = trials.desired_norm / desired_unit
        self.gain = 0.0
        self.tangents: Tangents = []
        self.farthest = 0.0
        self.closest: tuple[float, float] | None = None
        self.is_homogeneous = problem.limits.low == 0.0 and not problem.has_background

    def closest_sine(self, enough: float) -> float | None:
        """The least relative error of all gains, or one within `enough`; None if it is not found.

        No gain down to half the least one that was tried has an error that is smaller by more than
        the tolerance.
        """
        self._start_from_guess(self.guess.closest_gain() / self.gain_unit)
        change = _GainChange()
        for _ in range(MAX_STEPS):
            residual = self._read()
            direction = self._direction(residual)
            if not direction.cosine > 0.0 or not np.isfinite(direction.sine):
                return None
            self._add_tangent(residual)
            t, bound = lowest_of_tangents(self.tangents, 0.0, 2.0 * self.farthest)
            allowed = max(enough, (1.0 + self.tolerance) * bound)
            if direction.sine <= allowed:
                return self._accept_closest(direction, allowed)
            here = max(a + b / self.gain for a, b in self.tangents)
            error = np.sqrt(residual.square) / (self.gain * self.desired_norm)
            if self.is_homogeneous and error <= KNOWN_ERROR * here and t * self.gain > 1.0:
                self._dim(1.0 / t)
                change = _GainChange()
            else:
                self._shift(change.next(self.gain, direction.size / direction.cosine))
            self._step()
        return None

    def largest(self, loss: float) -> LargestGain | None:
        """The largest gain within the loss, to the tolerance; None if it is not found."""
        self._start_below_loss(loss)
        low = 0.0
        high = np.inf
        for _ in range(MAX_STEPS):
            residual = self._read()
            reached = self._direction(residual).largest_gain(loss)
            low = max(low, reached)
            high = min(high, self._upper_bound(residual, loss))
            if high <= 0.0:
                # No gain is within the loss.
                return None
            if high <= (1.0 + self.tolerance) * reached:
                return self._accept_largest(loss, high)
            expected = SAFE_GAIN * self._expected_gain(residual, loss)
            expected = float(np.clip(expected, self.gain / MAX_STEP, self.gain * MAX_STEP))
            gain = max(min(expected, high), low)
            if not 0.0 < gain < np.inf:
                return None
            if abs(gain - self.gain) > MIN_CHANGE * self.gain:
                self._shift(gain)
            self._step()
        return None

    def light(self) -> Columns:
        """The light of each system, within the bounds."""
        return [system.light() for system in self.systems]

    def _accept_closest(self, direction: PictureDirection, allowed: float) -> float | None:
        """The sine of the light, measured anew: rounding may have hidden some of it."""
        sine = self._measured_direction(self.light()).sine
        if sine > (1.0 + ROUNDING) * allowed:
            return None
        self.closest = (direction.size / direction.cosine, sine)
        return sine

    def _accept_largest(self, loss: float, high: float) -> LargestGain | None:
        light = self.light()
        gain = self._measured_direction(light).largest_gain(loss)
        high *= self.gain_unit
        if high > (1.0 + self.tolerance + ROUNDING) * gain:
            return None
        return LargestGain(gain, light, high)

    def _measured_direction(self, light: Columns) -> PictureDirection:
        for index in range(len(self.systems)):
            self.problem.products[index] += 1
        return self.trials.direction(light)

    def _start_from_guess(self, gain: float) -> None:
        self.gain = gain
        for system, slope, shift in zip(self.systems, self.slopes, self.shifts, strict=True):
            system.start(gain * slope - shift, gain)

    def _start_below_loss(self, loss: float) -> None:
        """Start at the gain where the loss is expected, from the light that is the best guess."""
        if self.closest is None:
            guess = self.guess.largest_gain(0.0, 0.0, loss)
            self._start_from_guess(guess / self.gain_unit)
            return
        gain, error = self.closest
        guess = self.guess.largest_gain(gain * self.gain_unit, error, loss)
        change = guess / self.gain_unit - self.gain
        self.gain += change
        for system, slope in zip(self.systems, self.slopes, strict=True):
            system.start(system.descent.x.get() + change * slope, self.gain)

    def _read(self) -> _Residual:
        residuals = [system.read() for system in self.systems]
        return _Residual(*np.sum(residuals, axis=0))

    def _step(self) -> None:
        for system in self.systems:
            system.step()

    def _shift(self, gain: float) -> None:
        self.gain = gain
        for system in self.systems:
            system.shift(gain)

    def _dim(self, gain: float) -> None:
        """Go towards a smaller gain, with less of the same light: then bounds above do not hold."""
        self.gain = max(gain, self.gain / MAX_JUMP)
        for system in self.systems:
            system.rescale(self.gain)

    def _direction(self, residual: _Residual) -> PictureDirection:
        """W c in parts along W d and across it, from W c = gain W d - r."""
        square = self.desired_norm**2
        along = self.gain - residual.along / square
        across = max(residual.square - residual.along**2 / square, 0.0) / square
        return combined_direction(along, np.sqrt(across))

    def _support(self, residual: _Residual) -> float:
        """max r.Wc over all light within the bounds."""
        return self.gain * residual.along - residual.square + residual.gap

    def _add_tangent(self, residual: _Residual) -> None:
        unit = np.sqrt(residual.square) * self.desired_norm
        if unit > 0.0:
            self.tangents.append((residual.along / unit, -self._support(residual) / unit))
        self.farthest = max(self.farthest, 1.0 / self.gain)

    def _upper_bound(self, residual: _Residual, loss: float) -> float:
        """No gain within the loss exceeds this one."""
        unit = np.sqrt(residual.square) * self.desired_norm
        if residual.along <= (loss + MIN_RISE) * unit:
            return np.inf
        return self._support(residual) / (residual.along - loss * unit)

    def _expected_gain(self, residual: _Residual, loss: float) -> float:
        """The zero of the parabola through q at the closest picture, and q and its slope here."""
        allowed = (loss * self.desired_norm) ** 2
        value = residual.square - allowed * self.gain**2
        slope = 2.0 * (residual.along - allowed * self.gain)
        anchor, error = 0.0, 0.0
        if self.closest is not None:
            anchor, error = self.closest
        anchor_value = (error * anchor * self.desired_norm) ** 2 - allowed * anchor**2
        distance = anchor - self.gain
        if distance == 0.0:
            return MAX_STEP * self.gain
        curvature = (anchor_value - value - slope * distance) / distance**2
        discriminant = slope**2 - 4.0 * curvature * value
        if curvature > 0.0 and discriminant >= 0.0:
            return self.gain + (np.sqrt(discriminant) - slope) / (2.0 * curvature)
        if slope > 0.0:
            return self.gain - value / slope
        return self.gain


class _GainChange:
    """The next gain for the closest picture: where the light asks for no other gain, by secants.

    Light needs a few steps to follow, so that the gain rests in between.
    """

    def __init__(self) -> None:
        self._gain = 0.0
        self._change = 0.0
        self._rest = 0

    def next(self, gain: float, suitable: float) -> float:
        """The next gain, from this one and the one that suits the light here best."""
        if self._rest > 0:
            self._rest -= 1
            return gain
        self._rest = RESTING_STEPS
        change = suitable - gain
        lengthening = FIRST_LENGTHENING
        if self._change != 0.0 and gain != self._gain:
            fall = (self._change - change) / (gain - self._gain)
            # The change has this slope over the gain, between -1 and 0 where light has settled.
            lengthening = 1.0 / max(fall, 1.0 / MAX_LENGTHENING)
        self._gain = gain
        self._change = change
        return float(np.clip(gain + lengthening * change, gain / MAX_STEP, gain * MAX_STEP))
