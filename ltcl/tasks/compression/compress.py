# SPDX-License-Identifier: BSD-3-Clause
"""`compress`: a transport on compressed operators, and what pictures, or any light, may lose by that.

R of every channel is written between bases in which it is sparse, and what is small is dropped: R~
= R + E.

    ||x~ - x|| / ||x|| <= ||S~^-1|| ||E||    since    x~ - x = -S~^-1 E x,    S~ = I + R~

What is dropped has a known Frobenius norm f. What it makes of pictures (`pictures`), or the 2-norm
of E, is measured, rounding and all: how far below f it lies changes slowly, so that a few
measurements find the f that is needed. Bases are compared on a window.

A dropped number c of column l costs light of energies e about c^2 e_l: it is weighted by sqrt(1 + N
e_l), for single pixels and for pictures. Noise gives coefficients variances (W^2 u)_k (W^2 v)_l. By
SURE (squares lost, and twice the variance of the rest) c^2 above 2 variances is worth its bytes
where e_l is large; where it is average, N e_l = 1, above 9: 2 + 14 / (1 + N e_l) variances. Of
bases the one of least SURE is taken.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.batch import cluster
from ltcl.device import Device
from ltcl.errors import ConvergenceError, InputError, InputTypeError, ToleranceError
from ltcl.operators import Compressed, IdentityPlus, ScaledColumns, Tiles
from ltcl.tasks.compression import losses
from ltcl.tasks.compression.coefficients import INVERSE_NAMES, Bases, Coefficients, basis_names
from ltcl.tasks.compression.losses import (
    PictureError,
    Starts,
    fresh_starts,
    inverse_norm,
    picture_error,
)
from ltcl.tasks.compression.sources import (
    Inputs,
    Problem,
    memory_errors,
    validate_inputs,
    window_of,
)
from ltcl.theory import TwoNorm, two_norm
from ltcl.transport.transport import Transport, check_transport

Note = Callable[[str, float], object]
_GATHER = 0.7  # of what is allowed: Frobenius norm of what need not even be looked at
_MORE, _TRIES = 4, 8  # times the numbers kept on the window, which the whole may need; thresholds
_AIM, _CLOSE, _GROWTH = (
    0.96,
    0.92,
    8.0,
)  # of the tolerance, tried next; enough; no step grows by more
_ROUNDING = {"worst": 0.05, "pictures": 0.3}  # of what is allowed, for rounding the core
_GUESS = 64  # pictures by which bases are compared
_NOISE = (
    math.sqrt(2.0),
    3.0,
)  # deviations that stand out, where light is most, and where it is average
_LEAST, _QUIET = (
    0.5,
    0.1,
)  # of T.noise, never taken back; of that of pictures, for rounding the core
_TRANSFORMS = 1e-6  # of coefficients that went through transforms in float32, rounded there
_FACTOR, _COARSE = 1.05, 1.5  # between the bounds of a norm, and of one on which no choice depends
_DIFFUSE = 2.0  # ||S^-1|| of a diffuse scene, as long as nothing was measured
_MOST = 512  # numbers a row, beyond which a basis is no use unless all are
_WIDE, _WORSE = (
    2.0,
    3,
)  # times what may be dropped: bases of more numbers than 3 times the best are left


@dataclass(frozen=True)
class Trial:
    """R in one basis, tried on a window of pixels or on the whole.

    `format` ("tiles"; "csr" where none were made), `width` and `precision` are of the core. `kept`
    numbers in a row take `nbytes`. `error` is an upper bound on the 2-norm of R~ - R, rounding
    included; None where pictures chose, or the basis was `left` before, and why.
    """

    basis: str
    format: str
    width: int
    precision: str
    kept: float
    nbytes: int
    error: float | None
    left: str = ""


@dataclass(frozen=True, kw_only=True)
class ChannelCompression(Trial):
    """One colour channel: what was taken, of the whole R.

    Numbers below `threshold` were dropped, times the weights of columns, at least 1, unless the
    norm is "worst"; `dropped` is the Frobenius norm of these products, so a bound on that of what
    was dropped, and `quantisation` of what rounding of the core changed. `inverse_norm` bounds the
    2-norm of S~^-1; its product with `error` is `error_bound`, which bounds ``||x~ - x|| / ||x||``.
    `confidence` is that the bounds of all channels hold, over the random starts of the norms.
    `solution_error` is what the norm states: this bound, or that of `pictures`, which has a share
    and confidence of its own.
    """

    threshold: float
    dropped: float
    quantisation: float
    inverse_norm: float
    solution_error: float
    error_bound: float
    pictures: PictureError | None
    confidence: float
    trials: tuple[Trial, ...]


@dataclass(frozen=True, repr=False)
class Compression:
    """How a compressed transport was made; its ``.compression``.

    `rtol`, `norm` and `budget` are as asked for, `uncompressed` the bytes of T before (of rows, in
    float32), `window` (h, w) the pixels that bases were tried on, and `channels` 1 or 3
    `ChannelCompression`.
    """

    rtol: float | str
    norm: str
    budget: int | None
    uncompressed: int
    window: tuple[int, int]
    seconds: float
    channels: tuple[ChannelCompression, ...]

    def __repr__(self) -> str:
        bases = ", ".join(channel.basis for channel in self.channels)
        return (
            f"<ltcl Compression of {checks.size(self.uncompressed)} to rtol {self.rtol} in {bases}>"
        )


def compress(
    T: Any,
    rtol: float | str = 1e-2,
    budget: int | None = None,
    *,
    norm: str = "pictures",
    basis: str | Sequence[str] | None = None,
    grid: tuple[int, int] | None = None,
    first_bounce: Any = None,
    device: Device | str | None = None,
    memory: int | None = None,
    client: Any = None,
    progress: Note | None = None,
) -> Transport:
    """Write a transport in few numbers, at a known cost to its solutions.

    Parameters
    ----------
    T : Transport, or (N, N) rows of one
        Rows may be far larger than memory: an array or memory-mapped file, an HDF5 or zarr array,
        anything with ``shape`` and ``rows(start, stop)`` that gives (stop - start, N) real numbers;
        or an operator, whose rows are products of its transpose; a sequence of 3 of these for RGB.
    rtol : float or "noise"
        The relative error that pictures may have, in the 2-norm, or that is allowed of every light;
        see `norm`. "noise" keeps what stands out of `T.noise`, a Transport's, by 3 standard
        deviations; by 1.4 where pictures have most of their light, by 4 where they have none.
    budget : int, optional
        Bytes that the cores of all channels may take together on the device.
    norm : "pictures" or "worst"
        Whose error `rtol` limits and the result's `error` states. That of pictures is the largest
        loss of 256 fresh random ones, a quarter each of 1 / f spectra (amplitudes f^-0.8 to f^-1.4,
        log-normal values), straight edges, strokes as of text, and one lit rectangle, half of these
        a single pixel. A picture p may lose ``||E x|| / ||S x||`` of its appearance T p and
        ``||S~^-1 E x|| / ||x||`` of its direct light x = F p, where E was dropped of R; every other
        picture is a target, x the light that compensates for it. At least 95 % of such pictures
        lose no more, with 99 % confidence, whatever the distribution of losses. In `compensate`
        that is the error of the pattern, and of what it shows; in `separate` of direct light, and
        of the sum of all bounces relative to direct light. "worst" is a bound, ``||x~ - x|| <= rtol
        ||x||`` for the solution of S x = b with any b.
    basis : str or sequence of str, optional
        "pixels", a wavelet ("haar", "db2", "db4", ... on both sides), or one for rows alone ("db2
        rows", the paper's). Several, or db2, haar, db4 and pixels when not given, are compared on
        the middle 64 x 64 pixels; that of the fewest bytes is taken.
    grid, first_bounce, device : (h, w); (N,) or (3, N), optional; Device or str, optional
        Of rows; a Transport has its own. The first bounce is their diagonal when not given.
    memory : int, optional
        Bytes of host memory for a block of rows. Between the passes over rows and over columns half
        of what is free is taken; something is dropped there only where that is too little.
    client : distributed.Client, optional
        Its workers read, transform and multiply the blocks of rows: those of a Dask array, of a
        zarr array that they see, and of what has ``rows`` by themselves; others are sent. The
        numbers are the same.
    progress : callable(text, share), optional
        Called as the work goes on.

    Returns
    -------
    Transport
        Its `error` is that of `norm`, at most `rtol`, without what float32 rounds in products,
        1e-7, and its `error_bound` that of "worst". But for a probability of two in a million over
        the random starts of norms all bounds hold together. `compression` is a `Compression`. The
        same T gives the same bits on a device.

    Raises
    ------
    InputError
        T is not square, compressed with an error, or does not fit the grid; rtol is not between 0
        and 1, or below what float32 keeps; a basis is not orthonormal; the budget is below what
        rtol needs.
    ConvergenceError
        S is singular, or nearly so.
    MemoryLimitError
        A block of rows does not fit into `memory`, or what remains of R into that of the host.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    >>> C = ltcl.compress(T, rtol=0.05)
    >>> C.error <= 0.05, C.error < C.error_bound, C.nbytes < T.nbytes
    (True, True, True)
    """
    began = time.perf_counter()
    rtol = rtol if isinstance(rtol, str) and rtol == "noise" else validate_rtol(rtol, losses.UNIT)
    goal = Goal(
        checks.one_of("norm", norm, tuple(_ROUNDING)), math.nan if rtol == "noise" else float(rtol)
    )
    budget = None if budget is None else checks.count("budget", budget)
    memory = None if memory is None else checks.count("memory", memory)
    names = basis_names(INVERSE_NAMES if basis is None else basis)
    note = validate_progress(progress)
    if client is not None:
        cluster.require(client)
    with memory_errors("compress", T):
        noise = check_transport(T).noise if rtol == "noise" else None
        inputs = validate_inputs(T, grid, first_bounce, device, noise, memory=memory, client=client)
        C, channels = compress_inputs(inputs, names, goal, fresh_starts("compress"), note)
    needed = sum(channel.nbytes for channel in channels)
    if budget is not None and needed > budget:
        advice = f"give a budget of at least {needed} bytes, or a larger rtol"
        what = f"budget is {budget} bytes, but rtol {rtol} needs {needed} ({checks.size(needed)})"
        raise InputError(f"{what}; {advice}")
    window, spent = window_of(C.grid), time.perf_counter() - began
    C.compression = Compression(rtol, norm, budget, inputs.nbytes, window, spent, channels)
    return C


@dataclass(frozen=True)
class Goal:
    """What a compression has to reach: an error of at most `rtol` by a `norm`; NaN is what noise allows."""

    norm: str
    rtol: float

    def frobenius(self, inverse: float, pixels: int) -> float:
        """About the Frobenius norm that may be dropped; of pictures where all light loses alike."""
        return self.rtol / inverse * (math.sqrt(pixels) if self.norm == "pictures" else 1.0)


def validate_rtol(rtol: Any, least: float) -> float:
    """`rtol`, refused before any work where a product in float32 already rounds by as much."""
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    if rtol <= least:
        message = (
            f"rtol is {rtol:g}; it must be above {checks.upwards(least)}, which float32 rounds"
        )
        raise ToleranceError(message)
    return rtol


def validate_progress(progress: Note | None) -> Note:
    """`progress`, or in its place a function that does nothing."""
    if progress is not None and not callable(progress):
        raise InputTypeError(f"progress is {progress!r}; it must be callable(text, share), or None")
    return progress or (lambda text, share: None)


def compress_inputs(
    inputs: Inputs, names: Sequence[str], goal: Goal, starts: Starts, progress: Note
) -> tuple[Transport, tuple[ChannelCompression, ...]]:
    """R of every channel in the best of the bases `names`, and what is reported of each."""
    colours = ("red: ", "green: ", "blue: ") if len(inputs.problems) == 3 else ("",)
    matrices, reports, draws = [], [], fresh_starts("pictures", 1.0 - losses.PICTURES)
    for number, problem in enumerate(inputs.problems):
        note = lambda text, share, c=number: progress(colours[c] + text, (c + share) / len(colours))  # noqa: E731
        best, trials = _compare(problem, names, goal, note)
        fit = _whole(problem, best, goal, starts, draws, note)
        matrices.append(ScaledColumns(fit.system(problem), problem.F))
        reports.append(fit.report(trials))
        note("done", 1.0)
    return Transport(matrices, dark_threshold=0.0, **inputs.settings), tuple(reports)


@dataclass(frozen=True)
class _Fit:
    """R~ in some bases: the largest `numbers` of the `candidates`, rounded.

    `norm` is that of R~ - R, `inverse` an upper bound on that of S~^-1, or a guess where nothing
    confirms it, `pictures` what these lose, and `risk` the estimated squared error of theirs where
    noise decides.
    """

    bases: Bases
    candidates: Coefficients
    numbers: Coefficients
    R: Any  # Compressed, of Tiles
    norm: TwoNorm | None
    inverse: float
    pictures: PictureError | None
    risk: float = 0.0

    @property
    def nbytes(self) -> int:
        """Of the core, without a transpose that products made."""
        return self.R.core.packed.nbytes

    @property
    def error_bound(self) -> float:
        """||x~ - x|| / ||x|| at most."""
        return self.norm.upper * self.inverse if self.norm else math.inf

    @property
    def solution_error(self) -> float:
        """What the norm states."""
        return self.pictures.error if self.pictures else self.error_bound

    def system(self, problem: Problem) -> IdentityPlus:
        """S~ as it is handed out, with its errors and the diagonal of R, on a core without a transpose."""
        try:
            diagonal = problem.operator.diagonal()
        except InputError:  # somebody's own operator may have none
            diagonal = None
        error, core = (
            self.norm.upper if self.norm else math.inf,
            Tiles(self.R.device, self.R.core.packed),
        )
        R = Compressed(core, self.R.out, self.R.into, error, diagonal=diagonal)
        S = IdentityPlus(R, solution_error=self.solution_error)
        S.error_bound = self.error_bound
        return S

    def trial(self) -> Trial:
        """What the report says of it as one of several."""
        core, per_row = self.R.core, self.numbers.core.nnz / (len(self.numbers.core.indptr) - 1)
        error = self.norm.upper if self.norm else None
        return Trial(
            self.bases.name, "tiles", core.width, core.precision, per_row, self.nbytes, error
        )

    def report(self, trials: Sequence[Trial]) -> ChannelCompression:
        """What is reported of a channel."""
        return ChannelCompression(
            **vars(self.trial()),
            threshold=self.numbers.threshold,
            dropped=self.numbers.dropped,
            quantisation=self.R.core.quantisation,
            inverse_norm=self.inverse,
            solution_error=self.solution_error,
            error_bound=self.error_bound,
            pictures=self.pictures,
            confidence=1.0 - losses.MISS,
            trials=tuple(trials),
        )


@dataclass(frozen=True)
class _Search:
    """The way to R~ of a channel, confirmed by fresh `starts` of norms and `draws` of pictures.

    On the window, without them, a guess of ||S~^-1|| is believed, and few pictures suffice.
    """

    problem: Problem
    goal: Goal
    note: Callable[[str], object]
    starts: Starts | None = None
    draws: Starts | None = None

    def bases(self, name: str) -> Bases:
        """Those of a name, with weights where pictures or noise decide."""
        worst = self.goal.norm == "worst" and not math.isnan(self.goal.rtol)
        light = None if worst else losses.typical_light(self.problem, _GUESS)
        return Bases.named(self.problem.operator.device, self.problem.grid, name, light)

    def norm(self, numbers: Coefficients, R: Any, factor: float, **start: Any) -> TwoNorm:
        """||R~ - R||_2, at most what is certain of its Frobenius norm."""
        transforms = _TRANSFORMS * float(np.linalg.norm(numbers.core.data.astype(np.float64)))
        certain = numbers.dropped + transforms + R.core.quantisation
        return two_norm(self.problem.operator, R, factor=factor, frobenius=certain, **start)

    def fit(self, bases: Bases, candidates: Coefficients, inverse: float, drop: float) -> _Fit:
        """R~ of fewest bytes that was found with a solution error of at most `goal.rtol`.

        The largest of the `candidates` remain; where all are too few, R is read again. `inverse`
        and `drop` are guesses of ||S~^-1|| and of the Frobenius norm to drop.
        """
        rtol, by_pictures, N = self.goal.rtol, self.goal.norm == "pictures", self.problem.R.shape[0]
        starts, best = self.draws if by_pictures else self.starts, None
        share, low, high, misses = math.inf, 0.0, math.inf, 0
        for number in range(_TRIES):
            self.note(stage := f"{bases.name}, threshold {number + 1}")
            numbers, norm, pictures = candidates.largest(drop), None, None
            R = bases.compressed(numbers.core, _ROUNDING[self.goal.norm] * rtol / inverse)
            fresh = next(starts) if starts else {}
            if by_pictures:
                pictures = picture_error(self.problem, R, **(fresh or {"count": _GUESS}))
                least = pictures.error
            else:
                norm = self.norm(numbers, R, _FACTOR, **fresh)
                least = norm.estimate * inverse
                if starts and norm.upper * inverse <= rtol:
                    self.note(f"{stage}: norm of S^-1")
                    inverse = inverse_norm(IdentityPlus(R), factor=_FACTOR, **next(starts)).upper
            fit = _Fit(bases, candidates, numbers, R, norm, inverse, pictures)
            share = fit.solution_error / rtol
            if share <= 1.0:
                low = drop
                best = fit if best is None or fit.nbytes < best.nbytes else best
                if share >= _CLOSE or not numbers.core.nnz:
                    break
            elif fit.R.core.precision == "float32" and least - numbers.dropped * inverse > rtol:
                break  # by rounding alone
            elif numbers.core.nnz < candidates.core.nnz:
                high, misses = drop, misses + 1
            else:  # all are too few
                finer = _GATHER * min(self.goal.frobenius(inverse, N), candidates.dropped / share)
                again = (
                    bases.gather(self.problem.R, drop=finer) if candidates.dropped else candidates
                )
                if not again.dropped < candidates.dropped:
                    break
                candidates = again
            # How far the 2-norm lies below the Frobenius norm changes slowly: in proportion, a
            # little short. Where that misses again, rounding is most of it, and leaves less for
            # what is dropped.
            drop *= min(_AIM / share / 2.0 ** max(misses - 1, 0), _GROWTH) if share else _GROWTH
            if not low < drop < high:
                between, widest = low and high < math.inf, self.goal.frobenius(inverse, N)
                drop = math.sqrt(low * high) if between else 2.0 * low or 0.5 * min(high, widest)
            if high < 1.05 * low:
                break
        if best is None:
            least = float(checks.upwards(1.25 * share * rtol))
            message = f"rtol is {rtol:g}, but float32 reaches about {least:g} for this T"
            raise ToleranceError(message, least)
        return best

    def significant(self, bases: Bases) -> _Fit:
        """R~ of the numbers that stand out of the noise."""
        self.note(f"{bases.name}, noise")
        rows, columns = bases.noise(self.problem.noise)
        weights, (low, middle) = bases.weights**2, _NOISE
        limits = np.sqrt(low**2 + 2.0 * (middle**2 - low**2) / weights)
        least = [
            float(np.min(side, where=side > 0.0, initial=np.inf))
            for side in (rows, limits * columns)
        ]
        least = _LEAST * math.prod(least) if max(least) < math.inf else 0.0
        coefficients = bases.gather(self.problem.R, threshold=least)
        core, total = coefficients.core.copy(), float(np.sum(rows**2) * np.sum(columns**2))
        sizes = np.repeat(rows, np.diff(core.indptr)) * columns[core.indices]
        small = np.abs(core.data) < limits[core.indices] * sizes
        # What is dropped has all of its noise: where it is less than T.noise says, that is too
        # much.
        left = coefficients.dropped**2 + np.sum(core.data[small] ** 2)
        noise = total - np.sum(sizes[~small] ** 2)
        sizes *= np.clip(math.sqrt(left / noise), _LEAST, 1.0) if noise > 0.0 else 1.0
        small = np.abs(core.data) < limits[core.indices] * sizes
        second, core.data[small] = (
            math.hypot(coefficients.second, np.linalg.norm(core.data[small])),
            0.0,
        )
        core.eliminate_zeros()
        numbers, indices = (
            replace(coefficients, core=core, second=second),
            coefficients.core.indices[~small],
        )
        of_pictures = math.sqrt(
            np.mean(rows**2) * np.sum(columns**2 / weights)
        )  # noise in light of norm 1
        R, light = (
            bases.compressed(core, _QUIET * of_pictures),
            losses.typical_light(self.problem, _GUESS),
        )
        energies = ((1.0 - 1.0 / weights) / len(weights))[
            indices
        ]  # over the weights, which `sizes` have
        risk = np.sum(losses.lost(self.problem, R, light)[0] ** 2) / _GUESS
        risk += 2.0 * np.sum(sizes[~small] ** 2 * energies)
        return _Fit(bases, coefficients, numbers, R, None, _DIFFUSE, None, float(risk))


def _compare(
    problem: Problem, names: Sequence[str], goal: Goal, note: Note
) -> tuple[_Fit, list[Trial]]:
    """The fit of fewest bytes on a window, and all that was tried; the first also tells the norm of S^-1."""
    window, trials, fits, refusals, fewest = problem.window(), [], [], [], math.inf
    inverse, pixels = _DIFFUSE if goal.norm == "pictures" else None, window.R.shape[0]
    for number, name in enumerate(names):
        search = _Search(
            window, goal, lambda text, k=number: note(f"trying {text}", 0.5 * k / len(names))
        )
        search.note(name)
        bases = search.bases(name)
        if math.isnan(goal.rtol):
            fits.append(search.significant(bases))
            trials.append(fits[-1].trial())
            continue
        allowed, left = goal.frobenius(inverse or _DIFFUSE, pixels), ""
        candidates = bases.gather(window.R, drop=_GATHER * allowed, most=_MOST * pixels)
        count = candidates.largest(_WIDE * allowed).core.nnz
        if fits and count > _WORSE * fewest:
            left = f"{count / max(fewest, 1):.1f} times as many numbers for the same error"
        else:
            fewest = min(fewest, count)
            if inverse is None:
                search.note(f"{name}: norm of S^-1")
                try:
                    inverse = inverse_norm(
                        IdentityPlus(bases.compressed(candidates.core, 0.0))
                    ).upper
                except ConvergenceError:  # the candidates are not good enough for that
                    inverse = inverse_norm(IdentityPlus(window.operator)).upper
            try:
                fits.append(
                    search.fit(bases, candidates, inverse, _WIDE * goal.frobenius(inverse, pixels))
                )
            except ToleranceError as error:
                refusals.append(error)
                left = str(error)
        refused = Trial(name, "csr", 1, "float32", count / pixels, 8 * count, None, left)
        trials.append(refused if left else fits[-1].trial())
    if not fits:
        raise refusals[0]
    return min(fits, key=lambda fit: (fit.risk, fit.nbytes)), trials


def _whole(
    problem: Problem, best: _Fit, goal: Goal, starts: Starts, draws: Starts, note: Note
) -> _Fit:
    """All of R in the bases that are best on the window, confirmed by norms and pictures."""
    pixels, N, by_noise = (
        len(best.numbers.core.indptr) - 1,
        problem.R.shape[0],
        math.isnan(goal.rtol),
    )
    at, fit, candidates = 0.5 if by_noise else 0.9, best, best.candidates
    search = _Search(problem, goal, lambda text: note(text, at), starts, draws)
    bases = search.bases(best.bases.name) if pixels < N else best.bases
    if by_noise and pixels < N:
        fit = search.significant(bases)
    elif not by_noise:
        drop = best.numbers.dropped * math.sqrt(
            N / pixels
        )  # begun where the window ended, row by row
        if pixels < N:
            allowed = max(drop, goal.frobenius(best.inverse, N))
            most = _MORE * math.ceil(best.numbers.core.nnz / pixels) * N
            share = lambda share: note("coefficients of all pixels", 0.5 + 0.4 * share)  # noqa: E731
            candidates = bases.gather(problem.R, share, drop=_GATHER * allowed, most=most)
        fit = search.fit(bases, candidates, best.inverse, drop)
    if fit.norm:
        return fit
    # A bound for all light, a coarse one, where nothing depends on it.
    pictures = fit.pictures
    if goal.norm == "pictures" and pictures is None:
        pictures = picture_error(problem, fit.R, **next(draws))
    norm = search.norm(fit.numbers, fit.R, _COARSE, **next(starts))
    inverse = inverse_norm(IdentityPlus(fit.R), factor=_COARSE, **next(starts)).upper
    return replace(fit, norm=norm, inverse=inverse, pictures=pictures)
