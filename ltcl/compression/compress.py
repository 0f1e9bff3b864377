# SPDX-License-Identifier: BSD-3-Clause
"""`compress`: a transport on compressed operators, with a bound on what a solution loses.

R of every channel is written between bases in which it is sparse, and what is small is dropped: R~ = R + E.

    ||x~ - x|| / ||x|| <= ||S~^-1|| ||E||    since    x~ - x = -S~^-1 E x,    S~ = I + R~

What is dropped has a known Frobenius norm f. The 2-norm of E, rounding and all, is measured: how far below f
it lies changes slowly, so that a few norms find the f that is needed. Bases are compared on a window.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.compression.bases import INVERSE_NAMES, Bases, quantize, validate_names
from ltcl.compression.coefficients import Coefficients
from ltcl.compression.norms import MISS, Starts, fresh_starts, inverse_norm
from ltcl.compression.sources import Inputs, Problem, memory_errors, validate_inputs, window_of
from ltcl.device import Device
from ltcl.errors import ConvergenceError, InputError, InputTypeError, ToleranceError
from ltcl.operators import IdentityPlus, ScaledColumns
from ltcl.operators.tiles import Packed
from ltcl.theory import TwoNorm, two_norm
from ltcl.transport import Transport

Note = Callable[[str, float], object]
_GATHER = 0.7  # of what is allowed: Frobenius norm of what need not even be looked at
_MORE = 4  # times the numbers kept on the window, which the whole may need
_TRIES = 8
_AIM, _GROWTH = 0.94, 8.0  # of the tolerance, what is tried next; no step grows by more
_CLOSE = 0.85  # of the tolerance is good enough
_UNIT = 2.0**-24  # rounding of float32
_ROUNDING = 0.05  # of what is allowed, for the rounding of the core
_TRANSFORMS = 1e-6  # of coefficients that went through transforms in float32, rounded there
_FACTOR = 1.05  # between the bounds of a norm
_DIFFUSE = 2.0  # ||S^-1|| of a diffuse scene, as long as nothing was measured
_MOST = 512  # numbers a row, beyond which a basis is no use unless all are
_WIDE = 2.0  # times what is allowed: a Frobenius norm at which bases are compared before more is measured
_WORSE = 3  # times the numbers of the best then: left


@dataclass(frozen=True)
class Trial:
    """R in one basis, tried on a window of pixels or on the whole.

    `format` ("tiles"; "csr" where none were made), `width` and `precision` are of the core. `kept` numbers in
    a row take `nbytes`, and a product of a solve so many `launches`. `error` is an upper bound on the 2-norm
    of R~ - R, rounding included; None where the basis was `left` before, and why.
    """

    basis: str
    format: str
    width: int
    precision: str
    kept: float
    nbytes: int
    launches: int
    error: float | None
    left: str = ""


@dataclass(frozen=True, kw_only=True)
class ChannelCompression(Trial):
    """One colour channel: what was taken, of the whole R.

    Numbers below `threshold` were dropped; `dropped` is their Frobenius norm, where memory was short a bound
    on it, and `quantisation` that of what rounding of the core changed. `inverse_norm` bounds the 2-norm of
    S~^-1; its product with `error` is `solution_error`, which bounds ``||x~ - x|| / ||x||``. `confidence` is
    that the bounds of all channels hold, over the random starts of the norms.
    """

    threshold: float
    dropped: float
    quantisation: float
    inverse_norm: float
    solution_error: float
    confidence: float
    trials: tuple[Trial, ...]


@dataclass(frozen=True, repr=False)
class Compression:
    """How a compressed transport was made; its ``.compression``.

    `rtol` and `budget` are as allowed, `uncompressed` the bytes of T before (of rows, in float32), `window`
    (h, w) the pixels that bases were tried on, and `channels` 1 or 3 `ChannelCompression`.
    """

    rtol: float
    budget: int | None
    uncompressed: int
    window: tuple[int, int]
    seconds: float
    channels: tuple[ChannelCompression, ...]

    def __repr__(self) -> str:
        bases = ", ".join(channel.basis for channel in self.channels)
        return f"<ltcl Compression of {checks.size(self.uncompressed)} to rtol {self.rtol:g} in {bases}>"


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
        Rows may be far larger than memory: an array or memory-mapped file, an HDF5 or zarr array,
        anything with ``shape`` and ``rows(start, stop)`` that gives (stop - start, N) real numbers; or an
        operator, whose rows are products of its transpose; a sequence of 3 of these for RGB.
    rtol : float
        The relative error that a solution x of S x = b may have: ``||x~ - x|| <= rtol ||x||``, any b.
    budget : int, optional
        Bytes that the cores of all channels may take together on the device.
    basis : str or sequence of str, optional
        "pixels", a wavelet ("haar", "db2", "db4", ... on both sides), or one for rows alone ("db2 rows", the
        paper's). Several, or db2, haar, db4 and pixels when not given, are compared on the middle 64 x 64
        pixels; that of the fewest bytes is taken.
    grid, first_bounce, device : (h, w); (N,) or (3, N), optional; Device or str, optional
        Of rows; a Transport has its own. The first bounce is their diagonal when not given.
    memory : int, optional
        Bytes of host memory for a block of rows. Between the passes over rows and over columns half of what
        is free is taken; something is dropped there only where that is too little.
    progress : callable(text, share), optional
        Called as the work goes on.

    Returns
    -------
    Transport
        Its `error` is the bound on solutions, at most `rtol`, without what float32 rounds in products, 1e-7.
        But for a probability of two in a million over the random starts of norms all bounds hold together.
        `compression` is a `Compression`. The same T gives the same bits on a device.

    Raises
    ------
    InputError
        T is not square, compressed with an error, or does not fit the grid; rtol is not between 0 and 1, or
        below what float32 keeps; a basis is not orthonormal; the budget is below what rtol needs.
    ConvergenceError
        S is singular, or nearly so.
    MemoryLimitError
        A block of rows does not fit into `memory`, or what remains of R into that of the host.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    >>> C = ltcl.compress(T, rtol=0.05)
    >>> C.error <= 0.05, C.nbytes < T.nbytes
    (True, True)
    """
    began = time.perf_counter()
    rtol = validate_rtol(rtol, _UNIT)
    budget = None if budget is None else checks.count("budget", budget)
    memory = None if memory is None else checks.count("memory", memory)
    names = validate_names(INVERSE_NAMES if basis is None else basis)
    note = validate_progress(progress)
    with memory_errors("compress", T):
        inputs = validate_inputs(T, grid, first_bounce, device, memory)
        C, channels = compress_inputs(inputs, names, rtol, fresh_starts("compress"), note)
    needed = sum(channel.nbytes for channel in channels)
    if budget is not None and needed > budget:
        raise InputError(
            f"budget is {budget} bytes, but rtol {rtol:g} needs {needed} ({checks.size(needed)}); "
            f"give a budget of at least {needed} bytes, or a larger rtol"
        )
    window, spent = window_of(inputs.grid), time.perf_counter() - began
    C.compression = Compression(rtol, budget, inputs.nbytes, window, spent, channels)
    return C


