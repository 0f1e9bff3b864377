# SPDX-License-Identifier: BSD-3-Clause
"""
A shadow removed
================

A lamp stands in a room, and a block casts its shadow. A projector fills the shadow in: ltcl finds the light that is missing, and
takes into account that it will bounce.
"""

import numpy as np

import ltcl
from ltcl.plots import pictures

block = ltcl.scenes.Block(corner=(0.35, 0.35, 0.0), size=(0.25, 0.25, 0.4), albedo=0.5)
room = ltcl.scenes.box(12, sides=3, albedo=0.6, occluder=block)
T = room.transport()

lamp = T @ (0.6 * room.irradiance((0.95, 0.75, 0.95)))  # what is seen without projector
even = T @ (0.6 * ltcl.scenes.box(12, sides=3).irradiance((0.95, 0.75, 0.95)).max() * np.ones(room.grid))
wanted = lamp.copy()
floor = slice(24, 36)  # columns of the third wall
wanted[:, floor] = np.maximum(lamp[:, floor], np.quantile(lamp[:, floor], 0.8))

# %%
# ``background`` is light that is there anyway, and that the projector cannot take away.

result = ltcl.compensate(T, wanted, background=lamp)
print(f"error {result.error:.1%}, {result.clipped:.1%} of the pattern clipped")


def view(light):
    """The room from above."""
    return room.view(light, size=320, supersample=2)


figure = pictures(
    {
        "under the lamp": view(lamp),
        "what the projector adds": view(result.pattern),
        "both together": view(result.appearance),
    }
)
