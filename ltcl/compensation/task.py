# SPDX-License-Identifier: BSD-3-Clause
"""`compensate`: the projector pattern that makes the scene look as desired (section 8.2).

    l_in = F^-1 S^-1 (gain * desired - background)

by products with S only. Where that asks for light beyond the projector's bounds, clamping it is not the best:
min ||W (T l_in + background - gain * desired)|| over the patterns within the bounds is solved from there on.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import layout
from ltcl.compensation import inputs
from ltcl.compensation.problem import Limits, Problem, systems
from ltcl.compensation.result import Compensation
from ltcl.compensation.start import Backward, Start, at_gain, at_largest_gain
from ltcl.errors import ConvergenceError
from ltcl.exact import beside
from ltcl.solvers import Bounded, Inverse, Status
from ltcl.solvers.precomputed import require_inverse
from ltcl.transport import Transport, require

_EXPLAINED = 3.0  # times the root mean square of an error: few of a solve's are larger
Columns = list[np.ndarray]  # one (N, k) a channel of the transport


def compensate(
    T: Transport,
    desired: Any,
    *,
    bounds: tuple[float, float] = (0.0, 1.0),
    background: Any = None,
    gain: float | str = 1.0,
    loss: float | None = None,
    weights: Any = None,
    method: str = "auto",
    rtol: float = 1e-2,
    exact: Transport | None = None,
    inverse: Inverse | None = None,
    clamp: bool = False,
    **options: Any,
) -> Compensation:
    """Find the projector pattern under which the scene looks most like `desired`.

    Parameters
    ----------
    T : Transport
        With more or fewer camera than projector pixels, or blocks between colours, it works too, in the
        least-squares sense and without `method`.
    desired : (h, w), (h, w, 3), or frames of these
        Wanted radiance at each camera pixel, in the units of T.
    bounds : (low, high)
        What the projector can emit per pixel, in linear light.
    background : number, like `desired` or one frame of it, optional
        Light the projector cannot take away: ambient and its own black. T pattern + background is matched.
    gain : float or "auto"
        Scale of the target; "auto" finds the largest one, for all frames and colours, that the bounds reach;
        at a loss at most 1 % below the largest there is.
    loss : float, optional
        Of gain="auto": relative error, weights included, that the gain may cost, from 1e-6 to 1. When not
        given, none where some gain is within reach exactly and there are no `weights`; else `rtol` or 1.1
        times the least error of all gains (found to 1 %), whichever is more.
    weights : like `desired` or one frame of it, optional
        How much the error at each camera pixel counts, at least 0. When not given 1, and 0 where T.masked.
    method, rtol, **options
        Of `ltcl.solve`. Within the bounds the error is the least there is up to `rtol`, relative to
        gain * desired - background. Where no bound holds, noise of a method that samples stays; it is part of
        `error` and `gap`, and makes the gain that gain="auto" finds smaller.
    exact : Transport, optional
        The uncompressed transport that a compressed T stands for: T then solves, to an `rtol` as
        `ltcl.solve` says, and everything else is of `exact`; the pattern itself is rounded to float32, 6e-8.
    inverse : Inverse, optional
        Of T, as `ltcl.invert` makes it: the light without bounds is then one product, whatever the method.
    clamp : bool
        Clamp the light to the bounds where it exceeds them, and leave it at that: quick, for videos. What is
        lost is the light by which other pixels would make up for it; `error` tells how far off that is, and
        `gap` is the whole error, since nothing is proved.

    Returns
    -------
    Compensation
        Never worse than the light without bounds, clamped, at a given gain; within the loss of gain="auto".

    Raises
    ------
    InputError
        Shapes that do not fit, bounds in the wrong order, a gain that is not positive, weights below 0, no
        gain that keeps the picture within `loss`, or an `rtol` below the error of a compressed T without
        `exact`, or below that of `inverse`, or an inverse of another transport.
    ConvergenceError
        A solve did not reach `rtol` in `maxiter` steps, or not at all. Within the bounds, where float32 is
        too coarse to prove it, the best that was found comes back, and `gap` tells what is proved.

    Notes
    -----
    F = diag(T) is a valid choice here for any opaque scene: compensation does not depend on it.

    Examples
    --------
    >>> import ltcl, numpy
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> ltcl.compensate(T, numpy.array([[0.3, 0.3]])).pattern.round(2).tolist()
    [[0.5, 0.5]]
    >>> c = ltcl.compensate(T, numpy.array([[1.0, 1.0]]), gain="auto")
    >>> round(c.gain, 2), c.pattern.round(2).tolist()
    (0.6, [[1.0, 1.0]])
    """
    require(T, square=False)
    limits = Limits(*inputs.bounds(bounds), T.join([T.masked] * T.channels)[0])
    sought = inputs.gain(gain, loss)
    wanted, shape = inputs.desired(desired, T)
    dark = inputs.background(background, T, shape, wanted)
    counts = inputs.weights(weights, T, shape, wanted)
    rules = inputs.rules(T, method, rtol, options)
    wanted, dark = T.join(wanted), T.join(dark)
    if inverse is not None:
        require_inverse(T, inverse, rtol, exact=exact, method=None if method == "auto" else method)
    inputs.clamp(clamp, T)
    true, judges = beside(T, exact)
    problem = Problem(systems(true), wanted, dark, None if counts is None else T.join(counts), limits, rules)
    backward = Backward(T, method, {"rtol": rtol, **options}, judges, inverse)
    if sought is not None:
        start = at_gain(backward, problem, sought)
    else:
        start = at_largest_gain(backward, problem, loss, exactly=weights is None)
    light, limited = _within(problem, start, options.get("throw", True), clamp)
    return _result(true, problem, shape, start, light, limited)


def _within(problem: Problem, start: Start, throw: bool, clamp: bool) -> tuple[Columns, list[Bounded | None]]:
    """Light within the limits, and the solve that it took of each system, None where it took none."""
    light: Columns = []
    limited: list[Bounded | None] = []
    for which, free in enumerate(start.light):
        nearest, found = problem.limits.clip(free), None
        if not clamp and (not start.meets or problem.limits.exceeded(free).any()):
            nearest, found = problem.nearest(which, start.gain, nearest)
            if throw and found.status is Status.MAXITER:
                raise ConvergenceError(str(found), found)
        light.append(nearest)
        limited.append(found)
    return light, limited


def _result(
    T: Transport,
    problem: Problem,
    shape: layout.Layout,
    start: Start,
    light: Columns,
    limited: list[Bounded | None],
) -> Compensation:
    target = [start.gain * wanted for wanted in problem.desired]
    seen = [np.asarray(A @ p) + dark for A, p, dark in zip(T.operators, light, problem.dark, strict=True)]
    missing = [wanted - found for wanted, found in zip(target, seen, strict=True)]
    solved = tuple(found for found in limited if found is not None)
    solutions = start.solutions or solved
    held, frames = _held(light, start.light, limited, problem.limits), shape.frames or 1
    clipped = float(np.mean([part.mean() for part in held]))
    size, error = problem.norm(target) or 1.0, problem.norm(missing)
    sizes, errors = (problem.norms(parts, frames) for parts in (target, missing))
    least = np.sqrt(sum(float(np.sum(np.square(found.least))) for found in solved))  # of others 0

    def picture(columns: Columns, grid: tuple[int, int]) -> np.ndarray:
        return shape.pack(T.split(columns), grid).astype(np.float32)

    return Compensation(
        pattern=picture(light, T.grid),
        appearance=picture(seen, T.camera_grid),
        gain=start.gain,
        clipped=clipped,
        target=picture(target, T.camera_grid),
        out_of_reach=picture(_beyond(problem, missing, target, clipped), T.camera_grid),
        error=error / size,
        gap=max(error - float(least), 0.0) / size,
        frame_errors=errors / np.where(sizes > 0, sizes, 1.0),
        frame_clipped=np.mean([p.reshape(len(p), frames, -1).mean(axis=(0, 2)) for p in held], axis=0),
        solution=solutions[0] if len(solutions) == 1 else solutions,
        limited=solved,
        transport_error=T.error,
    )


def _held(light: Columns, free: Columns, limited: list[Bounded | None], limits: Limits) -> Columns:
    """Where values at a bound want to go beyond it, of pixels that are lit."""
    held = []
    for p, wanted, found in zip(light, free, limited, strict=True):
        beyond = limits.exceeded(wanted) if found is None else found.held & limits.touched(p)
        held.append(beyond[~limits.masked])
    return held


def _beyond(problem: Problem, missing: Columns, target: Columns, clipped: float) -> Columns:
    """What is missing, without what the tolerance of a solve explains."""
    if clipped == 0.0:
        return [np.zeros_like(part) for part in missing]
    counted = zip(missing, problem.weighted(missing), problem.weighted(target), strict=True)
    rtol, atol = problem.rules["rtol"], problem.rules["atol"]
    found = []
    for part, wrong, wanted in counted:
        allowed = np.maximum(rtol * np.linalg.norm(wanted, axis=0), atol) / np.sqrt(len(part))
        found.append(np.where(np.abs(wrong) > _EXPLAINED * allowed, part, 0.0))
    return found
