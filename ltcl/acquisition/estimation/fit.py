# SPDX-License-Identifier: BSD-3-Clause
"""`fit`: a transport from any pairs of pictures and their photographs.

    pairs       the pictures, their checks
    view        which projector pixel a camera pixel sees
    windows     the functions in which each row of T is written
    estimator   T in the functions of `windows`, by the `regression` of its rows
    refinement  T of many pixels: far light at few nodes of `hats`, `near` light at every pixel

Some pairs are held out, the error of T is that of their photographs; then they are used, too.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.estimation.pairs import MIN_LIGHT_SHARE, Pairs, gains
from ltcl.acquisition.estimation.refinement import make_estimator
from ltcl.acquisition.estimation.view import find_view
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.errors import AcquisitionError, InputError, InputTypeError
from ltcl.transport.matrices import check_mixing
from ltcl.transport.transport import Transport

logger = logging.getLogger(__name__)

# Stretches of neighbouring pairs that are held out: frames of a film are like those beside them.
HELD_OUT_STRETCHES = 4
# Share of the lit pixels at which pairs must show direct light.
MIN_DIRECT_SHARE = 0.5
# Change of brightness from the first pair to the last that is corrected.
NOTABLE_DRIFT = 0.005


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Fit:
    """A transport that was fitted to pairs of patterns and photographs.

    Attributes
    ----------
    transport : Transport
        On the pixels of the photographs, in a basis of hat functions; fitted to all pairs.
    error : float
        Error of T p for pairs that the fit had not seen, relative to their photographs: the root
        mean square over them. Frames that are black are not among them.
    errors : (held out,)
        That of each of them.
    held_out : (held out,)
        Their numbers.
    drift : float
        Change of brightness over all pairs, which was corrected.
    noise : float
        What T leaves of a photograph at a pixel, relative to its light: noise of the camera, and
        light that varies faster than the functions do.
    pairs : Pairs
        Those that were given.

    Examples
    --------
    >>> import ltcl, numpy
    >>> patterns = numpy.random.default_rng(0).random((40, 3, 4))
    >>> photographs = 0.5 * patterns + 0.01 * patterns.sum(axis=(1, 2), keepdims=True)
    >>> result = ltcl.fit(patterns[:20], photographs[:20])
    >>> result = result.add(patterns[20:], photographs[20:])
    >>> len(result.pairs), bool(result.error < 0.01)
    (40, True)
    """

    transport: Transport
    error: float
    errors: np.ndarray
    held_out: np.ndarray
    drift: float
    noise: float
    pairs: Pairs
    options: dict[str, Any]

    def __repr__(self) -> str:
        h, w = self.pairs.grid
        return f"<ltcl Fit {h} x {w} pixels, {len(self.pairs)} pairs, error {self.error:.2%}>"

    def add(
        self,
        patterns: Any,
        photographs: Any,
        progress: Callable[[str, int, int], object] | None = None,
    ) -> Fit:
        """Fit to these pairs, too, one or more, which come after those before.

        Parameters and errors are those of `ltcl.fit`.
        """
        pairs = self.pairs.joined(Pairs.of(patterns, photographs))
        pairs.check_values()
        return _fit(pairs, **self.options, progress=progress)


def fit(
    patterns: Any,
    photographs: Any,
    *,
    geometry: str | Correspondence = "aligned",
    mixing: Any = None,
    held_out: float = 0.2,
    device: Any = None,
    progress: Callable[[str, int, int], object] | None = None,
) -> Fit:
    """Find the transport that turned these patterns into these photographs.

    Any pictures do, such as 50 to 500 photographs of nature, or a film and its recording: direct
    light must vary from picture to picture at every pixel. T is written in functions that widen
    with the distance from each camera pixel, and estimated with a prior that is learned from the
    pairs (`ltcl.acquisition.estimation`).

    Parameters
    ----------
    patterns : (frames, h, w) or (frames, h, w, 3)
        Linear light that the projector sent, at least 10 frames. Grey ones light all channels.
    photographs : (frames, h, w) or (frames, h, w, 3)
        Linear light that the camera saw of each, without ambient light.
    geometry : "aligned", "pairs" or Correspondence
        Which projector pixel each camera pixel sees: the same; found from the pairs, where their
        details allow it; or as measured before.
    mixing : (3, 3), optional
        Mixing of the projector's colours, as in `Transport`; None: found from the pairs.
    held_out : float
        Share of the pairs that judge the fit, in (0, 0.5].
    device : Device or str, optional
        As in `Transport`.
    progress : function of (str, int, int), optional
        Called with "fit", rows that are done, and all rows.

    Returns
    -------
    Fit

    Raises
    ------
    InputError, InputTypeError
        Shapes that do not fit together, NaN, too few pairs, patterns that are all the same
        or negative, photographs that are saturated.
    MemoryLimitError
        More pixels than the host has memory for.
    AcquisitionError
        Photographs in another order than the patterns, or of other pixels; pairs that do not show
        the geometry.

    Examples
    --------
    >>> import ltcl, numpy
    >>> truth = ltcl.scenes.dihedral(6, albedo=0.6).transport()
    >>> patterns = numpy.random.default_rng(0).random((60, *truth.grid))
    >>> photographs = numpy.stack([truth @ pattern for pattern in patterns])
    >>> result = ltcl.fit(patterns, photographs)
    >>> bool(result.error < 0.01)
    True
    """
    pairs = Pairs.of(patterns, photographs)
    pairs.check_values()
    share = checks.number("held_out", held_out, above=0.0, most=0.5)
    if progress is not None and not callable(progress):
        raise InputTypeError(
            f"progress is {progress!r}; it must be a function of (str, int, int), or None"
        )
    if mixing is not None:
        mixing = check_mixing(mixing, pairs.channels, has_blocks=False)
    return _fit(
        pairs,
        geometry=_check_geometry(geometry, pairs),
        mixing=mixing,
        held_out=share,
        device=device,
        progress=progress,
    )


def _check_geometry(geometry: Any, pairs: Pairs) -> str | Correspondence:
    if isinstance(geometry, Correspondence):
        if geometry.grid != pairs.grid or geometry.valid.shape != pairs.camera_grid:
            raise InputError(
                f"geometry is of {geometry.valid.shape} camera pixels and a projector of "
                f"{geometry.grid}; photographs is of {pairs.camera_grid}, patterns of {pairs.grid}"
            )
        return geometry
    checks.one_of("geometry", geometry, ("aligned", "pairs"))
    if geometry == "aligned" and pairs.camera_grid != pairs.grid:
        raise InputError(
            f"photographs is of {pairs.camera_grid} pixels, patterns of {pairs.grid}; give "
            "geometry='pairs', or photographs on the pixels of the projector"
        )
    return geometry


def _fit(
    original_pairs: Pairs,
    *,
    geometry: str | Correspondence,
    mixing: np.ndarray | None,
    held_out: float,
    device: Any,
    progress: Callable[[str, int, int], object] | None,
) -> Fit:
    pairs = original_pairs
    if geometry == "aligned":
        pairs.check_order()
    else:
        if isinstance(geometry, Correspondence):
            mapping = geometry
        else:
            mapping = find_view(pairs)
        pairs = pairs.resampled(Resampling.of(mapping))
        pairs.check_order()
    lit = pairs.lit_frames()
    judges = lit[_held_out(len(lit), held_out)]
    is_judge = np.zeros(len(pairs), bool)
    is_judge[judges] = True

    # 1. The prior and the colours, from the pairs that are not held out.
    # Rows are solved for those that judge, and at last for all pairs.
    estimator = make_estimator(pairs.grid, pairs.channels, mixing, progress, solves=2)
    estimator.learn(pairs.select(~is_judge))
    explained = estimator.explain(pairs.patterns)
    pairs.check_partners(explained)

    # 2. The lamp, and the error of the pairs that were held out.
    trend = _trend(judges, gains(pairs.photographs[judges], explained[judges]), len(pairs))
    drift = float(trend[-1] - trend[0])
    steady = pairs
    if abs(drift) > NOTABLE_DRIFT:
        logger.warning("brightness changes by %.1f %% over the pairs: corrected", 100 * drift)
        photographs = pairs.photographs / trend[:, None, None]
        steady = replace(pairs, photographs=photographs)
        estimator.solve(steady.select(~is_judge))
        explained = estimator.explain(pairs.patterns)
    residual = steady.photographs[judges] - explained[judges]
    errors = _norms(residual) / np.maximum(_norms(steady.photographs[judges]), np.finfo(float).tiny)

    error = float(np.sqrt(np.mean(errors**2)))
    squares = (residual**2).sum(axis=(0, 1))
    scales = estimator.scale_of_variance(pairs.patterns[judges], squares)

    # 3. The transport, from all pairs.
    estimator.solve(steady)
    arrays = estimator.arrays(scales)
    _check_direct_light(arrays["first_bounce"], pairs.photographs)
    return Fit(
        transport=Transport.from_arrays(arrays, device=device),
        error=error,
        errors=errors,
        held_out=judges,
        drift=drift,
        noise=estimator.noise,
        pairs=original_pairs,
        options={"geometry": geometry, "mixing": mixing, "held_out": held_out, "device": device},
    )


def _check_direct_light(first_bounce: np.ndarray, photographs: np.ndarray) -> None:
    """Refuse pairs that show the light of its own at too few of the pixels that are lit."""
    light = photographs.mean(axis=0).T
    is_lit = light > MIN_LIGHT_SHARE * light.max(axis=1, keepdims=True)
    share = float(np.mean(first_bounce[is_lit] > 0))
    if share < MIN_DIRECT_SHARE:
        raise AcquisitionError(
            f"photographs follow the light of their own pattern at {share:.0%} of the lit pixels; "
            "they are in another order, flipped or of another view (geometry='pairs'), or patterns "
            "vary too little"
        )


def _held_out(count: int, share: float) -> np.ndarray:
    """Numbers of the pairs that are held out: stretches, evenly spread."""
    length = math.ceil(count * share / HELD_OUT_STRETCHES)
    middles = (np.arange(HELD_OUT_STRETCHES) + 0.5) * count / HELD_OUT_STRETCHES
    first = (middles - length / 2).astype(int)
    numbers = first[:, None] + np.arange(length)
    return np.unique(np.clip(numbers, 0, count - 1))


def _trend(numbers: np.ndarray, gain: np.ndarray, count: int) -> np.ndarray:
    """A straight line through the gains of some pairs, at all of them, 1 on average."""
    line = np.polynomial.Polynomial.fit(numbers, gain, 1)(np.arange(count))
    return line / line.mean()


def _norms(pictures: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pictures.reshape(len(pictures), -1), axis=1)
