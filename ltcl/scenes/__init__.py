# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic scenes with their light transport, and a picture to show on them."""

from __future__ import annotations

from ltcl.scenes.blocks import Block
from ltcl.scenes.box import box
from ltcl.scenes.dihedral import dihedral
from ltcl.scenes.form_factor import FormFactor
from ltcl.scenes.glossy import glossy
from ltcl.scenes.landscape import landscape
from ltcl.scenes.light_field import GlossyScene
from ltcl.scenes.patches import Patches, cut
from ltcl.scenes.scene import Scene
from ltcl.scenes.trihedral import trihedral
from ltcl.scenes.visibility import visibility

__all__ = [
    "Block",
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
