# SPDX-License-Identifier: BSD-3-Clause
"""`compress`: transports as compressed operators, with bounds on the loss of pictures or light.

R of every channel is written between bases in which it is sparse, and small numbers are dropped:
R~ = R + E.

    ||x~ - x|| / ||x|| <= ||S~^-1|| ||E||    since    x~ - x = -S~^-1 E x,    S~ = I + R~
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from ltcl import checks
from ltcl.batch import cluster
from ltcl.device import Device
from ltcl.errors import InputError, ToleranceError
from ltcl.operators import ScaledColumns
from ltcl.tasks.compression.basis_pairs import INVERSE_NAMES, basis_names
from ltcl.tasks.compression.fit import ChannelCompression, Compression
from ltcl.tasks.compression.goals import (
    ROUNDING_SHARE,
    ByNoise,
    ByTolerance,
    Confirmation,
    Goal,
    Note,
)
from ltcl.tasks.compression.inputs import (
    CompressionInputs,
    check_inputs,
    memory_errors,
    window_of,
)
from ltcl.tasks.compression.norms import FLOAT32_UNIT, Starts, fresh_starts
from ltcl.tasks.compression.pictures import PICTURE_CONFIDENCE
from ltcl.tasks.requirements import check_progress
from ltcl.transport.transport import Transport, check_transport

COLOURS = ("red", "green", "blue")


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
        Bytes that the cores of all channels may take together on the device. It limits nothing on
        the way: compression runs to its end, and then raises an error if it needs more.
    norm : "pictures" or "worst"
        Light that the error bound covers, pictures or any; `rtol` limits this error, and the
        result's `error` states it. The error of pictures is the largest loss of 256 fresh random
        ones, a quarter each of 1 / f spectra (amplitudes f^-0.8 to f^-1.4, log-normal values),
        straight edges, strokes as of text, and one lit rectangle, half of these a single pixel. A
        picture p may lose ``||E x|| / ||S x||`` of its appearance T p and
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
    grid : (h, w), optional
    first_bounce : (N,) or (3, N), optional
    device : Device or str, optional
        These three belong to rows; a Transport has its own. The first bounce is the diagonal when
        not given.
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
    checks.one_of("norm", norm, ROUNDING_SHARE)
    goal: Goal
    if isinstance(rtol, str) and rtol == "noise":
        goal = ByNoise(norm)
    else:
        rtol = check_rtol(rtol, FLOAT32_UNIT)
        goal = ByTolerance(norm, rtol)
    if budget is not None:
        budget = checks.count("budget", budget)
    if memory is not None:
        memory = checks.count("memory", memory)
    if basis is None:
        basis = INVERSE_NAMES
    names = basis_names(basis)
    note = check_progress(progress)
    if client is not None:
        cluster.require(client)
    with memory_errors("compress", T):
        noise = None
        if isinstance(goal, ByNoise):
            noise = check_transport(T).noise
        inputs = check_inputs(T, grid, first_bounce, device, noise, memory=memory, client=client)
        starts = fresh_starts("compress")
        C, channels = compress_inputs(inputs, names, goal, starts, note)
    _check_budget(budget, rtol, channels)
    C.compression = Compression(
        rtol=rtol,
        norm=norm,
        budget=budget,
        uncompressed=inputs.nbytes,
        window=window_of(C.grid),
        seconds=time.perf_counter() - began,
        channels=channels,
    )
    return C


def check_rtol(rtol: Any, least: float) -> float:
    """Return `rtol`; refuse, before any work, one that float32 products exceed by rounding."""
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    if rtol <= least:
        rounding = checks.upwards(least)
        raise ToleranceError(
            f"rtol is {rtol:g}; it must be above {rounding}, the rounding of float32"
        )
    return rtol


def _check_budget(
    budget: int | None, rtol: float | str, channels: Sequence[ChannelCompression]
) -> None:
    needed = sum(channel.nbytes for channel in channels)
    if budget is not None and needed > budget:
        raise InputError(
            f"budget is {budget} bytes, but rtol {rtol} needs {needed} "
            f"({checks.size(needed)}); give at least {needed} bytes, or a larger rtol"
        )


def compress_inputs(
    inputs: CompressionInputs,
    names: Sequence[str],
    goal: Goal,
    starts: Starts,
    progress: Note,
) -> tuple[Transport, tuple[ChannelCompression, ...]]:
    """R of every channel in the best of the bases `names`, and the report of each."""
    draws = fresh_starts("pictures", 1.0 - PICTURE_CONFIDENCE)
    confirmation = Confirmation(starts, draws)
    count = len(inputs.problems)
    matrices = []
    reports = []
    for channel, problem in enumerate(inputs.problems):

        def note(text: str, share: float, channel: int = channel) -> None:
            if count == 3:
                text = f"{COLOURS[channel]}: {text}"
            progress(text, (channel + share) / count)

        best, trials = goal.compare(problem.window(), names, note)
        fit = goal.whole(problem, best, confirmation, note)
        matrices.append(ScaledColumns(fit.system(problem), problem.F))
        reports.append(fit.report(trials))
        note("done", 1.0)
    C = Transport(matrices, dark_threshold=0.0, **inputs.settings)
    return C, tuple(reports)
