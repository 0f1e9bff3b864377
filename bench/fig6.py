# SPDX-License-Identifier: BSD-3-Clause
"""Figure 6: the inverse series on scenes with shadows and with glossy surfaces.

Above, a box with a block in it, lit by a lamp; below, a box of glossy walls. Claims of the paper:
the series recovers the direct light in 10 iterations with shadows, in 20 with gloss. It names no
albedos; ours are such that rho(R) is about 0.7 and 0.8, for which these numbers are due (to 1 %).
It is measured that shadows and gloss leave the rate at rho(R) and come back as they were. Gloss
needs the full light field for that (section 4); one camera and one projector measure less of it
(eq. 28): rho(R) is reported for that case, too.
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
from _coefficients import norms
from _figures import Claim
from _harness import Options, parse_options
from ltcl.plots.page import FAINT
from ltcl.scenes import Block, Scene, box, glossy

# Above: a box of matt walls, a block in it, and a lamp.
SHADED_ALBEDO = 1.15 * np.array(ALBEDO[:5])
BLOCK = Block((0.3, 0.42, 0), (0.28, 0.28, 0.5), albedo=(0.5, 0.5, 0.5))
LAMP = (0.85, 0.75, 0.8)
# Below: a box of glossy walls.
GLOSSY_ALBEDO = 1.6 * np.array(ALBEDO[:5])
GLOSS = 0.5
EXPONENT = 150
DIRECTIONS = 64
PROJECTOR = (2.3, 0.75, 0.7)
# Iterations that are made, and those whose pictures are drawn.
ITERATIONS = 30
DRAWN_SHADOWS = (1, 2, 10)
DRAWN_GLOSS = (1, 2, 20)
# Bounces end where they are so small beside their sum: float32 products tell no more.
BOUNCE_ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Patches along a wall; the spectrum of the box of one camera needs a dense matrix."""

    shadows: int = 14
    gloss: int = 12
    camera: int = 6


SMOKE_SIZES = Sizes(shadows=4, gloss=4, camera=4)


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """Sums of the series (ITERATIONS + 1, 3, unknowns), their limit l_d, and how they look.

    `systems` are S = I + R and `bounces` A, one for each colour.
    """

    scene: Scene
    l_d: np.ndarray
    sums: np.ndarray
    systems: tuple[Any, ...]
    bounces: tuple[Any, ...]
    to_picture: Callable[[np.ndarray], np.ndarray]

    @functools.cached_property
    def errors(self) -> np.ndarray:
        """Relative error of each sum, in the picture."""
        truth = self.to_picture(self.l_d)
        pictures = np.array([self.to_picture(l) for l in self.sums])
        deviations = norms(pictures - truth)
        return deviations / np.linalg.norm(truth)

    @functools.cached_property
    def rho(self) -> float:
        """rho(R) = rho(A) / (1 - rho(A)), of the slowest colour, by Arnoldi's method on A."""
        radii = []
        for A in self.bounces:
            start = np.ones(A.shape[0])
            values = scipy.sparse.linalg.eigs(A, k=1, v0=start, return_eigenvectors=False)
            radii.append(float(np.abs(values[0])))
        largest = max(radii)
        return largest / (1 - largest)

    @property
    def steps(self) -> float:
        """Iterations until the error is below RTOL."""
        (below,) = np.nonzero(self.errors <= RTOL)
        return int(below[0]) if len(below) else math.inf

    def chebyshev(self) -> int:
        """Products that Chebyshev's iteration needs, in the slowest colour."""
        products = []
        for S, l_out in zip(self.systems, self.sums[0], strict=True):
            products.append(ltcl.solve(S, l_out, "chebyshev", rtol=RTOL).products)
        return max(products)


