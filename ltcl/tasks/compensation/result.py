# SPDX-License-Identifier: BSD-3-Clause
"""`Compensation`, the result of `ltcl.compensate`, and the evidence that its pictures come from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ltcl.interop.arrays import numbers
from ltcl.solvers import Bounded, Inverse, Solution
from ltcl.tasks.compensation.problem import Columns, channel_systems, stack_channels, subtract
from ltcl.tasks.requirements import error_note
from ltcl.transport import frames as layout
from ltcl.transport.transport import Transport
from ltcl.transport.uncertainty import CompensationStd, compensation_std


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """The pictures of a compensation as columns, and what its standard deviations come from.

    Attributes
    ----------
    shape, camera_grid : PictureLayout, (h, w)
        Frames and colours of the pictures, and their size.
    target, missing : list of (M, k)
        gain * desired, and target - appearance, one array per system.
    appearance : list of (M, k), optional
        None if `missing` is what was computed.
    weights : list of (M, k), optional
    clipped_values : list of (N, k) bool or None
        Values of each system that are at a bound and would go beyond it.
    explained : list of (k,), optional
        Weighted values of `missing` that the tolerance explains; None if nothing is clipped.
    solving, reference : Transport
        The transport that solves, and the one whose noise counts.
    inverse : Inverse, optional
    bounds : (low, high)
    """

    shape: layout.PictureLayout
    camera_grid: tuple[int, int]
    target: Columns
    missing: Columns
    appearance: Columns | None
    weights: Columns | None
    clipped_values: list[np.ndarray | None]
    explained: Columns | None
    solving: Transport
    reference: Transport
    inverse: Inverse | None
    bounds: tuple[float, float]

    def appearance_picture(self) -> np.ndarray:
        """T pattern + background, on the camera's grid."""
        appearance = self.appearance
        if appearance is None:
            appearance = subtract(self.target, self.missing)
        return self._picture(appearance)

    def target_picture(self) -> np.ndarray:
        """gain * desired, on the camera's grid."""
        return self._picture(self.target)

    def out_of_reach_picture(self) -> np.ndarray:
        """The missing light, 0 where the tolerance explains it."""
        if self.explained is None:
            return np.zeros_like(self.target_picture())
        weights = self.weights
        if weights is None:
            weights = [np.ones((1, 1), np.float32)] * len(self.missing)
        columns = []
        for missing, w, explained in zip(self.missing, weights, self.explained, strict=True):
            is_beyond = np.abs(w * missing) > explained
            columns.append(np.where(is_beyond, missing, 0.0))
        return self._picture(columns)

    def free_pixels(self) -> np.ndarray:
        """Values of the pattern that follow the target: lit ones that no bound holds."""
        T = self.solving
        systems = len(self.target)
        lit = stack_channels([~T.masked[:, None]] * T.channels, systems)
        free = []
        for target, is_lit, is_clipped in zip(self.target, lit, self.clipped_values, strict=True):
            is_free = np.broadcast_to(is_lit, (len(is_lit), target.shape[1]))
            free.append(is_free if is_clipped is None else is_free & ~is_clipped)
        return self.shape.pack(free, self.reference.grid)

    def _picture(self, columns: Columns) -> np.ndarray:
        return self.shape.pack(columns, self.camera_grid).astype(np.float32, copy=False)


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Compensation:
    """Result of `ltcl.compensate`.

    Pictures are linear, float32, with the frames and colours of `desired`. Those of the camera,
    `appearance`, `target` and `out_of_reach`, are made when they are asked for. All are arrays of
    the kind of `desired`. For a tensor with a gradient `pattern` has one, and so ``T @ pattern``.

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
        ``||W (appearance - target)|| / ||W target||`` of all frames and colours together, with T
        as it is, or `exact` where that was given; see `transport_error`. If the target is black,
        ``||W (appearance - target)||``.
    gap : float
        Bound on what the error is above the least: no pattern within the bounds has an error below
        error - gap.
    frame_errors, frame_clipped : (frames,) float64
        `error` and `clipped` of each frame by itself; of a single picture, one value.
    solution : Solution or tuple of 3
        The light without bounds, one solution per channel of the transport; of a T without S,
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
    _evidence: Evidence
    # Pictures in the kind of array of `desired`, where that is not NumPy's.
    _give: Callable[[np.ndarray], Any] = np.asarray

    def with_arrays(self, give: Callable[[np.ndarray], Any]) -> Compensation:
        """The same result with pictures of another kind of array."""
        return dataclasses.replace(self, pattern=give(self.pattern), _give=give)

    def free_pixels(self) -> np.ndarray:
        """Values of the pattern that follow the target: lit ones that no bound holds, as bool.

        There the derivative of the pattern is that of a solve, elsewhere it is 0.
        """
        return self._evidence.free_pixels()

    @cached_property
    def patterns(self) -> tuple[np.ndarray, ...]:
        """`pattern` of each projector, where T is of several (`ltcl.combine`); else of the one."""
        patterns = self._evidence.solving.split(numbers(self.pattern))
        return tuple(map(self._give, patterns))

    @cached_property
    def appearance(self) -> np.ndarray:
        """T pattern + background: what the camera will see, on its grid."""
        return self._give(self._evidence.appearance_picture())

    @cached_property
    def target(self) -> np.ndarray:
        """gain * desired."""
        return self._give(self._evidence.target_picture())

    @cached_property
    def out_of_reach(self) -> np.ndarray:
        """target - appearance where the projector leaves the scene too dark or too bright.

        Positive values are too dark. 0 where nothing is clipped, and where
        weight * abs(target - appearance) is at most 3 times what ``max(rtol ||W target||, atol)``
        of this frame and colour makes in the root mean square.
        """
        return self._give(self._evidence.out_of_reach_picture())

    @cached_property
    def std(self) -> CompensationStd:
        """Standard deviations by the noise of T, computed at the first call.

        See `ltcl.transport.uncertainty`.
        """
        evidence = self._evidence
        systems = ()
        if self.limited:
            systems = channel_systems(evidence.solving)
        bounds = (-np.inf, np.inf)
        if self.clipped:
            bounds = evidence.bounds
        return compensation_std(
            evidence.solving,
            evidence.reference.noise,
            numbers(self.pattern),
            bounds,
            evidence.inverse,
            systems,
            evidence.weights,
        )

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.pattern.shape))
        error = f"relative error {self.error:.2%}{error_note(self.transport_error)}"
        return f"<ltcl Compensation {size}, {error}, {self.clipped:.2%} clipped>"

    def _repr_html_(self) -> str:
        # Imports OpenCV.
        from ltcl.images.thumbnails import thumbnails

        pictures = {
            "pattern": self.pattern,
            "appearance": self.appearance,
            "target": self.target,
            "out_of_reach": self.out_of_reach,
        }
        pictures = {name: numbers(picture) for name, picture in pictures.items()}
        return thumbnails(self, pictures)
