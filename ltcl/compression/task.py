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
from ltcl.compression.result import Compression
from ltcl.compression.sources import Interreflection, RowSource, source
from ltcl.compression.streamed import Streamed
from ltcl.compression.window import pixels, window
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import IdentityPlus, Operator, ScaledColumns, Shifted
from ltcl.operators.interreflection import made_with
from ltcl.transport import Transport, require

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
        on coefficients where both sides have one basis.

    Raises
    ------
    InputError
        A T that is not square, compressed already, or does not fit the grid; rtol not between 0 and 1, or
        below what float32 keeps; a basis that is not orthonormal; a budget that is too small: the message has
        what this tolerance needs, and the least one that fits, which takes a few compressions to find.

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
    if isinstance(T, Transport):
        given = _of_transport(T, memory, {"grid": grid, "first_bounce": first_bounce, "device": device})
    elif _are_operators(T):  # their products are at hand, their rows are made of those
        F = "diagonal" if first_bounce is None else first_bounce
        given = _of_transport(Transport(T, _grid(grid), F, device=device), memory, {})
    else:
        given = _of_rows(T, grid, first_bounce, device, memory)
    find = functools.cache(functools.partial(kinds.kind, given.problems[0].device))
    channels = list(zip(given.problems, _notes(progress, len(given.problems)), strict=True))

    def make(allowed: float, share: float) -> list[Made]:
        wanted = _Wanted(names, allowed, share, "" if allowed == rtol else f" at rtol {allowed:g}")
        return [_channel(problem, wanted, find, note) for problem, note in channels]

    made = budgets.within(make, rtol, limit)
    channels[-1][1]("done", 1.0)
    C = _transport(given, [found for found, _ in made])
    told = tuple(one.report(R, chosen) for R, (one, chosen) in zip(given.problems, made, strict=True))
    spent = time.perf_counter() - started
    C.compression = Compression(rtol, limit, given.nbytes, pixels(given.grid)[1], spent, told)
    return C


@dataclass(frozen=True)
class _Given:
    """R of every channel, and what else a transport is made of; `nbytes` is what T takes."""

    problems: list[Problem]
    F: np.ndarray
    grid: tuple[int, int]
    nbytes: int
    masked: bool = False
    mixing: np.ndarray | None = None


@dataclass(frozen=True)
class _Wanted:
    """Kinds to try, tolerance, bytes that a channel may take, and what progress adds to say so."""

    names: Sequence[str]
    rtol: float
    budget: float
    told: str


def _transport(given: _Given, found: Sequence[Confirmed]) -> Transport:
    """What was found, on operators that hold nothing but what they need; equal bases are shared."""
    fresh = functools.cache(functools.partial(kinds.kind, given.problems[0].device, given.grid))
    matrices = []
    for problem, one, f in zip(given.problems, found, given.F, strict=True):
        R = one.fresh(fresh(one.fit.kind.name), _diagonal(problem))
        matrices.append(ScaledColumns(IdentityPlus(R, solution_error=one.solution_error), f))
    on_dark = "mask" if given.masked else "raise"
    return Transport(matrices, given.grid, first_bounce=given.F, on_dark=on_dark, mixing=given.mixing)


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


def _of_transport(T: Transport, memory: int | None, others: dict[str, Any]) -> _Given:
    for name, value in others.items():
        if value is not None:
            raise InputError(f"{name} is given, but T is a Transport, which has its own; leave it out")
    require(T)
    if any(made_with(matrix) is not None for matrix in T.matrices):
        raise InputError(
            f"T is compressed already, with an error of {T.error:.2g}; compress what it came from"
        )
    F = np.atleast_2d(T.first_bounce)
    rows = [Interreflection(source("T", matrix), f) for matrix, f in zip(T.matrices, F, strict=True)]
    try:
        operators, nbytes = [S.R for S in T.systems], T.nbytes or _dense(F)
    except MemoryLimitError:
        operators, nbytes = [_streamed(T.device, R, memory) for R in rows], _dense(F)
    problems = [Problem(R, A, T.grid, memory) for R, A in zip(rows, operators, strict=True)]
    return _Given(problems, F, T.grid, nbytes, bool(T.masked.any()), T.mixing)


def _of_rows(T: Any, grid: Any, first_bounce: Any, device: Device | str | None, memory: int | None) -> _Given:
    if isinstance(T, (list, tuple)) and len(T) not in (1, 3):
        raise InputError(f"T has {len(T)} channels; it must be one, or three for RGB")
    parts = [source("T", part) for part in (T if isinstance(T, (list, tuple)) else [T])]
    n = parts[0].shape[0]
    for part in parts:
        if tuple(part.shape) != (n, n):
            raise InputError(f"T has shape {tuple(part.shape)}; it must be square, (N, N), to have an S")
    shape = checks.grid("grid", _grid(grid), n)
    chosen = device if isinstance(device, Device) else open_device(device)
    F = _first_bounce(parts, first_bounce, chosen, memory)
    rows = [Interreflection(part, f) for part, f in zip(parts, F, strict=True)]
    problems = [Problem(R, _streamed(chosen, R, memory), shape, memory) for R in rows]
    return _Given(problems, F, shape, _dense(F))


def _dense(F: np.ndarray) -> int:
    """Bytes of T in float32, of its first bounces (channels, N)."""
    return 4 * F.size * F.shape[1]


def _streamed(device: Device, R: Interreflection, memory: int | None) -> Operator:
    """R = T F^-1 - I by products with the rows of T as they are read."""
    lit = R.F > 0
    scaled = ScaledColumns(Streamed(device, R.T, memory), np.where(lit, 1.0 / np.where(lit, R.F, 1.0), 0.0))
    return Shifted(scaled, None if lit.all() else lit)


def _grid(grid: Any) -> Any:
    if grid is None:
        raise InputError("grid is None, but T is no Transport; it must be (h, w), the projector's pixels")
    return grid


def _are_operators(T: Any) -> bool:
    parts = T if isinstance(T, (list, tuple)) else [T]
    return all(hasattr(part, "matvec") and not isinstance(part, RowSource) for part in parts)


def _first_bounce(parts: Sequence[RowSource], given: Any, device: Device, memory: int | None) -> np.ndarray:
    n = parts[0].shape[0]
    if given is None:
        F = np.stack([Streamed(device, part, memory).diagonal() for part in parts])
    elif isinstance(given, str):
        raise InputTypeError(f"first_bounce is {given!r}; of rows it must be an array (N,), or None")
    else:
        F = checks.finite("first_bounce", checks.real("first_bounce", given)).astype(np.float64)
        F = np.broadcast_to(checks.shape("first_bounce", F, (n,), (len(parts), n)), (len(parts), n))
    dark = np.flatnonzero(np.any(F <= 0.0, axis=0))
    if len(dark):
        raise InputError(
            f"first_bounce is zero or negative at {len(dark)} of {n} pixels, the first {dark[0]}; it must be "
            "positive; make a Transport with on_dark='mask' of it"
        )
    return F


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