def with_shadows(n: int, device: ltcl.Device) -> Recovery:
    """The box with a block in it, under a lamp."""
    room = box(n, 5, SHADED_ALBEDO, occluder=BLOCK, device=device)
    scene, l_d, systems, l_out = boxes.light_room(room, LAMP, device)
    terms = boxes.terms(systems, l_out, ITERATIONS)
    return Recovery(
        scene=scene,
        l_d=l_d,
        sums=np.cumsum(terms, axis=0),
        systems=systems,
        bounces=tuple(scene.A),
        to_picture=scene.picture,
    )


def with_gloss(n: int, smoke: bool) -> Recovery:
    """The glossy box: every patch sends light in `directions`, and R is that of all of them."""
    scene = glossy_box(n, smoke)
    projected = scene.Q @ np.ones(scene.Q.shape[1])
    l_d = np.stack([K @ projected for K in scene.K])
    systems = tuple(map(LightField, scene.A))
    l_out = np.stack([S @ l for S, l in zip(systems, l_d, strict=True)])
    terms = boxes.terms(systems, l_out, ITERATIONS)
    return Recovery(
        scene=scene.matte,
        l_d=l_d,
        sums=np.cumsum(terms, axis=0),
        systems=systems,
        bounces=scene.A,
        to_picture=lambda l: scene.picture(l @ scene.P.T),
    )


def glossy_box(n: int, smoke: bool) -> Any:
    """Five glossy walls, camera and projector before the sixth."""
    room = boxes.from_the_front(box(1, 5, ALBEDO[:5]))
    exponent, directions = (EXPONENT / 2, 16) if smoke else (EXPONENT, DIRECTIONS)
    place: Any = {"projector": PROJECTOR, "directions": directions, "rays": 32}
    return glossy(room, n, GLOSSY_ALBEDO, GLOSS, exponent, **place)


class LightField(scipy.sparse.linalg.LinearOperator):
    """S = I + A + A^2 + ... (eq. 8), by as many products with A as float32 can tell."""

    def __init__(self, A: Any) -> None:
        super().__init__(np.float64, A.shape)
        self.A = A

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        total = x.astype(np.float64)
        bounce = x
        while np.abs(bounce).max() > BOUNCE_ROUNDING * np.abs(total).max():
            bounce = self.A @ bounce
            total += bounce
        return total


def claims(shade: Recovery, gloss: Recovery, camera_radius: float) -> list[Claim]:
    one_camera = "one camera's T F^-1 is another operator: gloss makes its rho(R) larger (eq. 28)"
    radii = f"rho(R) = {camera_radius:.2f}, of the light field {gloss.rho:.2f}"
    return [
        steps_claim("shadows", shade, 10),
        darkness_claim(shade),
        steps_claim("gloss", gloss, 20),
        rate_claim("shadows", shade),
        rate_claim("gloss", gloss),
        chebyshev_claim(shade, gloss),
        Claim(one_camera, radii, "larger", camera_radius > gloss.rho),
    ]


def steps_claim(name: str, recovery: Recovery, limit: int) -> Claim:
    text = f"{name}: direct light in {limit} iterations"
    measured = f"1 % after {recovery.steps}"
    return Claim(text, measured, f"{limit}", recovery.steps <= limit)


def darkness_claim(shade: Recovery) -> Claim:
    # Patches that the lamp does not reach.
    is_unlit = shade.l_d.sum(axis=0) == 0
    in_shadow = np.abs(shade.sums[:, :, is_unlit]).mean(axis=(1, 2))
    dark = in_shadow / shade.l_d[:, ~is_unlit].mean()
    measured = f"light in them {dark[0]:.0%} of that outside, after 10 iterations {dark[10]:.1g}"
    text = "shadows get as dark as they are"
    return Claim(text, measured, "below 1%", dark[10] < 0.01 < dark[0])


def rate_claim(name: str, recovery: Recovery) -> Claim:
    rate = recovery.errors[16] / recovery.errors[15]
    is_due = abs(rate / recovery.rho - 1) < 0.02
    text = f"{name}: each iteration leaves rho(R) of the error"
    measured = f"{rate:.3f}, rho(R) = {recovery.rho:.3f}"
    return Claim(text, measured, "within 2%", is_due)


