# SPDX-License-Identifier: BSD-3-Clause
"""`compensate`: the projector pattern that makes the scene look as desired (section 8.2).

    l_in = F^-1 S^-1 (gain * desired - background)

by products with S only, in four steps: check the inputs, undo the light, bring it within the
bounds, judge the result. Where the light exceeds the projector's bounds, clamping it is not the
best: min ||W (T l_in + background - gain * desired)|| over the patterns within the bounds is solved
from there on. Where T has no S, it is solved from no light on.

The prepared frames of `Compensator` have the same checks, problem and steps within the bounds. Only
here light is undone to a residual that is proved, and the result comes with its evidence.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import ConvergenceError
from ltcl.interop.calls import Differentiable
from ltcl.operators import Operator
from ltcl.operators.diagonal_blocks import are_quicker_joined, joined_once
from ltcl.solvers import Bounded, Inverse, Solution, Status, solve_each
from ltcl.tasks.compensation.derivative import CompensationDerivative
from ltcl.tasks.compensation.gain import exact_gain, gain_within_loss
from ltcl.tasks.compensation.inputs import CompensationRequest, check_inputs
from ltcl.tasks.compensation.problem import (
    Columns,
    CompensationProblem,
    multiply,
    stack_channels,
    subtract,
)
from ltcl.tasks.compensation.result import Compensation, Evidence
from ltcl.transport import frames as layout
from ltcl.transport.transport import Transport

logger = logging.getLogger(__name__)

# From this rtol on, the rounding of a pattern does not count beside the residual of the solve.
MIN_RESIDUAL_RTOL = 1e-5
# Times the brightest pixel that was reached: beyond, desired is hardly in the units of T.
UNITS_RATIO = 4.0
# Times the root mean square of an error: few values of a solve's error are larger.
EXPLAINED_DEVIATIONS = 3.0


def _derivative(T: Any, desired: Any, **arguments: Any) -> CompensationDerivative:
    return CompensationDerivative(compensate, T, desired, **arguments)


@checks.takes_arrays(
    "desired",
    "background",
    "weights",
    differentiable=Differentiable(("desired", "background"), _derivative),
)
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
        given 1, and 0 where `T.unlit`: at camera pixels that no projector pixel lights.
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
        A solve did not reach `rtol` in `maxiter` steps, or not at all by the `method` that was
        given, or with `clamp`. A singular T, whose light cannot be undone, still has a best pattern
        within the bounds, which is returned. Where float32 is too coarse to prove that it is the
        best, the best light found is returned, and `gap` tells what is proved.

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
    request = check_inputs(
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
    request.problem.check_range(start.gain)
    bounded = _bring_within_bounds(request, start)
    compensation = _judge(request, start, bounded)
    if request.gain is not None and compensation.clipped > 0.0:
        _warn_of_units(desired, compensation._evidence)
    return compensation


@dataclass(frozen=True, kw_only=True, eq=False)
class StartingLight:
    """A gain, and the light (N, k) of each system to be brought within the bounds.

    `solutions` are those without bounds, one per channel, where T has an S. Light that
    `is_on_target` is the best there is if clipping does not change it.
    """

    gain: float
    light: Columns
    solutions: tuple[Solution, ...] = ()
    is_on_target: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class BoundedLight:
    """Light (N, k) of each system within the bounds, and the solves that it took.

    `clipped_values`, (N, k) bool of each system, are at a bound and would go beyond it; None where
    there are none. `frame_clipped`, (frames,), is their share of the values of lit pixels.
    """

    light: Columns
    solves: tuple[Bounded, ...]
    clipped_values: list[np.ndarray | None]
    frame_clipped: np.ndarray

    @property
    def clipped(self) -> float:
        """The share of all frames together."""
        return float(np.mean(self.frame_clipped))


def _undo_light(request: CompensationRequest) -> StartingLight:
    """Step 2: the light without bounds, at the gain, or at the largest gain within the loss."""
    try:
        if not request.T.is_square:
            return _share_light(request)
        if request.gain is None:
            return _undo_light_at_largest_gain(request)
        return _undo_light_at_gain(request, request.gain)
    except ConvergenceError as error:
        has_choice = request.method == "auto" and not request.clamp
        if not has_choice or error.solution.status is Status.MAXITER:
            raise
        # S may be singular, and yet some pattern within the bounds is the best.
        return _start_without_light(request)


def _share_light(request: CompensationRequest) -> StartingLight:
    """Light undone in the camera's pixels and shared out between several projectors."""
    T = request.T
    if T.scene is T:
        return _start_without_light(request)
    problem = request.problem
    if request.gain is not None:
        direct = _solve_in_scene(request, problem.light_to_add(request.gain))
        return StartingLight(gain=request.gain, light=T.share_light(direct))
    slopes = T.share_light(_solve_in_scene(request, problem.desired))
    shifts = [np.zeros_like(slope) for slope in slopes]
    if problem.has_background:
        shifts = T.share_light(_solve_in_scene(request, problem.background))
    gain, light = gain_within_loss(problem, request.loss, (slopes, shifts))
    return StartingLight(gain=gain, light=light)


