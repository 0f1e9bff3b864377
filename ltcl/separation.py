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
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks, layout
from ltcl.errors import InputTypeError
from ltcl.solvers import Inverse, Solution, monte_carlo, solve_each
from ltcl.solvers.solve import SAMPLED
from ltcl.transport import Transport, default_rtol, error_note, require, require_inverse, resolve_reference

logger = logging.getLogger(__name__)
Parts = list[np.ndarray]  # (N, k) of each channel

# Of a scene taken for Lambertian: noise of path tracing alone gives a defect of 0.05 and takes 0.0004.
LARGEST_DEFECT = 0.1
LARGEST_NEGATIVE = 0.005
RTOL = 1e-3


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
        Of T, see `ltcl.diagnostics`: 0 of a Lambertian scene measured without noise; NaN where unknown.
    negative_bounce : float
        Share of light that a bounce as T has it would take away, see `ltcl.diagnostics`: 0 of a Lambertian
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
        shape, off = " x ".join(map(str, self.direct.shape)), error_note(self.transport_error)
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
    monte_carlo.check_whole(options)
    columns, shape = layout.unpack("image", image, T.grid, T.channels)
    pictures = sum(column.size for column in columns)
    checks.fits_host(f"separating {bounces} bounces", 3 * 8 * pictures * (bounces + 1))
    true, judges = resolve_reference(T, exact)
    if inverse is not None:
        require_inverse(T, inverse, rtol, exact=exact, method=None if method == "auto" else method)
        for name in options.keys() - {"callback", "throw"}:
            raise InputTypeError(
                f"option {name!r} is given, but with inverse there is no solve that takes it"
            )
    options |= {"rtol": default_rtol(RTOL, T, exact, inverse) if rtol is None else rtol, "exact": judges}

    def undo(parts: Parts, k: int) -> tuple[Solution, ...]:
        """S^-1 of what is left of each channel before bounce k."""
        if inverse is not None:
            return tuple(inverse.solve(l, channel) for channel, l in enumerate(parts))
        return solve_each(T.systems, parts, method, **_with_seed(method, options, k))

    def picture(parts: Parts) -> np.ndarray:
        return shape.pack(parts, T.grid).astype(np.float32, copy=False)

    found, solutions, indirect = [], [], np.empty(0)
    left = [l_out.astype(np.float64) for l_out in columns]
    for k in range(bounces + 1):
        solutions.append(undo(left, k))
        b_k = [solution.x.astype(np.float64) for solution in solutions[-1]]
        left = [l - b for l, b in zip(left, b_k, strict=True)]
        found.append(picture(b_k))
        if k == 0:
            indirect = picture(left)
    warning = _warning(true.reciprocity_defect, max(true.negative_bounces), true.error)
    if warning:
        logger.warning(warning)
    return Separation(
        direct=found[0],
        indirect=indirect,
        bounces=np.stack(found[1:]) if bounces else np.empty((0, *found[0].shape), np.float32),
        rest=picture(left),
        solutions=tuple(each[0] if T.channels == 1 else each for each in solutions),
        reciprocity_defect=true.reciprocity_defect,
        negative_bounce=max(true.negative_bounces),
        warning=warning,
        transport_error=true.error,
    )


def _warning(defect: float, negative: float, error: float) -> str:
    """Why bounces are approximate; nothing where both numbers are within that of T's compression, or NaN."""
    reasons = []
    if defect > (most := LARGEST_DEFECT + error):
        reasons.append(f"T is not reciprocal (defect {defect:.2g}, above {most:.2g})")
    if negative > (most := LARGEST_NEGATIVE + error):
        reasons.append(f"a bounce takes away {negative:.2g} of its light (above {most:.2g})")
    if not reasons:
        return ""
    return (
        f"{' and '.join(reasons)}: surfaces reflect differently to different sides, or T is noisy; with one "
        "camera the bounces of such a scene are approximate (section 8.4, eq. 28 and 29)"
    )


def _with_seed(method: str, options: dict[str, Any], k: int) -> dict[str, Any]:
    """The options of bounce k: random numbers of its own, or its noise would go with that of others."""
    if method not in SAMPLED:
        return options
    seed = options.get("seed", 0)
    monte_carlo.check_seed(seed)
    return {**options, "seed": (seed + k) % 2**64}
