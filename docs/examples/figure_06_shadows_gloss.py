# SPDX-License-Identifier: BSD-3-Clause
"""
Figure 6: shadows and gloss
===========================

A lamp and a block that casts a shadow; below, glossy walls. In both the direct light comes back:
shadows get as dark as they are, and highlights as sharp.

``bench/fig6.py`` computes and draws it. Here the rooms are smaller, and gloss has fewer directions.
"""

import fig6
import ltcl

shade = fig6.with_shadows(6, ltcl.open_device())
gloss = fig6.with_gloss(4, smoke=True)
figure = fig6.draw(shade, gloss)
figure

# sphinx_gallery_thumbnail_number = 6
