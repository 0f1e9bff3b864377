# SPDX-License-Identifier: BSD-3-Clause
"""
A webcam and a second display
=============================

A projector on the second output, a webcam on a cable: ltcl shows the patterns and takes the
photographs itself. It measures how long a picture takes from one to the other, and checks each
frame for old and half-changed pictures.
"""

# %%
# The real one
# ------------
#
# Install the extras ``camera`` and ``projector`` (:doc:`../install`). Put this into
# ``scan/acquisition.toml``:
#
# .. code-block:: toml
#
#    [rig]
#    kind = "live"
#    [rig.camera]
#    kind = "opencv"       # or "gphoto2" for a camera on a USB cable
#    source = 0            # the first webcam
#    [rig.display]
#    grid = [135, 240]     # pixels that the projector is divided into
#    index = 1             # the second display
#
# and then
#
# .. code-block:: sh
#
#    ltcl acquire plan scan       # how many photographs, how long, how good
#    ltcl acquire run scan
#    ltcl view scan               # in another terminal: watch it in the browser while it runs
#
# On Linux ltcl switches the automatics of the webcam off, or refuses a camera whose automatics stay
# on. Elsewhere fix the exposure with the camera's own program, and tell ltcl: ``seconds = 0.033``
# under ``[rig.camera]``.
#
# The loop, with a camera of your own
# -----------------------------------
#
# Your hardware is another one? Any object will do that has these three: ``projector_grid``,
# ``channels`` (1 or 3), and ``photograph(codes, seconds)``. It shows the codes, numbers from 0 to 1
# on the grid, waits, exposes, and gives the image back as the camera made it.
#
# This one has no hardware: it asks a simulated corner of 256 x 512 pixels. Put the two lines of
# your display and of your camera there.

import tempfile
from pathlib import Path

import numpy as np

import ltcl
from ltcl.acquisition import Report, Setup, VirtualRig
from ltcl.plots import pictures

corner = ltcl.scenes.refine(ltcl.scenes.dihedral(16, albedo=0.7), 16)
simulated = VirtualRig(corner.transport(), corner.grid, bits=12, response="film", ambient=0.01)


class MyRig:
    """A projector and a camera."""

    projector_grid = (256, 512)
    channels = 1  # or 3, in colour
    bits = 12  # in use, of images of 16 bits

    def __init__(self):
        self.photographs = []

    def photograph(self, codes, seconds):
        """Show codes (h, w[, 3]), expose so long, return uint8, uint16 or float (H, W, 3)."""
        # display.show(codes); time.sleep(0.2)
        # image = camera.read(seconds)
        image = simulated.photograph(codes, seconds)
        self.photographs.append(image)
        return image


rig = MyRig()
store = Path(tempfile.mkdtemp()) / "corner.zarr"
T = ltcl.acquire(rig, geometry="aligned", strategy="sketch", store=store)
print(f"{len(rig.photographs)} photographs; T is {T.shape[0]} x {T.shape[1]}")
print(f"pictures by T are wrong by {Report.of(store).judged_error:.1%}")

# %%
# ``geometry="aligned"`` says that camera and projector have the same pixels, as here. Leave it out
# for a real camera: then stripes (Gray code) tell which pixel of the camera sees which one of the
# projector.
#
# These are four of the photographs. Coarse and finer patterns tell the light that bounces, which is
# smooth; the finest tell the direct light of each pixel: so these few do for 131 072 pixels. The
# last are of pictures that T is never made from: they tell its error
# (:doc:`../guide/photographs`).

chosen = {"a coarse pattern": 41, "a finer one": 68, "the finest": -21, "one that judges T": -5}
figure = pictures({name: rig.photographs[k] / 4095 for name, k in chosen.items()})
figure

# %%
# Project with it
# ---------------
#
# The wanted picture is compensated, turned into codes by the measured response of the projector,
# shown, and photographed.

setup = Setup.of(store)
wanted = 0.2 + 0.6 * corner.sample(ltcl.scenes.landscape(480, 960)[..., 0])
result = ltcl.compensate(T, wanted, gain="auto", background=setup.ambient)


def photograph_of(pattern):
    """The light on the walls under a pattern of light."""
    return simulated.radiance(setup.codes(pattern))


plain = photograph_of(np.clip(wanted, 0, 1))
exact = photograph_of(result.pattern)


def view(light):
    """The corner seen from in front, as bright as the wanted picture."""
    return corner.view(light * np.median(wanted) / np.median(light), size=480, supersample=2)


figure = pictures(
    {"wanted": view(wanted), "projected as it is": view(plain), "with ltcl": view(exact)}
)
figure

# %%
# When it was interrupted
# -----------------------
#
# All photographs are on disk. The same call again goes on with the next one, and gives the same T
# to the last bit; what is finished is read, and takes no photograph:

before = len(rig.photographs)
T = ltcl.acquire(rig, geometry="aligned", strategy="sketch", store=store)
print(f"{len(rig.photographs) - before} new photographs")

# sphinx_gallery_thumbnail_number = 9
