# SPDX-License-Identifier: BSD-3-Clause
"""`compensate`: the projector pattern that makes the scene look as desired (section 8.2).

    l_in = F^-1 S^-1 (gain * desired - background)

by products with S only, in four steps: check the inputs, undo the light, bring it within the
bounds, judge the result. Where the light exceeds the projector's bounds, clamping it is not the
best: min ||W (T l_in + background - gain * desired)|| over the patterns within the bounds is solved
from there on. Where T has no S, it is solved from no light on.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Operator
from ltcl.solvers import Bounded, Inverse, Solution, Status, solve_each
from ltcl.tasks.compensation.gain import exact_gain, gain_within_loss
from ltcl.tasks.compensation.inputs import (
    check_background,
    check_gain,
    check_range,
    check_rules,
    check_weights,
    warn_of_units,
)
from ltcl.tasks.compensation.problem import (
    Columns,
    CompensationProblem,
    Limits,
    channel_systems,
    join_channels,
)
from ltcl.tasks.compensation.result import Compensation, Evidence
from ltcl.transport import frames as layout
from ltcl.transport.transport import (
    Transport,
    default_rtol,
    require,
    require_inverse,
    resolve_reference,
)

RTOL = 1e-2
# From this rtol on, the rounding of a pattern does not count beside the residual of the solve.
MIN_RESIDUAL_RTOL = 1e-5
# Times the root mean square of an error: few values of a solve's error are larger.
EXPLAINED_DEVIATIONS = 3.0


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
    rtol: float | None = None,
    exact: Transport | None = None,
    inverse: Inverse | None = None,
    clamp: bool = False,
    **options: Any,
) -> Compensation:
    """Find the projector pattern under which the scene looks most like `desired`.

    Parameters
    ----------
    T : Transport
        Any transport. One with more or fewer camera than projector pixels, or with blocks between
        colours, is solved in the least-squares sense and without `method`. F = diag(T) is a valid
        choice for any opaque scene.
    desired : (h, w), (h, w, 3), or frames of these
        Wanted radiance at each camera pixel, in the units of T.
    bounds : (low, high)
        Linear light that the projector can emit per pixel.
    background : number, like `desired` or one frame of it, optional
        Light the projector cannot take away: ambient and its own black. T pattern + background is
        matched.
    gain : float or "auto"
        Scale of the target; "auto" finds the largest one, for all frames and colours, that the
        bounds reach; at a loss at most 1 % below the largest there is.
    loss : float, optional
        Relative error, weights included, that gain="auto" may cost, from 1e-6 to 1. When not
        given, no error is allowed where some gain is within reach exactly and there are no
        `weights`; elsewhere the larger of `rtol` and 1.1 times the smallest error that any gain
        has.
    weights : like `desired` or one frame of it, optional
        Factor, at least 0, of the residual at each camera pixel, before it is squared. When not
        given 1, and 0 where T.masked.
    method, rtol, **options
        Arguments of `ltcl.solve`. rtol is 1e-2 when not given, or the error of a compressed T or
        an inverse where that is more, as the result's `rtol` says. Within the bounds the error is
        the least there is up to `rtol`, relative to gain * desired - background. Where no bound
        holds, noise of a method that samples stays; it is part of `error` and `gap`, and makes the
        gain that gain="auto" finds smaller.
    exact : Transport, optional
        The uncompressed transport that T was compressed from: T then solves, to an `rtol` as
        `ltcl.solve` says; errors and pictures are computed with `exact`. The pattern itself is
        rounded to float32, 6e-8.
    inverse : Inverse, optional
        The inverse of T that `ltcl.invert` makes: the light without bounds is then one product,
        whatever the method.
    clamp : bool
        Clamp the light to the bounds, and leave it at that: quick, for videos. Other pixels do not
        make up for it; `error` tells how far off that is, and `gap` is the whole error, since
        nothing is proved.

    Returns
    -------
    Compensation
        The pattern with its error. At a given gain it is never worse than the light without
        bounds, clamped.

    Raises
    ------
    InputError
        Other shapes, bounds in the wrong order, a gain that is not positive, weights below 0, no
        gain within `loss`, an `rtol` below the error of a compressed T without `exact` or of
        `inverse`, or an inverse of another transport.
    ConvergenceError
        A solve did not reach `rtol` in `maxiter` steps, or not at all. Within the bounds, where
        float32 is too coarse to prove it, the best light found is returned, and `gap` tells what
        is proved.

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
    request = _check_inputs(
        T,
        desired,
        bounds=bounds,
        background=background,
        gain=gain,
        loss=loss,
        weights=weights,
        method=method,
        rtol=rtol,
        exact=exact,
        inverse=inverse,
        clamp=clamp,
        options=options,
    )
    start = _undo_light(request)
    check_range(request.problem, start.gain)
    bounded = _bring_within_bounds(request, start)
    compensation = _judge(request, start, bounded)
    evidence = compensation._evidence
    is_float = np.asarray(desired).dtype.kind == "f"
    if evidence.explained is not None and request.gain is not None and is_float:
        warn_of_units(evidence.target, evidence.appearance)
    return compensation