def _solve_in_scene(request: CompensationRequest, targets: Columns) -> Columns:
    """The direct light of each channel that makes the targets, without bounds."""
    T = request.T
    if len(targets) != T.channels:
        targets = np.split(targets[0], 3)
    targets = [np.ascontiguousarray(target) for target in targets]
    if request.inverse is not None:
        direct = []
        for channel, target in enumerate(targets):
            direct.append(request.inverse.solve(target, channel).x)
        return direct
    solutions = solve_each(T.scene.systems, targets, rtol=request.problem.settings.rtol)
    return [solution.x for solution in solutions]


def _start_without_light(request: CompensationRequest) -> StartingLight:
    """No light, or the nearest one at the largest gain, where S^-1 does not exist."""
    problem = request.problem
    if request.gain is None:
        gain, light = gain_within_loss(problem, request.loss)
        return StartingLight(gain=gain, light=light)
    columns = problem.desired[0].shape[1]
    light = [np.zeros((len(scale), columns)) for _, scale in problem.systems]
    return StartingLight(gain=request.gain, light=light)


def _undo_light_at_gain(request: CompensationRequest, gain: float) -> StartingLight:
    problem = request.problem
    solutions = _solve_channels(request, problem.light_to_add(gain))
    # S^-1 meets every pixel but masked ones, which count only where weights say so.
    is_on_target = not problem.counts_masked_pixels
    undone = [solution.x for solution in solutions]
    return StartingLight(
        gain=gain,
        light=_projector_light(request, undone),
        solutions=solutions,
        is_on_target=is_on_target and _has_undone_light(solutions),
    )


def _undo_light_at_largest_gain(request: CompensationRequest) -> StartingLight:
    problem = request.problem
    # Light is affine in the gain: desired and background are solved side by side, once.
    columns = problem.desired[0].shape[1]
    sides = [np.hstack(pair) for pair in zip(problem.desired, problem.background, strict=True)]
    solutions = _solve_channels(request, sides)
    undone_desired = []
    undone_background = []
    for solution in solutions:
        undone_desired.append(solution.x[:, :columns])
        undone_background.append(solution.x[:, columns:])
    slopes = _projector_light(request, undone_desired)
    shifts = _projector_light(request, undone_background)
    gain = None
    if request.is_exact_gain_allowed:
        gain = exact_gain(slopes, shifts, problem.limits)
    is_on_target = gain is not None and _has_undone_light(solutions)
    if gain is None:
        gain, light = gain_within_loss(problem, request.loss, (slopes, shifts))
    else:
        light = subtract(multiply(gain, slopes), shifts)
    scaled = [_solution_at_gain(solution, gain) for solution in solutions]
    return StartingLight(
        gain=gain,
        light=light,
        solutions=tuple(scaled),
        is_on_target=is_on_target,
    )


def _has_undone_light(solutions: tuple[Solution, ...]) -> bool:
    """False if some solve with ``throw=False`` came no nearer than no light."""
    return all(s.converged or s.residual < 1.0 for s in solutions)


def _solve_channels(request: CompensationRequest, targets: Columns) -> tuple[Solution, ...]:
    """S^-1 of the targets of all systems: one solution per channel."""
    T = request.T
    if len(targets) != T.channels:
        targets = np.split(targets[0], 3)
    if request.inverse is not None:
        solutions = []
        for channel, target in enumerate(targets):
            solutions.append(request.inverse.solve(target, channel))
        return tuple(solutions)
    rtol = request.problem.settings.rtol
    return solve_each(
        T.systems,
        targets,
        request.method,
        exact=request.exact,
        rtol=rtol,
        with_residual=rtol >= MIN_RESIDUAL_RTOL,
        **request.options,
    )


