# SPDX-License-Identifier: BSD-3-Clause
"""
Figure 8: inverse by random walks
=================================

Each pixel of the direct light is the mean of random walks of its own. Thirty walks a pixel are
noisy; one exact product with their result (final gather) takes most of the noise out.

``bench/fig8.py`` computes and draws it with 5120 pixels, here are 500.
"""

import fig8
import ltcl

found = fig8.invert(10, ltcl.open_device())
figure = fig8.draw(found, fig8.measure(found, seeds=2))
figure

# sphinx_gallery_thumbnail_number = 3
