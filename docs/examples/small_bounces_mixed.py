# SPDX-License-Identifier: BSD-3-Clause
"""
Bounces with sliders
====================

After separation each bounce can have a strength of its own: 0 switches it off, 2 doubles it, and -1
takes it away twice. ``ltcl view`` has these sliders in the browser.
"""

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.box(14, sides=3, albedo=[(0.85, 0.4, 0.3), (0.85, 0.75, 0.4), (0.8, 0.5, 0.7)])
T = corner.transport()
seen = T @ (0.2 + 0.6 * corner.sample(ltcl.scenes.landscape(300, 300)))
parts = ltcl.separate(T, seen, bounces=3)


def mixed(*strengths, rest=1.0):
    """The picture with bounces 1, 2 and 3 of these strengths."""
    light = parts.direct + rest * parts.rest
    return light + sum(s * bounce for s, bounce in zip(strengths, parts.bounces, strict=True))


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(light, size=320, supersample=2)


mixes = {
    "as it is\n1, 1, 1": mixed(1, 1, 1),
    "direct light\n0, 0, 0": mixed(0, 0, 0, rest=0),
    "first bounce only more\n3, 1, 1": mixed(3, 1, 1),
    "later bounces only more\n1, 3, 6": mixed(1, 3, 6),
}
figure = pictures({name: view(0.8 * light) for name, light in mixes.items()})
figure

# sphinx_gallery_thumbnail_number = 4
