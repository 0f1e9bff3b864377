# SPDX-License-Identifier: BSD-3-Clause
"""
Where it matters most
=====================

Not all of a picture can be had: the projector is not dark enough next to the bright wall.
``weights`` say where the error counts more. Here it is the middle of the right wall.
"""

import numpy as np

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(16, albedo=0.85)
T = corner.transport()

wanted = np.full(corner.grid, 0.03)
wanted[:, :16] = 0.8  # a bright left wall, whose light falls on the right one
wanted[4:12, 22:28] = 0.35

region = np.ones(corner.grid)
region[3:13, 20:30] = 20.0

plain = ltcl.compensate(T, wanted)
weighted = ltcl.compensate(T, wanted, weights=region)


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(light, size=320, supersample=2)


inside = region > 1


def off(result):
    """Relative error in the region."""
    return np.linalg.norm((result.appearance - wanted)[inside]) / np.linalg.norm(wanted[inside])


figure = pictures(
    {
        "wanted": view(wanted),
        f"all alike\nregion off by {off(plain):.0%}": view(plain.appearance),
        f"the region 20 times as important\noff by {off(weighted):.0%}": view(weighted.appearance),
    }
)
figure

# sphinx_gallery_thumbnail_number = 4
