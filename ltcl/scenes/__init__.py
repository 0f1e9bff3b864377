# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic scenes with exact light transport, and a picture to show on them."""

from __future__ import annotations

from ltcl.scenes.box import box
from ltcl.scenes.dihedral import dihedral
from ltcl.scenes.landscape import landscape
from ltcl.scenes.scene import Scene
from ltcl.scenes.trihedral import trihedral

__all__ = ["Scene", "box", "dihedral", "landscape", "trihedral"]
