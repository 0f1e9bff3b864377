# SPDX-License-Identifier: BSD-3-Clause
"""The steps of a prepared compensation on the device: buffers and bound launches, made once.

    codes -> light to add -> direct light -> projector light within the bounds -> codes

Light stands in units in which the brightest is near 1, so that squares stay within float32. The
three colours are one vector, channel below channel, and one system.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Array, Device, transfers, vectors
from ltcl.device.kernels import Kernel, Launch, Queued, in_order
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, IdentityPlus, Operator, block_diagonal
from ltcl.operators.epilogue import Epilogue
from ltcl.solvers.auto import SMALL
from ltcl.solvers.bounded import Descent, Search, power_of_two
from ltcl.solvers.survey import survey
from ltcl.tasks.compensation.codes import CODE_TYPES, CodeTable, light_of_codes
from ltcl.tasks.compensation.inputs import CompensationRequest
from ltcl.tasks.compensation.kept_bounces import KeptBounces
from ltcl.tasks.compensation.problem import BOUNDS_SLACK

# Work-items of a group on a GPU, and spans of pixels for each unit of a CPU.
GROUP = 64
SPANS_PER_UNIT = 16
# Pixels that an item of a CPU takes at a time, channel by channel.
CPU_BLOCK = 64
# Pixels whose brightest light counts as one.
STRIP_PIXELS = 256
# Light may be so much brighter or darker than its unit.
MAX_UNIT_CHANGE = 64.0
# Light that no bound cuts off.
FREE_LIGHT = 1e30
# Of the tolerance: what probes may leave after a fixed number of steps, since frames are others.
PROBE_SHARE = 0.5
# Steps beyond which fixed steps are given up.
MAX_FIXED_STEPS = 60
# Products of the norms of S and S^-1 up to which float32 holds an inverse of a small system.
MAX_CONDITION = 1e5


@dataclass(frozen=True, kw_only=True)
class LightLayout:
    """The place of the light of each pixel and channel: (rows, columns) on the device."""

    pixels: int
    channels: int
    is_stacked: bool

    @property
    def shape(self) -> tuple[int, int]:
        """Channel below channel, or side by side."""
        if self.is_stacked:
            return self.channels * self.pixels, 1
        return self.pixels, self.channels

    @property
    def defines(self) -> dict[str, int]:
        """Defines of the kernels."""
        return {"CHANNELS": self.channels, "STACKED": int(self.is_stacked)}

    def from_channels(self, channels: Sequence[np.ndarray]) -> np.ndarray:
        """Values of this layout from (pixels, 1) of each channel, or one (pixels, channels)."""
        if self.is_stacked:
            return np.concatenate([np.ravel(channel) for channel in channels])[:, None]
        return np.broadcast_to(channels[0], self.shape)

    def to_channels(self, values: np.ndarray) -> np.ndarray:
        """(pixels, channels) of values in this layout."""
        if self.is_stacked:
            return values.reshape(self.channels, self.pixels).T
        return values.reshape(self.pixels, self.channels)


def _unit_of(request: CompensationRequest) -> float:
    """A power of two near the brightest light that the projector makes."""
    limits = request.problem.limits
    brightest = max(abs(limits.low), abs(limits.high))
    largest_scale = max(float(scale.max()) for _, scale in request.problem.systems)
    return power_of_two(brightest * largest_scale)


class ByInverse:
    """Direct light by a kept inverse: one product."""

    products = 1

    def __init__(self, inverse: Operator, target: Array, direct: Array) -> None:
        self.queue = inverse.bind(target, direct)


def _dense_inverses(systems: Sequence[Operator]) -> list[Dense] | None:
    """S^-1 of small systems, by a factorization in float64; None if one is singular."""
    inverses = []
    for S in systems:
        matrix, _ = S.matrix_float64()
        try:
            inverse = np.linalg.inv(matrix)
        except np.linalg.LinAlgError:
            return None
        size = float(np.linalg.norm(inverse)) * float(np.linalg.norm(matrix))
        if not size < MAX_CONDITION:
            return None
        inverses.append(Dense(S.device, inverse))
    return inverses


class ByFixedSteps:
    """Direct light by so many steps as probes need to the tolerance, a product with R each.

    From x = b on, a step is

        x' = x + w (b - S x) = (1 - w) x + w b - w R x,

    one product with all its terms. The w are the reciprocals of the roots of Chebyshev's polynomial
    on the bounds of the spectrum, in the order of Leja, in which rounding does not grow: after all
    steps x is that of Chebyshev's iteration, whose directions and residuals no vector holds. Where
    there is a basis W, x is on coefficients: x = b + W^T e.

    Attributes
    ----------
    products : int
        Products with R, of all frames alike; 0 if no number of steps was enough.
    residual : float
        The largest relative residual of the probes.
    """

    def __init__(
        self, S: IdentityPlus, target: Array, direct: Array, rtol: float, probes: np.ndarray
    ) -> None:
        self._target = target
        self._direct = direct
        self._W = S.coefficient_basis
        system = S.on_coefficients() if self._W is not None else S
        assert isinstance(system, IdentityPlus)  # noqa: S101 - so it is made
        self._system = system
        self._right = target
        if self._W is not None:
            self._right = S.device.empty((self._W.shape[0], target.columns))
        self.queue: Queued = in_order([])
        self.residual = math.inf
        self.products = 0
        self._choose_steps(S, survey(S).spectrum, rtol, probes)

    def _choose_steps(
        self, S: Operator, bounds: tuple[float, float], rtol: float, probes: np.ndarray
    ) -> None:
        """Take a step more until all probes are within the share of the tolerance."""
        for count in range(1, MAX_FIXED_STEPS):
            self.queue = self._bind(step_lengths(bounds, count))
            residual = max(self._residual(S, probe) for probe in probes)
            if not math.isfinite(residual):
                break
            if residual <= PROBE_SHARE * rtol:
                self.residual = residual
                self.products = count
                return

    def _bind(self, lengths: Sequence[float]) -> Queued:
        """The launches of steps of these lengths."""
        if self._W is None:
            return self._bind_steps(lengths, self._direct, leaves_change=False)
        change = self._right.like()
        added = Epilogue(b=1.0, y=self._target)
        return in_order(
            [
                self._W.bind(self._target, self._right),
                self._bind_steps(lengths, change, leaves_change=True),
                self._W.bind(change, self._direct, added, transpose=True),
            ]
        )

    def _bind_steps(self, lengths: Sequence[float], out: Array, *, leaves_change: bool) -> Queued:
        """The launches of steps from the right side b on, which leave x in `out`, or x - b."""
        b = self._right
        R = self._system.R
        sign = self._system.sign
        taken_off = 1.0 if leaves_change else 0.0
        between = [b.like() for _ in lengths[1:3]]
        x = b
        launches: list[Queued] = []
        for number, length in enumerate(lengths):
            is_last = number + 1 == len(lengths)
            following = out if is_last else between[number % 2]
            of_b = length - taken_off if is_last else length
            if x is b:
                # The operand is the right side.
                epilogue = Epilogue(a=-length * sign, c=1.0 - length + of_b)
            else:
                epilogue = Epilogue(a=-length * sign, b=of_b, y=b, c=1.0 - length)
            launches.append(R.bind(x, following, epilogue))
            x = following
        return in_order(launches)

    def _residual(self, S: Operator, probe: np.ndarray) -> float:
        """||b - S x|| / ||b|| of a probe b, of the worst column."""
        self._target.set(probe)
        self.queue()
        left = S.apply(self._direct, scale=-1.0, add=self._target)
        left_norms, norms = vectors.norms(left, self._target)
        return float(np.max(left_norms / np.where(norms > 0.0, norms, 1.0)))


def step_lengths(bounds: tuple[float, float], count: int) -> list[float]:
    """Reciprocals of the roots of Chebyshev's polynomial of a degree on an interval.

    In the order of Leja: each root is the one farthest from those before, by the product of all
    distances.

    >>> [round(1.0 / length, 3) for length in step_lengths((1.0, 3.0), 3)]
    [2.866, 1.134, 2.0]
    """
    lower, upper = bounds
    angles = np.pi * (np.arange(count) + 0.5) / count
    roots = 0.5 * (upper + lower) + 0.5 * (upper - lower) * np.cos(angles)
    left = list(roots)
    ordered = [left.pop(0)]
    # Distances in units of a quarter of the interval, so that products stay within range.
    unit = 0.25 * (upper - lower) or 1.0
    while left:
        distances = np.abs(np.subtract.outer(left, ordered)) / unit
        farthest = int(np.argmax(distances.prod(axis=1)))
        ordered.append(left.pop(farthest))
    return [1.0 / float(root) for root in ordered]


class BySharing:
    """Light of several projectors: direct light, its drive, and the shares of all, within bounds.

    A drive within the bounds gives each projector no more than its ceiling.

    Attributes
    ----------
    products : int
    queue : Queued
        All launches.
    free, queue_free : Array, Queued
        Light without bounds, and what leaves it there after `queue`.
    """

    def __init__(
        self,
        products: int,
        queue: Queued,
        clip: Launch,
        exceeded: Array,
        free: Array,
        queue_free: Queued,
    ) -> None:
        self.products = products
        self.queue = queue
        self.free = free
        self.queue_free = queue_free
        self._clip = clip
        self._exceeded = exceeded

    def count_clipped(self) -> int:
        """The number of values that were beyond the bounds; waits."""
        self._exceeded.set(np.zeros(1, np.int32))
        self._clip()
        return int(self._exceeded.get()[0])


class WithinBounds:
    """Light within the bounds by projected steps, warm from the light of the frame before.

    Attributes
    ----------
    start : Array
        The clamped light of this frame, as unknowns, which the caller writes.
    x, target : Array
        The result, and the light to add.
    errors : (k,), optional
        ||w (A x - b)|| of the last frame, if steps were taken.
    steps : int
        Number of steps that the last frame took.
    """

    def __init__(
        self,
        A: Operator,
        columns: int,
        weights: np.ndarray | None,
        box: Any,
        rtol: float,
        is_warm: bool,
        planes: int,
    ) -> None:
        self.descent = Descent(A, columns, weights, box, planes)
        self._box = box
        self.target = self.descent.b
        self.x = self.descent.x
        self.start = self.x.like()
        self._last = self.x.like()
        # A x of the last x, where it is known, and what it leaves of another target.
        self._last_picture = self.target.like()
        self._last_residual = self.target.like()
        self._is_warm = is_warm
        self._has_last = False
        self._has_last_picture = False
        self._rtol = rtol
        self.errors: np.ndarray | None = None
        self.steps = 0

    def set_box(self, box: Any) -> None:
        """Take other bounds; the light of the frame before may be outside."""
        self.descent.set_box(box)
        self._box = box
        self._has_last = False

    def keep_start(self) -> None:
        """Take the clamped light as it is, where that is the best there is."""
        self.x.copy_from(self.start)
        self.errors = None
        self.steps = 0
        self._keep(has_picture=False)

    def solve(self, deadline: float) -> None:
        """Lower the error from the better of two starts, until the tolerance or the deadline."""
        descent = self.descent
        self.x.copy_from(self.start)
        descent.forget()
        clamped_errors = descent.measure()
        if self._has_last:
            errors = self._measure_last()
            if np.linalg.norm(errors) < np.linalg.norm(clamped_errors):
                self.start.copy_from(self._last)
                self.x.copy_from(self._last)
                descent.r.copy_from(self._last_residual)
        descent.take_residual()
        search = Search(descent, self._rtol, deadline=deadline)
        search.run()
        self.steps = len(search.history) - 1
        self.errors = search.errors
        is_worse = bool(search.is_worse.any())
        if is_worse:
            self.x.copy_from(self.start)
            self.errors = search.initial
        self._keep(has_picture=descent.has_true_residual and not is_worse)

    def _measure_last(self) -> np.ndarray:
        """||w (b - A x)|| of this target and the last x, by a product at most; waits."""
        descent = self.descent
        if self._has_last_picture:
            vectors.axpby(1.0, self.target, -1.0, self._last_picture, self._last_residual)
        else:
            descent.A.apply(self._last, self._last_residual, scale=-1.0, add=self.target)
            descent.products += 1
        return descent.norm_of(self._last_residual)

    def _keep(self, has_picture: bool) -> None:
        """Keep x for the next frame, and A x, if r is that of x itself."""
        if not self._is_warm:
            return
        self._last.copy_from(self.x)
        self._has_last = True
        self._has_last_picture = has_picture
        if has_picture:
            vectors.axpby(1.0, self.target, -1.0, self.descent.r, self._last_picture)

    def saturated(self) -> int:
        """The number of values at a bound, beyond which a step would go."""
        x = self.x.get()
        # The device rounds light at a bound to a neighbour of it.
        lower, upper = (bound[:, None] for bound in self._box)
        slack = BOUNDS_SLACK * (upper - lower)
        is_at_bound = (x <= lower + slack) | (x >= upper - slack)
        return int(np.count_nonzero(self.descent.saturated(x) & is_at_bound))


@dataclass(eq=False, kw_only=True)
class Slot:
    """Buffers of one frame on its way, on the device and on the host."""

    frame: transfers.Upload
    codes: transfers.Download
    peaks: transfers.Download
    decode: Launch
    # Of a frame for which the bounces of an earlier one stand.
    decode_between: Launch | None
    encode: Launch
    begun_at: float = 0.0
    gain: float = 1.0


class PreparedFrames:
    """All that frames of one kind take.

    Parameters
    ----------
    request : CompensationRequest
        The checked inputs of a picture of the same colours.
    frame_colours : 1 or 3
    frame_dtype, dtype : numpy type, str
        Types of the codes of frames and of the projector.
    decode : str
    table : CodeTable
    is_bounded, is_warm : bool
        Whether projected steps follow where light is beyond the bounds, and whether they may begin
        with the light of the frame before.
    has_peaks : bool
        Whether the brightest light of each strip of pixels is wanted.
    slots : int
        Frames that may be on their way.
    bounces_every : int
        Frames from one whose bounces are computed to the next.
    """

    def __init__(
        self,
        request: CompensationRequest,
        *,
        frame_colours: int,
        frame_dtype: Any,
        decode: str,
        dtype: str,
        table: CodeTable,
        is_bounded: bool,
        is_warm: bool,
        has_peaks: bool,
        slots: int,
        bounces_every: int = 1,
    ) -> None:
        T = request.T
        self.device: Device = request.problem.systems[0].A.device
        self.frame_colours = frame_colours
        self.frame_dtype = np.dtype(frame_dtype)
        self.dtype = dtype
        self._request = request
        is_stacked = T.channels == 3
        colours = 3 if is_stacked else frame_colours
        self.colours = colours
        h, w = T.grid
        H, W = T.camera_grid
        self.seen = LightLayout(pixels=H * W, channels=colours, is_stacked=is_stacked)
        self.shown = LightLayout(pixels=h * w, channels=colours, is_stacked=is_stacked)
        self.grid = T.grid
        self.camera_grid = T.camera_grid
        self.unit = _unit_of(request)
        self._device_tables(decode)
        self._set_code_table(table)
        self._is_warm = is_warm
        self._has_peaks = has_peaks
        self._make_steps(is_bounded, has_peaks)
        self._kept_bounces: KeptBounces | None = None
        if bounces_every > 1:
            self._kept_bounces = self._keep_bounces(bounces_every)
        self.slots = [self._slot() for _ in range(slots)]

    def for_codes(self, frame_colours: int, frame_dtype: Any, decode: str) -> PreparedFrames:
        """The same for frames of other codes, which share all buffers but those of the codes."""
        other = copy.copy(self)
        other.frame_colours = frame_colours
        other.frame_dtype = np.dtype(frame_dtype)
        other._set_light_table(decode)
        other.slots = [other._slot() for _ in self.slots]
        return other

    def takes_bounds(self, request: CompensationRequest) -> bool:
        """True if `set_bounds` takes the bounds of another request; else all is prepared anew.

        That is so for light of another size, and where it is shared between projectors.
        """
        if isinstance(self.direct_steps, BySharing):
            return False
        unit = _unit_of(request)
        return 1.0 / MAX_UNIT_CHANGE <= unit / self.unit <= MAX_UNIT_CHANGE

    def set_bounds(self, request: CompensationRequest, table: CodeTable) -> None:
        """Take the bounds of another request, and a table for them; nothing may be on its way."""
        self._request = request
        self._set_code_table(table)
        if self.bounded is not None:
            self.bounded.set_box(self._box())
        self._judge = self.bounded
        self._bind_to_bounds()
        for slot in self.slots:
            slot.encode = self._bind_encode(slot.codes.array, self.dtype, table)

    # Preparation.

    def _device_tables(self, decode: str) -> None:
        """Upload the tables of codes and the factors of light."""
        request = self._request
        device = self.device
        self._set_light_table(decode)
        background = self.seen.from_channels(request.problem.background)
        self._subtracts = float(request.problem.has_background)
        self._background_host = background
        self._background = device.upload(background / self.unit)
        mixing = np.eye(self.colours)
        # Several projectors share light whose colours are unmixed already.
        self._is_mixed = request.T.mixing is not None and request.T.scene is request.T
        if request.T.mixing is not None:
            mixing = np.linalg.inv(request.T.mixing)
        self._mixing = device.upload(mixing)

    def _set_code_table(self, table: CodeTable) -> None:
        self._table = table
        self._starts = self.device.upload(table.starts, np.int32)
        self._thresholds = self.device.upload(table.thresholds)

    def _set_light_table(self, decode: str) -> None:
        self._light_table = self.device.upload(light_of_codes(decode, self.frame_dtype))
        self._has_table = self.frame_dtype.kind != "f"

    def _factors(self) -> np.ndarray:
        """Projector light per direct light, of each pixel and channel; 0 at masked ones."""
        F = self._request.first_bounce
        is_lit = (F > 0.0) & ~self._request.T.masked
        factors = np.divide(self.unit, F, out=np.zeros_like(F), where=is_lit)
        return self.shown.from_channels([f[:, None] for f in factors])

    def _scales(self) -> np.ndarray:
        """Unknowns of the bounded solve per projector light."""
        problem = self._request.problem
        masked = problem.limits.masked
        scales = []
        for _, scale in problem.systems:
            scales.append(np.where(masked, 0.0, scale)[:, None] / self.unit)
        return self.shown.from_channels(scales)

    def _make_steps(self, is_bounded: bool, has_peaks: bool) -> None:
        """Make buffers and launches between the codes."""
        request = self._request
        device = self.device
        self.bounded: WithinBounds | None = None
        if is_bounded:
            self.bounded = self._bounded_steps()
            self.target = self.bounded.target
        else:
            self.target = device.empty(self.seen.shape)
        self.direct_steps: ByInverse | ByFixedSteps | BySharing | None = None
        if request.T.is_square:
            self.direct = device.empty(self.shown.shape)
            self._direct_factors = device.upload(self._factors())
            self.direct_steps = self._direct_steps(self.direct)
        elif request.T.scene is not request.T:
            self.direct = device.empty(self.shown.shape)
            lit = np.where(request.T.masked, 0.0, self.unit)[:, None]
            self._direct_factors = device.upload(self.shown.from_channels([lit] * self.colours))
            self.direct_steps = self._sharing_steps()
        self._exceeded = device.upload(np.zeros(1), np.int32)
        self._no_excess = np.zeros(1, np.int32)
        self._unknown_scales = device.upload(self._scales())
        self._judge: WithinBounds | None = self.bounded
        self._strips = -(-self.shown.pixels // STRIP_PIXELS)
        self._find_peaks: Launch | None = None
        if has_peaks and self.direct_steps is None:
            raise InputError(
                f"gain is 'follow', but {MAX_FIXED_STEPS} steps do not undo the light of this "
                "T, whose brightness it follows; give inverse=ltcl.invert(T), or a number"
            )
        self._bind_to_bounds()

    def _bind_to_bounds(self) -> None:
        """Bind the launches that know the bounds."""
        limits = self._request.problem.limits
        # Unknowns of the darkest light that is allowed nearest to none.
        darkest = self._scales() * np.clip(0.0, limits.low, limits.high)
        self._darkest = self.device.upload(darkest)
        self._make_final()
        if self.bounded is not None and self.direct_steps is not None:
            self._clip = self._bind_clip(self.bounded)
        if self._has_peaks:
            self._find_peaks = self._bind_peaks()

    def _bounded_steps(self) -> WithinBounds:
        problem = self._request.problem
        A = block_diagonal([system.A for system in problem.systems])
        weights = None
        if problem.weights is not None:
            weights = self.seen.from_channels(problem.weights)
        columns = self.seen.shape[1]
        rtol = problem.settings.rtol
        planes = len(problem.systems)
        return WithinBounds(A, columns, weights, self._box(), rtol, self._is_warm, planes)

    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest unknowns of all systems, in units of light."""
        problem = self._request.problem
        boxes = [problem.box(index) for index in range(len(problem.systems))]
        lower = np.concatenate([box[0] for box in boxes]) / self.unit
        upper = np.concatenate([box[1] for box in boxes]) / self.unit
        return lower, upper

    def _direct_steps(self, direct: Array) -> ByInverse | ByFixedSteps | None:
        """The way from light to add to direct light; None if steps do not converge."""
        request = self._request
        if request.inverse is not None:
            inverse = block_diagonal(request.inverse.systems)
            return ByInverse(inverse, self.target, direct)
        systems = request.T.scene.systems
        if systems[0].shape[0] <= SMALL:
            inverses = _dense_inverses(systems)
            if inverses is not None:
                return ByInverse(block_diagonal(inverses), self.target, direct)
        S = block_diagonal(systems)
        assert isinstance(S, IdentityPlus)  # noqa: S101 - as all systems are
        rtol = request.problem.settings.rtol
        steps = ByFixedSteps(S, self.target, direct, rtol, self._probes(S))
        if steps.products:
            return steps
        if self.bounded is None:
            raise InputError(
                f"clamp is True, but {MAX_FIXED_STEPS} steps do not undo the light of this T to "
                f"{rtol:g}; give inverse=ltcl.invert(T), or leave out clamp"
            )
        return None

    def _keep_bounces(self, every: int) -> KeptBounces:
        """The light of bounces for frames in between, whose background's is found here."""
        if self.direct_steps is None:
            raise InputError(
                f"bounces_every is {every}, but {MAX_FIXED_STEPS} steps do not undo the light of "
                "this T, whose bounces it keeps; give inverse=ltcl.invert(T), or leave it out"
            )
        background = None
        if self._subtracts:
            self.target.copy_from(self._background)
            self.direct_steps.queue()
            background = self.direct.like()
            vectors.axpby(1.0, self.direct, -1.0, self.target, background)
        return KeptBounces(every, self.target, self.direct, background)

    def _probes(self, S: Operator) -> np.ndarray:
        """Light of white, of a random pattern, and a random picture, (3, rows, columns)."""
        random = np.random.default_rng(0)
        light_of_white = self._request.T.light_of_white
        white = self.seen.from_channels([f[:, None] for f in light_of_white])
        white = white.astype(np.float32) / np.float32(self.unit)
        noise = random.random(self.seen.shape, np.float32)
        probes = [S @ white, S @ (noise * white), random.random(self.seen.shape, np.float32)]
        return np.stack([np.reshape(probe, self.seen.shape) for probe in probes])

    def _light_arguments(self, factors: Array, direct: Array) -> dict[str, Any]:
        limits = self._request.problem.limits
        return {
            "pixels": self.shown.pixels,
            "low": limits.low,
            "high": limits.high,
            "mixing": self._mixing,
            "factors": factors,
            "direct": direct,
        }

    def _make_final(self) -> None:
        """Choose the light that becomes codes: direct light, or the unknowns within the bounds."""
        if self.bounded is None:
            self._final = self._light_arguments(self._direct_factors, self.direct)
            self._is_final_mixed = self._is_mixed
            return
        scales = self._scales()
        inverses = np.divide(1.0, scales, out=np.zeros_like(scales), where=scales > 0.0)
        factors = self.device.upload(inverses)
        self._final = self._light_arguments(factors, self.bounded.x)
        self._is_final_mixed = False

    def _bind_clip(self, bounded: WithinBounds) -> Launch:
        limits = self._request.problem.limits
        kernel = self._kernel("clip", "float32", self.shown, MIXED=int(self._is_mixed))
        return self._bind(
            kernel,
            self.shown,
            slack=BOUNDS_SLACK * (limits.high - limits.low),
            scales=self._unknown_scales,
            x=bounded.start,
            exceeded=self._exceeded,
            **self._light_arguments(self._direct_factors, self.direct),
        )

    def _sharing_steps(self) -> BySharing | None:
        """The way from light to add to the light of several projectors; None if all must be lit."""
        request = self._request
        T = request.T
        if request.problem.limits.low > 0.0:
            self._refuse_without_sharing()
            return None
        device = self.device
        direct = device.empty(self.seen.shape)
        steps = self._direct_steps(direct)
        if steps is None:
            return None
        drive = device.empty(self.seen.shape)
        exceeded = device.upload(np.zeros(1), np.int32)
        matrix = T.sharing_matrix() / self.unit
        count = self.seen.channels if self.seen.is_stacked and T.blocks is None else 1
        share = block_diagonal([CSR(device, matrix)] * count)
        free = device.empty(self.shown.shape)
        make_free = in_order(
            [self._bind_drive(direct, drive, exceeded, FREE_LIGHT), share.bind(drive, free)]
        )
        if T.blocks is not None:
            # Each projector unmixes its colours, before which no bounds are known.
            clip = self._bind_ceilings(free, exceeded)
            queue = in_order([steps.queue, make_free, clip])
            return BySharing(steps.products, queue, clip, exceeded, free, in_order([]))
        clip = self._bind_drive(direct, drive, exceeded, None)
        queue = in_order([steps.queue, clip, share.bind(drive, self.direct)])
        return BySharing(steps.products, queue, clip, exceeded, free, make_free)

    def _bind_drive(
        self, direct: Array, drive: Array, exceeded: Array, bound: float | None
    ) -> Launch:
        """The launch of the drive, with colours unmixed, from direct light; None: the bounds."""
        T = self._request.T
        limits = self._request.problem.limits
        divisors = self.seen.from_channels([divisor[:, None] for divisor in T.light_of_white])
        factors = np.divide(self.unit, divisors, out=np.zeros_like(divisors), where=divisors > 0.0)
        arguments = self._light_arguments(self.device.upload(factors), direct)
        arguments["pixels"] = self.seen.pixels
        arguments["low"] = limits.low if bound is None else -bound
        arguments["high"] = limits.high if bound is None else bound
        return self._bind(
            self._kernel("clip", "float32", self.seen, MIXED=int(T.mixing is not None)),
            self.seen,
            slack=0.0,
            scales=self.device.upload(np.ones(self.seen.shape)),
            x=drive,
            exceeded=exceeded,
            **arguments,
        )

    def _bind_ceilings(self, free: Array, exceeded: Array) -> Launch:
        """The launch that brings light below the ceilings of the projectors, in `direct`."""
        limits = self._request.problem.limits
        ceilings = self._request.T.ceilings
        assert ceilings is not None  # noqa: S101 - several projectors have them
        columns = self.shown.from_channels([ceilings[:, None]] * self.colours)
        factors = np.divide(self.unit, columns, out=np.zeros_like(columns), where=columns > 0.0)
        arguments = self._light_arguments(self.device.upload(factors), free)
        arguments["low"] = min(limits.low, 0.0)
        return self._bind(
            self._kernel("clip", "float32", self.shown, MIXED=0),
            self.shown,
            slack=0.0,
            scales=self.device.upload(columns / self.unit),
            x=self.direct,
            exceeded=exceeded,
            **arguments,
        )

    def _refuse_without_sharing(self) -> None:
        """Refuse what needs light before the solve within the bounds."""
        setting = ""
        if self.bounded is None:
            setting = "clamp is True"
        elif self._has_peaks:
            setting = "gain is 'follow'"
        elif self._request.inverse is not None:
            setting = "inverse is given"
        if setting:
            raise InputError(
                f"{setting}, but bounds begin above 0, where several projectors take the solve "
                "within the bounds alone; leave it out"
            )

    def _bind_peaks(self) -> Launch:
        """The launch of the peaks, after the light of the background itself is found."""
        assert self.direct_steps is not None  # noqa: S101 - only then is it called
        peaks = self.device.empty(self._strips)
        shift = peaks
        # Light of several projectors is clipped before it is shared.
        free = self.direct
        if isinstance(self.direct_steps, BySharing):
            free = self.direct_steps.free
        if self._subtracts:
            self.target.set(np.asarray(self._background_host / self.unit, np.float32))
            self.direct_steps.queue()
            if isinstance(self.direct_steps, BySharing):
                self.direct_steps.queue_free()
            shift = self.device.empty(self.shown.shape)
            shift.set(self.light_of_direct(free))
        kernel = self._kernel("peaks", "float32", self.shown, MIXED=int(self._is_mixed))
        return kernel.bind(
            self._strips,
            GROUP,
            span=STRIP_PIXELS,
            shifts=self._subtracts,
            shift=shift,
            peaks=peaks,
            **self._light_arguments(self._direct_factors, free),
        )

    def _kernel(self, name: str, dtype: str, light: LightLayout, **defines: int) -> Kernel:
        """A kernel of frames.cl for codes of a type, and for light that stands so."""
        code = CODE_TYPES[dtype]
        block = CPU_BLOCK if self.device.is_cpu else 1
        return self.device.kernel(
            "frames", f"frames_{name}", CODE=code, BLOCK=block, **light.defines, **defines
        )

    def _bind(self, kernel: Kernel, light: LightLayout, **arguments: Any) -> Launch:
        """The launch of a kernel: a pixel an item, or some long spans of pixels on a CPU."""
        span = 1
        if self.device.is_cpu:
            spans = SPANS_PER_UNIT * self.device.compute_units
            span = max(1, -(-light.pixels // spans))
        group = 1 if span > 1 else GROUP
        return kernel.bind(-(-light.pixels // span), group, span=span, **arguments)

    def _slot(self) -> Slot:
        seen = self.seen
        shown = self.shown
        dtype = np.dtype(self.dtype)
        frame = self.device.empty((seen.pixels, self.frame_colours), self.frame_dtype)
        codes = self.device.empty((shown.pixels, self.colours), dtype)
        decode_between = None
        if self._kept_bounces is not None:
            decode_between = self._bind_decode_between(frame, self._kept_bounces)
        return Slot(
            frame=transfers.upload(frame),
            codes=transfers.download(codes),
            peaks=transfers.download(self.device.empty(self._strips)),
            decode=self._bind_decode(frame),
            decode_between=decode_between,
            encode=self._bind_encode(codes, self.dtype, self._table),
        )

    def _bind_decode(self, frame: Array) -> Launch:
        kernel = self._decode_kernel(KEPT=0)
        return self._bind(kernel, self.seen, **self._decode_arguments(frame))

    def _bind_decode_between(self, frame: Array, kept: KeptBounces) -> Launch:
        """The launch of light to add, and of direct light by the bounces of an earlier frame."""
        background = kept.light if kept.background is None else kept.background
        return self._bind(
            self._decode_kernel(KEPT=1),
            self.seen,
            share=1.0,
            kept=kept.light,
            background_bounces=background,
            direct=self.direct,
            **self._decode_arguments(frame),
        )

    def _decode_kernel(self, **defines: int) -> Kernel:
        return self._kernel(
            "decode",
            self.frame_dtype.name,
            self.seen,
            COLOURS=self.frame_colours,
            TABLE=int(self._has_table),
            **defines,
        )

    def _decode_arguments(self, frame: Array) -> dict[str, Any]:
        return {
            "pixels": self.seen.pixels,
            "gain": 1.0,
            "subtracts": self._subtracts,
            "codes": frame,
            "table": self._light_table,
            "background": self._background,
            "out": self.target,
        }

    def _bind_encode(self, codes: Array, dtype: str, table: CodeTable) -> Launch:
        kernel = self._kernel(
            "encode",
            dtype,
            self.shown,
            MIXED=int(self._is_final_mixed),
            STEPS=table.steps,
            BETWEEN=int(table.is_between),
            ROUNDED=int(dtype != "float32"),
        )
        return self._bind(
            kernel,
            self.shown,
            count=table.thresholds.shape[1],
            cells=table.starts.shape[1],
            cells_per_light=table.cells_per_light,
            first_light=table.first_light,
            code_step=table.code_step,
            starts=self._starts,
            thresholds=self._thresholds,
            codes=codes,
            **self._final,
        )

    # Frames.

    def begin(self, slot: Slot, frame: np.ndarray | Array, gain: float, begun_at: float) -> None:
        """Queue the upload of a frame, and all launches up to direct light."""
        slot.begun_at = begun_at
        slot.gain = gain
        if isinstance(frame, Array):
            own = slot.frame.array
            self.device.copy(own.buffer, frame.buffer, byte_count=own.nbytes)
        else:
            host = slot.frame.host
            np.copyto(host, frame.reshape(host.shape))
            slot.frame.send()
        kept = self._kept_bounces
        if kept is not None and slot.decode_between is not None and not kept.are_due:
            slot.decode_between.set(gain=gain / self.unit, share=kept.reuse(gain))
            slot.frame.release(slot.decode_between())
            return
        slot.decode.set(gain=gain / self.unit)
        slot.frame.release(slot.decode())
        if self.direct_steps is not None:
            self.direct_steps.queue()
        if kept is not None:
            kept.keep(gain)

    def forget_bounces(self) -> None:
        """Let the bounces of the next frame be computed, whatever came before."""
        if self._kept_bounces is not None:
            self._kept_bounces.forget()

    def keep_within_bounds(self, deadline: float) -> None:
        """Take projected steps, if some light is beyond the bounds; waits for the device."""
        bounded = self.bounded
        if bounded is None:
            return
        if self.direct_steps is None:
            bounded.start.copy_from(self._darkest)
            bounded.solve(deadline)
            return
        is_exceeded = self._count_exceeded() > 0
        # What several projectors share is not exact.
        is_inexact = isinstance(self.direct_steps, BySharing)
        if is_exceeded or is_inexact or self._request.problem.counts_masked_pixels:
            bounded.solve(deadline)
        else:
            bounded.keep_start()

    def _count_exceeded(self) -> int:
        """Clip the light to the bounds, and count what was beyond; waits."""
        self._exceeded.set(self._no_excess)
        self._clip()
        return int(self._exceeded.get()[0])

    def judge(self) -> tuple[float, float]:
        """The relative error and the clipped share of the last frame, by one product; waits."""
        if self._judge is None:
            self._judge = self._bounded_steps()
            self._clip = self._bind_clip(self._judge)
        judge = self._judge
        clipped = 0
        if self.bounded is None:
            judge.target.copy_from(self.target)
            clipped = self._count_exceeded()
            judge.keep_start()
            if isinstance(self.direct_steps, BySharing):
                share = self.direct_steps.count_clipped() / (self.seen.pixels * self.colours)
                lit_values = self.colours * np.count_nonzero(~self._request.T.masked)
                clipped = share * lit_values
        elif judge.errors is not None:
            clipped = judge.saturated()
        errors = judge.errors
        if errors is None:
            errors = judge.descent.measure()
        size = self._size_of_target(judge)
        lit_values = self.colours * np.count_nonzero(~self._request.T.masked)
        error = float(np.linalg.norm(errors))
        if size > 0.0:
            error /= size
        else:
            # Errors of a black target are not relative.
            error *= self.unit * self._request.problem.weight_unit
        return error, float(clipped / max(lit_values, 1))

    def _size_of_target(self, judge: WithinBounds) -> float:
        """||w gain desired|| of the last frame, in units of light."""
        target = judge.target
        if self._subtracts:
            target = vectors.axpby(1.0, target, 1.0, self._background, target.like())
        return float(np.linalg.norm(judge.descent.norm_of(target)))

    def end(self, slot: Slot) -> None:
        """Queue the codes and their download."""
        slot.codes.make_room()
        encoded = slot.encode()
        if self._find_peaks is not None:
            if isinstance(self.direct_steps, BySharing):
                self.direct_steps.queue_free()
            slot.peaks.make_room()
            self._find_peaks.set(peaks=slot.peaks.array)
            slot.peaks.send(self._find_peaks())
        slot.codes.send(encoded)
        self.device.flush()

    def take(self, slot: Slot) -> np.ndarray:
        """Wait for the codes of a frame; (h, w) or (h, w, 3)."""
        codes = slot.codes.take()
        h, w = self.grid
        if self.colours == 3:
            shape = (h, w, 3)
        else:
            shape = (h, w)
        return codes.reshape(shape)

    def light(self) -> np.ndarray:
        """Projector light of the last frame, (pixels, colours) float32."""
        codes = self.device.empty((self.shown.pixels, self.colours))
        self._bind_encode(codes, "float32", CodeTable.of_light())()
        return codes.get()

    def light_of_direct(self, array: Array) -> np.ndarray:
        """Projector light without bounds of direct light in an array, in its layout."""
        direct = array.get()
        factors = self._direct_factors.get()
        light = self.shown.to_channels(factors * direct)
        if self._is_mixed:
            light = light @ self._mixing.get().T
        if self.shown.is_stacked:
            return np.ascontiguousarray(light.T.reshape(self.shown.shape), np.float32)
        return np.ascontiguousarray(light, np.float32)
