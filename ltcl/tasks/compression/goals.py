# SPDX-License-Identifier: BSD-3-Clause
"""Goals of a compression: `ByTolerance` bounds the error, `ByNoise` follows the noise of T.

The dropped numbers have a known Frobenius norm f. Their effect on pictures, or the 2-norm of E, is
measured, rounding and all: how far below f it lies changes slowly, so that a few measurements find
the f that is needed (`ThresholdSearch`). Bases are compared on a window.

Noise gives coefficients variances (W^2 u)_k (W^2 v)_l. By SURE (squares lost, and twice the
variance of what remains) c^2 above 2 variances is worth its bytes where the energy e_l of light is
large; where it is average, N e_l = 1, above 9: 2 + 14 / (1 + N e_l) variances. The basis of least
SURE is taken.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import ConvergenceError, ToleranceError
from ltcl.operators import IdentityPlus
from ltcl.tasks.compression.basis_pairs import Bases
from ltcl.tasks.compression.coefficients import Coefficients
from ltcl.tasks.compression.fit import Fit, Trial, error_norm
from ltcl.tasks.compression.inputs import CompressionProblem
from ltcl.tasks.compression.norms import Starts, inverse_norm
from ltcl.tasks.compression.pictures import (
    PictureError,
    lost_light,
    picture_error,
    typical_light,
)
from ltcl.tasks.compression.threshold_search import ThresholdSearch
from ltcl.theory import TwoNorm

# Of text, and of the share of the work that is done.
Note = Callable[[str, float], object]

# Pictures by which bases are compared.
COMPARED_PICTURES = 64
# ||S^-1|| of a diffuse scene, as long as nothing was measured.
DIFFUSE_INVERSE_NORM = 2.0
# Between the bounds of a norm; and of a norm on which no choice depends.
NORM_FACTOR = 1.05
COARSE_NORM_FACTOR = 1.5
# Part of what may be dropped: numbers below need not even be gathered.
GATHERED_SHARE = 0.7
# Part of what is allowed that rounding the core may take.
ROUNDING_SHARE = {"worst": 0.05, "pictures": 0.3}

# On the window: numbers a row beyond which a basis is of no use unless all are kept; times what
# may be dropped, by which bases are compared; times the numbers of the best basis beyond which one
# is left.
MAX_NUMBERS_PER_ROW = 512
TRIAL_DROP_FACTOR = 2.0
MAX_SIZE_RATIO = 3
# Times the numbers kept on the window, which the whole may need.
MAX_COEFFICIENT_RATIO = 4
MAX_THRESHOLDS = 8

# Standard deviations that stand out, where light is most, and where it is average.
SIGNIFICANT_WHERE_BRIGHT = math.sqrt(2.0)
SIGNIFICANT_ON_AVERAGE = 3.0
# Part of T.noise that is never taken back; and part of the noise of pictures for rounding the core.
MIN_NOISE_SCALE = 0.5
NOISE_ROUNDING_SHARE = 0.1


@dataclass(frozen=True)
class Confirmation:
    """Fresh random starts of norms and fresh draws of pictures, which confirm what is handed out.

    On the window there is none: a guess of ||S~^-1|| is believed, and few pictures suffice.
    """

    starts: Starts
    draws: Starts


class Goal(ABC):
    """Goal of a compression, by a `norm` "pictures" or "worst"."""

    norm: str

    @abstractmethod
    def compare(
        self, window: CompressionProblem, names: Sequence[str], note: Note
    ) -> tuple[Fit, list[Trial]]:
        """The best fit on a window, and all that was tried."""

    @abstractmethod
    def whole(
        self, problem: CompressionProblem, best: Fit, confirmation: Confirmation, note: Note
    ) -> Fit:
        """All of R in the bases that are best on the window."""


def bound_all_light(
    problem: CompressionProblem, fit: Fit, goal: Goal, confirmation: Confirmation
) -> Fit:
    """Complete a fit with a coarse bound for all light, where nothing depends on it."""
    if fit.norm is not None:
        return fit
    pictures = fit.pictures
    if goal.norm == "pictures" and pictures is None:
        pictures = picture_error(problem, fit.R, **next(confirmation.draws))
    start = next(confirmation.starts)
    norm = error_norm(problem, fit.numbers, fit.R, COARSE_NORM_FACTOR, **start)
    start = next(confirmation.starts)
    inverse = inverse_norm(IdentityPlus(fit.R), factor=COARSE_NORM_FACTOR, **start).upper
    return replace(fit, norm=norm, inverse=inverse, pictures=pictures)


@dataclass(frozen=True)
class ByTolerance(Goal):
    """An error of at most `rtol` by a `norm`."""

    norm: str
    rtol: float

    @property
    def is_of_pictures(self) -> bool:
        """True if pictures decide, not any light."""
        return self.norm == "pictures"

    def frobenius(self, inverse: float, pixels: int) -> float:
        """Estimate the norm that may be dropped; for pictures, if all light loses alike."""
        allowed = self.rtol / inverse
        if self.is_of_pictures:
            allowed *= math.sqrt(pixels)
        return allowed

    def bases(self, problem: CompressionProblem, name: str) -> Bases:
        """Bases of a name, with weights where pictures decide."""
        light = None
        if self.is_of_pictures:
            light = typical_light(problem, COMPARED_PICTURES)
        return Bases.named(problem.operator.device, problem.grid, name, light)

    def compare(
        self, window: CompressionProblem, names: Sequence[str], note: Note
    ) -> tuple[Fit, list[Trial]]:
        """The fit of fewest bytes on a window, and all that was tried.

        The first basis also tells the norm of S^-1, where that matters.
        """
        comparison = _Comparison(self, window)
        for number, name in enumerate(names):
            share = 0.5 * number / len(names)

            def note_trial(text: str, share: float = share) -> None:
                note(f"trying {text}", share)

            comparison.try_basis(name, note_trial)
        if not comparison.fits:
            raise comparison.refusals[0]
        best = min(comparison.fits, key=lambda fit: fit.nbytes)
        return best, comparison.trials

    def whole(
        self, problem: CompressionProblem, best: Fit, confirmation: Confirmation, note: Note
    ) -> Fit:
        """All of R, confirmed by norms or pictures."""
        pixels = problem.pixels
        window_pixels = best.rows
        bases = best.bases
        candidates = best.candidates
        # The search begins where the window ended, row by row.
        drop = best.numbers.dropped * math.sqrt(pixels / window_pixels)
        if window_pixels < pixels:
            bases = self.bases(problem, best.bases.name)
            allowed = max(drop, self.frobenius(best.inverse, pixels))
            numbers_per_row = math.ceil(best.numbers.core.nnz / window_pixels)

            def note_gathering(share: float) -> None:
                note("coefficients of all pixels", 0.5 + 0.4 * share)

            candidates = bases.gather(
                problem.R,
                note_gathering,
                drop=GATHERED_SHARE * allowed,
                most=MAX_COEFFICIENT_RATIO * numbers_per_row * pixels,
            )
        fitting = ToleranceFitting(
            goal=self,
            problem=problem,
            bases=bases,
            note=lambda text: note(text, 0.9),
            confirmation=confirmation,
        )
        fit = fitting.fit(candidates, best.inverse, drop)
        return bound_all_light(problem, fit, self, confirmation)


class _Comparison:
    """Bases that are tried one after the other on a window."""

    def __init__(self, goal: ByTolerance, window: CompressionProblem) -> None:
        self.goal = goal
        self.window = window
        self.fits: list[Fit] = []
        self.trials: list[Trial] = []
        self.refusals: list[ToleranceError] = []
        self.fewest = math.inf  # numbers of the best basis so far
        # Norm of S^-1: a guess, until the first basis tells it where it matters.
        self.inverse = DIFFUSE_INVERSE_NORM
        self.is_inverse_known = goal.is_of_pictures

    def try_basis(self, name: str, note: Callable[[str], object]) -> None:
        """Fit in one basis, unless it needs far more numbers than another."""
        note(name)
        pixels = self.window.pixels
        bases = self.goal.bases(self.window, name)
        allowed = self.goal.frobenius(self.inverse, pixels)
        candidates = bases.gather(
            self.window.R, drop=GATHERED_SHARE * allowed, most=MAX_NUMBERS_PER_ROW * pixels
        )
        count = candidates.largest(TRIAL_DROP_FACTOR * allowed).core.nnz
        if self.fits and count > MAX_SIZE_RATIO * self.fewest:
            ratio = count / max(self.fewest, 1)
            self._leave(name, count, f"{ratio:.1f} times as many numbers for the same error")
            return
        self.fewest = min(self.fewest, count)
        if not self.is_inverse_known:
            note(f"{name}: norm of S^-1")
            self.inverse = self._inverse_norm(bases, candidates)
            self.is_inverse_known = True
        fitting = ToleranceFitting(
            goal=self.goal, problem=self.window, bases=bases, note=note, confirmation=None
        )
        drop = TRIAL_DROP_FACTOR * self.goal.frobenius(self.inverse, pixels)
        try:
            fit = fitting.fit(candidates, self.inverse, drop)
        except ToleranceError as error:
            self.refusals.append(error)
            self._leave(name, count, str(error))
            return
        self.fits.append(fit)
        self.trials.append(fit.trial())

    def _inverse_norm(self, bases: Bases, candidates: Coefficients) -> float:
        try:
            R = bases.compressed(candidates.core, 0.0)
            return inverse_norm(IdentityPlus(R)).upper
        except ConvergenceError:
            # The candidates are not good enough for that.
            return inverse_norm(IdentityPlus(self.window.operator)).upper

    def _leave(self, name: str, count: int, reason: str) -> None:
        """Note that a basis is left, and why."""
        trial = Trial(
            basis=name,
            format="csr",
            width=1,
            precision="float32",
            kept=count / self.window.pixels,
            nbytes=8 * count,
            error=None,
            left=reason,
        )
        self.trials.append(trial)


@dataclass(frozen=True)
class _Measured:
    """R~ of some numbers, its fit, and the least error that no smaller rounding could undercut."""

    fit: Fit
    least_error: float


@dataclass(frozen=True, kw_only=True)
class ToleranceFitting:
    """Search for R~ of fewest bytes in some bases, with a solution error within `goal.rtol`."""

    goal: ByTolerance
    problem: CompressionProblem
    bases: Bases
    note: Callable[[str], object]
    confirmation: Confirmation | None

    def fit(self, candidates: Coefficients, inverse: float, drop: float) -> Fit:
        """R~ of the largest `candidates`; where all of them are too few, R is read again.

        `inverse` and `drop` are guesses of ||S~^-1|| and of the Frobenius norm to drop.
        """
        rtol = self.goal.rtol
        search = ThresholdSearch(drop)
        best: Fit | None = None
        share = math.inf  # of the tolerance, that the last fit takes
        for number in range(MAX_THRESHOLDS):
            stage = f"{self.bases.name}, threshold {number + 1}"
            self.note(stage)
            measured = self._measure(candidates, inverse, search.drop, stage)
            fit = measured.fit
            inverse = fit.inverse
            share = fit.solution_error / rtol
            if share <= 1.0:
                search.accept()
                if best is None or fit.nbytes < best.nbytes:
                    best = fit
                if search.is_close(share) or not fit.numbers.core.nnz:
                    break
            elif self._is_rounding_alone(measured):
                break
            elif fit.numbers.core.nnz < candidates.core.nnz:
                search.reject()
            else:  # all candidates are too few
                finer = self._gather_finer(candidates, inverse, share)
                if not finer.dropped < candidates.dropped:
                    break
                candidates = finer
            widest = self.goal.frobenius(inverse, self.problem.pixels)
            if not search.advance(share, widest):
                break
        if best is None:
            least = float(checks.upwards(1.25 * share * rtol))
            raise ToleranceError(
                f"rtol is {rtol:g}, but float32 reaches about {least:g} for this T", least
            )
        return best

    def _measure(
        self, candidates: Coefficients, inverse: float, drop: float, stage: str
    ) -> _Measured:
        """R~ without numbers of the Frobenius norm `drop`, and its error."""
        numbers = candidates.largest(drop)
        allowance = ROUNDING_SHARE[self.goal.norm] * self.goal.rtol / inverse
        R = self.bases.compressed(numbers.core, allowance)
        norm: TwoNorm | None = None
        pictures: PictureError | None = None
        if self.goal.is_of_pictures:
            pictures = self._picture_error(R)
            least_error = pictures.error
        else:
            norm = error_norm(self.problem, numbers, R, NORM_FACTOR, **self._next_start())
            least_error = norm.estimate * inverse
            is_promising = norm.upper * inverse <= self.goal.rtol
            if self.confirmation is not None and is_promising:
                self.note(f"{stage}: norm of S^-1")
                start = self._next_start()
                inverse = inverse_norm(IdentityPlus(R), factor=NORM_FACTOR, **start).upper
        fit = Fit(
            bases=self.bases,
            candidates=candidates,
            numbers=numbers,
            R=R,
            norm=norm,
            inverse=inverse,
            pictures=pictures,
        )
        return _Measured(fit, least_error)

    def _next_start(self) -> dict[str, Any]:
        if self.confirmation is None:
            return {}
        return next(self.confirmation.starts)

    def _picture_error(self, R: Any) -> PictureError:
        draw: dict[str, Any] = {"count": COMPARED_PICTURES}
        if self.confirmation is not None:
            draw = next(self.confirmation.draws)
        return picture_error(self.problem, R, **draw)

    def _is_rounding_alone(self, measured: _Measured) -> bool:
        """True if the error is above the tolerance by rounding, which is as fine as it can be."""
        fit = measured.fit
        if fit.R.core.precision != "float32":
            return False
        dropped = fit.numbers.dropped * fit.inverse
        return measured.least_error - dropped > self.goal.rtol

    def _gather_finer(self, candidates: Coefficients, inverse: float, share: float) -> Coefficients:
        """More candidates, where some were dropped."""
        if not candidates.dropped:
            return candidates
        allowed = self.goal.frobenius(inverse, self.problem.pixels)
        drop = GATHERED_SHARE * min(allowed, candidates.dropped / share)
        return self.bases.gather(self.problem.R, drop=drop)


@dataclass(frozen=True)
class ByNoise(Goal):
    """The numbers that stand out of the noise of T."""

    norm: str

    def compare(
        self, window: CompressionProblem, names: Sequence[str], note: Note
    ) -> tuple[Fit, list[Trial]]:
        """The fit of least risk on a window, and all that was tried."""
        fits = []
        for number, name in enumerate(names):
            share = 0.5 * number / len(names)
            note(f"trying {name}", share)
            bases = self._bases(window, name)
            note(f"trying {name}, noise", share)
            fits.append(self._significant(window, bases))
        best = min(fits, key=lambda fit: (fit.risk, fit.nbytes))
        return best, [fit.trial() for fit in fits]

    def whole(
        self, problem: CompressionProblem, best: Fit, confirmation: Confirmation, note: Note
    ) -> Fit:
        """All of R in the bases of least risk."""
        fit = best
        if best.rows < problem.pixels:
            bases = self._bases(problem, best.bases.name)
            note(f"{bases.name}, noise", 0.5)
            fit = self._significant(problem, bases)
        return bound_all_light(problem, fit, self, confirmation)

    def _bases(self, problem: CompressionProblem, name: str) -> Bases:
        light = typical_light(problem, COMPARED_PICTURES)
        return Bases.named(problem.operator.device, problem.grid, name, light)

    def _significant(self, problem: CompressionProblem, bases: Bases) -> Fit:
        """R~ of the numbers that stand out of the noise."""
        rows, columns = bases.noise(np.asarray(problem.noise))
        # 1. Gather the numbers that may stand out, times the weights.
        squared_weights = bases.weights**2
        low = SIGNIFICANT_WHERE_BRIGHT**2
        average = SIGNIFICANT_ON_AVERAGE**2
        limits = np.sqrt(low + 2.0 * (average - low) / squared_weights)
        smallest_column = _smallest_lit(limits * columns)
        least = MIN_NOISE_SCALE * _smallest_lit(rows) * smallest_column
        if not math.isfinite(least):
            least = 0.0
        gathered = bases.gather(problem.R, threshold=least)
        core = gathered.core.copy()

        # 2. Drop those within the noise. Its scale is corrected first: dropped numbers have all of
        # their noise, and where they are less than T.noise says, that is too much.
        noise = np.repeat(rows, np.diff(core.indptr))
        noise *= columns[core.indices]
        is_small = np.abs(core.data) < limits[core.indices] * noise
        dropped_square = gathered.dropped**2 + np.sum(core.data[is_small] ** 2)
        total_noise = float(np.sum(rows**2) * np.sum(columns**2))
        dropped_noise = total_noise - np.sum(noise[~is_small] ** 2)
        if dropped_noise > 0.0:
            scale = math.sqrt(dropped_square / dropped_noise)
            noise *= np.clip(scale, MIN_NOISE_SCALE, 1.0)
        is_small = np.abs(core.data) < limits[core.indices] * noise
        kept_columns = core.indices[~is_small]
        kept_noise = noise[~is_small]
        second = math.hypot(gathered.second, np.linalg.norm(core.data[is_small]))
        core.data[is_small] = 0.0
        core.eliminate_zeros()
        numbers = replace(gathered, core=core, second=second)

        # 3. Estimate the squared error of pictures: squares lost, and twice the variance kept.
        column_noise = np.sum(columns**2 / squared_weights)
        noise_of_pictures = math.sqrt(np.mean(rows**2) * column_noise)
        R = bases.compressed(core, NOISE_ROUNDING_SHARE * noise_of_pictures)
        light = typical_light(problem, COMPARED_PICTURES)
        lost, _ = lost_light(problem, R, light)
        # Energies of light over the weights, which `kept_noise` holds.
        energies = (1.0 - 1.0 / squared_weights) / len(squared_weights)
        risk = np.sum(lost**2) / COMPARED_PICTURES
        risk += 2.0 * np.sum(kept_noise**2 * energies[kept_columns])
        return Fit(
            bases=bases,
            candidates=gathered,
            numbers=numbers,
            R=R,
            inverse=DIFFUSE_INVERSE_NORM,
            risk=float(risk),
        )


def _smallest_lit(deviations: np.ndarray) -> float:
    """The smallest deviation above 0, infinite where there is none."""
    return float(np.min(deviations, where=deviations > 0.0, initial=np.inf))
