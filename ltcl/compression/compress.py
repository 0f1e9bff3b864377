# SPDX-License-Identifier: BSD-3-Clause
"""`compress`: a transport on compressed operators, with a bound on what a solution loses.

R of every channel is written between bases in which it is sparse, and what is small is dropped: R~ = R + E.

    ||x~ - x|| / ||x|| <= ||S~^-1|| ||E||    since    x~ - x = -S~^-1 E x,    S~ = I + R~

What is dropped has a known Frobenius norm f. The 2-norm of E is at most that, and far less where it is noise:
how much less changes slowly with f, so that a few measured norms find the f that is wanted. They are measured
of what would be handed out, rounding of its numbers and all. Bases are compared on a window of the picture,
and the best takes the whole.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.compression.bases import NAMES, Bases, Stored, make_bases, store, validate_names
from ltcl.compression.coefficients import Coefficients, Magnitudes, Progress, require_room
from ltcl.compression.norms import MISS, Starts, fresh_starts, inverse_norm
from ltcl.compression.result import ChannelCompression, Compression, Trial
from ltcl.compression.sources import Inputs, Problem, validate_inputs, window_of
from ltcl.device import Device
from ltcl.errors import ConvergenceError, InputError, MemoryLimitError, ToleranceError
from ltcl.operators import IdentityPlus, ScaledColumns
from ltcl.theory import TwoNorm, two_norm
from ltcl.transport import Transport

Note = Callable[[str, float], object]
_GATHER = 0.7  # of what is allowed: Frobenius norm of what need not even be looked at
_MORE = 4  # times the numbers kept on the window, which the whole may need
_TRIES = 8
_AIM, _GROWTH = 0.94, 8.0  # of the tolerance, what is tried next; no step grows by more
_CLOSE = 0.85  # of the tolerance is good enough
_ROUNDING = 0.05  # of what is allowed, for the rounding of the core
_TRANSFORMS = 1e-6  # of coefficients that went through transforms in float32, rounded there
_FACTOR = 1.05  # between the bounds of a norm
_DIFFUSE = 2.0  # ||S^-1|| of a diffuse scene, as long as nothing was measured
_MOST = 512  # numbers a row, beyond which a basis is no use unless all are
_WIDE = 2.0  # times what is allowed: a Frobenius norm at which bases are compared before more is measured
_WORSE = 3  # times the numbers of the best then: left
_ALIKE = 1.25  # times the least launches x bytes: alike


def compress(
    T: Any,
    rtol: float = 1e-2,
    budget: int | None = None,
    *,
    basis: str | Sequence[str] | None = None,
    grid: tuple[int, int] | None = None,
    first_bounce: Any = None,
    device: Device | str | None = None,
    memory: int | None = None,
    progress: Note | None = None,
) -> Transport:
    """Write a transport in few numbers, at a known cost to its solutions.

    Parameters
    ----------
    T : Transport, or (N, N) rows of one
        Square. Or what gives the rows of T a block at a time and may be far larger than memory: an array or
        memory-mapped file, an HDF5 or zarr array, anything with ``shape`` and ``rows(start, stop)``; or an
        operator, whose rows are products of its transpose; a sequence of 3 of these for RGB. `grid` and
        `first_bounce` then come with it.
    rtol : float
        The relative error that a solution x of S x = b may have: ``||x~ - x|| <= rtol ||x||``, any b.
    budget : int, optional
        Bytes that the cores of all channels may take together on the device.
    basis : str or sequence of str, optional
        "pixels", a wavelet ("haar", "db2", "db4", ... on both sides), one for rows alone ("db2 rows", the
        paper's), or a sum of sharp parts in pixels and the smooth rest in wavelets ("db2 + pixels"). When not
        given, db2, haar, db4, pixels and the sum are tried.
    grid : (h, w)
        Of rows. A Transport has its own, and its first bounce.
    first_bounce : (N,) or (3, N), optional
        Of rows; their diagonal when not given.
    device : Device or str, optional
        Of rows.
    memory : int, optional
        Bytes of host memory for a block of rows. What lies between the passes over rows and over columns
        takes half of what is free; something is dropped there only where that is too little.
    progress : callable(text, share), optional
        Called as the work goes on.

    Returns
    -------
    Transport
        Its `error` is the bound on solutions, at most `rtol`, without what float32 rounds in products, 1e-7;
        `compression` a `Compression`, which tells how it was made.

    Raises
    ------
    InputError
        T is not square, compressed with an error, or does not fit the grid; rtol is not between 0 and 1, or
        below what float32 keeps; a basis is not orthonormal; the budget is below what rtol needs.
    ConvergenceError
        S is singular, or nearly so.

    Notes
    -----
    Bases are compared on the middle 64 x 64 pixels; the best has the least launches times bytes in a product
    of a solve, and the fewest bytes of those within a quarter of it; or, where that exceeds a budget, the
    fewest bytes. Nothing is timed: the same T gives the same bits on a device. A sum needs host memory for
    R a few times, and is left out where there is none. All bounds hold together but for a probability of two
    in a million over the random starts of norms; see `ltcl.compression.norms`.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    >>> C = ltcl.compress(T, rtol=0.05)
    >>> C.error <= 0.05, C.nbytes < T.nbytes
    (True, True)
    """
    began = time.perf_counter()
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    budget = None if budget is None else checks.count("budget", budget)
    names = validate_names(NAMES if basis is None else basis)
    memory = None if memory is None else checks.count("memory", memory)
    inputs = validate_inputs(T, grid, first_bounce, device, memory)
    C, channels = compress_inputs(
        inputs, names, rtol, fresh_starts("compress"), budget=budget, progress=progress
    )
    window, spent = window_of(inputs.grid), time.perf_counter() - began
    C.compression = Compression(rtol, budget, inputs.nbytes, window, spent, channels)
    return C


def compress_inputs(
    inputs: Inputs,
    names: Sequence[str],
    rtol: float,
    starts: Starts,
    *,
    budget: int | None = None,
    progress: Note | None = None,
) -> tuple[Transport, tuple[ChannelCompression, ...]]:
    """R of every channel in the best of the bases `names`, and what is told of each; else as `compress`."""
    problems, reached = inputs.problems, 0.0
    colours = ("red: ", "green: ", "blue: ") if len(problems) == 3 else ("",)

    def note(text: str, share: float) -> None:
        nonlocal reached
        reached = max(reached, share)  # a part that is done again does not count back
        if progress is not None:
            progress(text, reached)

    surveys = [_Survey(problem, rtol) for problem in problems]
    for number, survey in enumerate(surveys):
        for tried, name in enumerate(names):
            note(f"{colours[number]}trying {name}", 0.5 * (number + tried / len(names)) / len(problems))
            survey.add(name)
    needed = 0
    for by_bytes in (False, True):
        fits = []
        for number, survey in enumerate(surveys):

            def done(share: float, number: int = number) -> None:
                note(f"{colours[number]}all of it", 0.5 + 0.49 * (number + share) / len(problems))

            fits.append(survey.whole(by_bytes, starts, done))
        needed = sum(one.stored.nbytes for one in fits)
        if budget is None or needed <= budget:
            break
    else:
        raise InputError(
            f"budget is {budget} bytes, but rtol {rtol:g} needs {needed} ({checks.size(needed)}); raise one"
        )
    matrices = [
        ScaledColumns(one.system(problem), f)
        for problem, one, f in zip(problems, fits, inputs.F, strict=True)
    ]
    on_dark = "mask" if inputs.masked else "raise"
    C = Transport(matrices, inputs.grid, first_bounce=inputs.F, on_dark=on_dark, mixing=inputs.mixing)
    note("done", 1.0)
    return C, tuple(one.report(survey.trials) for one, survey in zip(fits, surveys, strict=True))


@dataclass(frozen=True)
class _Fit:
    """R~ in some bases: the numbers `kept` of all that were `gathered`, as they are stored.

    `norm` is that of R~ - R, `inverse` an upper bound on that of S~^-1, or a guess where nothing confirms it.
    """

    bases: Bases
    gathered: Coefficients
    kept: Coefficients
    stored: Stored
    norm: TwoNorm
    inverse: float

    @property
    def solution_error(self) -> float:
        """||x~ - x|| / ||x|| at most."""
        return self.norm.upper * self.inverse

    def system(self, problem: Problem) -> IdentityPlus:
        """S~ as it is handed out, with its errors and the diagonal of R."""
        try:
            diagonal = problem.operator.diagonal()
        except InputError:  # somebody's own operator may have none
            diagonal = None
        R = self.stored.operator(self.norm.upper, diagonal)
        return IdentityPlus(R, solution_error=self.solution_error)

    def trial(self) -> Trial:
        """What the report says of it as one of several."""
        stored, core = self.stored, self.kept.core
        form = (self.bases.name, "tiles", stored.cores[-1].width, stored.precision)
        return Trial(
            *form, core.nnz / (len(core.indptr) - 1), stored.nbytes, self.bases.launches, self.norm.upper
        )

    def report(self, trials: Sequence[Trial]) -> ChannelCompression:
        """What is told of a channel."""
        kept = self.kept
        return ChannelCompression(
            **vars(self.trial()),
            threshold=kept.threshold,
            dropped=kept.dropped,
            quantisation=self.stored.quantisation,
            inverse_norm=self.inverse,
            solution_error=self.solution_error,
            confidence=1.0 - MISS,
            trials=tuple(trials),
        )


def _fit(
    problem: Problem,
    bases: Bases,
    gathered: Coefficients,
    rtol: float,
    inverse: float,
    drop: float,
    starts: Starts | None = None,
    progress: Progress | None = None,
) -> _Fit:
    """R~ of fewest bytes that was found with a solution error of at most `rtol`.

    Of what was `gathered` the largest are kept; where all are too few, R is read again. `inverse` and `drop`
    are guesses of ||S~^-1|| and of the Frobenius norm to drop; without `starts` of norms that confirm what is
    handed out, `inverse` is believed.
    """
    best: _Fit | None = None
    share, sizes, low, high = math.inf, Magnitudes.of(gathered.core.data), 0.0, math.inf
    for _ in range(_TRIES):
        kept = gathered.above(sizes.threshold(math.sqrt(max(drop**2 - gathered.dropped**2, 0.0))))
        stored = store(problem.operator.device, bases, kept, _ROUNDING * rtol / inverse)
        R, transforms = (
            stored.operator(),
            _TRANSFORMS * float(np.linalg.norm(kept.core.data.astype(np.float64))),
        )
        certain = kept.dropped + transforms + stored.quantisation
        fresh = next(starts) if starts else {}
        norm = two_norm(problem.operator, R, factor=_FACTOR, frobenius=certain, **fresh)
        if starts and norm.upper * inverse <= rtol:
            inverse = inverse_norm(IdentityPlus(R), factor=_FACTOR, **next(starts)).upper
        found = _Fit(bases, gathered, kept, stored, norm, inverse)
        share = found.solution_error / rtol
        if share <= 1.0:
            low = drop
            best = found if best is None or found.stored.nbytes < best.stored.nbytes else best
            if share >= _CLOSE or not kept.core.nnz:
                break
        elif kept.core.nnz < gathered.core.nnz:
            high = drop
        else:  # all are too few
            finer = _GATHER * min(rtol / inverse, gathered.dropped / share)
            again = bases.gather(problem, finer, progress=progress) if gathered.dropped else gathered
            if not again.dropped < gathered.dropped:
                break
            gathered, sizes = again, Magnitudes.of(again.core.data)
        # How far the 2-norm lies below the Frobenius norm changes slowly: in proportion, a little short.
        guess = drop * min(_AIM / share, _GROWTH) if share else _GROWTH * drop
        if not low < guess < high:
            guess = math.sqrt(low * high) if low and high < math.inf else 2.0 * low or 0.5 * high
        drop = guess
        if high < 1.05 * low:
            break
    if best is None:
        least = float(checks.upwards(1.1 * share * rtol))
        raise ToleranceError(
            f"rtol is {rtol:g}, which float32 does not keep for this T; about {least:g} is what it does",
            least,
        )
    return best


@dataclass
class _Survey:
    """Bases that are tried one after the other on a window; the first also tells the norm of S^-1.

    The best has the least launches x bytes, and the fewest bytes of those alike; or the fewest bytes. Nothing
    is timed, so that the choice is the same each time.
    """

    problem: Problem
    rtol: float
    trials: list[Trial] = field(default_factory=list)
    fits: list[_Fit] = field(default_factory=list)
    refusals: list[ToleranceError | MemoryLimitError] = field(default_factory=list)
    inverse: float | None = None
    fewest: float = math.inf  # numbers that the best basis keeps at one Frobenius norm

    def __post_init__(self) -> None:
        self.window = self.problem.window()

    def add(self, name: str) -> None:
        """Try these bases, to the end unless they are no good."""
        bases = make_bases(self.window.operator.device, self.window.grid, name)
        try:
            if bases.is_sum:
                require_room(self.problem.pixels)
            self._try(bases)
        except (ToleranceError, MemoryLimitError) as error:
            self.refusals.append(error)
            self._leave(bases, 0, str(error))

    def _try(self, bases: Bases) -> None:
        window, rtol = self.window, self.rtol
        allowed = rtol / (self.inverse or _DIFFUSE)
        gathered = bases.gather(window, _GATHER * allowed, _MOST * window.pixels)
        sizes = Magnitudes.of(gathered.core.data)
        left = math.sqrt(max((_WIDE * allowed) ** 2 - gathered.dropped**2, 0.0))
        count = sizes.kept(sizes.threshold(left))
        if self.fits and count > _WORSE * self.fewest:
            times = count / max(self.fewest, 1)
            self._leave(bases, count, f"{times:.1f} times as many numbers at one Frobenius norm")
            return
        self.fewest = min(self.fewest, count)
        if self.inverse is None:
            try:
                R = store(window.operator.device, bases, gathered, 0.0).operator()
                self.inverse = inverse_norm(IdentityPlus(R)).upper
            except ConvergenceError:  # what was gathered is not good enough for that
                self.inverse = inverse_norm(IdentityPlus(window.operator)).upper
        found = _fit(window, bases, gathered, rtol, self.inverse, _WIDE * rtol / self.inverse)
        self.fits.append(found)
        self.trials.append(found.trial())

    def _leave(self, bases: Bases, count: int, why: str) -> None:
        kept = count / self.window.pixels
        self.trials.append(Trial(bases.name, "csr", 1, "float32", kept, 8 * count, bases.launches, None, why))

    def whole(self, by_bytes: bool, starts: Starts, done: Progress) -> _Fit:
        """All of R in the best bases, confirmed by norms from fresh starts."""
        if not self.fits:
            raise self.refusals[0]
        costs = [(1 if by_bytes else one.bases.launches) * one.stored.nbytes for one in self.fits]
        alike = [one for one, cost in zip(self.fits, costs, strict=True) if cost <= _ALIKE * min(costs)]
        best = min(alike, key=lambda one: one.stored.nbytes)
        problem, window, bases = self.problem, self.window, best.bases
        drop, gathered = best.kept.dropped, best.gathered
        if window is not problem:  # begun where the window ended: the same is dropped of each row
            bases = make_bases(problem.operator.device, problem.grid, bases.name)
            drop *= math.sqrt(problem.pixels / window.pixels)
            most = _MORE * math.ceil(best.kept.core.nnz / window.pixels) * problem.pixels
            gathered = bases.gather(problem, _GATHER * max(drop, self.rtol / best.inverse), most, done)
        return _fit(problem, bases, gathered, self.rtol, best.inverse, drop, starts, done)