@dataclass(frozen=True, kw_only=True, eq=False)
class LightSolver:
    """The solves that undo light: S^-1 of pictures, one per channel."""

    T: Transport
    exact: tuple[Operator | None, ...]
    inverse: Inverse | None
    method: str
    rtol: float
    options: dict[str, Any]

    def solve(self, targets: Columns) -> tuple[Solution, ...]:
        """S^-1 of the targets of all systems: one solution per channel."""
        if len(targets) != self.T.channels:
            targets = np.split(targets[0], 3)
        if self.inverse is not None:
            solutions = [self.inverse.solve(b, channel) for channel, b in enumerate(targets)]
            return tuple(solutions)
        return solve_each(
            self.T.systems,
            targets,
            self.method,
            exact=self.exact,
            rtol=self.rtol,
            with_residual=self.rtol >= MIN_RESIDUAL_RTOL,
            **self.options,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Request:
    """The checked inputs of `compensate`.

    `gain` is None for "auto"; `is_gain_exact` tells whether "auto" may take the largest gain
    without an error. `reference` is the transport that judges.
    """

    T: Transport
    reference: Transport
    problem: CompensationProblem
    shape: layout.Layout
    solver: LightSolver
    gain: float | None
    loss: float | None
    is_gain_exact: bool
    clamp: bool
    throw: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class StartingLight:
    """A gain, and the light (N, k) of each system to be brought within the bounds.

    `solutions` are those without bounds, one per channel, where T has an S. Light that
    `meets_target` is the best there is if clipping does not change it.
    """

    gain: float
    light: Columns
    solutions: tuple[Solution, ...] = ()
    meets_target: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class BoundedLight:
    """Light (N, k) of each system within the bounds, and the solves that it took.

    `frame_clipped`, (frames,), is the share of values of lit pixels that are at a bound and would
    go beyond it.
    """

    light: Columns
    solves: tuple[Bounded, ...]
    frame_clipped: np.ndarray


def _check_inputs(
    T: Transport,
    desired: Any,
    *,
    bounds: tuple[float, float],
    background: Any,
    gain: float | str,
    loss: float | None,
    weights: Any,
    method: str,
    rtol: float | None,
    exact: Transport | None,
    inverse: Inverse | None,
    clamp: bool,
    options: dict[str, Any],
) -> Request:
    """Step 1: refuse bad inputs before anything is uploaded, and set up the problem."""
    require(T, square=False)
    bounds = checks.interval("bounds", bounds)
    checked_gain = check_gain(gain, loss)
    system_count = 1 if T.couples else T.channels
    masked = join_channels([T.masked] * T.channels, system_count)[0]
    limits = Limits.in_float32(bounds, masked)
    columns, shape = layout.unpack("desired", desired, T.camera_grid, T.channels)
    dark = check_background(background, T, shape, columns)
    channel_weights, weight_unit = check_weights(weights, T, shape, columns)
    if inverse is not None:
        other_method = None if method == "auto" else method
        require_inverse(T, inverse, rtol, exact=exact, method=other_method)
    if rtol is None:
        rtol = default_rtol(RTOL, T, exact, inverse)
    rules = check_rules(T, method, rtol, options, weight_unit)
    if checks.flag("clamp", clamp) and not T.is_square:
        raise InputError(
            "clamp is True, but this T has no S; its light is found within the bounds only"
        )
    reference, judging_systems = resolve_reference(T, exact)
    if channel_weights is not None:
        channel_weights = join_channels(channel_weights, system_count)
    problem = CompensationProblem(
        systems=channel_systems(reference),
        desired=join_channels(columns, system_count),
        background=join_channels(dark, system_count),
        weights=channel_weights,
        weight_unit=weight_unit,
        limits=limits,
        rules=rules,
    )
    solver = LightSolver(
        T=T,
        exact=tuple(judging_systems),
        inverse=inverse,
        method=method,
        rtol=rtol,
        options=options,
    )
    return Request(
        T=T,
        reference=reference,
        problem=problem,
        shape=shape,
        solver=solver,
        gain=checked_gain,
        loss=loss,
        is_gain_exact=weights is None and loss is None,
        clamp=clamp,
        throw=options.get("throw", True),
    )


def _undo_light(request: Request) -> StartingLight:
    """Step 2: the light without bounds, at the gain, or at the largest gain within the loss."""
    problem = request.problem
    if request.gain is None:
        return _undo_light_at_largest_gain(request)
    if not request.T.is_square:
        columns = problem.desired[0].shape[1]
        light = [np.zeros((len(scale), columns)) for _, scale in problem.systems]
        return StartingLight(gain=request.gain, light=light)
    solutions = request.solver.solve(problem.missing_light(request.gain))
    # S^-1 meets every pixel but masked ones, which count only where weights say so.
    return StartingLight(
        gain=request.gain,
        light=_projector_light(request, [s.x for s in solutions]),
        solutions=solutions,
        meets_target=not problem.counts_masked_pixels,
    )


def _undo_light_at_largest_gain(request: Request) -> StartingLight:
    problem = request.problem
    if not request.T.is_square:
        gain, light = gain_within_loss(problem, request.loss)
        return StartingLight(gain=gain, light=light)
    # Light is affine in the gain: desired and background are solved side by side, once.
    columns = problem.desired[0].shape[1]
    sides = [np.hstack(pair) for pair in zip(problem.desired, problem.background, strict=True)]
    solutions = request.solver.solve(sides)
    slopes = _projector_light(request, [s.x[:, :columns] for s in solutions])
    shifts = _projector_light(request, [s.x[:, columns:] for s in solutions])
    gain = None
    if request.is_gain_exact:
        gain = exact_gain(slopes, shifts, problem.limits)
    meets_target = gain is not None
    if gain is None:
        gain, light = gain_within_loss(problem, request.loss)
    else:
        light = [gain * slope - shift for slope, shift in zip(slopes, shifts, strict=True)]
    return StartingLight(
        gain=gain,
        light=light,
        solutions=tuple(_solution_at_gain(s, gain) for s in solutions),
        meets_target=meets_target,
    )


def _projector_light(request: Request, direct: Columns) -> Columns:
    """The projector light of each system from the direct light of each channel."""
    T = request.T
    F = np.atleast_2d(T.first_bounce)
    light = layout.to_light(direct, F, T.mixing)
    return join_channels(light, len(request.problem.systems))


def _solution_at_gain(solution: Solution, gain: float) -> Solution:
    """gain times the solution of desired, less that of background; both stand side by side."""
    columns = solution.x.shape[1] // 2
    x = gain * solution.x[:, :columns] - solution.x[:, columns:]
    standard_error = solution.standard_error
    if standard_error is not None:
        # Both sides share their samples, so that errors add at worst.
        standard_error = gain * standard_error[:, :columns] + standard_error[:, columns:]
    return dataclasses.replace(solution, x=x, standard_error=standard_error, rest=None)


def _bring_within_bounds(request: Request, start: StartingLight) -> BoundedLight:
    """Step 3: the light within the bounds that comes nearest to the target, or the clamped one."""
    problem = request.problem
    limits = problem.limits
    frames = request.shape.frames or 1
    light: Columns = []
    solves: list[Bounded] = []
    clipped = np.zeros(frames)
    for index, unbounded in enumerate(start.light):
        nearest = limits.clip(unbounded)
        is_clipped = limits.exceeded(unbounded)
        is_best = start.meets_target and is_clipped is None
        if not is_best and not request.clamp:
            nearest, solution = problem.nearest(index, start.gain, nearest, problem.rules)
            if request.throw and solution.status is Status.MAXITER:
                raise ConvergenceError(str(solution), solution)
            solves.append(solution)
            is_at_bound = (nearest <= limits.low) | (nearest >= limits.high)
            is_clipped = solution.saturated & is_at_bound & ~limits.masked[:, None]
        light.append(nearest)
        if is_clipped is not None:
            counts = np.reshape([np.count_nonzero(column) for column in is_clipped.T], (frames, -1))
            clipped += counts.mean(axis=1) / np.count_nonzero(~limits.masked)
    return BoundedLight(light=light, solves=tuple(solves), frame_clipped=clipped / len(start.light))


def _judge(request: Request, start: StartingLight, bounded: BoundedLight) -> Compensation:
    """Step 4: what the scene will look like under the light, and how far that is from the target."""
    problem = request.problem
    reference = request.reference
    target = problem.target(start.gain)
    frames = len(bounded.frame_clipped)
    clipped = float(np.mean(bounded.frame_clipped))
    residuals = _residuals_of_solves(request, start, bounded)
    queued: list[Array] = []
    if residuals is None:
        for A, light in zip(reference.operators, bounded.light, strict=True):
            queued.append(A.apply(A.device.upload(light)))
    # While the device works:
    pattern = request.shape.pack(bounded.light, reference.grid)
    target_norms = problem.norms(target)
    if residuals is None:
        appearance = _read_appearance(problem, queued)
        missing = [d - c for d, c in zip(target, appearance, strict=True)]
    else:
        appearance = None
        missing = join_channels(residuals, len(problem.systems))

    frame_sizes = _norms_of_frames(target_norms, frames)
    frame_errors = _norms_of_frames(problem.norms(missing), frames)
    size = float(np.linalg.norm(frame_sizes)) or 1.0
    error = float(np.linalg.norm(frame_errors))
    least_of_solves = []
    for solution in bounded.solves:
        least_of_solves.append(np.linalg.norm(solution.least / problem.weight_unit))
    least_error = float(np.linalg.norm(least_of_solves))
    solutions = start.solutions or bounded.solves
    return Compensation(
        pattern=pattern,
        gain=start.gain,
        clipped=clipped,
        error=error / size,
        gap=max(error - least_error, 0.0) / size,
        frame_errors=frame_errors / np.where(frame_sizes > 0, frame_sizes, 1.0),
        frame_clipped=bounded.frame_clipped,
        solution=solutions[0] if len(solutions) == 1 else solutions,
        limited=bounded.solves,
        transport_error=reference.error,
        rtol=problem.rules.rtol,
        _evidence=Evidence(
            shape=request.shape,
            camera_grid=reference.camera_grid,
            target=target,
            missing=missing,
            appearance=appearance,
            weights=problem.weights,
            explained=_explained_values(problem, target_norms) if clipped else None,
            solving=request.T,
            reference=reference,
            inverse=request.solver.inverse,
            bounds=(problem.limits.low, problem.limits.high),
        ),
    )


def _residuals_of_solves(
    request: Request, start: StartingLight, bounded: BoundedLight
) -> Columns | None:
    """The residuals of the solves without bounds, if they are the missing light of this pattern."""
    has_changed = bounded.solves or bounded.frame_clipped.any()
    if has_changed or request.problem.limits.masked.any():
        return None
    residuals = [s.rest for s in start.solutions if s.rest is not None]
    if len(residuals) < request.T.channels:
        return None
    return residuals


def _read_appearance(problem: CompensationProblem, queued: list[Array]) -> Columns:
    """T p + background of each system, (M, k)."""
    pictures = [picture.get() for picture in queued]
    if not problem.has_background:
        return pictures
    return [picture + dark for picture, dark in zip(pictures, problem.background, strict=True)]


def _norms_of_frames(norms: list[np.ndarray], frames: int) -> np.ndarray:
    """Norms (frames,) from those of the columns of each system, of which frames lie side by side."""
    columns_of_frames = [n.reshape(frames, -1) for n in norms]
    return np.linalg.norm(np.concatenate(columns_of_frames, axis=1), axis=1)


def _explained_values(problem: CompensationProblem, target_norms: list[np.ndarray]) -> Columns:
    """Weighted values of missing light, (k,) of each system, that the tolerance explains."""
    pixels = problem.desired[0].shape[0]
    explained = []
    for norms in target_norms:
        tolerance = np.maximum(problem.rules.rtol * norms, problem.rules.atol)
        explained.append(EXPLAINED_DEVIATIONS * tolerance / np.sqrt(pixels))
    return explained
