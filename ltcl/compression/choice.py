# SPDX-License-Identifier: BSD-3-Clause
"""Which basis, threshold, tile and precision: by measurement on this operator and this device.

Every basis is given the threshold at which the error just stays within the goal; of what then remains, the
least product of time and bytes wins: `cores.choose`. The goal is on the 2-norm of E = R~ - R:

    ||x~ - x|| / ||x|| <= ||S~^-1|| ||E||    since    x~ - x = -S~^-1 E x
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ltcl import checks
from ltcl.compression import cores, fit, kinds, parted
from ltcl.compression.coefficients import Coefficients
from ltcl.compression.cores import Core
from ltcl.compression.fit import Fit, Problem
from ltcl.compression.inverse_norm import inverse_norm
from ltcl.compression.kinds import Kind
from ltcl.compression.magnitudes import Magnitudes
from ltcl.compression.result import Trial
from ltcl.errors import ConvergenceError, MemoryLimitError, ToleranceError
from ltcl.operators import Compressed, IdentityPlus, Sum

DROPPING, ROUNDING = 0.9, 0.05  # of the goal, for what is dropped and for the rounding of the core
GATHER = 0.7  # of the goal: Frobenius norm of what need not even be looked at
_MOST = 512  # numbers a row, beyond which a basis is no use unless all are
_ALIKE = 2.0  # of the goal: a Frobenius norm at which bases are compared before more is measured
_WORSE = 3  # times the numbers of the best then: left
_LOOSER = 1.25  # times the tolerance, where float32 does not keep it
Find = Callable[[str], Kind]  # a kind by its name, on the grid of the problem


@dataclass(frozen=True)
class Candidate:
    """A basis that was tried to the end."""

    fit: Fit
    core: Core
    seconds: float | None
    found: Coefficients

    def trial(self, pixels: int) -> Trial:
        """What the report says of it."""
        core, kept = self.core, self.fit.coefficients.core.nnz / pixels
        return Trial(
            self.fit.kind.name,
            core.format,
            core.width,
            core.precision,
            kept,
            core.nbytes,
            self.fit.norm.upper,
            self.seconds,
        )


@dataclass(frozen=True)
class Choice:
    """The best candidate, what was tried, and the goal that it meets."""

    best: Candidate
    trials: tuple[Trial, ...]
    goal: float


def choose(
    problem: Problem,
    names: Sequence[str],
    rtol: float,
    budget: float = math.inf,
    find: Find | None = None,
    note: Callable[[str], object] = lambda text: None,
) -> Choice:
    """The best of the kinds `names` for a solution within `rtol` and a core within `budget` bytes.

    Where no core is within the budget, it is the smallest.

    Raises
    ------
    ToleranceError
        Float32 does not keep the tolerance; it says which it does.
    """
    if all(name.endswith(kinds.SUM) for name in names):
        parted.require_room(problem.whole or problem.pixels)
    find = find or (lambda name: kinds.kind(problem.device, problem.grid, name))
    for most in (_MOST * problem.pixels, None):
        survey = _Survey(problem, find, rtol, budget, most)
        for name in names:
            note(name)
            survey.add(name)
        if survey.candidates:
            break
    if not survey.candidates:
        least = survey.least()
        kept = f"the least that it does is {checks.upwards(least)}" if least < 1.0 else "nor any below 1"
        why = f"rtol is {rtol:g}, which float32 does not keep for this T; {kept}"
        raise ToleranceError(why, least)
    smallest = min(survey.candidates, key=lambda one: one.core.nbytes)
    fits = [one for one in survey.candidates if one.core.nbytes <= budget] or [smallest]
    costs = [(one.seconds, one.core.nbytes) for one in fits]
    return Choice(fits[cores.choose(costs, cores.launch(problem.device))], tuple(survey.trials), survey.goal)


class _Survey:
    """Kinds, tried one after the other; the first also tells the norm of S^-1 and so the goal."""

    def __init__(self, problem: Problem, find: Find, rtol: float, budget: float, most: int | None) -> None:
        self.problem, self.find, self.rtol, self.budget, self.most = problem, find, rtol, budget, most
        self.goal = 0.5 * rtol
        self._known = False
        self._least = math.inf  # numbers that the best basis keeps then
        self._closest = ("", math.inf)  # the kind of the smallest error, where it is beyond the goal
        self.candidates: list[Candidate] = []
        self.trials: list[Trial] = []

    def add(self, name: str) -> None:
        kind, dropping = self.find(name), DROPPING * self.goal
        if kind.sum:
            try:
                parted.require_room(self.problem.whole or self.problem.pixels)
            except MemoryLimitError as error:
                self._leave(name, 0, str(error))
                return
        found = fit.gather(self.problem, kind, GATHER * dropping, self.most)
        alike = _kept(found, _ALIKE * self.goal)
        if alike > _WORSE * self._least:
            why = f"{alike / self._least:.1f} times as many numbers at one Frobenius norm"
            self._leave(name, alike, why)
            return
        self._least = min(self._least, alike)
        fitted = fit.fit(self.problem, kind, found, dropping)
        if not self._known:
            self.goal, self._known = self.rtol / inverse_bound(self.problem, fitted), True
            dropping = DROPPING * self.goal
            if found.dropped > dropping:
                found = fit.gather(self.problem, kind, GATHER * dropping, self.most)
            start = fitted.coefficients.dropped * dropping / max(fitted.norm.upper, 1e-30)
            fitted = fit.fit(self.problem, kind, found, dropping, start)
        if fitted.norm.upper > dropping:
            self._closest = min(self._closest, (name, fitted.norm.upper), key=lambda one: one[1])
            self._leave(name, found.core.nnz, "so many numbers are too few", fitted.norm.upper)
            return
        active = fitted.active()  # as it is handed out
        core = active.best(self.problem.device, ROUNDING * self.goal, self.budget)
        candidate = Candidate(fitted, core, seconds(active.operator(core.operator), core), found)
        self.candidates.append(candidate)
        self.trials.append(candidate.trial(self.problem.pixels))

    def least(self) -> float:
        """The least tolerance that is kept, to a quarter, where none of the kinds keeps this one."""
        name, error = self._closest
        rtol = error * self.rtol / self.goal / DROPPING
        while rtol < 1.0:
            looser = _Survey(self.problem, self.find, rtol, math.inf, None)
            looser.add(name)
            if looser.candidates:
                break
            rtol *= _LOOSER
        return rtol

    def _leave(self, name: str, count: int, why: str, error: float | None = None) -> None:
        kept = count / self.problem.pixels
        self.trials.append(Trial(name, "csr", 1, "float32", kept, 8 * count, error, None, why))


def _kept(found: Coefficients, frobenius: float) -> int:
    """Numbers that are left where this Frobenius norm is dropped."""
    sizes = Magnitudes.of(found.core.data)
    return sizes.kept(sizes.threshold(math.sqrt(max(frobenius**2 - found.dropped**2, 0.0))))


def inverse_bound(problem: Problem, fitted: Fit) -> float:
    """Upper bound on ||S~^-1||, by the fit where it is good enough for that, else by R itself."""
    if fitted.norm.upper < 0.1:
        try:
            R = fit.exact(problem.device, fitted.kind, fitted.coefficients)
            return inverse_norm(IdentityPlus(R)).upper
        except ConvergenceError:
            pass
    return inverse_norm(IdentityPlus(problem.operator)).upper


def seconds(R: Compressed | Sum, core: Core) -> float | None:
    """Of a product in a solve, which runs on the core alone where both bases are one."""
    alone = isinstance(R, Compressed) and R.two_sided
    return core.seconds if core.seconds is None or alone else cores.seconds(R)
