# SPDX-License-Identifier: BSD-3-Clause
"""
Figure 4: the series takes the bounces out
==========================================

A closed box with a red and a green wall. Each term of the inverse series takes away more of the
light that bounced: the first takes too much, the second gives some of it back, and so on. What is
left in the end is the direct light.

``bench/fig4.py`` computes and draws it, and checks what the paper says about it with 16 patches
along a wall; here are 8.
"""

import fig4
import ltcl

found = fig4.measure(8, ltcl.open_device())
figure = fig4.draw(found)
figure

# %%
# The error after n terms:

for n in (0, 1, 2, 5, 10, 20, 30):
    print(f"{n:2} terms: {found.errors[n]:.1e}")

# sphinx_gallery_thumbnail_number = 8
