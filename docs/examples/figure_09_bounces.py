# SPDX-License-Identifier: BSD-3-Clause
"""
Figure 9: every bounce as a picture
===================================

Green light falls on the left wall only. The first bounce is on the right wall, the second on the
left one, and so on: no flat wall lights itself. Below, a glossy board stands in the corner; its
highlight is in the direct light alone.

``bench/fig9.py`` computes and draws it, there with 24 and 14 patches along a wall, here with 12 and
5.
"""

import fig9
import ltcl

device = ltcl.open_device()
plain = fig9.diffuse(12, device)
board = fig9.with_board(5, smoke=True, device=device)
figure = fig9.draw(plain, board)
figure

# sphinx_gallery_thumbnail_number = 5