def validate_rtol(rtol: float, least: float) -> float:
    """`rtol`, refused before any work where a product in float32 already rounds by as much."""
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    if rtol <= least:
        raise ToleranceError(
            f"rtol is {rtol:g}; it must be above {checks.upwards(least)}, which float32 rounds"
        )
    return rtol


def validate_progress(progress: Note | None) -> Note:
    """`progress`, or in its place a function that does nothing."""
    if progress is not None and not callable(progress):
        raise InputTypeError(f"progress is {progress!r}; it must be callable(text, share), or None")
    return progress or (lambda text, share: None)


def compress_inputs(
    inputs: Inputs, names: Sequence[str], rtol: float, starts: Starts, progress: Note
) -> tuple[Transport, tuple[ChannelCompression, ...]]:
    """R of every channel in the best of the bases `names`, and what is reported of each."""
    colours = ("red: ", "green: ", "blue: ") if len(inputs.problems) == 3 else ("",)
    matrices, reports = [], []
    for number, (problem, F) in enumerate(zip(inputs.problems, inputs.F, strict=True)):

        def note(text: str, share: float, number: int = number) -> None:
            progress(colours[number] + text, (number + share) / len(colours))

        best, trials = _compare(problem, names, rtol, note)
        fit = _whole(problem, best, rtol, starts, note)
        matrices.append(ScaledColumns(fit.system(problem), F))
        reports.append(fit.report(trials))
        note("done", 1.0)
    on_dark = "mask" if inputs.masked else "raise"
    C = Transport(matrices, inputs.grid, first_bounce=inputs.F, on_dark=on_dark, mixing=inputs.mixing)
    return C, tuple(reports)


