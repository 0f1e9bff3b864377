# SPDX-License-Identifier: BSD-3-Clause
"""What a transport is like before anything is solved: norms, spectrum, and what each method will cost."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks, theory
from ltcl.errors import InputError
from ltcl.operators import IdentityPlus
from ltcl.transport import Transport, require


@dataclass(frozen=True)
class ChannelAnalysis:
    """One colour channel.

    Attributes
    ----------
    norm_one, norm_inf, norm_frobenius : float
        Of R; NaN where the operator cannot see its entries. ||R||_inf < 1 makes the series converge.
    spectral_radius : float
        rho(R) by power iteration; the paper's iteration converges below 1.
    spectral_radius_change : float
        Relative change of it in the last step.
    albedo : float
        rho / (1 + rho): the uniform albedo of a closed scene with this radius (eq. 14).
    bounds : (lower, upper)
        Free bounds on the spectrum of S.
    products : dict
        Products each iterative method needs to reach rtol; infinite where it diverges.
    first_bounce : (smallest, median, largest)
    """

    norm_one: float
    norm_inf: float
    norm_frobenius: float
    spectral_radius: float
    spectral_radius_change: float
    albedo: float
    bounds: tuple[float, float]
    products: dict[str, float]
    first_bounce: tuple[float, float, float]


@dataclass(frozen=True)
class Analysis:
    """Result of `ltcl.analyze`: one entry of `channels` per colour channel."""

    shape: tuple[int, int]
    grid: tuple[int, int]
    rtol: float
    nbytes: int
    masked: int
    channels: tuple[ChannelAnalysis, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and dicts for JSON; infinite products and unknown norms are None."""
        report = dataclasses.asdict(self)
        for channel in report["channels"]:
            for values in (channel, channel["products"]):
                nothing = [
                    name
                    for name, value in values.items()
                    if isinstance(value, float) and not np.isfinite(value)
                ]
                values.update(dict.fromkeys(nothing))
        return report


def analyze(T: Transport, *, rtol: float = 1e-2) -> Analysis:
    """Norms and spectral radius of R, and the products each method would need.

    Parameters
    ----------
    T : Transport
        Square.
    rtol : float
        Tolerance the forecast is for.

    Returns
    -------
    Analysis

    Raises
    ------
    InputError
        A rectangular T.

    Examples
    --------
    >>> import ltcl
    >>> a = ltcl.analyze(ltcl.scenes.box(3, albedo=0.4).transport())
    >>> 0.5 < a.channels[0].spectral_radius < 0.7  # m / (1 - m) = 2/3, less what diag(T) took along
    True
    """
    require(T)
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    F = np.atleast_2d(T.first_bounce)
    return Analysis(
        shape=T.shape,
        grid=T.grid,
        rtol=rtol,
        nbytes=T.nbytes,
        masked=int(T.masked.sum()),
        channels=tuple(_channel(S, f[~T.masked], rtol) for S, f in zip(T.systems, F, strict=True)),
    )


def _channel(S: IdentityPlus, F: np.ndarray, rtol: float) -> ChannelAnalysis:
    try:
        norms = dataclasses.astuple(S.R.norms())
    except InputError:
        norms = (float("nan"),) * 3
    rho = theory.spectral_radius(S.R)
    bounds = theory.free_bounds(S)
    series = theory.series_products(rho.value, rtol)
    return ChannelAnalysis(
        *norms,
        spectral_radius=rho.value,
        spectral_radius_change=rho.change,
        albedo=rho.albedo,
        bounds=bounds,
        products={
            "jacobi": series,
            "neumann": series,
            "richardson": theory.richardson_products(*bounds, rtol),
            "chebyshev": theory.chebyshev_products(*bounds, rtol),
        },
        first_bounce=(float(F.min()), float(np.median(F)), float(F.max())),
    )
