# SPDX-License-Identifier: BSD-3-Clause
"""The largest gain at which a picture is within the projector's reach.

Exactly: the light without bounds is affine in the gain, p = gain u - v with T u = desired and
T v = background, so that each pixel allows an interval of gains.

Up to a loss: with C the pictures T p + background of all p within the bounds, which is convex,

    h(gain) = min over c in C of ||W (gain d - c)|| - loss ||gain W d||

is convex in the gain, so that the gains with h <= 0 are an interval. Its upper end is enclosed:
every c is within the loss at gains where a quadratic is at most 0, and the largest of these is in
reach; every trial has a certificate, and with it a tangent below h, whose zero cannot be passed and
is the next gain (Newton).

Both searches are done in one bounded solve whose gain moves at each step (`gain_descent`), where
there is a guess at the light to start from, and errors are above the rounding of float32. Systems
of few numbers, other errors, and what takes too many steps, are searched by trials of one gain
after the other.
"""

from __future__ import annotations

from operator import attrgetter

import numpy as np

from ltcl.errors import InputError
from ltcl.tasks.compensation.gain_descent import (
    MIN_RESOLVED_ERROR,
    GainDescent,
    lowest_of_tangents,
)
from ltcl.tasks.compensation.gain_trials import GainTrial, GainTrials
from ltcl.tasks.compensation.problem import Columns, CompensationProblem, Limits

# Relative tolerance of the gain, and of the least error where that is sought.
TOLERANCE = 0.01
# How exact trials on the way are: a fraction of the distance between their error and the loss.
TRIAL_FRACTION = 0.1
# How exact the last trials are: a fraction of what the tolerance of the gain is worth.
FINAL_SOLVE_FRACTION = 0.2
# The least relative error that float32 resolves.
MIN_ERROR = 1e-6
# Trials of a search: each one about halves the distance, so that this many are never needed.
MAX_TRIALS = 60
# Times the least error of all gains, that the gain may cost if no loss is given.
DEFAULT_LOSS_FACTOR = 1.1


def exact_gain(u: Columns, v: Columns, limits: Limits) -> float | None:
    """The largest gain with low <= gain u - v <= high at all lit pixels; None if there is none."""
    lowest = 0.0
    highest = np.inf
    for slope, shift in zip(u, v, strict=True):
        is_constant = (slope == 0.0) | limits.masked[:, None]
        exceeded = limits.exceeded(-shift)
        if exceeded is not None and (exceeded & is_constant).any():
            return None
        divisor = np.where(is_constant, 1.0, slope)
        ends = np.stack([limits.low + shift, limits.highest + shift]) / divisor
        starts = np.min(ends, axis=0)
        stops = np.max(ends, axis=0)
        lowest = max(lowest, float(np.max(starts, where=~is_constant, initial=0.0)))
        highest = min(highest, float(np.min(stops, where=~is_constant, initial=np.inf)))
    if lowest <= highest and 0.0 < highest < np.inf:
        return highest
    return None


def gain_within_loss(
    problem: CompensationProblem, loss: float | None, undone: tuple[Columns, Columns] | None = None
) -> tuple[float, Columns]:
    """The largest gain within `loss`, and its light.

    Without a loss, the larger of rtol and 1.1 times the least error of all gains is allowed. Light
    without bounds, gain * slopes - shifts, is `undone`, where there is such light.
    """
    trials = GainTrials(problem)
    descent = _descent(trials, undone)
    if loss is None:
        loss = _default_loss(trials, descent)
    search = LargestGainSearch(trials, loss)
    if descent is not None and loss >= MIN_RESOLVED_ERROR:
        found = descent.largest(loss)
        if found is not None:
            return found.gain, found.light
    search.run()
    if search.low > 0.0:
        return search.low, search.best_light
    # The search has met no gain within the loss; the picture that comes closest may be.
    closest = ClosestPictureSearch(trials).run()
    if closest.sine <= loss:
        return closest.largest_gain(loss), closest.light
    raise InputError(
        f"gain is 'auto', but no gain brings the picture within a loss of {loss:g}; the least is "
        f"about {closest.sine:.3g}; give a larger loss, or brighten the picture's dark parts"
    )


def _descent(trials: GainTrials, undone: tuple[Columns, Columns] | None) -> GainDescent | None:
    """The search in one solve, if this problem allows it."""
    if trials.is_on_host:
        return None
    if undone is None:
        undone = trials.steepest_light()
    slopes, shifts = undone
    if not all(np.isfinite(light).all() for light in [*slopes, *shifts]):
        return None
    descent = GainDescent(trials, slopes, shifts, TOLERANCE)
    return descent if descent.is_usable else None


def _default_loss(trials: GainTrials, descent: GainDescent | None) -> float:
    """The larger of rtol and 1.1 times the least error of all gains."""
    rtol = trials.problem.settings.rtol
    enough = rtol / DEFAULT_LOSS_FACTOR
    sine = None
    if descent is not None and enough >= MIN_RESOLVED_ERROR:
        sine = descent.closest_sine(enough)
    if sine is None:
        sine = ClosestPictureSearch(trials, enough).run().sine
    return max(rtol, DEFAULT_LOSS_FACTOR * sine)


