# SPDX-License-Identifier: BSD-3-Clause
"""
A film onto a wall
==================

A film on two coloured walls that meet in a corner: every frame is compensated, all with the same
brightness, so that nothing flickers. A run that was stopped goes on where it was.
"""

# %%
# A wall and a film
# -----------------
#
# The walls are computed here; yours come from :doc:`photographs <3_photograph_a_corner>` or from a
# :doc:`file <2_my_matrix>`. Each has 256 x 256 pixels; light bounces between 32 x 32 patches of
# it. The film is a dozen frames: the camera pans over a landscape. A folder of numbered pictures is
# a film, and so is any video file, ``film.mp4``.

import tempfile
from pathlib import Path

import ltcl
from ltcl.plots import pictures

walls = ltcl.scenes.dihedral(32, albedo=[(0.8, 0.5, 0.4), (0.5, 0.7, 0.8)])
corner = ltcl.scenes.refine(walls, 8)
T = corner.transport()

folder = Path(tempfile.mkdtemp())
wide = ltcl.scenes.landscape(480, 1600)
for number in range(12):
    start = 48 * number
    frame = 0.2 + 0.7 * corner.sample(wide[:, start : start + 960])
    ltcl.images.write(folder / "film" / f"{number:03}.png", frame)

# %%
# Compensate it
# -------------
#
# ``gain="auto"`` looks at eight frames, spread over the film, and takes the largest brightness that
# all of them can have. To show how a run is stopped, this one does five frames only.

patterns = folder / "patterns"
first = ltcl.batch.compensate_frames(
    T, folder / "film", patterns, gain="auto", appearance=True, frames=5
)
print(first.solved, "frames, brightness", round(first.gain, 3))

# %%
# After Ctrl-C, a power cut or, as here, a limit, ``resume=True`` goes on. It looks at what is
# there, does the rest, and makes the same files as one run would have made.

done = ltcl.batch.compensate_frames(
    T, folder / "film", patterns, gain="auto", appearance=True, resume=True
)
print(done.solved, "frames more;", len(done.records), "in all, the worst with an error of", end=" ")
print(f"{done.worst.error:.1%} ({done.worst.name})")

# %%
# Before and after
# ----------------
#
# Each column is a frame of the film: first as it looks when it is projected as it is, then the
# pattern that ltcl found, and what the walls look like under it.


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(light, size=480, supersample=2)


rows = [{}, {}, {}]
for number in (0, 5, 11):
    frame = ltcl.images.read(folder / "film" / f"{number:03}.png")
    pattern = ltcl.images.read(patterns / f"pattern_{number + 1:06}.png")
    rows[0][f"frame {number + 1}\nprojected as it is"] = view(T @ frame)
    rows[1][f"pattern {number + 1}"] = view(pattern)
    rows[2][f"seen under pattern {number + 1}"] = view((T @ pattern) / done.gain)
figure = pictures(*rows)
figure

# %%
# The brightness is the same in all frames: it is one number for the film. Here is how much of each
# frame was asked for and could not be had, because a pattern would have to be brighter than the
# projector, or darker than black.

for record in done.records[::4]:
    print(f"{record.name}: error {record.error:.2%}, {record.clipped:.1%} of the pattern clipped")

# %%
# In a terminal
# -------------
#
# .. code-block:: sh
#
#    ltcl film T.npz film.mp4 --gain auto --resize crop crop --out patterns
#    # after it was stopped: the same, and --resume
#    ltcl film T.npz film.mp4 --gain auto --resize crop crop --out patterns --resume
#    # on the projector, 24 a second (extra projector)
#    ltcl show patterns --every 0.0417
#    # or compensated while it plays, in a window for the projector (extras view, film)
#    ltcl play film.mp4 T.npz
#    # or between other programs, as raw video
#    ffmpeg -i film.mp4 -f rawvideo -pix_fmt rgb24 -s 640x480 - |
#        ltcl play --pipe --video-size 640x480 --gain 0.4 - T.npz |
#        ffplay -f rawvideo -pixel_format rgb24 -video_size 512x256 -framerate 25 -
#
# A pattern has as many pixels as the projector's grid in T. ``ltcl show`` and ``ltcl play`` make
# each pixel a square, where the scan had it. ``--video patterns.mkv`` writes a film for other
# programs: do not let them smooth it when they enlarge it. Sound is left out.
#
# ``gain="auto"`` sees eight frames only. Where others ask for more light than there is, ltcl names
# the worst frame; begin again in another folder with a ``--gain`` a little lower.
#
# ``ltcl play`` drops frames that would be late, and tells how many frames a second it reached. For
# a large T make it fast first: ``ltcl compress``, then ``ltcl invert`` (:doc:`6_large`). Films over
# several machines: :doc:`../guide/cluster`; pipes, control by OSC and files for other software:
# :doc:`../guide/shows`.

# sphinx_gallery_thumbnail_number = 10
