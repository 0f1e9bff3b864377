# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic scenes with their light transport, and a picture to show on them.

`builders` puts `walls` and blocks, cut into `patches`, together to a `scene`. Form factors: exact on the host
in `exchange`, past blocks by the rays of `visibility`, computed in each product in `form_factor`. What rays
meet: `rays`. Who looks: `viewer`. Gloss: `ltcl.scenes.gloss`. A target picture: `landscape`.
"""

from __future__ import annotations

from ltcl.scenes.builders import box, dihedral, trihedral
from ltcl.scenes.form_factor import CornerRows, FormFactor
from ltcl.scenes.gloss.glossy import GlossyScene, glossy
from ltcl.scenes.landscape import landscape
from ltcl.scenes.patches import Patches, cut
from ltcl.scenes.scene import Scene
from ltcl.scenes.visibility import visibility
from ltcl.scenes.walls import Block

__all__ = [
    "Block",
    "CornerRows",
    "FormFactor",
    "GlossyScene",
    "Patches",
    "Scene",
    "box",
    "cut",
    "dihedral",
    "glossy",
    "landscape",
    "trihedral",
    "visibility",
]