class LargestGainSearch:
    """Newton's search, from above, for the largest gain with h(gain) <= 0.

    Attributes
    ----------
    low, best_light : float, list of (N, k)
        The largest gain that was reached within the loss, 0 if none was, and its light.
    high : float
        No larger gain is within the loss.
    gain, accuracy, light : float, float, list of (N, k)
        The next trial: its gain, how exact it is solved, and where the solve starts.
    """

    def __init__(self, trials: GainTrials, loss: float) -> None:
        self.trials = trials
        self.loss = loss
        self.high, self.light = trials.upper_bound(loss)
        self.low = 0.0
        self.best_light = self.light
        self.gain = self.high
        self.accuracy = TRIAL_FRACTION * (1.0 - loss)

    def run(self) -> None:
        """Enclose the largest gain to the tolerance."""
        for _ in range(MAX_TRIALS):
            trial = self.trials.nearest(self.gain, self.light, self.accuracy)
            self.light = trial.light
            self._raise_low(trial)
            is_decided = True
            if trial.least > self.loss:
                if not self._has_smaller_gains(trial):
                    return
                self._follow_tangent(trial)
            elif trial.is_settled:
                self.high = self.gain
            else:
                # Neither reached nor refused: the same gain once more, but more exactly.
                self.accuracy /= 4
                is_decided = False
            if self.high <= (1.0 + TOLERANCE) * self.low:
                return
            if is_decided:
                self.gain = self.high * (1.0 - TOLERANCE / 2)

    def _raise_low(self, trial: GainTrial) -> None:
        reached = trial.largest_gain(self.loss)
        if reached > self.low:
            self.low = reached
            self.best_light = trial.light

    def _has_smaller_gains(self, trial: GainTrial) -> bool:
        """True if the tangent of h at this trial has a zero at a positive gain below."""
        rise = trial.slope - self.loss
        return rise > 0.0 and trial.least - self.loss < rise

    def _follow_tangent(self, trial: GainTrial) -> None:
        """Lower the upper end to the zero of the tangent."""
        rise = trial.slope - self.loss
        self.high = self.gain * (1.0 - (trial.least - self.loss) / rise)
        on_the_way = TRIAL_FRACTION * (trial.error - self.loss)
        at_the_end = FINAL_SOLVE_FRACTION * TOLERANCE * rise
        self.accuracy = max(on_the_way, at_the_end)


class ClosestPictureSearch:
    """Search for the light with the least sine of all gains, or one within `enough`.

    In t = 1 / gain the least error is convex: the next trial is where the tangents of those before
    are lowest, at most at twice the largest t.

    Attributes
    ----------
    t, farthest : float
        The next trial, and the largest t of those before, in units of 1 / the first gain.
    tangents : list of (a, b)
        Lines a + b t below the least error.
    bound : float
        The least height of these lines: no light has a smaller sine.
    """

    def __init__(self, trials: GainTrials, enough: float = 0.0) -> None:
        self.trials = trials
        self.enough = max(enough, MIN_ERROR)
        self.first_gain, self.light = trials.upper_bound(0.0)
        self.t = 1.0
        self.farthest = 1.0
        self.bound = 0.0
        self.tangents: list[tuple[float, float]] = []
        self.tried: list[GainTrial] = []

    def run(self) -> GainTrial:
        """The trial with the least sine, to the tolerance, or as far as limited solves tell it."""
        sine = 1.0
        for _ in range(MAX_TRIALS):
            bound_before = self.bound
            sine_before = sine
            self._try_next(sine)
            self.t, self.bound = lowest_of_tangents(self.tangents, 2 * self.farthest)
            sine = min(trial.sine for trial in self.tried)
            if sine <= max(self.enough, (1.0 + TOLERANCE) * self.bound):
                break
            # A solve that may take no more steps, and has told nothing new: nor will the next one.
            closed_in = max(sine_before - sine, self.bound - bound_before)
            is_limited = self.tried[-1].is_settled and not self.trials.is_on_host
            if is_limited and closed_in <= TOLERANCE / 4 * sine:
                break
        return min(self.tried, key=attrgetter("sine"))

    def _try_next(self, sine: float) -> None:
        on_the_way = TRIAL_FRACTION * (sine - self.bound)
        at_the_end = TOLERANCE / 4 * max(sine, self.enough)
        gain = self.first_gain / self.t
        trial = self.trials.nearest(gain, self._start(gain), max(on_the_way, at_the_end))
        self.tried.append(trial)
        self.tangents.append((trial.slope, (trial.least - trial.slope) / self.t))
        self.farthest = max(self.farthest, self.t)

    def _start(self, gain: float) -> Columns:
        """The light that came closest, at this gain."""
        if not self.tried:
            return self.light
        closest = min(self.tried, key=attrgetter("sine"))
        limits = self.trials.problem.limits
        factor = np.float32(gain / closest.gain)
        return [limits.clip(factor * light) for light in closest.light]
