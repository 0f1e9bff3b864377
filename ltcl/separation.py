# SPDX-License-Identifier: BSD-3-Clause
"""Each bounce of light as a picture of its own (eq. 27).

Let l^(0) be the picture and X = S^-1. The direct part is b_0 = X l^(0); what remains, l^(1) = l^(0) - b_0, is
light that bounced at least once, and of it b_1 = X l^(1) bounced exactly once, and so on:

    b_k = X l^(k),    l^(k+1) = l^(k) - b_k

Equal to the paper's chain b_k = b_(k-1) - X b_(k-1) in exact arithmetic; in this form the bounces and the
rest add up to the picture whatever the tolerance of the solves. Nothing is clipped on the way.

One projector and one camera see T = P S F Q (eq. 28), and bounces are exact of Lambertian scenes only
(eq. 29, section 8.4): elsewhere P A^k F Q is no power of anything that T tells. A T whose I - S^-1 takes
light away, or that is far from reciprocal, gives such a scene away: the result then carries a warning.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ltcl import checks, layout
from ltcl.errors import InputTypeError
from ltcl.exact import beside, itself
from ltcl.single_view import negative_bounces
from ltcl.solvers import Inverse, Solution, sampled, solve_each
from ltcl.solvers.methods import SAMPLED
from ltcl.solvers.precomputed import require_inverse
from ltcl.transport import Transport, require

logger = logging.getLogger(__name__)
Parts = list[np.ndarray]  # (N, k) of each channel

# Of a scene taken for Lambertian: noise of path tracing alone gives a defect of 0.05 and takes 0.0004.
LARGEST_DEFECT = 0.1
LARGEST_NEGATIVE = 0.005
_RTOL = 1e-3


@dataclass(frozen=True, repr=False, eq=False)
class Separation:
    """Result of `ltcl.separate`. Pictures have the shape of the image, linear, float32.

    Attributes
    ----------
    direct : array
        Bounce 0: light that went from projector to surface to camera.
    indirect : array
        Everything else: image - direct.
    bounces : array, (bounces, ...)
        bounces[0] is the first indirect bounce.
    rest : array
        All further bounces together: direct + sum of bounces + rest is the image.
    solutions : tuple
        Solves in the order direct, first bounce, ...; per entry one Solution, or 3 in colour.
    reciprocity_defect : float
        Of T, see `ltcl.reciprocity`: 0 of a Lambertian scene measured without noise; NaN where unknown.
    negative_bounce : float
        Share of light that a bounce as T has it would take away, see `ltcl.single_view`: 0 of a Lambertian
        scene. The first bounce of a glossy scene is off by a few times as much, later ones by more.
    warning : str
        Why the bounces are only approximate, also logged; empty where the defect is at most 0.1 and the
        negative light at most 0.005, or unknown; of a compressed T both may be more by its error.
    transport_error : float
        ``.error`` of the T that all of this is of, the one that was given, or `exact` where that was: what a
        compressed one may be off by itself, beyond the tolerance of each solve; 0 of others.
    """

    direct: np.ndarray
    indirect: np.ndarray
    bounces: np.ndarray
    rest: np.ndarray
    solutions: tuple[Solution | tuple[Solution, ...], ...]
    reciprocity_defect: float = float("nan")
    negative_bounce: float = float("nan")
    warning: str = ""
    transport_error: float = 0.0

    def __repr__(self) -> str:
        shape, off = " x ".join(map(str, self.direct.shape)), itself(self.transport_error)
        return f"<ltcl Separation {shape}, direct and {len(self.bounces)} bounces{off}>"


def separate(
    T: Transport,
    image: Any,
    bounces: int = 4,
    *,
    method: str = "auto",
    rtol: float | None = None,
    exact: Transport | None = None,
    inverse: Inverse | None = None,
    **options: Any,
) -> Separation:
    """Split an image of the scene into direct light and bounces.

    Parameters
    ----------
    T : Transport
        Square. The bounces are as good as its first bounce: see ``first_bounce="exact"``.
    image : (h, w), (h, w, 3), or frames of these
        Any picture taken under the projector's light, in the units of T.
    bounces : int
        How many indirect bounces to tell apart.
    method, rtol, **options
        Of `ltcl.solve`; rtol is per bounce, 1e-3 when not given, or what a compressed T or an inverse is
        off by where that is more.
    exact : Transport, optional
        The uncompressed transport that a compressed T stands for: T then solves, to an `rtol` as `ltcl.solve`
        says, and all that is told is of `exact`.
    inverse : Inverse, optional
        Of T, as `ltcl.invert` makes it: each bounce is then one product, and `rtol` the error it may have.

    Returns
    -------
    Separation

    Raises
    ------
    InputError
        A rectangular T, shapes that do not fit, a negative number of bounces, an `rtol` below the error of
        a compressed T without `exact`, or below that of `inverse`, or an inverse of another transport.
    ConvergenceError
        A solve did not reach `rtol`.

    Examples
    --------
    >>> import ltcl, numpy
    >>> scene = ltcl.scenes.dihedral(4, albedo=0.5)
    >>> T = scene.transport(first_bounce=scene.first_bounce)
    >>> b = ltcl.separate(T, T @ numpy.ones(T.grid), bounces=2)
    >>> bool(abs(b.direct - 0.5).max() < 1e-3)
    True
    """
    require(T)
    checks.count("bounces", bounces, least=0)
    sampled.check_whole(options)
    columns, shape = layout.unpack("image", image, T.grid, T.channels)
    pictures = sum(column.size for column in columns)
    checks.fits_host(f"separating {bounces} bounces", 3 * 8 * pictures * (bounces + 1))
    true, judges = beside(T, exact)
    if inverse is not None:
        _check_inverse(T, inverse, method, rtol, exact, options)
    rtol = usual_rtol(T, exact, inverse) if rtol is None else rtol
    undo = partial(_undo, T, inverse, method, {"rtol": rtol, **options, "exact": judges})
    chain = _chain(undo, columns, bounces)

    def picture(parts: list[np.ndarray]) -> np.ndarray:
        return shape.pack(parts, T.grid).astype(np.float32)

    direct, *indirect = [picture(found) for found in chain.bounces]
    negative = max(negative_bounces(true))
    warning = _warning(true.reciprocity_defect, negative, true.error)
    if warning:
        logger.warning(warning)
    return Separation(
        direct=direct,
        indirect=picture([l_out - b_0 for l_out, b_0 in zip(columns, chain.bounces[0], strict=True)]),
        bounces=np.stack(indirect) if indirect else np.empty((0, *direct.shape), np.float32),
        rest=picture(chain.rest),
        solutions=tuple(found[0] if T.channels == 1 else found for found in chain.solutions),
        reciprocity_defect=true.reciprocity_defect,
        negative_bounce=negative,
        warning=warning,
        transport_error=true.error,
    )


def usual_rtol(T: Transport, exact: Transport | None = None, inverse: Inverse | None = None) -> float:
    """Of each bounce where none is given: 1e-3, or what a compressed T or an inverse is off by.

    >>> usual_rtol(Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2)))
    0.001
    """
    error = inverse.error if inverse is not None else T.error if exact is None else 0.0
    return max(_RTOL, error) if error < 1.0 else _RTOL  # which is refused, with the reason


def _check_inverse(
    T: Transport, inverse: Any, method: str, rtol: float | None, exact: Any, options: dict[str, Any]
) -> None:
    require_inverse(T, inverse, rtol, exact=exact, method=None if method == "auto" else method)
    unknown = [name for name in options if name not in ("callback", "throw")]
    if unknown:
        name = unknown[0]
        raise InputTypeError(f"option {name!r} is given, but with inverse there is no solve that takes it")


def _warning(defect: float, negative: float, error: float) -> str:
    """What is wrong with T for a separation; nothing where both are small, or unknown.

    What a compressed T may be off by is no sign of anything.
    """
    found = []
    if defect > (most := LARGEST_DEFECT + error):
        found.append(f"T is not reciprocal (defect {defect:.2g}, above {most:.2g})")
    if negative > (most := LARGEST_NEGATIVE + error):
        found.append(f"a bounce takes away {negative:.2g} of its light (above {most:.2g})")
    if not found:
        return ""
    return (
        f"{' and '.join(found)}: surfaces reflect differently to different sides, or T is noisy; with one "
        "camera the bounces of such a scene are approximate (section 8.4, eq. 28 and 29)"
    )


@dataclass(frozen=True)
class _Chain:
    """Bounces 0, 1, ..., (N, k) of each channel, what is left of each, and the solves of each bounce."""

    bounces: list[list[np.ndarray]]
    rest: list[np.ndarray]
    solutions: list[tuple[Solution, ...]]


def _undo(
    T: Transport, inverse: Inverse | None, method: str, options: dict[str, Any], left: Parts, k: int
) -> tuple[Solution, ...]:
    """S^-1 of what is `left` of each channel, for bounce k."""
    if inverse is not None:
        return tuple(inverse.solve(l, channel) for channel, l in enumerate(left))
    return solve_each(T.systems, left, method, **_fresh(method, options, k))


def _chain(undo: Callable[[Parts, int], tuple[Solution, ...]], columns: Parts, bounces: int) -> _Chain:
    """`undo` is S^-1 of what is left, for bounce k."""
    found, solutions, left = [], [], [l_out.astype(np.float64) for l_out in columns]
    for k in range(bounces + 1):
        solutions.append(undo(left, k))
        found.append([solution.x.astype(np.float64) for solution in solutions[-1]])
        left = [l - b_k for l, b_k in zip(left, found[-1], strict=True)]
    return _Chain(found, left, solutions)


def _fresh(method: str, options: dict[str, Any], k: int) -> dict[str, Any]:
    """The options of bounce k: with random numbers of its own, or its noise would go with that of others."""
    if method not in SAMPLED:
        return options
    seed = options.get("seed", 0)
    sampled.check_seed(seed)
    return {**options, "seed": (seed + k) % 2**64}
