# SPDX-License-Identifier: BSD-3-Clause
"""`analyze`: norms and spectrum of a transport, the products of each method, and a verdict."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks, theory
from ltcl.errors import InputError
from ltcl.operators import IdentityPlus, Operator
from ltcl.operators.base import Norms
from ltcl.solvers.auto import survey
from ltcl.tasks import report
from ltcl.theory.forecast import LEAST_RTOL
from ltcl.transport import diagnostics
from ltcl.transport.diagnostics import Energy
from ltcl.transport.transport import Transport, check_transport
from ltcl.transport.verdict import Verdict, verdict


@dataclass(frozen=True, kw_only=True)
class ChannelAnalysis:
    """Analysis of a colour channel.

    Attributes
    ----------
    norm_one, norm_inf, norm_frobenius : float
        Norms of R; NaN if the operator does not show its entries. The series converges if
        ||R||_inf < 1.
    spectral_radius, spectral_radius_change, spectral_radius_bounds, spectral_radius_certificate
        rho(R), its bounds and their certificate: see `theory.SpectralRadius`. The paper's iteration
        converges below 1.
    albedo : float
        rho / (1 + rho): the uniform albedo of a closed scene with this radius (eq. 14).
    bounds : (lower, upper)
        Free bounds on the spectrum of S.
    products : dict
        Products (sweeps of Gauss-Seidel) each iterative method needs to reach rtol; infinite where
        it diverges, NaN where there is no forecast.
    certificates : dict
        Basis of each forecast; see `theory.Forecast`.
    series : tuple of theory.Terms
        Light that 1, 2, 4, 8 and 16 terms of the series leave out (eq. 13, 15, 16), with m from the
        bound on rho(R).
    first_bounce : (smallest, median, largest)
    reciprocity_defect, negative_bounce : float
        Both are 0 in a Lambertian scene without noise; the second is above 0.005 in glossy ones:
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


# Facts of a channel that notebooks show, by their titles.
HTML_FACTS = {
    "spectral radius of R": "spectral_radius",
    "albedo of a closed scene": "albedo",
    "negative light in a bounce": "negative_bounce",
    "reciprocity defect": "reciprocity_defect",
}


def _html_row(kind: str, title: str, values: Sequence[str]) -> str:
    """Return a row of a table: a title, and a cell of the kind th or td for each value."""
    cells = "".join(f"<{kind}>{html.escape(value)}</{kind}>" for value in values)
    return f"<tr><th>{html.escape(title)}</th>{cells}</tr>"


@dataclass(frozen=True, kw_only=True, repr=False)
class Analysis:
    """Result of `ltcl.analyze`: an analysis of each colour channel, and the verdict on T.

    A T without S, of other camera pixels or of blocks between colours, has no `channels`.
    """

    shape: tuple[int, int]
    grid: tuple[int, int]
    rtol: float
    nbytes: int
    masked: int
    channels: tuple[ChannelAnalysis, ...]
    verdict: Verdict

    def __repr__(self) -> str:
        height, width = self.grid
        radii = ", ".join(f"{channel.spectral_radius:.3g}" for channel in self.channels)
        return f"<ltcl Analysis grid {height} x {width}, rho(R) {radii or 'unknown'}>"

    def _repr_html_(self) -> str:
        text = ""
        for line in (str(self), self.verdict.text):
            text += f"<div>{html.escape(line)}</div>"
        if not self.channels:
            return text
        colours = ("red", "green", "blue") if len(self.channels) == 3 else ("",)
        rows = [_html_row("th", "", colours)]
        for title, name in HTML_FACTS.items():
            values = [f"{getattr(channel, name):.3g}" for channel in self.channels]
            rows.append(_html_row("td", title, values))
        for method in self.channels[0].products:
            counts = [_count_text(channel.products[method]) for channel in self.channels]
            rows.append(_html_row("td", f"products to {self.rtol:g}: {method}", counts))
        return f"{text}<table>{''.join(rows)}</table>"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and dicts for JSON; infinite or unknown numbers are None."""
        return report.plain(self)


def analyze(T: Transport, *, rtol: float = 1e-2) -> Analysis:
    """Analyze the norms and the spectrum of R, the cost of each method, and the measurement.

    Parameters
    ----------
    T : Transport
        Any transport; one without S gets the verdict alone. Of several projectors (`ltcl.combine`)
        the S between camera pixels is analyzed.
    rtol : float
        Tolerance of the forecast, from 1.2e-7 to 1.

    Returns
    -------
    Analysis

    Raises
    ------
    InputError
        A T that is no Transport, or a tolerance out of range.

    Examples
    --------
    >>> import ltcl
    >>> a = ltcl.analyze(ltcl.scenes.box(3, albedo=0.4).transport())
    >>> 0.5 < a.channels[0].spectral_radius < 0.7  # m / (1 - m) = 2/3, less what diag(T) took along
    True
    """
    check_transport(T, square=False)
    rtol = checks.number("rtol", rtol, least=LEAST_RTOL, below=1.0)
    channels = []
    T = T.scene
    if T.is_square:
        for matrix, F, S, negative in zip(
            T.matrices, np.atleast_2d(T.first_bounce), T.systems, T.negative_bounces, strict=True
        ):
            channels.append(_analyze_channel(matrix, F, S, negative, rtol))
    return Analysis(
        shape=T.shape,
        grid=T.grid,
        rtol=rtol,
        nbytes=T.nbytes,
        masked=int(T.masked.sum()),
        channels=tuple(channels),
        verdict=verdict(T),
    )


def _analyze_channel(
    T: Any, F: np.ndarray, S: IdentityPlus, negative_bounce: float, rtol: float
) -> ChannelAnalysis:
    norms = _known_norms(S.R)
    rho = theory.spectral_radius(S.R, norms=norms)
    bounds = theory.free_bounds(S)
    surveyed = survey(S)
    spectrum = None
    if surveyed.in_an_interval:
        spectrum = surveyed.spectrum
    forecasts = theory.forecasts(S, rho, bounds, rtol, spectrum, surveyed.self_adjoint)
    largest_radius = rho.upper
    if not math.isfinite(rho.upper):
        largest_radius = rho.value
    # rho(R) <= m / (1 - m), eq. 14.
    m = largest_radius / (1.0 + largest_radius)
    lit = F[F > 0]
    if norms is None:
        norms = Norms(one=math.nan, inf=math.nan, frobenius=math.nan, lowest=math.nan)
    return ChannelAnalysis(
        norm_one=norms.one,
        norm_inf=norms.inf,
        norm_frobenius=norms.frobenius,
        spectral_radius=rho.value,
        spectral_radius_change=rho.change,
        spectral_radius_bounds=(rho.lower, rho.upper),
        spectral_radius_certificate=rho.certificate,
        albedo=rho.albedo,
        bounds=bounds,
        products={name: forecast.products for name, forecast in forecasts.items()},
        certificates={name: forecast.certificate for name, forecast in forecasts.items()},
        series=theory.after_terms(m),
        first_bounce=(float(lit.min()), float(np.median(lit)), float(lit.max())),
        reciprocity_defect=diagnostics.reciprocity_defect(T, F),
        negative_bounce=negative_bounce,
        energy=diagnostics.check_energy(T, F, S),
    )


def _known_norms(R: Operator) -> Norms | None:
    """Norms of R; None if it does not show its entries."""
    try:
        return R.norms()
    except InputError:
        return None


def _count_text(products: float) -> str:
    """A number of products, infinite where a method diverges, NaN where it is unknown."""
    if math.isfinite(products):
        return f"{products:.0f}"
    return "diverges" if products > 0 else "-"
