# SPDX-License-Identifier: BSD-3-Clause
"""
I have a matrix
===============

You have measured or computed light transport yourself, and it is in a file. This page reads it,
asks whether it is good enough, and uses it: with its noise, and with pixels that no light reaches.
"""

# %%
# What ltcl expects
# -----------------
#
# One matrix T for each colour. Column j is the picture that the camera sees when projector pixel j
# alone is lit with light of 1, unrolled row by row. The picture is on the same grid as the
# projector, so T is square. The numbers are *linear* light: twice the light, twice the number. Undo
# the gamma of the camera first.
#
# We make such a file here: two white walls that meet in a corner, 12 x 24 pixels. To be like a
# measured one it has noise, and three projector pixels miss the walls. A file with all of T is only
# for few pixels, and so pictures on this page are coarse: 288 x 288 numbers here would be 1.7e10,
# 69 GB, for 256 x 512 pixels. :doc:`6_large` says how these are kept.

import tempfile
from pathlib import Path

import numpy as np
import scipy.io

import ltcl
from ltcl.plots import pictures

folder = Path(tempfile.mkdtemp())
corner = ltcl.scenes.dihedral(12, albedo=0.7)
true = corner.transport().to_numpy()
random = np.random.default_rng(0)
lit = np.ones(len(true))
lit[[100, 101, 125]] = 0
measured = true * lit + 3e-4 * random.normal(size=true.shape)

np.save(folder / "T.npy", measured)
scipy.io.savemat(folder / "T.mat", {"LTM": measured})

# %%
# Read it
# -------
#
# An ``.npy`` file holds the numbers only. The grid, height and width, you have to tell. A ``.mat``
# file has names in it: without ``variable=`` ltcl looks for ``LTM``.

T = ltcl.load(folder / "T.npy", grid=(12, 24))
same = ltcl.load(folder / "T.mat", grid=(12, 24))
print(T.shape, T.grid, np.abs(T.to_numpy() - same.to_numpy()).max())

# %%
# A wrong grid is the most common mistake. Rows of T are then smooth on another grid, and ltcl says
# so:

import logging

logger, said = logging.getLogger("ltcl"), []
handler = logging.Handler()
handler.emit = lambda record: said.append(record.getMessage())
logger.addHandler(handler)
ltcl.load(folder / "T.npy", grid=(24, 12))
print("\n".join(said))

# %%
# Look at it
# ----------
#
# A column of T is what one projector pixel lights. A row is where the light of one camera pixel
# comes from. The largest number is the lit pixel itself; the rest, here 20 times as bright, is
# light that bounced.

pixel = 6 * 24 + 8
column, row = (
    20 * T.to_numpy()[at].reshape(T.grid) for at in ((slice(None), pixel), (pixel, slice(None)))
)
white = T @ np.ones(T.grid)
figure = pictures({"one column\n× 20": column, "one row\n× 20": row, "all pixels lit": 0.8 * white})
figure

# %%
# No light leaves the three pixels that miss the walls. ltcl found them, and will not use them:

print(T.dark_note)

# %%
# Is it good enough?
# ------------------
#
# ``analyze`` answers in two sentences. They come from many numbers (:doc:`../reference/json` lists
# them).

analysis = ltcl.analyze(T)
print(analysis.verdict.text)

# %%
# Here it finds fault with bounces: noise can make one a little negative, which no light is. And it
# names the part of the picture where the three pixels are.
#
# How large the noise is was not told: it is estimated from T itself, where T should be smooth.

print(f"noise {np.max(T.noise.floor):.2g}, in truth 3e-4")

# %%
# Use it
# ------

wanted = 0.5 * corner.sample(ltcl.scenes.landscape(240, 480)[..., 1]) + 0.2
result = ltcl.compensate(T, wanted, gain="auto")
print(f"error {result.error:.1%} at {result.gain:.0%} of the brightness")
lights = {"wanted": wanted, "pattern": result.pattern, "seen": result.appearance / result.gain}
figure = pictures(
    {name: corner.view(light, size=320, supersample=2) for name, light in lights.items()}
)
figure

# %%
# A camera of more pixels
# -----------------------
#
# Most cameras see more pixels than were projected. T then has a row for each pixel of the camera,
# and is not square: tell ltcl ``camera_grid``, too. Here each projector pixel is 8 x 8 pixels of
# the camera.

fine = ltcl.scenes.refine(corner, 8)
walls = fine.transport()
columns = []
for pixel in np.eye(len(true)).reshape(-1, *corner.grid):
    light = pixel.repeat(8, axis=0).repeat(8, axis=1)
    columns.append((walls @ light).ravel())
np.save(folder / "camera.npy", np.stack(columns, axis=1))

C = ltcl.load(folder / "camera.npy", grid=corner.grid, camera_grid=fine.grid)
print(C.shape, C.grid, C.camera_grid)

# %%
# What is wanted, and what is seen, are then pictures of the camera. The projector still has its own
# pixels, of which the error tells.

wanted = 0.5 * fine.sample(ltcl.scenes.landscape(240, 480)[..., 1]) + 0.2
result = ltcl.compensate(C, wanted, gain="auto")
print(f"error {result.error:.1%} at {result.gain:.0%} of the brightness")
lights = {"wanted": wanted, "seen": result.appearance / result.gain}
figure = pictures({name: fine.view(light, size=400) for name, light in lights.items()})
figure

# %%
# Such a T has no S, and so no bounces: for these the grids must be one.

from ltcl.errors import InputError

try:
    ltcl.separate(C, result.appearance, bounces=2)
except InputError as error:
    print(error)

# %%
# How sure are bounces?
# ---------------------
#
# Noise of T makes the bounces uncertain, and the more so the later the bounce. ``std`` has a number
# for each pixel. Read it before you believe a small bounce.

parts = ltcl.separate(T, white, bounces=3)
for number, (light, std) in enumerate(zip(parts.bounces, parts.std.bounces, strict=True), start=1):
    print(f"bounce {number}: {light.mean():.3f} ± {np.sqrt((std**2).mean()):.4f} in a pixel")

# %%
# Less noise
# ----------
#
# ``denoise`` makes use of what is known about light: what pixel i sends to j, pixel j sends to i,
# and far from the direct light T is smooth.

better = ltcl.denoise(T)


def error(M):
    """Error of the light that bounced; the diagonal, the direct light, counts as right."""
    off = (M.to_numpy() - true * lit) * (1 - np.eye(len(true)))
    return np.linalg.norm(off) / np.linalg.norm(true * (1 - np.eye(len(true))))


print(f"error of the entries: {error(T):.1%} measured, {error(better):.1%} denoised")
ltcl.save(folder / "T.npz", better)

# %%
# In a terminal
# -------------
#
# .. code-block:: sh
#
#    # the verdict, and what it comes from
#    ltcl analyze T.npy --grid 12x24
#    # from one format to another; .npz keeps the grid, and no further command needs it
#    ltcl convert T.mat T.npz --grid 12x24
#    ltcl convert camera.npy camera.npz --grid 12x24 --camera-grid 96x192
#    ltcl compensate T.npz picture.png --resize crop --out out
#    # a photograph of the scene in linear light, or what 'compensate' has made
#    ltcl separate T.npz out/picture_appearance.exr --out out
#
# Formats and their limits stand in :doc:`../reference/formats`; noise, dark pixels and deviations
# in :doc:`../guide/noise`.

# sphinx_gallery_thumbnail_number = 7
