# SPDX-License-Identifier: BSD-3-Clause
"""
What is out of reach
====================

A projector cannot take light away. Next to something bright, a place cannot be darker than the
light that bounces into it. ltcl finds the best pattern there is, proves how good it is, and shows
where light is missing (orange) or too much (blue).
"""

import numpy as np

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(16, albedo=0.85)
T = corner.transport()

wanted = np.full(corner.grid, 0.02)  # a dark corner ...
wanted[4:12, 3:11] = 0.9  # ... with a bright window on the left wall
wanted[2:5, 20:24] = 1.6  # and a spot that no projector is bright enough for

result = ltcl.compensate(T, wanted)
print(f"error {result.error:.1%}; no pattern can have less than {result.error - result.gap:.1%}")

missing = wanted - result.appearance
shown = np.repeat(0.15 * wanted[..., None], 3, axis=2)
shown += np.clip(missing, 0, None)[..., None] * 3 * (1.0, 0.45, 0.0)
shown += np.clip(-missing, 0, None)[..., None] * 6 * (0.1, 0.4, 1.0)


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(light, size=320, supersample=2)


figure = pictures(
    {"wanted": view(wanted), "seen": view(result.appearance), "missing, and too much": view(shown)},
    width=1000,
)
figure

# sphinx_gallery_thumbnail_number = 4