def chebyshev_claim(shade: Recovery, gloss: Recovery) -> Claim:
    shade_products = shade.chebyshev()
    gloss_products = gloss.chebyshev()
    is_fewer = shade_products < shade.steps and gloss_products < gloss.steps
    measured = f"shadows {shade_products}, gloss {gloss_products} products to 1 %"
    return Claim("ours: Chebyshev needs fewer", measured, "fewer", is_fewer)


def draw_row(
    figure: Figure, recovery: Recovery, top: float, drawn: tuple[int, ...], name: str
) -> None:
    """The picture, some sums of the series, and the direct light, side by side."""
    gain = 0.9 / np.quantile(recovery.to_picture(recovery.sums[0]), 0.98)

    def view(light: np.ndarray, label: str, note: str) -> tuple[np.ndarray, str, str]:
        image = figures.light(recovery.scene, recovery.to_picture(light), gain)
        return image, label, note

    views = [view(recovery.sums[0], name, f"error {recovery.errors[0]:.2g}")]
    for n in drawn:
        label = "1 iteration" if n == 1 else f"{n} iterations"
        note = f"error {recovery.errors[n]:.2g}"
        views.append(view(recovery.sums[n], label, note))
    views.append(view(recovery.l_d, r"direct light $l_d$", "the truth"))
    figures.pictures(figure, top, views, gap=20)


def draw(shade: Recovery, gloss: Recovery) -> Figure:
    figure = figures.page(
        900,
        "Figure 6: the inverse series undoes shadowed and glossy scenes alike",
        "Above: a lamp, a block, and light that bounces into its shadows. "
        "Below: glossy walls in even light.",
        "Iterations take the bounces out, "
        "until shadows and highlights are as they were; below 0 is black.",
    )
    draw_row(figure, shade, 130, DRAWN_SHADOWS, "lamp and block")
    draw_row(figure, gloss, 370, DRAWN_GLOSS, "glossy walls")
    box = (85, 620, 860, 210)
    title = "Error of the direct light"
    axes = figures.graph(figure, box, title, "iteration", "relative error")
    curves = ((shade, "shadows", "#5cc8ff"), (gloss, "gloss", "#ffb347"))
    for recovery, name, colour in curves:
        label = f"{name}: rho(R) = {recovery.rho:.2f}, 1 % after {recovery.steps}"
        axes.plot(recovery.errors, color=colour, lw=2, label=label)
    axes.axhline(RTOL, color=FAINT, lw=1, ls=":")
    axes.set_xlim(0, ITERATIONS)
    figures.legend(axes)
    return figure


def camera_radius(n: int, options: Options) -> float:
    """Spectral radius of R of the glossy box as one camera and one projector see it."""
    scene = glossy_box(n, options.smoke)
    T = scene.transport(scene.first_bounce, options.device, on_dark="mask")
    return max(channel.spectral_radius for channel in ltcl.analyze(T).channels)


def main() -> None:
    options = parse_options(__doc__)
    sizes = SMOKE_SIZES if options.smoke else Sizes()
    shade = with_shadows(sizes.shadows, options.device)
    gloss = with_gloss(sizes.gloss, options.smoke)
    unknowns = []
    errors = []
    albedos = []
    for recovery in (shade, gloss):
        unknowns.append(recovery.l_d.shape[1])
        errors.append([float(f"{error:.3g}") for error in recovery.errors])
        albedos.append(float(recovery.scene.albedo.max()))
    facts = {
        "unknowns": unknowns,
        "relative error after n iterations": errors,
        "largest albedo": albedos,
    }
    listed = claims(shade, gloss, camera_radius(sizes.camera, options))
    title = "Figure 6: shadows and gloss"
    figures.conclude(options, title, listed, facts, lambda: draw(shade, gloss))


if __name__ == "__main__":
    main()