def _projector_light(request: CompensationRequest, direct: Columns) -> Columns:
    """The projector light of each system from the direct light of each channel."""
    light = layout.to_light(direct, request.first_bounce, request.T.mixing)
    return stack_channels(light, len(request.problem.systems))


def _solution_at_gain(solution: Solution, gain: float) -> Solution:
    """gain times the solution of desired, less that of background; both stand side by side."""
    columns = solution.x.shape[1] // 2
    x = gain * solution.x[:, :columns] - solution.x[:, columns:]
    standard_error = solution.standard_error
    if standard_error is not None:
        # Both sides share their samples, so that errors add at worst.
        standard_error = gain * standard_error[:, :columns] + standard_error[:, columns:]
    return dataclasses.replace(solution, x=x, standard_error=standard_error, rest=None)


def _bring_within_bounds(request: CompensationRequest, start: StartingLight) -> BoundedLight:
    """Step 3: the light within the bounds that comes nearest to the target, or the clamped one."""
    problem = request.problem
    limits = problem.limits
    frames = request.shape.frame_count
    light: Columns = []
    clipped_values: list[np.ndarray | None] = []
    to_solve = {}
    for index, unbounded in enumerate(start.light):
        nearest = limits.clip(unbounded)
        is_clipped = limits.exceeded(unbounded)
        is_best = start.is_on_target and is_clipped is None
        if not is_best and not request.clamp:
            to_solve[index] = nearest
        light.append(nearest)
        clipped_values.append(is_clipped)
    solves: list[Bounded] = []
    solved = problem.nearest_each(start.gain, to_solve, problem.settings)
    for index, (nearest, solution) in solved.items():
        if problem.settings.throw and solution.status is Status.MAXITER:
            raise ConvergenceError(str(solution), solution)
        solves.append(solution)
        # The device rounds light at a bound to a neighbour of it.
        is_clipped = solution.saturated & limits.are_at_bound(nearest)
        light[index] = np.where(is_clipped, limits.nearer_bound(nearest), nearest)
        clipped_values[index] = is_clipped
    clipped = np.zeros(frames)
    for is_clipped in clipped_values:
        if is_clipped is not None:
            counts = np.reshape([np.count_nonzero(column) for column in is_clipped.T], (frames, -1))
            clipped += counts.mean(axis=1) / np.count_nonzero(~limits.masked)
    return BoundedLight(
        light=light,
        solves=tuple(solves),
        clipped_values=clipped_values,
        frame_clipped=clipped / len(start.light),
    )


def _judge(
    request: CompensationRequest, start: StartingLight, bounded: BoundedLight
) -> Compensation:
    """Step 4: how far the scene under this light is from the target, with the evidence."""
    problem = request.problem
    pattern, evidence, target_norms = _gather_evidence(request, start, bounded)
    frames = len(bounded.frame_clipped)
    frame_sizes = _norms_of_frames(target_norms, frames)
    frame_errors = _norms_of_frames(problem.norms(evidence.missing), frames)
    # Errors of a black target are not relative; norms are in the unit of the weights.
    black_size = 1.0 / problem.weight_unit
    size = float(np.linalg.norm(frame_sizes))
    if size == 0.0:
        size = black_size
    error = float(np.linalg.norm(frame_errors))
    solutions = start.solutions
    if not solutions:
        solutions = bounded.solves
    solution = solutions
    if len(solutions) == 1:
        solution = solutions[0]
    return Compensation(
        pattern=pattern,
        gain=start.gain,
        clipped=bounded.clipped,
        error=error / size,
        gap=max(error - _least_error(problem, bounded), 0.0) / size,
        frame_errors=frame_errors / np.where(frame_sizes > 0, frame_sizes, black_size),
        frame_clipped=bounded.frame_clipped,
        solution=solution,
        limited=bounded.solves,
        transport_error=request.transport_error,
        rtol=problem.settings.rtol,
        _evidence=evidence,
    )


