# SPDX-License-Identifier: BSD-3-Clause
"""Figure 6: the inverse series where there are shadows, and where surfaces are glossy.

Above, a box with a block in it, lit by a lamp; below, a box of glossy walls. Claims of the paper:
the series recovers the direct light in 10 iterations with shadows, in 20 with gloss. It names no
albedos; ours are such that rho(R) is about 0.7 and 0.8, for which these numbers are due (to 1 %).
What is measured is that shadows and gloss leave the rate at rho(R) and come back as they were.
Gloss needs the full light field for that (section 4); one camera and one projector measure less of
it (eq. 28): what rho(R) becomes then is told too.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse.linalg
from matplotlib.figure import Figure

import _boxes as boxes
import _figures as figures
import ltcl
from _boxes import ALBEDO, RTOL
from _figures import Claim
from _harness import parse_options
from ltcl.plots.page import FAINT
from ltcl.scenes import Block, Scene, box, glossy

SHADED, BLOCK = (
    1.15 * np.array(ALBEDO[:5]),
    Block((0.3, 0.42, 0), (0.28, 0.28, 0.5), albedo=(0.5, 0.5, 0.5)),
)
LAMP = (0.85, 0.75, 0.8)
POLISHED, GLOSS, EXPONENT, PROJECTOR = 1.6 * np.array(ALBEDO[:5]), 0.5, 150, (2.3, 0.75, 0.7)
SHADOWS, GLOSSES, MOST = (1, 2, 10), (1, 2, 20), 30  # iterations drawn, and made


@dataclass(frozen=True)
class Recovery:
    """Sums of the series (MOST + 1, 3, unknowns), what they should become, and how they look.

    `systems` are S = I + R and `bounces` A, one for each colour.
    """

    scene: Scene
    l_d: np.ndarray
    sums: np.ndarray
    systems: tuple[Any, ...]
    bounces: tuple[Any, ...]
    seen: Callable[[np.ndarray], np.ndarray]

    @functools.cached_property
    def errors(self) -> np.ndarray:
        """Relative error of each sum, as it is seen."""
        truth = self.seen(self.l_d)
        return np.array([np.linalg.norm(self.seen(l) - truth) for l in self.sums]) / np.linalg.norm(
            truth
        )

    @functools.cached_property
    def rho(self) -> float:
        """rho(R) = rho(A) / (1 - rho(A)), of the slowest colour, by Arnoldi's method on A."""
        eigs = functools.partial(scipy.sparse.linalg.eigs, k=1, return_eigenvectors=False)
        rho = max(float(np.abs(eigs(A, v0=np.ones(A.shape[0]))[0])) for A in self.bounces)
        return rho / (1 - rho)

    @property
    def steps(self) -> float:
        """Iterations until the error is below RTOL."""
        return next((k for k, error in enumerate(self.errors) if error <= RTOL), math.inf)

    def chebyshev(self) -> int:
        """Products that Chebyshev's iteration needs, in the slowest colour."""
        pairs = zip(self.systems, self.sums[0], strict=True)
        return max(ltcl.solve(S, l, "chebyshev", rtol=RTOL).products for S, l in pairs)


def with_shadows(n: int, device: ltcl.Device) -> Recovery:
    """The box with a block in it, under a lamp."""
    room = box(n, 5, SHADED, occluder=BLOCK, device=device)
    scene, l_d, systems, l_out = boxes.light_room(room, LAMP, device)
    sums = np.cumsum(boxes.terms(systems, l_out, MOST), axis=0)
    return Recovery(scene, l_d, sums, systems, tuple(scene.A), scene.picture)


def with_gloss(n: int, smoke: bool) -> Recovery:
    """The glossy box: every patch sends light in `directions`, and R is that of all of them."""
    scene = glossy_box(n, smoke)
    l_d = np.stack([K @ (scene.Q @ np.ones(scene.Q.shape[1])) for K in scene.K])
    systems = tuple(map(LightField, scene.A))
    l_out = np.stack([S @ l for S, l in zip(systems, l_d, strict=True)])
    sums, seen = (
        np.cumsum(boxes.terms(systems, l_out, MOST), axis=0),
        lambda l: scene.picture(l @ scene.P.T),
    )
    return Recovery(scene.matte, l_d, sums, systems, scene.A, seen)


def glossy_box(n: int, smoke: bool) -> Any:
    """Five glossy walls, camera and projector before the sixth."""
    room = boxes.from_the_front(box(1, 5, ALBEDO[:5]))
    directions, exponent = (16, EXPONENT / 2) if smoke else (64, EXPONENT)
    return glossy(
        room, n, POLISHED, GLOSS, exponent, projector=PROJECTOR, directions=directions, rays=32
    )


