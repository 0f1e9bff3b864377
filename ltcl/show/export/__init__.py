# SPDX-License-Identifier: BSD-3-Clause
"""The geometry of a scan as static files for other software.

scan       what scans tell: the map from camera to projector, and the calibration
projector  the maps, the share of each projector and its black, from scans with one camera
maps       dense maps as EXR, NPZ and for OpenCV's remap; masks as PNG
mpcdi      MPCDI: mpcdi.xml with warp, alpha and beta maps, one region a projector
mesh       a warp mesh as Wavefront OBJ
cube       response and colours as .cube
loss       what static files lose: light between walls depends on the picture
"""

from __future__ import annotations

from ltcl.show.export.cube import write_cubes
from ltcl.show.export.loss import MapLoss
from ltcl.show.export.maps import write_maps, write_masks
from ltcl.show.export.mesh import write_mesh
from ltcl.show.export.mpcdi import write_mpcdi
from ltcl.show.export.projector import ExportedProjector, read_projectors, share_light
from ltcl.show.export.scan import ExportedScan, read_scans

__all__ = [
    "ExportedProjector",
    "ExportedScan",
    "MapLoss",
    "read_projectors",
    "read_scans",
    "share_light",
    "write_cubes",
    "write_maps",
    "write_masks",
    "write_mesh",
    "write_mpcdi",
]