def _gather_evidence(
    request: CompensationRequest, start: StartingLight, bounded: BoundedLight
) -> tuple[np.ndarray, Evidence, list[np.ndarray]]:
    """The pattern, the evidence, and the norms of the target, (k,) of each system."""
    problem = request.problem
    reference = request.reference
    target = problem.target(start.gain)
    residuals = _residuals_of_solves(request, start, bounded)
    queued: list[Array] = []
    if residuals is None:
        queued = _queue_pictures(reference.operators, bounded.light)
    # While the device works:
    pattern = request.shape.pack(bounded.light, reference.grid)
    target_norms = problem.norms(target)
    appearance = None
    if residuals is None:
        appearance = _read_appearance(problem, queued)
        missing = subtract(target, appearance)
    else:
        missing = stack_channels(residuals, len(problem.systems))
    explained = None
    if bounded.clipped:
        explained = _explained_values(problem, target_norms)
    evidence = Evidence(
        shape=request.shape,
        camera_grid=reference.camera_grid,
        target=target,
        missing=missing,
        appearance=appearance,
        weights=problem.weights,
        clipped_values=bounded.clipped_values,
        explained=explained,
        solving=request.T,
        reference=reference,
        inverse=request.inverse,
        bounds=(problem.limits.low, problem.limits.high),
    )
    return pattern, evidence, target_norms


def _queue_pictures(operators: Sequence[Operator], lights: Columns) -> list[Array]:
    """Queue T p of each system, or of all of them in one product."""
    are_single = all(light.shape[1] == 1 for light in lights)
    if len(operators) > 1 and are_single and are_quicker_joined(operators):
        joined = joined_once(operators)
        return [joined.apply(joined.device.upload(np.concatenate(lights)))]
    queued = []
    for A, light in zip(operators, lights, strict=True):
        queued.append(A.apply(A.device.upload(light)))
    return queued


def _least_error(problem: CompensationProblem, bounded: BoundedLight) -> float:
    """No light within the bounds has a smaller error, as far as the solves have proved it."""
    least = []
    for solution in bounded.solves:
        least.append(np.linalg.norm(solution.least / problem.weight_unit))
    return float(np.linalg.norm(least))


def _residuals_of_solves(
    request: CompensationRequest, start: StartingLight, bounded: BoundedLight
) -> Columns | None:
    """The residuals of the solves without bounds, if they are the missing light of this pattern."""
    if bounded.solves or bounded.clipped or request.problem.limits.masked.any():
        return None
    residuals = [s.rest for s in start.solutions if s.rest is not None]
    if len(residuals) < request.T.channels:
        return None
    return residuals


def _read_appearance(problem: CompensationProblem, queued: list[Array]) -> Columns:
    """T p + background of each system, (M, k)."""
    pictures = [picture.get() for picture in queued]
    if len(pictures) < len(problem.systems):
        pictures = np.split(pictures[0], len(problem.systems))
    if not problem.has_background:
        return pictures
    return [picture + dark for picture, dark in zip(pictures, problem.background, strict=True)]


def _norms_of_frames(norms: list[np.ndarray], frames: int) -> np.ndarray:
    """Norms (frames,) from those of the columns of each system, where frames lie side by side."""
    columns_of_frames = [n.reshape(frames, -1) for n in norms]
    return np.linalg.norm(np.concatenate(columns_of_frames, axis=1), axis=1)


def _explained_values(problem: CompensationProblem, target_norms: list[np.ndarray]) -> Columns:
    """Weighted values of missing light, (k,) of each system, that the tolerance explains."""
    pixels = problem.desired[0].shape[0]
    explained = []
    for norms in target_norms:
        tolerance = np.maximum(problem.settings.rtol * norms, problem.settings.atol)
        explained.append(EXPLAINED_DEVIATIONS * tolerance / np.sqrt(pixels))
    return explained


def _warn_of_units(desired: Any, evidence: Evidence) -> None:
    """Log a warning if the target is far brighter than the appearance; integers are warned of."""
    if evidence.appearance is None or np.asarray(desired).dtype.kind != "f":
        return
    highest = max(float(c.max()) for c in evidence.target)
    reached = max(float(c.max()) for c in evidence.appearance)
    # Bounds below 0 leave no light to compare with.
    if 0.0 < UNITS_RATIO * reached < highest:
        logger.warning(
            "desired reaches %.3g, the scene %.3g at most; %s",
            highest,
            reached,
            layout.UNITS % 255,
        )
