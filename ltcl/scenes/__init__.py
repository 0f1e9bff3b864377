# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic scenes with their light transport, and a picture to show on them.

Scenes to build: `box`, `dihedral`, `trihedral`, of `walls` and `blocks` cut into `patches`; `scene` is what
they become. Who looks: `viewer`; what shines: `light`; what rays meet: `rays`. Pictures: `landscape`
from `noise`. How diffuse patches light each other is in `ltcl.scenes.exchange`, gloss in
`ltcl.scenes.gloss`.
"""

from __future__ import annotations

from ltcl.scenes.blocks import Block
from ltcl.scenes.box import box
from ltcl.scenes.dihedral import dihedral
from ltcl.scenes.exchange.corner import CornerRows
from ltcl.scenes.exchange.form_factor import FormFactor
from ltcl.scenes.exchange.visibility import visibility
from ltcl.scenes.gloss.glossy import glossy
from ltcl.scenes.gloss.light_field import GlossyScene
from ltcl.scenes.landscape import landscape
from ltcl.scenes.patches import Patches, cut
from ltcl.scenes.scene import Scene
from ltcl.scenes.trihedral import trihedral

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
