# SPDX-License-Identifier: BSD-3-Clause
"""
Two projectors on one corner
============================

Two projectors, one on each side, light a corner of two white walls and overlap around its crease.
One camera has scanned both. They become one projector: brighter where they overlap, without a seam,
and with the light undone that bounces between the walls.
"""

# %%
# Two scans with one camera
# -------------------------
#
# Each projector was scanned while the other one was off, and the camera did not move. Here the
# scans are computed: S, the light between the walls, is the same for both, and F says what a
# projector lights. The right one is brighter and has other pixels.

import numpy as np

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(20, albedo=0.7)
S = corner.transport().to_numpy() / 0.7
height, width = corner.grid


def direct_light(grid, left, right, brightness):
    """F (camera pixels, projector pixels) of a projector on the columns from left to right."""

    def weights(camera, begin, end, pixels):
        place = (np.arange(camera) + 0.5) / camera
        at = (place - begin) / (end - begin) * pixels - 0.5
        return np.exp(-0.5 * ((at[:, None] - np.arange(pixels)) / 0.5) ** 2) / (0.5 * 2.507)

    rows = weights(height, -0.05, 1.05, grid[0])
    columns = weights(width, left, right, grid[1])
    return brightness * np.kron(rows, columns)


scans = []
for grid, left, right, brightness in (((22, 29), -0.05, 0.65, 0.7), ((26, 34), 0.35, 1.05, 0.9)):
    F = direct_light(grid, left, right, brightness)
    scans.append(ltcl.Transport((S @ F).astype(np.float32), grid, camera_grid=corner.grid))

whites = {"left": scans[0] @ np.ones(scans[0].grid), "right": scans[1] @ np.ones(scans[1].grid)}
figure = pictures({name: corner.view(white / 1.5) for name, white in whites.items()})
figure

# %%
# As one
# ------
#
# The two need nothing else: where they overlap is in their scans.

T = ltcl.combine(scans)
print(T)
print(T.gamut)

# %%
# A picture
# ---------
#
# What the camera is to see is given on its own grid. There is a pattern for each projector; both
# fade out towards where the other one goes on alone.

desired = 0.25 + 0.4 * corner.sample(ltcl.scenes.landscape(240, 480)[..., 1])
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
# How soft are the seams? Let the left projector slip by half a pixel. What a careless cut down the
# middle would show is beside it.

F = direct_light(scans[0].grid, -0.05 + 0.012, 0.65 + 0.012, 0.7)
slipped = ltcl.Transport((S @ F).astype(np.float32), scans[0].grid, camera_grid=corner.grid)
even = np.full(corner.grid, 0.5)


def after(T):
    left, right = ltcl.compensate(T, even).patterns
    return slipped @ left + scans[1] @ right


columns = [np.linspace(-0.05, 0.65, 29), np.linspace(0.35, 1.05, 34)]
cut = [
    np.broadcast_to((columns[0] < 0.45) * 1.0, scans[0].grid),
    np.broadcast_to((columns[1] > 0.45) * 1.0, scans[1].grid),
]
shown = {"shared": after(T), "cut": after(ltcl.combine(scans, blend=cut))}
for name, picture in shown.items():
    print(f"{name}: {np.ptp(picture[10, 12:18]) / 0.5:.1%} of the brightness, side by side")
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
# ``ltcl.save("both.npz", T)`` keeps both scans and how they share their light; ``ltcl view
# both.npz`` shows them in the browser, with both patterns side by side. Weights, black and colours
# stand in :doc:`../guide/projectors`.

# sphinx_gallery_thumbnail_number = 2
