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
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.compression import choice, kinds
from ltcl.compression.confirm import Confirmed, confirm
from ltcl.compression.fit import Problem
from ltcl.compression.result import ChannelCompression, Compression
from ltcl.compression.sources import Interreflection, RowSource, source
from ltcl.compression.streamed import Streamed
from ltcl.compression.window import pixels, window
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import IdentityPlus, ScaledColumns
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
        memory-mapped file, an HDF5 or zarr array, anything with ``shape`` and ``rows(start, stop)``, a
        sequence of 3 of these for RGB; `grid` and `first_bounce` then come with it.
    rtol : float
        The relative error that a solution x of S x = b may have: ``||x~ - x|| <= rtol ||x||``, any b.
    budget : int, optional
        Bytes that the cores of all channels may take on the device.
    basis : str or sequence of str, optional
        "pixels", "hilbert" (pixels in that order), a wavelet ("haar", "db2", "db4", ... on both sides), or
        one for rows alone ("db2 rows", the paper's). When not given, all of these are tried.
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
        Its `error` is the bound on solutions, at most `rtol`; `nbytes` what it takes; `compression` a
        `Compression`, which tells how it was made. Its systems solve on coefficients where both sides have
        one basis.

    Raises
    ------
    InputError
        A T that is not square, compressed already, or does not fit the grid; rtol not between 0 and 1; a
        basis that is not orthonormal; a budget that is too small: the message has the tolerance that fits
        into it, and what this one needs.

    Notes
    -----
    Bases are compared on the middle 64 x 64 pixels, and the best takes the whole. Norms are upper bounds but
    for a probability of about two in a million over the random starts; see `ltcl.theory.two_norm`.

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
    names = _names(basis)
    if isinstance(T, Transport):
        given = {"grid": grid, "first_bounce": first_bounce, "device": device}
        channels, F = _of_transport(T, memory, given), np.atleast_2d(T.first_bounce)
        masked, mixing, shape = bool(T.masked.any()), T.mixing, T.grid
    else:
        channels, F, shape = _of_rows(T, grid, first_bounce, device, memory)
        masked, mixing = False, None
    find = functools.cache(functools.partial(kinds.kind, channels[0].device))
    share = float("inf") if limit is None else limit / len(channels)
    made = [
        _channel(problem, names, rtol, share, len(channels), find, _note(progress, index, len(channels)))
        for index, problem in enumerate(channels)
    ]
    C = Transport(
        [
            ScaledColumns(IdentityPlus(one.operator, solution_error=one.solution_error), f)
            for (one, _), f in zip(made, F, strict=True)
        ],
        shape,
        first_bounce=F,
        on_dark="mask" if masked else "raise",
        mixing=mixing,
    )
    reports = tuple(report for _, report in made)
    spent = time.perf_counter() - started
    C.compression = Compression(rtol, limit, pixels(shape)[1], spent, reports)
    return C


def _channel(
    problem: Problem,
    names: Sequence[str],
    rtol: float,
    budget: float,
    parts: int,
    find: Callable[[tuple[int, int], str], kinds.Kind],
    note: Note,
) -> tuple[Confirmed, ChannelCompression]:
    part = window(problem)
    share = part.pixels / problem.pixels
    tried = iter(range(len(names)))
    made = choice.choose(
        part,
        names,
        rtol,
        budget * share,
        functools.partial(find, part.grid),
        lambda name: note(f"trying {name}", 0.5 * next(tried, len(names)) / len(names)),
        parts / share,
    )
    name = made.best.fit.kind.name
    found = confirm(
        problem,
        find(problem.grid, name),
        made,
        part is problem,
        rtol,
        budget,
        parts,
        lambda done: note(f"all of it in {name}", 0.5 + 0.5 * done),
    )
    note("done", 1.0)
    return found, found.report(made)


def _names(basis: str | Sequence[str] | None) -> Sequence[str]:
    if basis is None:
        return kinds.KINDS
    names = [basis] if isinstance(basis, str) else list(basis)
    if not names:
        raise InputError("basis is empty; it must name at least one")
    return [kinds.check(name) for name in names]


def _of_transport(T: Transport, memory: int | None, given: dict[str, Any]) -> list[Problem]:
    for name, value in given.items():
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
        operators = [S.R for S in T.systems]
    except MemoryLimitError:
        operators = [Streamed(T.device, R, memory) for R in rows]
    return [Problem(R, A, T.grid, memory) for R, A in zip(rows, operators, strict=True)]


def _of_rows(
    T: Any, grid: Any, first_bounce: Any, device: Device | str | None, memory: int | None
) -> tuple[list[Problem], np.ndarray, tuple[int, int]]:
    if isinstance(T, (list, tuple)) and len(T) not in (1, 3):
        raise InputError(f"T has {len(T)} channels; it must be one, or three for RGB")
    parts = [source("T", part) for part in (T if isinstance(T, (list, tuple)) else [T])]
    n = parts[0].shape[0]
    for part in parts:
        if tuple(part.shape) != (n, n):
            raise InputError(f"T has shape {tuple(part.shape)}; it must be square, (N, N), to have an S")
    if grid is None:
        raise InputError(f"grid is None, but T is rows of a matrix; it must be (h, w) with h * w = {n}")
    shape = checks.grid("grid", grid, n)
    chosen = device if isinstance(device, Device) else open_device(device)
    F = _first_bounce(parts, first_bounce, chosen, memory)
    rows = [Interreflection(part, f) for part, f in zip(parts, F, strict=True)]
    return [Problem(R, Streamed(chosen, R, memory), shape, memory) for R in rows], F, shape


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


def _note(progress: Note | None, index: int, count: int) -> Note:
    """`progress` for one of several channels."""
    if progress is None:
        return lambda text, share: None
    name = f"{('red', 'green', 'blue')[index]}: " if count == 3 else ""
    return lambda text, share: progress(name + text, (index + share) / count)
