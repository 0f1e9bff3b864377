# SPDX-License-Identifier: BSD-3-Clause
"""
A shadow removed
================

A lamp stands in a room, and a block casts its shadow. A projector fills the shadow in: ltcl finds
the light that is missing, and takes into account that it will bounce.
"""

import numpy as np

import ltcl
from ltcl.plots import pictures

block = ltcl.scenes.Block(corner=(0.3, 0.3, 0.0), size=(0.25, 0.25, 0.4), albedo=0.5)
room = ltcl.scenes.box(14, sides=3, albedo=0.6, occluder=block)
empty = ltcl.scenes.box(14, sides=3, albedo=0.6)
place = (0.15, 0.3, 0.9)  # of the lamp: close to the walls, so that the shadow falls towards us

T = room.transport()
lamp = T @ room.irradiance(place)  # what is seen without the projector
floor = slice(2 * 14, 3 * 14)  # columns of the third wall
without_block = empty.transport() @ empty.irradiance(place)
wanted = lamp.copy()
wanted[:, floor] = np.maximum(lamp[:, floor], without_block[:, floor])

# %%
# ``background`` is light that is there anyway, and that the projector cannot take away.

result = ltcl.compensate(T, wanted, background=lamp)
print(f"error {result.error:.1%}, {result.clipped:.1%} of the pattern clipped")


def view(light):
    """The room from above, four times as bright."""
    return room.view(4 * light, size=320, supersample=2)


figure = pictures(
    {
        "under the lamp": view(lamp),
        "what the projector adds": view(result.pattern),
        "both together": view(result.appearance),
    }
)
figure

# sphinx_gallery_thumbnail_number = 2
