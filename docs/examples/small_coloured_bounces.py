# SPDX-License-Identifier: BSD-3-Clause
"""
Light takes the colour of what it met
=====================================

White light falls on one red wall. The first bounce makes the blue wall and the floor purple and
red; each further one is redder.
"""

import numpy as np

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.box(
    14, sides=3, albedo=[(0.9, 0.25, 0.2), (0.45, 0.5, 0.9), (0.85, 0.85, 0.8)]
)
T = corner.transport(first_bounce="exact")

pattern = np.zeros((14, 42, 3))
pattern[:, :14] = 1.0  # the left wall

seen = T @ pattern
parts = ltcl.separate(T, seen, bounces=3)


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(light, size=320, supersample=2)


figure = pictures(
    {
        "seen": view(seen),
        "direct light": view(parts.direct),
        "all bounces": view(seen - parts.direct),
    },
    {
        f"bounce {k}\n{3**k} times as bright": view(3**k * light)
        for k, light in enumerate(parts.bounces, start=1)
    },
)
figure

# %%
# The colour of each part, in shares of red, green and blue:

for name, light in [
    ("direct", parts.direct),
    *((f"bounce {k}", b) for k, b in enumerate(parts.bounces, start=1)),
]:
    total = light.sum(axis=(0, 1))
    print(f"{name}: {np.round(total / total.sum(), 2)}")

# sphinx_gallery_thumbnail_number = 6
