# SPDX-License-Identifier: BSD-3-Clause
"""
A noisy T, denoised
===================

One column of T, as it was measured and after ``ltcl.denoise``: the light of one projector pixel on
the other wall. No other measurement was used, only what is known about light.
"""

import numpy as np

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(14, albedo=0.7)
true = corner.transport().to_numpy()
noise = 1e-3 * np.random.default_rng(0).normal(size=true.shape)
T = ltcl.Transport(true + noise, corner.grid)
better = ltcl.denoise(T)

pixel = 7 * 28 + 9
columns = {"true": true, "measured": T.to_numpy(), "denoised": better.to_numpy()}
shown = {}
for name, matrix in columns.items():
    off = np.abs(matrix - true)[~np.eye(len(true), dtype=bool)].mean()
    note = f"\nmean error {off:.1e}" if off else ""
    shown[name + note] = 100 * matrix[:, pixel].reshape(corner.grid)
figure = pictures(shown)
figure

# sphinx_gallery_thumbnail_number = 3
