# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic scenes with their light transport, and a picture to show on them."""

from __future__ import annotations

from ltcl.scenes.box import box
from ltcl.scenes.dihedral import dihedral
from ltcl.scenes.glossy import glossy
from ltcl.scenes.landscape import landscape
from ltcl.scenes.light_field import GlossyScene
from ltcl.scenes.scene import Scene

__all__ = ["GlossyScene", "Scene", "box", "dihedral", "glossy", "landscape"]
