# SPDX-License-Identifier: BSD-3-Clause
"""
One pixel alone
===============

Random walks find the direct light of single pixels, without the others. Each value has a standard
error; ask for a smaller one, and more walks are taken.
"""

import numpy as np

import ltcl
from ltcl.plots.page import FAINT, GRID, INK, PAPER, figure_of

corner = ltcl.scenes.box(12, sides=3, albedo=0.45)
T = corner.transport(first_bounce=corner.first_bounce)
(S,) = T.systems
b = (T @ (0.3 + 0.7 * corner.sample(ltcl.scenes.landscape(300, 300)[..., 0]))).ravel()
pixel = 200
truth = ltcl.solve(S, b, "gmres", rtol=1e-6).x[pixel]

figure = figure_of(800, 400)
axes = figure.add_axes((0.1, 0.15, 0.86, 0.75), facecolor=PAPER)
counts = 4 ** np.arange(1, 9)
for seed, colour in enumerate(("#5cc8ff", "#ffb347", "#8bd17c")):
    solves = [
        ltcl.solve(S, b, "monte_carlo", pixels=[pixel], samples=int(n), seed=seed) for n in counts
    ]
    values = [float(s.x[0]) for s in solves]
    errors = [float(s.standard_error[0]) for s in solves]
    axes.errorbar(
        counts * 1.08**seed, values, errors, fmt="o", color=colour, capsize=3, label=f"seed {seed}"
    )
axes.axhline(truth, color=INK, ls=":", label="exact")
axes.set_xscale("log")
axes.set_xlabel("walks", color=FAINT)
axes.set_title(
    "direct light of one pixel, with its standard error", color=INK, loc="left", fontsize=11
)
axes.grid(color=GRID)
axes.tick_params(colors=FAINT)
axes.spines[:].set_visible(False)
axes.legend(frameon=False, labelcolor="linecolor")
figure

# %%
# An error can be asked for in place of a number of walks:

few = ltcl.solve(S, b, "monte_carlo", pixels=[pixel], error=2e-3)
print(f"{few.x[0]:.4f} ± {few.standard_error[0]:.4f}, exact {truth:.4f}")
print(few.reason)

# sphinx_gallery_thumbnail_number = 1