@dataclass(frozen=True)
class _Fit:
    """R~ in some bases: the largest `numbers` of the `candidates`, `packed` on their `support`.

    `norm` is that of R~ - R, `inverse` an upper bound on that of S~^-1, or a guess where nothing confirms it.
    """

    bases: Bases
    candidates: Coefficients
    numbers: Coefficients
    support: Bases
    packed: Packed
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
        R = self.support.operator(problem.operator.device, self.packed, self.norm.upper, diagonal)
        return IdentityPlus(R, solution_error=self.solution_error)

    def trial(self) -> Trial:
        """What the report says of it as one of several."""
        packed, per_row = self.packed, self.numbers.core.nnz / (len(self.numbers.core.indptr) - 1)
        form = (self.bases.name, "tiles", packed.width, packed.precision)
        return Trial(*form, per_row, packed.nbytes, self.bases.launches, self.norm.upper)

    def report(self, trials: Sequence[Trial]) -> ChannelCompression:
        """What is reported of a channel."""
        return ChannelCompression(
            **vars(self.trial()),
            threshold=self.numbers.threshold,
            dropped=self.numbers.dropped,
            quantisation=self.packed.difference[0],
            inverse_norm=self.inverse,
            solution_error=self.solution_error,
            confidence=1.0 - MISS,
            trials=tuple(trials),
        )


def _fit(
    problem: Problem,
    bases: Bases,
    candidates: Coefficients,
    rtol: float,
    inverse: float,
    drop: float,
    starts: Starts | None = None,
    note: Callable[[str], object] = lambda text: None,
) -> _Fit:
    """R~ of fewest bytes that was found with a solution error of at most `rtol`.

    The largest of the `candidates` remain; where all are too few, R is read again. `inverse` and `drop`
    are guesses of ||S~^-1|| and of the Frobenius norm to drop; without `starts` of norms that confirm what is
    handed out, `inverse` is believed.
    """
    best: _Fit | None = None
    share, low, high, misses = math.inf, 0.0, math.inf, 0
    for number in range(_TRIES):
        note(stage := f"{bases.name}, threshold {number + 1}")
        numbers = candidates.largest(drop)
        core, support = bases.restricted(numbers.core)
        packed = quantize(core, _ROUNDING * rtol / inverse)
        R = support.operator(problem.operator.device, packed)
        transforms = _TRANSFORMS * float(np.linalg.norm(numbers.core.data.astype(np.float64)))
        certain = numbers.dropped + transforms + packed.difference[0]
        fresh = next(starts) if starts else {}
        norm = two_norm(problem.operator, R, factor=_FACTOR, frobenius=certain, **fresh)
        if starts and norm.upper * inverse <= rtol:
            note(f"{stage}: norm of S^-1")
            inverse = inverse_norm(IdentityPlus(R), factor=_FACTOR, **next(starts)).upper
        fit = _Fit(bases, candidates, numbers, support, packed, norm, inverse)
        share = fit.solution_error / rtol
        if share <= 1.0:
            low = drop
            best = fit if best is None or fit.packed.nbytes < best.packed.nbytes else best
            if share >= _CLOSE or not numbers.core.nnz:
                break
        elif packed.precision == "float32" and (norm.estimate - numbers.dropped) * inverse > rtol:
            break  # by rounding alone
        elif numbers.core.nnz < candidates.core.nnz:
            high, misses = drop, misses + 1
        else:  # all are too few
            finer = _GATHER * min(rtol / inverse, candidates.dropped / share)
            again = bases.gather(problem.R, finer) if candidates.dropped else candidates
            if not again.dropped < candidates.dropped:
                break
            candidates = again
        # How far the 2-norm lies below the Frobenius norm changes slowly: in proportion, a little short.
        # Where that misses again, rounding is most of it, and leaves less for what is dropped.
        drop *= min(_AIM / share / 2.0 ** max(misses - 1, 0), _GROWTH) if share else _GROWTH
        if not low < drop < high:
            between = low and high < math.inf
            drop = math.sqrt(low * high) if between else 2.0 * low or 0.5 * min(high, rtol / inverse)
        if high < 1.05 * low:
            break
    if best is None:
        least = float(checks.upwards(1.25 * share * rtol))
        raise ToleranceError(f"rtol is {rtol:g}, but float32 reaches about {least:g} for this T", least)
    return best