class LightField(scipy.sparse.linalg.LinearOperator):
    """S = I + A + A^2 + ... (eq. 8), by as many products with A as float32 can tell."""

    def __init__(self, A: Any) -> None:
        super().__init__(np.float64, A.shape)
        self.A = A

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        total, bounce = x.astype(np.float64), x
        while np.abs(bounce).max() > 1e-9 * np.abs(total).max():
            bounce = self.A @ bounce
            total += bounce
        return total


def claims(shade: Recovery, gloss: Recovery, camera: float) -> list[Claim]:
    unlit = shade.l_d.sum(axis=0) == 0  # by the lamp
    dark = np.abs(shade.sums[:, :, unlit]).mean(axis=(1, 2)) / shade.l_d[:, ~unlit].mean()
    shade_products, gloss_products = shade.chebyshev(), gloss.chebyshev()
    shadows = f"light in them {dark[0]:.0%} of that outside, after 10 iterations {dark[10]:.1g}"
    products = f"shadows {shade_products}, gloss {gloss_products} products to 1 %"
    is_fewer = shade_products < shade.steps and gloss_products < gloss.steps
    radius = f"rho(R) = {camera:.2f}, of the light field {gloss.rho:.2f}"
    one_camera = "one camera's T F^-1 is another operator: gloss makes its rho(R) larger (eq. 28)"
    rates = []
    for name, found in (("shadows", shade), ("gloss", gloss)):
        text, rate = (
            f"{name}: each iteration leaves rho(R) of the error",
            found.errors[16] / found.errors[15],
        )
        measured = f"{rate:.3f}, rho(R) = {found.rho:.3f}"
        rates.append(Claim(text, measured, "within 2%", abs(rate / found.rho - 1) < 0.02))
    return [
        Claim(
            "shadows: direct light in 10 iterations",
            f"1 % after {shade.steps}",
            "10",
            shade.steps <= 10,
        ),
        Claim("shadows get as dark as they are", shadows, "below 1%", dark[10] < 0.01 < dark[0]),
        Claim(
            "gloss: direct light in 20 iterations",
            f"1 % after {gloss.steps}",
            "20",
            gloss.steps <= 20,
        ),
        *rates,
        Claim("ours: Chebyshev needs fewer", products, "fewer", is_fewer),
        Claim(one_camera, radius, "larger", camera > gloss.rho),
    ]


def draw_row(
    figure: Figure, found: Recovery, top: float, shown: tuple[int, ...], name: str
) -> None:
    images = [(name, f"error {found.errors[0]:.2g}", found.sums[0])]
    for n in shown:
        images.append(
            (f"{n} iteration{'s' * (n > 1)}", f"error {found.errors[n]:.2g}", found.sums[n])
        )
    images.append((r"direct light $l_d$", "the truth", found.l_d))
    gain = 0.9 / np.quantile(found.seen(found.sums[0]), 0.98)
    views = [(figures.light(found.scene, found.seen(l), gain), *text) for *text, l in images]
    figures.pictures(figure, top, views, gap=20)


def draw(shade: Recovery, gloss: Recovery) -> Figure:
    figure = figures.page(
        900,
        "Figure 6: the inverse series undoes shadowed and glossy scenes alike",
        "Above: a lamp, a block, and light that bounces into its shadows. Below: glossy walls in even light.",
        "Iterations take the bounces out, until shadows and highlights are as they were; below 0 is black.",
    )
    draw_row(figure, shade, 130, SHADOWS, "lamp and block")
    draw_row(figure, gloss, 370, GLOSSES, "glossy walls")
    box, title = (85, 620, 860, 210), "Error of the direct light"
    axes = figures.graph(figure, box, title, "iteration", "relative error")
    for found, name, colour in ((shade, "shadows", "#5cc8ff"), (gloss, "gloss", "#ffb347")):
        said = f"{name}: rho(R) = {found.rho:.2f}, 1 % after {found.steps}"
        axes.plot(found.errors, color=colour, lw=2, label=said)
    axes.axhline(RTOL, color=FAINT, lw=1, ls=":")
    axes.set_xlim(0, MOST)
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10)
    return figure


def main() -> None:
    given = parse_options(__doc__ or "")
    shade = with_shadows(4 if given.smoke else 14, given.device)
    gloss = with_gloss(4 if given.smoke else 12, given.smoke)
    scene = glossy_box(
        4 if given.smoke else 6, given.smoke
    )  # smaller, as one camera and projector see it
    T = scene.transport(scene.first_bounce, given.device, on_dark="mask")
    camera = max(channel.spectral_radius for channel in ltcl.analyze(T).channels)
    errors = [[float(f"{e:.3g}") for e in found.errors] for found in (shade, gloss)]
    facts = {
        "unknowns": [found.l_d.shape[1] for found in (shade, gloss)],
        "relative error after n iterations": errors,
        "largest albedo": [float(found.scene.albedo.max()) for found in (shade, gloss)],
    }
    found = claims(shade, gloss, camera)
    figures.conclude(given, "Figure 6: shadows and gloss", found, facts, lambda: draw(shade, gloss))


if __name__ == "__main__":
    main()
