# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic scenes with their light transport, and a picture to show on them.

`builders` makes a `scene` of `walls` and blocks, cut into `patches`. Form factors: exact in
`exchange`, past blocks by `visibility` (`rays`), computed in each product in `form_factor`. Many
pixels in each patch: `refined`. Gloss: `ltcl.scenes.gloss`.
"""

from __future__ import annotations

from ltcl.scenes.builders import box, dihedral, trihedral
from ltcl.scenes.form_factor import FormFactor
from ltcl.scenes.gloss.glossy import GlossyScene, glossy
from ltcl.scenes.landscape import landscape
from ltcl.scenes.patches import Patches, cut
from ltcl.scenes.refined import RefinedScene, refine
from ltcl.scenes.scene import Scene
from ltcl.scenes.visibility import visibility
from ltcl.scenes.walls import Block

__all__ = [
    "Block",
    "FormFactor",
    "GlossyScene",
    "Patches",
    "RefinedScene",
    "Scene",
    "box",
    "cut",
    "dihedral",
    "glossy",
    "landscape",
    "refine",
    "trihedral",
    "visibility",
]
