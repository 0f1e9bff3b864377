# SPDX-License-Identifier: BSD-3-Clause
"""Radiometric compensation: the projector pattern that makes the scene look as desired (section 8.2).

    l_in = F^-1 S^-1 (gain * desired - background)

solved with products by S only, then brought within the projector's limits. What the limits cost is
reported, not hidden: `clipped` and the predicted `appearance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks, layout
from ltcl.errors import InputError
from ltcl.solvers import Solution, solve
from ltcl.transport import Transport, require


@dataclass(frozen=True, repr=False)
class Compensation:
    """Result of `ltcl.compensate`. Pictures have the shape of `desired`, linear, float32.

    Attributes
    ----------
    pattern : array
        Linear projector light within the bounds; 0 at masked pixels.
    appearance : array
        T pattern + background: what the camera will see.
    gain : float
        The target was gain * desired.
    clipped : float
        Fraction of pattern values that the bounds changed.
    target : array
        gain * desired.
    solution : Solution or tuple of 3
        One per channel of the transport.
    """

    pattern: np.ndarray
    appearance: np.ndarray
    gain: float
    clipped: float
    target: np.ndarray
    solution: Solution | tuple[Solution, ...]

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.pattern.shape))
        return f"<ltcl Compensation {shape}, off by {self.error:.2%}, {self.clipped:.2%} clipped>"

    @property
    def error(self) -> float:
        """``||appearance - target|| / ||target||``, clipping included."""
        norm = float(np.linalg.norm(self.target))
        return float(np.linalg.norm(self.appearance - self.target)) / (norm or 1.0)


def compensate(
    T: Transport,
    desired: Any,
    *,
    bounds: tuple[float, float] = (0.0, 1.0),
    background: Any = None,
    gain: float = 1.0,
    method: str = "auto",
    rtol: float = 1e-2,
    **options: Any,
) -> Compensation:
    """Find the projector pattern under which the scene looks like `desired`.

    Parameters
    ----------
    T : Transport
        Square.
    desired : (h, w), (h, w, 3), or frames of these
        Wanted radiance at each camera pixel, in the units of T.
    bounds : (low, high)
        What the projector can emit per pixel, in linear light.
    background : like `desired` or one frame of it, optional
        Light the projector cannot take away: ambient and its own black. T pattern + background is matched.
    gain : float
        Scale of the target.
    method, rtol, **options
        Of `ltcl.solve`.

    Returns
    -------
    Compensation

    Raises
    ------
    InputError
        A rectangular T, shapes that do not fit, bounds in the wrong order, a gain that is not positive.
    ConvergenceError
        The solve did not reach `rtol`.

    Notes
    -----
    F = diag(T) is a valid choice here for any opaque scene: compensation does not depend on it.

    Examples
    --------
    >>> import ltcl, numpy
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> ltcl.compensate(T, numpy.array([[0.3, 0.3]])).pattern.round(2).tolist()
    [[0.5, 0.5]]
    """
    require(T)
    low, high = _bounds(bounds)
    gain = checks.number("gain", gain, above=0.0)
    columns, shape = layout.unpack("desired", desired, T.grid, T.channels)
    target = [gain * column for column in columns]
    backgrounds = _background(background, T, shape, columns)
    solutions = tuple(
        solve(S, l_out - dark, method, rtol=rtol, **options)
        for S, l_out, dark in zip(T.systems, target, backgrounds, strict=True)
    )
    wanted = T.to_light([solution.x for solution in solutions])
    light, clipped = _within(wanted, low, high, T.masked)
    seen = [operator @ p + dark for operator, p, dark in zip(T.operators, light, backgrounds, strict=True)]
    return Compensation(
        pattern=shape.pack(light, T.grid).astype(np.float32),
        appearance=shape.pack(seen, T.grid).astype(np.float32),
        gain=gain,
        clipped=clipped,
        target=shape.pack(target, T.grid).astype(np.float32),
        solution=solutions[0] if T.channels == 1 else solutions,
    )


def _bounds(bounds: Any) -> tuple[float, float]:
    try:
        low, high = bounds
    except (TypeError, ValueError):
        raise InputError(f"bounds is {bounds!r}; it must be (low, high)") from None
    low = checks.number("bounds[0]", low)
    return low, checks.number("bounds[1]", high, above=low)


def _background(
    background: Any, T: Transport, shape: layout.Layout, like: list[np.ndarray]
) -> list[np.ndarray]:
    """Background (N, k) of every channel: none, one for all frames, or one per frame."""
    if background is None:
        return [np.zeros((column.shape[0], 1)) for column in like]
    columns, own = layout.unpack("background", background, T.grid, T.channels)
    # (N, frames, colours): one frame or one grey serves all.
    have, want = (
        (len(like[0]), part.frames or 1, 3 if part.colour and T.channels == 1 else 1) for part in (own, shape)
    )
    try:
        return [np.broadcast_to(c.reshape(have), want).reshape(c.shape[0], -1) for c in columns]
    except ValueError:
        raise InputError(
            f"background has {have[1]} frame(s) of {have[2]} colour(s), desired {want[1]} of {want[2]}; "
            "background must have as many, or one"
        ) from None


def _within(
    wanted: list[np.ndarray], low: float, high: float, masked: np.ndarray
) -> tuple[list[np.ndarray], float]:
    """Patterns inside the projector's bounds, and the fraction of values that had to be moved there.

    The slack counts rounding at a bound as inside it.
    """
    slack = 1e-6 * (high - low)
    outside = [(p < low - slack) | (p > high + slack) for p in wanted]
    inside = [np.where(masked[:, None], 0.0, np.clip(p, low, high)) for p in wanted]
    return inside, float(np.mean([part[~masked].mean() for part in outside]))