def _compare(problem: Problem, names: Sequence[str], rtol: float, note: Note) -> tuple[_Fit, list[Trial]]:
    """The fit of fewest bytes on a window, and all that was tried; the first also tells the norm of S^-1."""
    window, trials, fits, refusals, inverse, fewest = problem.window(), [], [], [], None, math.inf
    device, pixels = window.operator.device, window.R.shape[0]
    for number, name in enumerate(names):

        def tried(text: str, at: float = 0.5 * number / len(names)) -> None:
            note(f"trying {text}", at)

        tried(name)
        bases = Bases.named(device, window.grid, name)
        allowed = rtol / (inverse or _DIFFUSE)
        candidates = bases.gather(window.R, _GATHER * allowed, _MOST * pixels)
        count = candidates.largest(_WIDE * allowed).core.nnz
        if fits and count > _WORSE * fewest:
            left = f"{count / max(fewest, 1):.1f} times as many numbers for the same error"
        else:
            fewest = min(fewest, count)
            if inverse is None:
                tried(f"{name}: norm of S^-1")
                try:
                    core, support = bases.restricted(candidates.core)
                    R = support.operator(device, quantize(core, 0.0))
                    inverse = inverse_norm(IdentityPlus(R)).upper
                except ConvergenceError:  # the candidates are not good enough for that
                    inverse = inverse_norm(IdentityPlus(window.operator)).upper
            try:
                drop = _WIDE * rtol / inverse
                fits.append(_fit(window, bases, candidates, rtol, inverse, drop, note=tried))
                trials.append(fits[-1].trial())
                continue
            except ToleranceError as error:
                refusals.append(error)
                left = str(error)
        form = (name, "csr", 1, "float32", count / pixels, 8 * count, bases.launches)
        trials.append(Trial(*form, error=None, left=left))
    if not fits:
        raise refusals[0]
    return min(fits, key=lambda fit: fit.packed.nbytes), trials


def _whole(problem: Problem, best: _Fit, rtol: float, starts: Starts, note: Note) -> _Fit:
    """All of R in the bases that are best on the window, confirmed by norms from fresh starts."""
    pixels, N = len(best.numbers.core.indptr) - 1, problem.R.shape[0]
    bases, candidates, drop = best.bases, best.candidates, best.numbers.dropped
    if pixels < N:  # begun where the window ended: the same is dropped of each row
        bases = Bases.named(problem.operator.device, problem.grid, bases.name)
        drop *= math.sqrt(N / pixels)
        most, allowed = _MORE * math.ceil(best.numbers.core.nnz / pixels) * N, max(drop, rtol / best.inverse)
        read = partial(note, "coefficients of all pixels")
        candidates = bases.gather(problem.R, _GATHER * allowed, most, lambda share: read(0.5 + 0.4 * share))
    return _fit(problem, bases, candidates, rtol, best.inverse, drop, starts, lambda text: note(text, 0.9))
