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

import dataclasses
import html
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputTypeError
from ltcl.interop.arrays import numbers
from ltcl.operators import Operator
from ltcl.solvers import Inverse, Solution, solve_each
from ltcl.solvers.solve import METHODS, SAMPLED
from ltcl.tasks.plausibility import bounce_limits, bounce_warning, check_direct_light
from ltcl.tasks.requirements import check_exact, check_inverse, default_rtol, error_note
from ltcl.transport import frames as layout
from ltcl.transport.transport import Transport, check_transport
from ltcl.transport.uncertainty import SeparationStd, separation_std

logger = logging.getLogger(__name__)

# Tolerance of each solve if none is given.
RTOL = 1e-3
# Seeds of methods that sample are below this number.
SEED_LIMIT = 1 << 64


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Separation:
    """Result of `ltcl.separate`. Pictures have the shape of the image, linear, float32.

    Attributes
    ----------
    direct, indirect : array
        Bounce 0, light that went from projector to surface to camera; and all other light of the
        image.
    bounces : array, (bounces, ...)
        bounces[0] is the first indirect bounce.
    rest : array
        All further bounces together: direct + sum of bounces + rest is the image.
    solutions : tuple
        Solves in the order direct, first bounce, ...; per entry one Solution, or 3 in colour.
    reciprocity_defect, negative_bounce : float
        Signs in T that bounces are approximate, see `ltcl.transport.diagnostics`: both 0 of a
        Lambertian scene measured without noise; NaN where unknown. The relative error of the first
        bounce of a glossy scene is a few times the latter, of others more.
    warning : str
        What T leaves unknown of its bounces, and by how much the choice of the first bounce changes
        them. Before it the reasons why they are only approximate, which are also logged, if T shows
        some: a defect above 0.1, negative light above 0.005, of a compressed T more by its error,
        or ambient light.
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
    _solving: Transport
    _reference: Transport
    _inverse: Inverse | None

    def with_arrays(self, give: Callable[[np.ndarray], Any]) -> Separation:
        """The same result with pictures of another kind of array."""
        names = ("direct", "indirect", "bounces", "rest")
        return dataclasses.replace(self, **{name: give(getattr(self, name)) for name in names})

    @cached_property
    def std(self) -> SeparationStd:
        """Standard deviations by the noise of T alone, computed at the first call.

        They do not hold what `warning` says is unknown. See `ltcl.transport.uncertainty`.
        """
        pictures = [numbers(self.direct), *numbers(self.bounces)]
        return separation_std(self._solving, self._reference.noise, pictures, self._inverse)

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.direct.shape))
        error = error_note(self.transport_error)
        return f"<ltcl Separation {size}, direct and {len(self.bounces)} bounces{error}>"

    def _repr_html_(self) -> str:
        # Imports OpenCV.
        from ltcl.images.thumbnails import thumbnails

        pictures = {"direct": numbers(self.direct)}
        for number, bounce in enumerate(numbers(self.bounces), 1):
            pictures[f"bounce {number}"] = bounce
        pictures["rest"] = numbers(self.rest)
        return f"{thumbnails(self, pictures)}<div>{html.escape(self.warning)}</div>"


@checks.takes_arrays("image")
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
        A square transport, or one of several projectors (`ltcl.combine`). The bounces are as good
        as its first bounce: see ``first_bounce="exact"``.
    image : (h, w), (h, w, 3), or frames of these
        Linear light in the units of T.
    bounces : int
        Number of indirect bounces to tell apart.
    method, rtol, **options
        Arguments of `ltcl.solve`. rtol is per bounce, 1e-3 when not given, or the error of a
        compressed T or an inverse where that is more.
    exact : Transport, optional
        The uncompressed transport that T was compressed from: T then solves, to an `rtol` as
        `ltcl.solve` says; residuals and warnings are computed with `exact`.
    inverse : Inverse, optional
        The inverse of T that `ltcl.invert` makes: each bounce is then one product, and `rtol` the
        error it may have.

    Raises
    ------
    InputError
        A rectangular T, other shapes, a negative number of bounces, an `rtol` below the error of a
        compressed T without `exact` or of `inverse`, an inverse of another transport; or direct
        light of less than 0 or more than all of a picture, by more than its uncertainty: F or T is
        wrong or noisy at the pixels that the message names.
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
    T = check_transport(T, square=False).scene
    check_transport(T)
    checks.count("bounces", bounces, least=0)
    _check_method(method, options)
    columns, shape = layout.unpack("image", image, T.grid, T.channels)
    values = sum(column.size for column in columns)
    checks.fits_host(f"separating {bounces} bounces", 3 * 8 * values * (bounces + 1))
    reference = T
    judging_systems: Sequence[Operator] = ()
    if exact is not None:
        check_exact(T, exact)
        reference = exact
        judging_systems = exact.systems
    if inverse is not None:
        _check_inverse_options(T, inverse, rtol, exact, method, options)
    if rtol is None:
        rtol = default_rtol(RTOL, T, exact, inverse)
    solver = BounceSolver(
        T=T,
        exact=judging_systems,
        inverse=inverse,
        method=method,
        rtol=rtol,
        options=options,
    )

    remaining = [column.astype(np.float64) for column in columns]
    indirect = remaining
    pictures = []
    solutions = []
    for number in range(bounces + 1):
        solved = solver.solve(number, remaining)
        bounce = [solution.x.astype(np.float64) for solution in solved]
        remaining = [l - b for l, b in zip(remaining, bounce, strict=True)]
        if number == 0:
            indirect = remaining
            residuals = [solution.residual for solution in solved]
            check_direct_light(reference, columns, bounce, max(rtol, *residuals))
        pictures.append(_picture(bounce, shape, T))
        solutions.append(solved[0] if T.channels == 1 else solved)

    warning = bounce_limits(reference)
    reasons = bounce_warning(reference)
    if reasons:
        logger.warning(reasons)
        warning = f"{reasons}; {warning}"
    return Separation(
        direct=pictures[0],
        indirect=_picture(indirect, shape, T),
        bounces=np.stack(pictures)[1:],
        rest=_picture(remaining, shape, T),
        solutions=tuple(solutions),
        reciprocity_defect=reference.reciprocity_defect,
        negative_bounce=max(reference.negative_bounces),
        warning=warning,
        transport_error=reference.error,
        _solving=T,
        _reference=reference,
        _inverse=inverse,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class BounceSolver:
    """The solves of bounces, b_k = S^-1 l^(k), of all channels."""

    T: Transport
    exact: Sequence[Operator]
    inverse: Inverse | None
    method: str
    rtol: float
    options: dict[str, Any]

    def solve(self, number: int, remaining: list[np.ndarray]) -> tuple[Solution, ...]:
        """Bounce `number` of the remaining light (N, k) of each channel."""
        if self.inverse is not None:
            solutions = []
            for channel, light in enumerate(remaining):
                solutions.append(self.inverse.solve(light, channel))
            return tuple(solutions)
        options = dict(self.options)
        if self.method in SAMPLED:
            # Random numbers of its own: the noise of a bounce must not depend on that of others.
            seed = options.get("seed", 0)
            options["seed"] = (seed + number) % SEED_LIMIT
        return solve_each(
            self.T.systems,
            remaining,
            self.method,
            exact=self.exact,
            rtol=self.rtol,
            **options,
        )


def _check_method(method: str, options: dict[str, Any]) -> None:
    if "pixels" in options:
        raise InputTypeError("pixels= gives some pixels alone; a picture needs all: leave it out")
    checks.one_of("method", method, METHODS)
    checks.count("seed", options.get("seed", 0), least=0, most=SEED_LIMIT - 1)


def _check_inverse_options(
    T: Transport,
    inverse: Inverse,
    rtol: float | None,
    exact: Transport | None,
    method: str,
    options: dict[str, Any],
) -> None:
    """Refuse an inverse of another T, and options of solves that it takes the place of."""
    other_method = None if method == "auto" else method
    check_inverse(T, inverse, rtol, exact=exact, method=other_method)
    for name in options:
        if name not in ("callback", "throw"):
            raise InputTypeError(
                f"option {name!r} is given, but with inverse there is no solve that takes it"
            )


def _picture(channels: list[np.ndarray], shape: layout.PictureLayout, T: Transport) -> np.ndarray:
    return shape.pack(channels, T.grid).astype(np.float32, copy=False)
