# SPDX-License-Identifier: BSD-3-Clause
"""Error against time of Monte Carlo, hybrid and Chebyshev: when each pays.

An iteration reads all of R in each step and gives the whole picture. A walk reads one entry a step and gives
one pixel: it pays for few pixels, and for pictures where rows are long. Tables, bounds and moments are made
before: they are kept with R. Errors are relative, in the norm over the pixels that were asked for, against a
solution by SciPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse.linalg

import _figures as figures
import ltcl
from _harness import seconds
from ltcl.device import Device
from ltcl.operators import CSR, Dense, IdentityPlus

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FEW = 64  # pixels
WHOLE = "whole picture"
COLOURS = {
    f"Chebyshev, {WHOLE}": "#5cc8ff",
    f"hybrid with final gather, {WHOLE}": "#7fd77f",
    f"Monte Carlo with final gather, {WHOLE}": "#ffb347",
    f"Monte Carlo, {FEW} pixels": "#ff7f9f",
}


@dataclass(frozen=True)
class Curves:
    """Of one R: by name pairs of (seconds, error)."""

    title: str
    points: dict[str, list[tuple[float, float]]]


def dense(n: int) -> np.ndarray:
    """R of n pixels that all see each other, row sums around 0.5."""
    return np.random.default_rng(4).random((n, n), dtype=np.float32) * np.float32(1.0 / n)


def curves(device: Device, R: Any, title: str, repeats: int) -> Curves:
    """Time and error of every method for a random picture."""
    n = R.shape[0]
    b = np.random.default_rng(3).random(n, dtype=np.float32)
    S = IdentityPlus(Dense(device, R) if isinstance(R, np.ndarray) else CSR(device, R))
    exact, pixels = _exact(R, b), np.random.default_rng(5).permutation(n)[:FEW]
    return Curves(
        title,
        {
            name: [_point(S, b, exact, given, repeats) for given in settings]
            for name, settings in _settings(pixels).items()
        },
    )


def _settings(pixels: np.ndarray) -> dict[str, list[dict[str, Any]]]:
    chebyshev, hybrid, walks, few = COLOURS
    gathered = {"gather": True}
    return {
        chebyshev: [{"method": "chebyshev", "rtol": rtol} for rtol in (0.3, 0.1, 1e-2, 1e-3, 1e-4)],
        hybrid: [{"method": "hybrid", "rtol": 1e-3, "samples": n, **gathered} for n in (1, 4, 16, 64)],
        walks: [{"method": "monte_carlo", "samples": n, **gathered} for n in (1, 4, 16, 64)],
        few: [{"method": "monte_carlo", "samples": 4**n, "pixels": pixels} for n in range(2, 9)],
    }


def _point(
    S: IdentityPlus, b: np.ndarray, exact: np.ndarray, given: dict[str, Any], repeats: int
) -> tuple[float, float]:
    found, wanted = ltcl.solve(S, b, **given).x, exact[given.get("pixels", slice(None))]
    time = seconds({"solve": lambda: ltcl.solve(S, b, **given)}, repeats)["solve"]
    return time, float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


def _exact(R: Any, b: np.ndarray) -> np.ndarray:
    linear: Any = scipy.sparse.linalg.LinearOperator
    S = linear(R.shape, matvec=lambda x: x.ravel() + R @ x.ravel().astype(np.float32), dtype=float)
    x, failed = scipy.sparse.linalg.bicgstab(S, b.astype(float), rtol=1e-6)
    if failed:
        raise SystemExit("SciPy's bicgstab did not find the solution to compare with")
    return x


def facts(found: list[Curves]) -> dict[str, Any]:
    """Milliseconds and errors, as they stand in the report."""
    return {
        f"{one.title}: {name}": ", ".join(f"{1e3 * time:.3g} ms {error:.2g}" for time, error in points)
        for one in found
        for name, points in one.points.items()
    }


def draw(found: list[Curves]) -> Figure:
    """One graph a matrix, side by side."""
    figure = figures.page(
        480,
        "When random walks pay",
        f"To a few per cent, walks give {FEW} pixels in a fraction of the time that an iteration takes.",
        "Finer than about 0.5 % the iteration has the whole picture by then. Whole pictures by walks, with",
        "one exact product at the end, are behind it where rows are short, and level where they are long.",
    )
    lefts, width = figures.columns(len(found), gap=90)
    for left, one in zip(lefts, found, strict=True):
        box = (left + 45, 168, width - 45, 200)
        axes = figures.graph(figure, box, one.title, "milliseconds", "relative error")
        for name, points in one.points.items():
            time, error = np.transpose(points)
            axes.loglog(1e3 * time, error, color=COLOURS[name], lw=2, marker="o", ms=4, label=name)
        axes.minorticks_off()
    handles, names = figure.axes[-1].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="lower center", ncols=2, frameon=False, labelcolor="linecolor", fontsize=10
    )
    return figure
