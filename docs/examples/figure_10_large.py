# SPDX-License-Identifier: BSD-3-Clause
"""
Figure 10: every pixel lights every other
=========================================

A picture on a corner of two coloured walls, the pattern that makes it, and its light by bounces. T
is never formed: its rows are compressed as they come.

``bench/resolution131k.py`` does this for 131 072 pixels; here are 2048, by the same code. The
record of the large one stands in :doc:`../auto_tutorials/6_large`.
"""

import ltcl
import resolution131k as large
from _harness import Options

rows = large.Bounce(32, large.REFERENCE)
built = large.build(Options(smoke=True, json=None, plot=None, device=ltcl.open_device()), rows)
images, errors = large.pictures(rows, built)
names = ["pattern", "direct", "bounce 1", "bounce 2"]
figure = large.draw(names, images)
figure

# %%
# Errors against the truth, which all numbers of the rows give:

for name, error in zip(names, errors, strict=True):
    print(f"{name}: {error:.2%}")
print(f"{built.T.nbytes / 1e6:.2f} MB in place of {3 * 4 * rows.shape[0] ** 2 / 1e6:.0f} MB")

# sphinx_gallery_thumbnail_number = 3
