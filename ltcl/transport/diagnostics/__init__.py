# SPDX-License-Identifier: BSD-3-Clause
"""Diagnostics of a measured T = S F: reciprocity, one bounce, energy, and grid."""

from ltcl.transport.diagnostics.bounce import (
    PARTS_PER_SIDE,
    ambient,
    ambient_share,
    between_parts,
    negative_bounce,
    picture_parts,
)
from ltcl.transport.diagnostics.choice import bounce_spreads_of_system
from ltcl.transport.diagnostics.energy import Energy, check_energy
from ltcl.transport.diagnostics.grid import other_grid
from ltcl.transport.diagnostics.reciprocity import QUICK_ENTRIES, reciprocity_defect

__all__ = [
    "PARTS_PER_SIDE",
    "QUICK_ENTRIES",
    "Energy",
    "ambient",
    "ambient_share",
    "between_parts",
    "bounce_spreads_of_system",
    "check_energy",
    "negative_bounce",
    "other_grid",
    "picture_parts",
    "reciprocity_defect",
]
