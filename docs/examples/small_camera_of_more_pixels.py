# SPDX-License-Identifier: BSD-3-Clause
"""
A camera of more pixels
=======================

The camera has more pixels than the projector: T is then not square, and has no inverse. ltcl finds
the pattern whose picture is closest to the wanted one, as the camera sees it.
"""

import ltcl
from ltcl.acquisition import camera_map
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(10, albedo=0.7)
fine = 3  # pixels of the camera to one of the projector, along each side
place = camera_map(lambda x, y: ((x - 1) / fine, (y - 1) / fine), (30, 60), corner.grid)
T = ltcl.Transport(place @ corner.transport().to_numpy(), corner.grid, camera_grid=(30, 60))
print(T.shape, "projector", T.grid, "camera", T.camera_grid)

wanted = 0.25 + 0.5 * ltcl.images.resize(ltcl.scenes.landscape(240, 480)[..., 0], (30, 60))
result = ltcl.compensate(T, wanted)
print(f"error {result.error:.1%}: what is finer than a pixel of the projector cannot be had")

figure = pictures(
    {
        "wanted, 30 x 60": wanted,
        "pattern, 10 x 20": result.pattern,
        "seen, 30 x 60": result.appearance,
    }
)
figure

# sphinx_gallery_thumbnail_number = 4
