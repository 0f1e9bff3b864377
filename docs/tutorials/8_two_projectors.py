# SPDX-License-Identifier: BSD-3-Clause
"""
Two projectors on one corner
============================

Two projectors, one on each side, light a corner of two white walls and overlap around its crease.
One camera has scanned both. They become one projector: brighter where they overlap, without a seam,
and with the light undone that bounces between the walls.
"""

# %%
# Scans with one camera
# ---------------------
#
# Each projector was scanned while the other one was off, and the camera did not move. S, the light
# between the walls, is the same for both: one full scan, on the camera's 256 x 512 pixels, tells
# it. Of each projector only F was scanned, the light that it throws itself, by
# ``strategy="direct"``, in some 40 photographs. Here all of this is computed. The right projector
# is brighter and has other pixels.

import numpy as np
import scipy.sparse

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.refine(ltcl.scenes.dihedral(16, albedo=0.7), 16)
scene = corner.transport()
height, width = corner.grid


def direct_light(grid, left, right, brightness):
    """F (camera pixels, projector pixels) of a projector on the columns from left to right."""

    def weights(camera, begin, end, pixels):
        place = (np.arange(camera) + 0.5) / camera
        at = (place - begin) / (end - begin) * pixels - 0.5
        blur = np.exp(-0.5 * ((at[:, None] - np.arange(pixels)) / 0.7) ** 2) / (0.7 * 2.507)
        return scipy.sparse.csr_array(np.where(blur > 1e-4, blur, 0.0))

    rows = weights(height, -0.05, 1.05, grid[0])
    columns = weights(width, left, right, grid[1])
    F = scipy.sparse.csr_array(brightness * scipy.sparse.kron(rows, columns))
    return ltcl.Transport(F, grid, camera_grid=corner.grid)


grids = [(200, 280), (230, 320)]
direct = [direct_light(grids[0], -0.05, 0.65, 0.7), direct_light(grids[1], 0.35, 1.05, 0.9)]


def on_the_walls(light):
    """The walls (h, w) under direct light and all that bounces."""
    return scene @ (light / 0.7)


whites = [on_the_walls(F @ np.ones(F.grid)) for F in direct]
figure = pictures({"left": corner.view(whites[0] / 1.5), "right": corner.view(whites[1] / 1.5)})
figure

# %%
# As one
# ------
#
# Where the two overlap is in their scans. Of small projectors with full scans,
# ``ltcl.combine([T_left, T_right])`` finds S by itself.

T = ltcl.combine(direct, scene=scene)
print(T)
print(T.gamut)

# %%
# A picture
# ---------
#
# What the camera is to see is given on its own grid. There is a pattern for each projector; both
# fade out towards where the other one goes on alone.

desired = 0.15 + 0.8 * corner.sample(ltcl.scenes.landscape(480, 960)[..., 1])
c = ltcl.compensate(T, desired, gain="auto")
left, right = c.patterns
print(f"error {c.error:.1%} at {c.gain:.0%} of the brightness")
figure = pictures({"pattern of the left": left, "pattern of the right": right})
figure

# %%
# Both together show the picture:

seen = ltcl.relight(T, [left, right])
figure = pictures(
    {"wanted": corner.view(desired), "seen": corner.view(seen / c.gain)},
)
figure

# %%
# A nudge
# -------
#
# How soft are the seams? Let the left projector slip by half of its pixels. What a careless cut
# down the middle would show is beside it.

slip = 0.5 * 0.7 / 280
slipped = direct_light(grids[0], -0.05 + slip, 0.65 + slip, 0.7)
even = np.full(corner.grid, 0.5)


def after(T):
    """The walls under patterns for an even picture, when the left projector has slipped."""
    left, right = ltcl.compensate(T, even).patterns
    return on_the_walls(slipped @ left + direct[1] @ right)


columns = [np.linspace(-0.05, 0.65, 280), np.linspace(0.35, 1.05, 320)]
cut = [
    np.broadcast_to((columns[0] < 0.45) * 1.0, grids[0]),
    np.broadcast_to((columns[1] > 0.45) * 1.0, grids[1]),
]
shown = {"shared": after(T), "cut": after(ltcl.combine(direct, scene=scene, blend=cut))}
for name, picture in shown.items():
    row = picture[height // 2, 160:256]
    print(f"{name}: {np.ptp(row) / 0.5:.1%} of the brightness, side by side")
figure = pictures({name: corner.view(1.4 * picture) for name, picture in shown.items()})
figure

# %%
# Bounces
# -------
#
# Bounces are of the scene, whichever projector the light came from. They are separated in the
# camera's pixels.

b = ltcl.separate(T, seen, bounces=2)
figure = pictures(
    {
        "direct": corner.view(b.direct / c.gain),
        "first bounce, x 3": corner.view(3 * b.bounces[0] / c.gain),
    }
)
figure

# %%
# Keep it, and look at it
# -----------------------
#
# ``ltcl.save("both.npz", T)`` keeps the scans and how both share their light; ``ltcl view
# both.npz`` shows them in the browser, with both patterns side by side. Weights, black and colours
# stand in :doc:`../guide/projectors`.

# sphinx_gallery_thumbnail_number = 2
