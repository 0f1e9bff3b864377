# SPDX-License-Identifier: BSD-3-Clause
"""`compensate`: the projector pattern that makes the scene look as desired (section 8.2).

    l_in = F^-1 S^-1 (gain * desired - background)

by products with S only. Where that asks for light beyond the projector's bounds, clamping it is not
the best: min ||W (T l_in + background - gain * desired)|| over the patterns within the bounds is
solved from there on. Where T has no S, it is solved from no light on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import ConvergenceError, InputError
from ltcl.solvers import Bounded, Inverse, Solution, Status, solve_each
from ltcl.tasks.compensation import gain as gains
from ltcl.tasks.compensation import problem as problems
from ltcl.tasks.compensation.problem import Columns, Limits, Problem, join, systems
from ltcl.tasks.requirements import check_inverse, default_rtol, error_note, resolve_reference
from ltcl.transport import frames as layout
from ltcl.transport.transport import Transport, check_transport
from ltcl.transport.uncertainty import CompensationStd, compensation_std

RTOL = 1e-2
_COARSE = 1e-5  # rtol from which on the rounding of a pattern does not count beside the residual
_EXPLAINED = 3.0  # times the root mean square of an error: few of a solve's are larger


@dataclass(frozen=True, repr=False, eq=False)
class Compensation:
    """Result of `ltcl.compensate`. Pictures are linear, float32, of the frames and colours of `desired`.

    Those of the camera, `appearance`, `target` and `out_of_reach`, are made when they are asked
    for.

    Attributes
    ----------
    pattern : array
        Linear projector light within the bounds, on the projector's grid; 0 at masked pixels.
    gain : float
        The target was gain * desired.
    clipped : float
        Fraction of pattern values that are at a bound and would lower the error beyond it; masked
        pixels do not count.
    error : float
        ``||W (appearance - target)|| / ||W target||`` of all frames and colours together, with T as it is, or
        `exact` where that was given; see `transport_error`.
    gap : float
        Bound on what the error is above the least: no pattern within the bounds has one below error
        - gap.
    frame_errors, frame_clipped : (frames,) float64
        `error` and `clipped` of each frame by itself; of a single picture, one value.
    solution : Solution or tuple of 3
        What the light would be without bounds, one per channel of the transport; of a T without S,
        `limited`.
    limited : tuple of Bounded
        The solves within the bounds, with the products of the search for a gain; empty where these
        cost nothing.
    transport_error : float
        ``.error`` of that T, 0 of uncompressed ones: the scene may look that much farther from the
        target, in relation to T pattern.
    rtol : float
        Tolerance of the solves: as given, or what was chosen.
    """

    pattern: np.ndarray
    gain: float
    clipped: float
    error: float
    gap: float
    frame_errors: np.ndarray
    frame_clipped: np.ndarray
    solution: Solution | tuple[Solution, ...]
    limited: tuple[Bounded, ...]
    transport_error: float
    rtol: float
    _shape: layout.PictureLayout
    _grid: tuple[int, int]  # of the camera
    _target: Columns
    _missing: Columns  # target - appearance
    _seen: Columns | None  # the appearance, where that is what was computed
    _weights: Columns | None
    _explained: (
        list[np.ndarray] | None
    )  # (k,), of what is missing, by the tolerance; None: all of it
    _transports: tuple[Transport, Transport]  # that solves; whose noise it is
    _inverse: Inverse | None
    _bounds: tuple[float, float]

    @cached_property
    def appearance(self) -> np.ndarray:
        """T pattern + background: what the camera will see, on its grid."""
        if self._seen is not None:
            return self._picture(self._seen)
        return self._picture([d - r for d, r in zip(self._target, self._missing, strict=True)])

    @cached_property
    def std(self) -> CompensationStd:
        """Standard deviations by the noise of T, `ltcl.transport.uncertainty`, computed at the first call."""
        (T, true), own = self._transports, systems(self._transports[0]) if self.limited else ()
        bounds = self._bounds if self.clipped else (-np.inf, np.inf)
        return compensation_std(
            T, true.noise, self.pattern, bounds, self._inverse, own, self._weights
        )

    @cached_property
    def target(self) -> np.ndarray:
        """gain * desired."""
        return self._picture(self._target)

    @cached_property
    def out_of_reach(self) -> np.ndarray:
        """target - appearance where the projector keeps the scene too dark (positive) or bright (negative).

        0 where nothing is clipped, and where weight * abs(target - appearance) is at most 3 times
        what ``max(rtol ||W target||, atol)`` of this frame and colour makes in the root mean
        square.
        """
        if self._explained is None:
            return np.zeros_like(self.target)
        weights = self._weights or [np.ones((1, 1), np.float32)] * len(self._missing)
        columns = zip(self._missing, weights, self._explained, strict=True)
        return self._picture([np.where(np.abs(w * r) > most, r, 0.0) for r, w, most in columns])

    def _picture(self, columns: Columns) -> np.ndarray:
        return self._shape.pack(columns, self._grid).astype(np.float32, copy=False)

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.pattern.shape))
        error = f"relative error {self.error:.2%}{error_note(self.transport_error)}"
        return f"<ltcl Compensation {shape}, {error}, {self.clipped:.2%} clipped>"

    def _repr_html_(self) -> str:
        from ltcl.images.thumbnails import thumbnails  # brings OpenCV

        names = ("pattern", "appearance", "target", "out_of_reach")
        return thumbnails(self, {name: getattr(self, name) for name in names})


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
        With more or fewer camera than projector pixels, or blocks between colours, it works too, in
        the least-squares sense and without `method`. F = diag(T) is a valid choice for any opaque
        scene.
    desired : (h, w), (h, w, 3), or frames of these
        Wanted radiance at each camera pixel, in the units of T.
    bounds : (low, high)
        What the projector can emit per pixel, in linear light.
    background : number, like `desired` or one frame of it, optional
        Light the projector cannot take away: ambient and its own black. T pattern + background is
        matched.
    gain : float or "auto"
        Scale of the target; "auto" finds the largest one, for all frames and colours, that the
        bounds reach; at a loss at most 1 % below the largest there is.
    loss : float, optional
        Of gain="auto": relative error, weights included, that the gain may cost, from 1e-6 to 1.
        When not given, no error is allowed where some gain is within reach exactly and there are no
        `weights`; elsewhere the larger of `rtol` and 1.1 times the smallest error that any gain
        has.
    weights : like `desired` or one frame of it, optional
        Factor, at least 0, of the residual at each camera pixel, before it is squared. When not
        given 1, and 0 where T.masked.
    method, rtol, **options
        Of `ltcl.solve`; rtol is 1e-2 when not given, or the error of a compressed T or an inverse
        where that is more, as the result's `rtol` says. Within the bounds the error is the least
        there is up to `rtol`, relative to gain * desired - background. Where no bound holds, noise
        of a method that samples stays; it is part of `error` and `gap`, and makes the gain that
        gain="auto" finds smaller.
    exact : Transport, optional
        The uncompressed transport that T was compressed from: T then solves, to an `rtol` as
        `ltcl.solve` says; errors and pictures are computed with `exact`. The pattern itself is
        rounded to float32, 6e-8.
    inverse : Inverse, optional
        Of T, as `ltcl.invert` makes it: the light without bounds is then one product, whatever the
        method.
    clamp : bool
        Clamp the light to the bounds, and leave it at that: quick, for videos. Other pixels do not
        make up for it; `error` tells how far off that is, and `gap` is the whole error, since
        nothing is proved.

    The result is never worse than the light without bounds, clamped, at a given gain.

    Raises
    ------
    InputError
        Other shapes, bounds in the wrong order, a gain that is not positive, weights below 0, no
        gain within `loss`, an `rtol` below the error of a compressed T without `exact` or of
        `inverse`, or an inverse of another transport.
    ConvergenceError
        A solve did not reach `rtol` in `maxiter` steps, or not at all. Within the bounds, where
        float32 is too coarse to prove it, the best that was found comes back, and `gap` tells what
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
    check_transport(T, square=False)
    low_high, requested = checks.interval("bounds", bounds), problems.gain(gain, loss)
    count = 1 if T.couples else T.channels
    limits = Limits.in_float32(low_high, join([T.masked] * T.channels, count)[0])
    d, shape = layout.unpack("desired", desired, T.camera_grid, T.channels)
    dark = problems.background(background, T, shape, d)
    W, unit = problems.weights(weights, T, shape, d)
    if inverse is not None:
        check_inverse(T, inverse, rtol, exact=exact, method=None if method == "auto" else method)
    rtol = default_rtol(RTOL, T, exact, inverse) if rtol is None else rtol
    rules = problems.rules(T, method, rtol, options)
    if checks.flag("clamp", clamp) and not T.is_square:
        raise InputError(
            "clamp is True, but this T has no S; its light is found within the bounds only"
        )
    true, judges = resolve_reference(T, exact)

    def undo(targets: Columns) -> tuple[Solution, ...]:
        """S^-1 of one target a system: one solution a channel."""
        targets = targets if len(targets) == T.channels else np.split(targets[0], 3)
        if inverse is not None:
            return tuple(inverse.solve(b, channel) for channel, b in enumerate(targets))
        return solve_each(
            T.systems,
            targets,
            method,
            exact=judges,
            rtol=rtol,
            with_residual=rtol >= _COARSE,
            **options,
        )

    problem = Problem(
        systems(true),
        join(d, count),
        join(dark, count),
        None if W is None else join(W, count),
        limits,
        {**rules, "atol": rules["atol"] / unit},
        unit,
    )
    error = true.error
    start = _start(T, problem, undo, requested, loss, exactly=weights is None)
    problems.check_range(problem, start.gain)
    within = _within(problem, start, shape.frames or 1, options.get("throw", True), clamp)
    c = _result((T, true), inverse, problem, shape, start, *within, transport_error=error)
    if requested is not None and c.clipped > 0.0 and np.asarray(desired).dtype.kind == "f":
        problems.warn_of_units(c._target, c._seen or [])
    return c


@dataclass(frozen=True, eq=False)
class _Start:
    """A gain, and the light (N, k) of each system to be brought within the limits.

    `solutions` are those without bounds, one a channel, where T has an S. Light that `meets` the
    target is the best there is if clipping does not change it.
    """

    gain: float
    light: Columns
    solutions: tuple[Solution, ...] = ()
    meets: bool = False


def _start(
    T: Transport,
    problem: Problem,
    undo: Callable[[Columns], tuple[Solution, ...]],
    gain: float | None,
    loss: float | None,
    exactly: bool,
) -> _Start:
    """At `gain`, or at the largest within `loss`; where both are None, `exactly` within reach if any is."""
    k = problem.desired[0].shape[1]
    if not T.is_square:
        if gain is None:
            return _Start(*gains.within_loss(problem, loss))
        return _Start(gain, [np.zeros((len(scale), k)) for _, scale in problem.systems])

    F = np.atleast_2d(T.first_bounce)

    def light(direct: Columns) -> Columns:
        return join(layout.to_light(direct, F, T.mixing), len(problem.systems))

    if gain is not None:
        solutions = undo(problem.target(gain))
        # S^-1 meets every pixel but those of masked ones, which count only where weights say so.
        masked = problem.limits.masked
        counted = problem.weights is not None and any(w[masked].any() for w in problem.weights)
        return _Start(gain, light([s.x for s in solutions]), solutions, meets=not counted)
    # Light is affine in the gain: desired and background are solved side by side, once.
    both = undo([np.hstack(sides) for sides in zip(problem.desired, problem.dark, strict=True)])
    u, v = (light([s.x[:, side] for s in both]) for side in (slice(k), slice(k, None)))
    gain = gains.exact(u, v, problem.limits) if exactly and loss is None else None
    if meets := gain is not None:
        nearest = [gain * slope - shift for slope, shift in zip(u, v, strict=True)]
    else:
        gain, nearest = gains.within_loss(problem, loss)
    solutions = []
    for s in both:  # both sides share their samples, so that errors add at worst
        x, error = gain * s.x[:, :k] - s.x[:, k:], s.standard_error
        error = None if error is None else gain * error[:, :k] + error[:, k:]
        solutions.append(dataclasses.replace(s, x=x, standard_error=error, rest=None))
    return _Start(gain, nearest, tuple(solutions), meets)


def _within(
    problem: Problem, start: _Start, frames: int, throw: bool, clamp: bool
) -> tuple[Columns, list[Bounded], np.ndarray]:
    """Light within the limits, the solves that it took, and the share of its values, (frames,), at a bound.

    That is of values that want to go beyond it, and of pixels that are lit.
    """
    limits = problem.limits
    light: Columns = []
    limited: list[Bounded] = []
    shares = np.zeros(frames)
    for which, free in enumerate(start.light):
        nearest, beyond = limits.clip(free), limits.exceeded(free)
        if not clamp and (not start.meets or beyond is not None):
            nearest, solution = problem.nearest(which, start.gain, nearest)
            if throw and solution.status is Status.MAXITER:
                raise ConvergenceError(str(solution), solution)
            limited.append(solution)
            at_bound = (nearest <= limits.low) | (nearest >= limits.high)
            beyond = solution.saturated & at_bound & ~limits.masked[:, None]
        light.append(nearest)
        if beyond is not None:
            counts = np.reshape([np.count_nonzero(column) for column in beyond.T], (frames, -1))
            shares += counts.mean(axis=1) / np.count_nonzero(~limits.masked)
    return light, limited, shares / len(light)


def _result(
    transports: tuple[Transport, Transport],
    inverse: Inverse | None,
    problem: Problem,
    shape: layout.PictureLayout,
    start: _Start,
    light: Columns,
    limited: list[Bounded],
    frame_clipped: np.ndarray,
    transport_error: float,
) -> Compensation:
    T, target, frames = transports[1], problem.scaled(start.gain), len(frame_clipped)
    clipped = float(np.mean(frame_clipped))
    missing, seen = (
        [solution.rest for solution in start.solutions if solution.rest is not None],
        None,
    )
    if clipped or limited or len(missing) < T.channels or problem.limits.masked.any():
        seen = [A.apply(A.device.upload(p)) for A, p in zip(T.operators, light, strict=True)]
    pattern = shape.pack(light, T.grid)  # while the device works
    norms = problem.norms(target)
    if seen is None:  # the light of the solve as it is, whose residual is what is missing
        missing = join(missing, len(problem.systems))
    else:
        seen = [T_p.get() for T_p in seen]
        if not problem.is_dark:
            seen = [T_p + dark for T_p, dark in zip(seen, problem.dark, strict=True)]
        missing = [d - c for d, c in zip(target, seen, strict=True)]
    # Columns of a frame lie side by side.
    sides = [
        [n.reshape(frames, -1) for n in columns] for columns in (norms, problem.norms(missing))
    ]
    sizes, errors = (np.linalg.norm(np.concatenate(side, axis=1), axis=1) for side in sides)
    size, error = float(np.linalg.norm(sizes)) or 1.0, float(np.linalg.norm(errors))
    least = np.linalg.norm([np.linalg.norm(solution.least / problem.unit) for solution in limited])
    rtol, atol = problem.rules["rtol"], problem.rules["atol"]
    pixels = target[0].shape[0]
    explained = [_EXPLAINED * np.maximum(rtol * norm, atol) / np.sqrt(pixels) for norm in norms]
    solutions = start.solutions or tuple(limited)
    return Compensation(
        pattern=pattern,
        gain=start.gain,
        clipped=clipped,
        error=error / size,
        gap=max(error - float(least), 0.0) / size,
        frame_errors=errors / np.where(sizes > 0, sizes, 1.0),
        frame_clipped=frame_clipped,
        solution=solutions[0] if len(solutions) == 1 else solutions,
        limited=tuple(limited),
        transport_error=transport_error,
        rtol=rtol,
        _shape=shape,
        _grid=T.camera_grid,
        _target=target,
        _missing=missing,
        _seen=seen,
        _weights=problem.weights,
        _explained=explained if clipped else None,
        _transports=transports,
        _inverse=inverse,
        _bounds=(problem.limits.low, problem.limits.high),
    )
