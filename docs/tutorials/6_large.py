# SPDX-License-Identifier: BSD-3-Clause
"""
131 072 pixels and more
=======================

T has as many numbers as the projector has pixels, times as many as the camera has. With 131 072
pixels, 256 x 512, these are 1.7e10 numbers, 69 GB for each colour. This page shows how ltcl makes
that small, with a T of 24 x 48 pixels, of which a computer still holds all numbers; then what was
measured with the large one, and its pictures.
"""

# %%
# Look at the size first
# ----------------------

import json
from pathlib import Path

import numpy as np

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(24, albedo=0.7)
T = corner.transport()
N = T.shape[0]
print(f"{N} pixels: {4 * N**2 / 1e6:.0f} MB;  131072 pixels: {4 * 131072**2 / 1e9:.0f} GB")

# %%
# Compress
# --------
#
# Bounced light is smooth. So most of T can be said with few numbers, as a photograph can be said
# with a small JPEG. ``rtol=0.01`` asks that pictures lose at most 1 %; ltcl measures it on pictures
# that it has not seen before.

C = ltcl.compress(T, rtol=0.01)
print(
    f"{T.nbytes / 1e6:.1f} MB became {C.nbytes / 1e6:.2f} MB; pictures lose at most {C.error:.2%}"
)

# %%
# A compressed T is used in the same way as the other one, and is faster.

wanted = 0.3 + 0.6 * corner.sample(ltcl.scenes.landscape(240, 480)[..., 0])
exact = ltcl.compensate(T, wanted, gain="auto")
small = ltcl.compensate(C, wanted, gain="auto")


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(light, size=320, supersample=2)


seen = (T @ small.pattern) / small.gain  # of the small pattern, by the T that is exact
off = np.linalg.norm(seen - wanted) / np.linalg.norm(wanted)
figure = pictures(
    {
        "pattern by T": view(exact.pattern),
        "pattern by the compressed T": view(small.pattern),
        f"seen under the latter\n{off:.2%} from what was wanted": view(seen),
    }
)
figure

# %%
# Better than 1 % all the same? Let the compressed T take the steps, and the exact one judge them:
# ``exact=T``.

refined = ltcl.compensate(C, wanted, gain=0.9 * small.gain, exact=T, rtol=1e-4)
print(f"error {refined.error:.3%}")

# %%
# Where the same T is used for very many pictures, invert it once. From then on each picture takes
# one product.

inverse = ltcl.invert(C, rtol=0.02)
again = ltcl.compensate(C, wanted, gain=small.gain, inverse=inverse, rtol=0.02)
print(f"error {again.error:.2%}")

# %%
# What was measured with 131 072 pixels
# -------------------------------------
#
# ``bench/resolution131k.py`` makes a corner of 256 x 512 pixels in colour, of which each lights all
# of the other wall. Its rows stream by and are compressed as they come; T itself is never there.
# This is its record, read when this page was built:

record = json.loads(Path("../../bench/results/resolution131k-xeon-pocl3.0.json").read_text())
facts = record["facts"]
bounces, patterns = (
    float(size) / 1e6 for size in facts["bytes of T, for bounces and for patterns"].split(",")
)
print(record["device"], "- 2 cores\n")
print(
    f"T in full                 {facts['bytes of R, were it dense'] / 1e9:8.0f} GB in three colours"
)
print(f"compressed, for bounces   {bounces:8.1f} MB")
print(f"compressed, for patterns  {patterns:8.1f} MB")
print(f"to compress it            {facts['compressing A, s'] / 60:8.1f} minutes")
print(f"to compensate a picture   {facts['compensate in colour, ms']:8.1f} ms")
for claim in record["claims"][:4]:
    print(f"{claim['text'].replace(' of 131072 pixels in colour', ''):9} {claim['measured']:>24}")

# %%
# From photographs
# ----------------
#
# No rows have to be known. ``bench/pictures.py`` photographs two tiled walls of 256 x 512 pixels
# under the patterns of a sketch (:doc:`../guide/photographs`), estimates T, and compensates a
# picture with it. The camera and the walls are simulated, so that the error is known.

record = json.loads(Path("../../bench/results/pictures.json").read_text())
facts = record["facts"]
print(record["device"], "- 2 cores\n")
print(f"photographs               {facts['photographs']:8.0f}")
print(f"T                         {facts['bytes of T'] / 1e6:8.1f} MB")
print(f"to scan and estimate it   {facts['scan, s'] / 60:8.1f} minutes")
for claim in record["claims"]:
    print(f"error, {claim['text']:18} {claim['measured']:>9}")

# %%
# .. image:: ../../bench/figures/corner.jpg
#    :alt: Two tiled walls under a picture, under the pattern that ltcl finds, and its bounces

# %%
# Where to go from here
# ---------------------
#
# - T is in a file larger than memory: ``ltcl.compress("T.npy")`` reads it in blocks
#   (:doc:`../guide/scale`).
# - T is larger than memory and must stay exact: ``ltcl.load`` leaves it on the disk
#   (:doc:`../guide/scale`).
# - Several GPUs in one machine: ``device="all"``, or a process for each (:doc:`../guide/scale`).
# - A film, or many scenes, and several machines: ``--cluster`` (:doc:`../guide/cluster`).
# - One solve over many machines: :doc:`../guide/mpi`.
# - T comes from walls that you know: ``ltcl.scenes.FormFactor`` computes it in each product.

# sphinx_gallery_thumbnail_number = 3
