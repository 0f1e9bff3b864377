# SPDX-License-Identifier: BSD-3-Clause
"""What a transport is like before it is used: norms, spectrum, what each method costs, whether it can be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks, theory
from ltcl.errors import InputError
from ltcl.operators import IdentityPlus
from ltcl.solvers.auto import survey
from ltcl.tasks import report
from ltcl.theory.forecast import LEAST_RTOL
from ltcl.transport import diagnostics
from ltcl.transport.diagnostics import Energy
from ltcl.transport.transport import Transport, check_transport
from ltcl.transport.verdict import Verdict, verdict


@dataclass(frozen=True)
class ChannelAnalysis:
    """One colour channel.

    Attributes
    ----------
    norm_one, norm_inf, norm_frobenius : float
        Of R; NaN where the operator cannot see its entries. ||R||_inf < 1 makes the series converge.
    spectral_radius, spectral_radius_change, spectral_radius_bounds, spectral_radius_certificate
        rho(R) and what is known of it: see `theory.SpectralRadius`. The paper's iteration converges
        below 1.
    albedo : float
        rho / (1 + rho): the uniform albedo of a closed scene with this radius (eq. 14).
    bounds : (lower, upper)
        Free bounds on the spectrum of S.
    products : dict
        Products (sweeps of Gauss-Seidel) each iterative method needs to reach rtol; infinite where
        it diverges, NaN where there is no forecast.
    certificates : dict
        What each forecast rests on; see `theory.Forecast`.
    series : tuple of theory.Terms
        What 1, 2, 4, 8 and 16 terms of the series leave undone (eq. 13, 15, 16), m from the bound
        on rho(R).
    first_bounce : (smallest, median, largest)
    reciprocity_defect, negative_bounce : float
        Both 0 of a Lambertian scene without noise, the second above 0.005 of glossy ones:
        `ltcl.transport.diagnostics`.
    energy : Energy
    """

    norm_one: float
    norm_inf: float
    norm_frobenius: float
    spectral_radius: float
    spectral_radius_change: float
    spectral_radius_bounds: tuple[float, float]
    spectral_radius_certificate: str
    albedo: float
    bounds: tuple[float, float]
    products: dict[str, float]
    certificates: dict[str, str]
    series: tuple[theory.Terms, ...]
    first_bounce: tuple[float, float, float]
    reciprocity_defect: float
    negative_bounce: float
    energy: Energy


@dataclass(frozen=True, repr=False)
class Analysis:
    """Result of `ltcl.analyze`: one entry of `channels` per colour channel, and what T is good for."""

    shape: tuple[int, int]
    grid: tuple[int, int]
    rtol: float
    nbytes: int
    masked: int
    channels: tuple[ChannelAnalysis, ...]
    verdict: Verdict

    def __repr__(self) -> str:
        (h, w), radii = (
            self.grid,
            ", ".join(f"{channel.spectral_radius:.3g}" for channel in self.channels),
        )
        return f"<ltcl Analysis grid {h} x {w}, rho(R) {radii}>"

    def _repr_html_(self) -> str:
        from ltcl.images.thumbnails import thumbnails  # brings OpenCV

        bars = {}
        for channel in self.channels:
            counts = {name: n for name, n in channel.products.items() if math.isfinite(n)}
            label = "products: " + ", ".join(f"{name} {n:.0f}" for name, n in counts.items())
            lengths = np.array([*counts.values()])[:, None]
            bars[label] = np.repeat(np.linspace(0, lengths.max(), 64) <= lengths, 4, axis=0)
        return thumbnails(self, bars)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and dicts for JSON; what is infinite or unknown is None."""
        return report.plain(self)


def analyze(T: Transport, *, rtol: float = 1e-2) -> Analysis:
    """Norms and spectral radius of R, the products each method would need, and checks of the measurement.

    T is square, else InputError. The forecast is for the tolerance `rtol`, from 1.2e-7 to 1.

    Examples
    --------
    >>> import ltcl
    >>> a = ltcl.analyze(ltcl.scenes.box(3, albedo=0.4).transport())
    >>> 0.5 < a.channels[0].spectral_radius < 0.7  # m / (1 - m) = 2/3, less what diag(T) took along
    True
    """
    check_transport(T)
    rtol = checks.number("rtol", rtol, least=LEAST_RTOL, below=1.0)
    systems = zip(
        T.matrices, np.atleast_2d(T.first_bounce), T.systems, T.negative_bounces, strict=True
    )
    channels = tuple(_channel(*system, rtol) for system in systems)
    negative, highest = T.negative_bounces, [channel.energy.bounce_highest for channel in channels]
    known = {"negative_bounce": np.fmax.reduce(negative), "bounce_highest": np.fmax.reduce(highest)}
    judged = verdict(T, **known)
    return Analysis(T.shape, T.grid, rtol, T.nbytes, int(T.masked.sum()), channels, judged)


def _channel(
    T: Any, F: np.ndarray, S: IdentityPlus, negative: float, rtol: float
) -> ChannelAnalysis:
    try:
        norms = S.R.norms()
    except InputError:
        norms = None
    rho = theory.spectral_radius(S.R, norms=norms)
    bounds = theory.free_bounds(S)
    surveyed = survey(S)
    spectrum = surveyed.spectrum if surveyed.in_an_interval else None
    forecasts = theory.forecasts(S, rho, bounds, rtol, spectrum, surveyed.self_adjoint)
    upper = rho.upper if math.isfinite(rho.upper) else rho.value
    lit = F[F > 0]
    return ChannelAnalysis(
        norm_one=norms.one if norms else math.nan,
        norm_inf=norms.inf if norms else math.nan,
        norm_frobenius=norms.frobenius if norms else math.nan,
        spectral_radius=rho.value,
        spectral_radius_change=rho.change,
        spectral_radius_bounds=(rho.lower, rho.upper),
        spectral_radius_certificate=rho.certificate,
        albedo=rho.albedo,
        bounds=bounds,
        products={name: forecast.products for name, forecast in forecasts.items()},
        certificates={name: forecast.certificate for name, forecast in forecasts.items()},
        series=theory.after_terms(upper / (1.0 + upper)),  # rho(R) <= m / (1 - m), eq. 14
        first_bounce=(float(lit.min()), float(np.median(lit)), float(lit.max())),
        reciprocity_defect=diagnostics.reciprocity_defect(T, F),
        negative_bounce=negative,
        energy=diagnostics.check_energy(T, F, S),
    )
