# SPDX-License-Identifier: BSD-3-Clause
"""Each bounce of light as a picture of its own (eq. 27).

Let l^(0) be the picture and X = S^-1. The direct part is b_0 = X l^(0); what remains, l^(1) = l^(0)
- b_0, is light that bounced at least once, and of it b_1 = X l^(1) bounced exactly once, and so on:

    b_k = X l^(k),    l^(k+1) = l^(k) - b_k

Equal to the paper's b_k = b_(k-1) - X b_(k-1); in this form bounces and rest add up to the picture
whatever the tolerance. With one camera they are exact of Lambertian scenes only (section 8.4, eq.
28 and 29).
"""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.solvers import Inverse, Solution, solve, solve_each
from ltcl.solvers.solve import METHODS, SAMPLED
from ltcl.tasks.requirements import check_inverse, default_rtol, error_note, resolve_reference
from ltcl.transport import diagnostics
from ltcl.transport import frames as layout
from ltcl.transport.first_bounce import ENTRIES
from ltcl.transport.transport import Transport, check_transport
from ltcl.transport.uncertainty import SeparationStd, separation_std

logger = logging.getLogger(__name__)

# Of a scene taken for Lambertian: noise of path tracing alone gives a defect of 0.05 and takes
# 0.0004.
LARGEST_DEFECT = 0.1
LARGEST_NEGATIVE = 0.005
LARGEST_AMBIENT = (
    0.05  # as of the verdict; 0 of clean scenes, mostly above with 1 % of ambient light
)
RTOL = 1e-3
_SIGMAS = 5.0  # of direct light beyond what it can be: no noise
_UNKNOWN = 0.5  # of the image: direct light that is uncertain by more is no result
_NEGATIVE = (
    0.01  # of the light of an image: what has more of negative light is no picture, and not judged
)


@dataclass(frozen=True, repr=False, eq=False)
class Separation:
    """Result of `ltcl.separate`. Pictures have the shape of the image, linear, float32.

    Attributes
    ----------
    direct, indirect : array
        Bounce 0, light that went from projector to surface to camera; and the rest of the image.
    bounces : array, (bounces, ...)
        bounces[0] is the first indirect bounce.
    rest : array
        All further bounces together: direct + sum of bounces + rest is the image.
    solutions : tuple
        Solves in the order direct, first bounce, ...; per entry one Solution, or 3 in colour.
    reciprocity_defect, negative_bounce : float
        Of T, see `ltcl.transport.diagnostics`: both 0 of a Lambertian scene measured without noise;
        NaN where unknown. The relative error of the first bounce of a glossy scene is a few times
        the latter, of others more.
    warning : str
        Why the bounces are only approximate, also logged; empty where the defect is at most 0.1,
        the negative light at most 0.005, of a compressed T more by its error, and T shows no
        ambient light; or unknown.
    transport_error : float
        ``.error`` of T, or of `exact` where that was given, beyond the tolerance of each solve.
    """

    direct: np.ndarray
    indirect: np.ndarray
    bounces: np.ndarray
    rest: np.ndarray
    solutions: tuple[Solution | tuple[Solution, ...], ...]
    reciprocity_defect: float
    negative_bounce: float
    warning: str
    transport_error: float
    _transports: tuple[Transport, Transport]  # that solves; whose noise it is
    _inverse: Inverse | None

    @cached_property
    def std(self) -> SeparationStd:
        """Standard deviations by the noise of T, `ltcl.transport.uncertainty`, computed at the first call."""
        T, true = self._transports
        return separation_std(T, true.noise, [self.direct, *self.bounces], self._inverse)

    def __repr__(self) -> str:
        shape, error = " x ".join(map(str, self.direct.shape)), error_note(self.transport_error)
        return f"<ltcl Separation {shape}, direct and {len(self.bounces)} bounces{error}>"

    def _repr_html_(self) -> str:
        from ltcl.images.thumbnails import thumbnails  # brings OpenCV

        bounces = {f"bounce {k}": bounce for k, bounce in enumerate(self.bounces, 1)}
        return thumbnails(self, {"direct": self.direct, **bounces, "rest": self.rest})


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
        In the units of T.
    bounces : int
        How many indirect bounces to tell apart.
    method, rtol, **options
        Of `ltcl.solve`; rtol is per bounce, 1e-3 when not given, or the error of a compressed T or
        an inverse where that is more.
    exact : Transport, optional
        The uncompressed transport that T was compressed from: T then solves, to an `rtol` as
        `ltcl.solve` says; residuals and warnings are computed with `exact`.
    inverse : Inverse, optional
        Of T, as `ltcl.invert` makes it: each bounce is then one product, and `rtol` the error it
        may have.

    Raises
    ------
    InputError
        A rectangular T, other shapes, a negative number of bounces, an `rtol` below the error of a
        compressed T without `exact` or of `inverse`, an inverse of another transport; or direct
        light of less than 0 or more than all of a picture, by more than its uncertainty: F or T is
        wrong or noisy where it says.
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
    check_transport(T)
    checks.count("bounces", bounces, least=0)
    if "pixels" in options:
        raise InputTypeError("pixels= gives some pixels alone; a picture needs all: leave it out")
    checks.one_of("method", method, METHODS)
    seed = checks.count("seed", options.get("seed", 0), least=0, most=(1 << 64) - 1)
    columns, shape = layout.unpack("image", image, T.grid, T.channels)
    pictures = sum(column.size for column in columns)
    checks.fits_host(f"separating {bounces} bounces", 3 * 8 * pictures * (bounces + 1))
    true, judges = resolve_reference(T, exact)
    if inverse is not None:
        check_inverse(T, inverse, rtol, exact=exact, method=None if method == "auto" else method)
        for name in options.keys() - {"callback", "throw"}:
            raise InputTypeError(
                f"option {name!r} is given, but with inverse there is no solve that takes it"
            )
    options |= {
        "rtol": default_rtol(RTOL, T, exact, inverse) if rtol is None else rtol,
        "exact": judges,
    }

    def picture(channels: list[np.ndarray]) -> np.ndarray:
        return shape.pack(channels, T.grid).astype(np.float32, copy=False)

    pictures, solutions = [], []
    indirect = rest = [l_out.astype(np.float64) for l_out in columns]
    for k in range(bounces + 1):
        if inverse is not None:
            solutions.append(tuple(inverse.solve(l, channel) for channel, l in enumerate(rest)))
        else:
            if (
                method in SAMPLED
            ):  # random numbers of its own, or its noise would go with that of others
                options["seed"] = (seed + k) % 2**64
            solutions.append(solve_each(T.systems, rest, method, **options))
        b_k = [solution.x.astype(np.float64) for solution in solutions[-1]]
        rest = [l - b for l, b in zip(rest, b_k, strict=True)]
        if k == 0:
            indirect = rest
            _refuse_impossible(
                true, columns, b_k, max(options["rtol"], *(s.residual for s in solutions[0]))
            )
        pictures.append(picture(b_k))
    warning = _warning(true.reciprocity_defect, max(true.negative_bounces), true.error)
    if (ambient := _ambient(true)) > LARGEST_AMBIENT:
        text = f"{ambient:.0%} of a bounce looks like ambient light left in T, and bounces are too bright"
        warning = f"{text}: subtract black from each picture of T; {warning}".removesuffix("; ")
    if warning:
        logger.warning(warning)
    return Separation(
        direct=pictures[0],
        indirect=picture(indirect),
        bounces=np.stack(pictures)[1:],
        rest=picture(rest),
        solutions=tuple(each[0] if T.channels == 1 else each for each in solutions),
        reciprocity_defect=true.reciprocity_defect,
        negative_bounce=max(true.negative_bounces),
        warning=warning,
        transport_error=true.error,
        _transports=(T, true),
        _inverse=inverse,
    )


