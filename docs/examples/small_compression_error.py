# SPDX-License-Identifier: BSD-3-Clause
"""
What compression costs, and where
=================================

The same T compressed three times. The fewer bytes, the more a picture differs from that of the
exact T; nowhere by a pattern that the eye would see at once, since it is smooth parts that are left
out.
"""

import numpy as np

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(16, albedo=0.8)
T = corner.transport()
pattern = 0.1 + 0.6 * corner.sample(ltcl.scenes.landscape(240, 480)[..., 1])
exact = T @ pattern


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(light, size=320, supersample=2)


above, below = (
    {f"exact\n{T.nbytes / 1e3:.0f} kB": view(exact)},
    {"error\n20 times as bright": view(0 * exact + 1e-6)},
)
for rtol in (0.003, 0.01, 0.05):
    C = ltcl.compress(T, rtol=rtol)
    seen = C @ pattern
    off = np.linalg.norm(seen - exact) / np.linalg.norm(exact)
    above[f"asked for {rtol:.1%}\n{C.nbytes / 1e3:.0f} kB"] = view(seen)
    below[f"off by {off:.2%}\n20 times as bright"] = view(20 * np.abs(seen - exact) + 1e-6)
figure = pictures(above, below)
figure

# sphinx_gallery_thumbnail_number = 9
