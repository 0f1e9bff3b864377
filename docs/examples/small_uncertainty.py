# SPDX-License-Identifier: BSD-3-Clause
"""
How sure is a bounce?
=====================

A measured T is noisy, and so are the bounces that are found with it. ``std`` says by how much,
pixel by pixel. Here the truth is known: where ltcl says one standard deviation, about two thirds of
the errors are within it.
"""

import numpy as np

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(14, albedo=0.75)
true = corner.transport().to_numpy()
random = np.random.default_rng(0)
measured, again = (true + 3e-4 * random.normal(size=true.shape) for _ in range(2))
# Two measurements tell.
T = ltcl.Transport(measured, corner.grid, noise=ltcl.Transport(again, corner.grid))

white = (true @ np.ones(len(true))).reshape(corner.grid)
parts = ltcl.separate(T, white, bounces=2)
exact = ltcl.separate(ltcl.Transport(true, corner.grid), white, bounces=2)


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(light, size=320, supersample=2)


rows = []
for k in (0, 1):
    error = np.abs(parts.bounces[k] - exact.bounces[k])
    std = parts.std.bounces[k]
    one, two = np.mean(error < std), np.mean(error < 2 * std)
    print(f"bounce {k + 1}: {one:.0%} of the errors are within one deviation, {two:.0%} within two")
    bright, times = 0.8 / parts.bounces[k].max(), 0.8 / error.max()
    rows.append(
        {
            f"bounce {k + 1}": view(bright * parts.bounces[k]),
            f"its error\n{times / bright:.0f} times as bright": view(times * error),
            f"what ltcl says\n{times / bright:.0f} times as bright": view(times * std),
        }
    )
figure = pictures(*rows)
figure

# sphinx_gallery_thumbnail_number = 3
