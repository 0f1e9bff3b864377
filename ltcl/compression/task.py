# SPDX-License-Identifier: BSD-3-Clause
"""`compress`: a transport on compressed operators, with a bound on what a solution loses.

R of every channel is written between bases in which it is sparse, and what is small is dropped: R~ = R + E.
Solutions of S~ = I + R~ are within ||S~^-1|| ||E|| of those of S, whatever the picture; both norms are
measured.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.compression import budgets, choice, kinds
from ltcl.compression.budgets import Made
from ltcl.compression.confirm import Confirmed, confirm
from ltcl.compression.fit import Problem
from ltcl.compression.given import Given, given
from ltcl.compression.result import ChannelCompression, Compression
from ltcl.compression.window import pixels, window
from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.operators import IdentityPlus, ScaledColumns
from ltcl.transport import Transport

Note = Callable[[str, float], object]


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
        "pixels", "hilbert" (pixels in that order), a wavelet ("haar", "db2", "db4", ... on both sides), one
        for rows alone ("db2 rows", the paper's), or a sum of sharp parts in pixels and the smooth rest in
        wavelets ("db2 + pixels"). When not given, all of these are tried.
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
        Its `error` is the bound on solutions, at most `rtol`; `nbytes` what it takes with its first bounce,
        which is in no budget; `compression` a `Compression`, which tells how it was made. Its systems solve
        on coefficients where both sides have one basis. Bounds are of what compression changed: rounding of
        products in float32, about 1e-7 of them, comes on top, even where the error is 0.

    Raises
    ------
    InputError
        A T that is not square, compressed already with some error, or does not fit the grid; rtol not between
        0 and 1, or below what float32 keeps; a basis that is not orthonormal; a budget that is too small: the
        message has what this tolerance needs, and the least one that fits, to a tenth of it, which takes a
        few compressions to find.
    ConvergenceError
        S is singular, or nearly so.

    Notes
    -----
    Bases are compared on the middle 64 x 64 pixels, and the best takes the whole: that of the least time x
    bytes, with no time below that of a launch, and the fewest bytes of those within a quarter of it. Times
    differ from run to run, and with them the choice between near equals; a named basis is not chosen. What
    only just fits into a budget is taken for its bytes alone.

    A sum needs host memory for the whole R a few times, and is left out where there is none. Norms are upper
    bounds but for a probability of about two in a million over the random starts; see `ltcl.theory.two_norm`.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    >>> C = ltcl.compress(T, rtol=0.05)
    >>> C.error <= 0.05, C.nbytes < T.nbytes
    (True, True)
    """
    started = time.perf_counter()
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    limit = None if budget is None else checks.count("budget", budget)
    names = kinds.KINDS if basis is None else kinds.names(basis)
    memory = None if memory is None else checks.count("memory", memory)
    found = given(T, grid, first_bounce, device, memory)
    C, told = written(found, names, rtol, limit, progress)
    spent = time.perf_counter() - started
    C.compression = Compression(rtol, limit, found.nbytes, pixels(found.grid)[1], spent, told)
    return C


def written(
    found: Given, names: Sequence[str], rtol: float, budget: int | None = None, progress: Note | None = None
) -> tuple[Transport, tuple[ChannelCompression, ...]]:
    """R of every channel in the best of the kinds `names`, and what is told of each; else as `compress`."""
    find = functools.cache(functools.partial(kinds.kind, found.problems[0].device))
    channels = list(zip(found.problems, _notes(progress, len(found.problems)), strict=True))

    def make(allowed: float, share: float) -> list[Made]:
        wanted = _Wanted(names, allowed, share, "" if allowed == rtol else f" at rtol {allowed:g}")
        return [_channel(problem, wanted, find, note) for problem, note in channels]

    made = budgets.within(make, rtol, budget)
    channels[-1][1]("done", 1.0)
    C = _transport(found, [one for one, _ in made])
    return C, tuple(one.report(R, chosen) for R, (one, chosen) in zip(found.problems, made, strict=True))


@dataclass(frozen=True)
class _Wanted:
    """Kinds to try, tolerance, bytes that a channel may take, and what progress adds to say so."""

    names: Sequence[str]
    rtol: float
    budget: float
    told: str


def _transport(of: Given, found: Sequence[Confirmed]) -> Transport:
    """What was found, on operators that hold nothing but what they need; equal bases are shared."""
    fresh = functools.cache(functools.partial(kinds.kind, of.problems[0].device, of.grid))
    matrices = []
    for problem, one, f in zip(of.problems, found, of.F, strict=True):
        R = one.fresh(fresh(one.fit.kind.name), _diagonal(problem))
        matrices.append(ScaledColumns(IdentityPlus(R, solution_error=one.solution_error), f))
    on_dark = "mask" if of.masked else "raise"
    return Transport(matrices, of.grid, first_bounce=of.F, on_dark=on_dark, mixing=of.mixing)


def _channel(
    problem: Problem, wanted: _Wanted, find: Callable[[tuple[int, int], str], kinds.Kind], note: Note
) -> Made:
    part = window(problem)
    share, tried = part.pixels / problem.pixels, iter(range(len(wanted.names)))
    told = wanted.told
    made = choice.choose(
        part,
        wanted.names,
        wanted.rtol,
        wanted.budget * share,
        functools.partial(find, part.grid),
        lambda name: note(f"trying {name}{told}", 0.5 * next(tried, len(wanted.names)) / len(wanted.names)),
    )
    name = made.best.fit.kind.name
    found = confirm(
        problem,
        find(problem.grid, name),
        made,
        part is problem,
        wanted.rtol,
        wanted.budget,
        lambda done: note(f"all of it in {name}{told}", 0.5 + 0.49 * done),
    )
    return found, made


def _diagonal(problem: Problem) -> np.ndarray | None:
    try:
        return problem.operator.diagonal()
    except InputError:  # somebody's own operator, which does not tell it
        return None


def _notes(progress: Note | None, count: int) -> list[Note]:
    """`progress` for each of several channels."""
    names = ("red: ", "green: ", "blue: ") if count == 3 else ("",)
    reached = 0.0

    def note(index: int, text: str, share: float) -> None:
        nonlocal reached
        reached = max(reached, (index + share) / count)  # a part that is done again does not count back
        if progress is not None:
            progress(names[index] + text, reached)

    return [functools.partial(note, index) for index in range(count)]
