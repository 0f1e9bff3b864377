# SPDX-License-Identifier: BSD-3-Clause
"""`analyze` foretells what `solve` then does."""

from __future__ import annotations

import dataclasses
import json
import math
import re

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError
from ltcl.solvers import Solution, Status
from ltcl.solvers.solve import ITERATIVE
from ltcl.tasks import report
from tests.problems import enclosure, lambertian

GRID = (5, 8)


def transport(scene, device, form=np.asarray):
    return ltcl.Transport(form(scene.T), GRID, first_bounce=scene.F, device=device)


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
def test_norms_and_radius_are_those_of_numpy(device, form):
    scene = lambertian(40, 1.7)
    (channel,) = ltcl.analyze(transport(scene, device, form)).channels
    assert channel.norm_one == pytest.approx(np.linalg.norm(scene.R, 1), rel=1e-5)
    assert channel.norm_inf == pytest.approx(np.linalg.norm(scene.R, np.inf), rel=1e-5)
    assert channel.norm_frobenius == pytest.approx(np.linalg.norm(scene.R), rel=1e-5)
    assert channel.spectral_radius == pytest.approx(1.7, rel=2e-3)
    assert channel.albedo == pytest.approx(1.7 / 2.7, rel=2e-3)
    assert channel.first_bounce == pytest.approx((scene.F.min(), np.median(scene.F), scene.F.max()))
    assert channel.bounds == pytest.approx((0.5, scene.S.sum(axis=1).max()), rel=1e-5)
    lower, upper = channel.spectral_radius_bounds
    assert 1.65 < lower <= 1.7 <= upper < 1.75
    assert channel.spectral_radius_certificate == "collatz-wielandt"
    assert channel.certificates["jacobi"] == "collatz-wielandt"
    assert channel.certificates["chebyshev"] == "free bounds"


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
@pytest.mark.parametrize("albedo", [0.1, 0.48])
def test_the_forecast_of_the_series_is_met(device, albedo, rtol):
    scene = enclosure(40, albedo)
    T = transport(scene, device)
    forecast = ltcl.analyze(T, rtol=rtol).channels[0].products
    dominant_eigenvector = np.ones(40)
    some = scene.S @ np.random.default_rng(0).uniform(0.2, 1.0, 40)
    # The series confirms its residual by one more product.
    for method, extra in (("jacobi", 0), ("neumann", 1)):
        for b, fewer in ((dominant_eigenvector, 1), (some, 2)):
            products = ltcl.solve(T.interreflection, b, method, rtol=rtol).products - extra
            assert forecast[method] - fewer <= products <= forecast[method] + 1


def test_colour_masks_and_json(device):
    matrices = [lambertian(40, rho).T for rho in (0.3, 0.6, 1.2)]
    for matrix in matrices:
        matrix[:, 3] = 0.0
    a = ltcl.analyze(ltcl.Transport(matrices, GRID, device=device, on_dark="mask"), rtol=1e-3)
    assert a.shape == (40, 40)
    assert a.grid == GRID
    assert a.rtol == 1e-3
    assert a.masked == 1
    assert a.nbytes == 3 * 40 * 40 * 4
    assert len(a.channels) == 3
    # The smallest first bounce is that of lit pixels.
    assert min(channel.first_bounce[0] for channel in a.channels) > 0.0
    assert len(repr(a)) < 100
    facts = json.loads(json.dumps(a.to_dict(), allow_nan=False))
    diverges = [channel["products"]["jacobi"] is None for channel in facts["channels"]]
    assert diverges == [False, False, True]


@pytest.mark.parametrize("rtol", [0.0, 1e-9, -1.0, 1.0, np.nan, "x", None])
def test_a_bad_tolerance_is_refused(device, rtol):
    with pytest.raises(InputError, match="rtol is"):
        ltcl.analyze(transport(lambertian(40, 0.5), device), rtol=rtol)


def test_every_iterative_method_has_an_entry(device):
    """Light that goes one way leaves Krylov methods without a forecast."""
    scene = enclosure(40, 0.45)
    (channel,) = ltcl.analyze(transport(scene, device)).channels
    assert set(channel.products) == set(channel.certificates) == set(ITERATIVE)
    assert channel.certificates["cg"] == "ritz values"
    assert channel.certificates["southwell"] == "none"
    one_way = ltcl.Transport(np.eye(40) + 0.9 * np.roll(np.eye(40), 1, axis=1), GRID, device=device)
    (turning,) = ltcl.analyze(one_way).channels
    assert math.isnan(turning.products["gmres"])
    assert math.isfinite(turning.products["jacobi"])


def test_a_solution_is_reported_without_its_vector():
    one = Solution(
        x=np.ones(4),
        status=Status.MAXITER,
        iterations=2,
        products=3,
        residuals=(1.0, 0.5, float("inf")),
        seconds=0.1,
        method="jacobi",
        reason="because",
    )
    (facts,) = report.solution(one)
    assert facts["method"] == "jacobi"
    assert facts["status"] == "maxiter"
    assert facts["products"] == 3
    assert facts["residual"] == 0.5
    assert facts["standard_error"] is None
    assert "x" not in facts
    sampled = dataclasses.replace(one, standard_error=np.array([np.nan, 0.1, 0.3]))
    facts = json.loads(report.dumps(report.solution((sampled,) * 3)))
    assert facts[2]["standard_error"] == {
        "largest": 0.3,
        "median": pytest.approx(0.2),
        "unknown": 1,
    }
    assert facts[2]["residuals"] == [1.0, 0.5, None]


@pytest.mark.parametrize("albedo", [0.6, (0.8, 0.5, 0.3)])
def test_a_notebook_shows_a_column_for_each_colour(device, albedo) -> None:
    found = ltcl.analyze(ltcl.scenes.dihedral(3, albedo=albedo).transport(device=device))
    html = found._repr_html_()
    rows = re.findall(r"<tr>(.*?)</tr>", html)
    columns = [len(re.findall(r"<t[hd]>", row)) for row in rows]
    assert set(columns) == {1 + len(found.channels)}
    titles = [re.sub("<.*?>", " ", row) for row in rows]
    assert any("spectral radius" in title for title in titles)
    assert sum("chebyshev" in title for title in titles) == 1
    assert html.count("<table>") == html.count("</table>") == 1