def _refuse_impossible(
    T: Transport, image: list[np.ndarray], direct: list[np.ndarray], rtol: float
) -> None:
    """InputError where the direct light of a frame and channel is not from 0 to all of its light.

    Its variance is at most sum_j N (sigma_j b_j / F_j)^2, with the noise sigma_j of F_j for all of
    column j.
    """
    n, lit = len(image[0]), ~T.masked
    for channel, (l, b) in enumerate(zip(image, direct, strict=True)):
        light, share = l.sum(axis=0), b.sum(axis=0)
        beyond = np.where(
            np.minimum(l, 0.0).sum(axis=0) > -_NEGATIVE * light,
            np.maximum(-share, share - light),
            0.0,
        )
        if not (beyond > 0.0).any():
            continue
        F, margin = np.atleast_2d(T.first_bounce), _UNKNOWN * light
        with suppress(InputError):  # of operators, whose noise is unknown
            sigma = (T.noise.diagonal(F)[channel, lit] / F[channel, lit])[:, None]
            noise = _SIGMAS * np.linalg.norm(sigma * b[lit], axis=0)
            solved = 2.0 * (rtol + T.error) * np.linalg.norm(l, axis=0)
            margin = np.minimum(np.sqrt(n) * (noise + solved), margin)
        if not (beyond > margin).any():
            continue
        k = int(np.argmax(beyond - margin))
        worst = np.argsort(np.minimum(b[:, k], l[:, k] - b[:, k]))[:8]
        where = ", ".join(f"({j // T.grid[1]}, {j % T.grid[1]})" for j in worst)
        direct_share, uncertainty = share[k] / light[k], margin[k] / light[k]
        raise InputError(
            f"direct light is {direct_share:.0%} of the image, uncertain to {uncertainty:.1%}; "
            "it must be from 0 to 100 %: T or its first bounce is wrong or noisy, most of all at the pixels "
            f"(row, column): {where}; mask dark ones by dark_threshold=, or measure T again"
        )


def _ambient(T: Transport) -> float:
    """`diagnostics.ambient` of the worst channel, by 10 parts; 0 where T shows no entries, or few."""
    if "_ambient" not in (facts := vars(T)):  # as a cached property
        shown = len(T.masked) >= 64 and all(isinstance(matrix, ENTRIES) for matrix in T.matrices)
        solves = [
            lambda e, S=S: solve(S.as_it_stands(), e, rtol=1e-2).x for S in T.systems if shown
        ]
        with suppress(ConvergenceError):
            facts["_ambient"] = max(
                (diagnostics.ambient(x, T.grid, 7) for x in solves), default=0.0
            )
    return facts.setdefault("_ambient", 0.0)


def _warning(defect: float, negative: float, error: float) -> str:
    """Why bounces are approximate; nothing where both numbers are within the limits, or NaN."""
    reasons = []
    if defect > (most := LARGEST_DEFECT + error):
        reasons.append(f"T is not reciprocal (defect {defect:.2g}, above {most:.2g})")
    if negative > (most := LARGEST_NEGATIVE + error):
        reasons.append(
            f"a bounce holds a share {negative:.2g} of negative light (above {most:.2g})"
        )
    why = "surfaces reflect differently to different sides, or T is noisy; with one camera"
    such = "the bounces of such a scene are approximate (section 8.4, eq. 28 and 29)"
    return f"{' and '.join(reasons)}: {why} {such}" if reasons else ""
