# SPDX-License-Identifier: BSD-3-Clause
"""
Photograph your own corner
==========================

With any projector, and a camera or phone that can hold its settings. ltcl tells you what to project
and how long to expose; you take the photographs; ltcl checks each of them and makes the transport
of your corner.

There is a :doc:`checklist to print <../checklist>`. This page does the whole thing once, with a
small simulated corner in place of yours, and then makes every mistake, to show what ltcl says. All
of these scans have 8 x 16 pixels, as a first one by hand may have, so their pictures are coarse:
:doc:`the next page <4_webcam>` scans 256 x 512.
"""

# %%
# The set-up
# ----------
#
# 1. Put the projector in front of the corner so that its picture fills both walls. Put the camera
#    beside it, on a tripod. It must see all of the projected picture.
# 2. Switch off what is automatic in the camera: exposure, ISO, white balance, focus, flash. A phone
#    needs an app with a manual ("pro") mode. Let it save raw files (or PNG, TIFF), and not JPEG:
#    ltcl reads JPEG, but most of the dim light that bounced is lost in it.
# 3. Make the room dark, and leave it so: a small lamp that stays on does no harm, one that changes
#    does.
# 4. Install what shows patterns on a projector, the extra ``projector`` (:doc:`../install`), and
#    for raw files ``camera``. Let the projector extend the desktop of your computer, not mirror
#    it.
# 5. Make a folder ``scan``, with a file ``acquisition.toml`` in it. It says how many pixels you
#    want, and which exposures your camera has, in seconds: 0.0167 is 1/60 s. Without that line ltcl
#    asks for any time, such as 0.0783 s. Begin with few pixels; the time grows with their number.
#
# .. code-block:: toml
#
#    [rig]
#    kind = "folder"
#    projector_grid = [8, 16]  # height, width
#    projector = [1080, 1920]  # the pixels of your projector
#    exposures = [
#        0.001, 0.002, 0.004, 0.008, 0.0167, 0.0333,
#        0.0667, 0.125, 0.25, 0.5, 1, 2, 4, 8, 15, 30,
#    ]
#
#    [acquire]
#    strategy = "sketch"       # some tens of patterns, from which T is estimated
#
# ``ltcl acquire plan scan`` says how many photographs that takes, and how long: fewer than 80 by a
# sketch, which :doc:`states its own error <../guide/photographs>`.
#
# How it goes
# -----------
#
# .. code-block:: sh
#
#    # writes patterns and their list, scan/shots.csv
#    ltcl acquire run scan
#    # shows them on the projector; a key is for the next
#    ltcl show scan
#    # copies your photographs from the folder CARD
#    ltcl acquire run scan --take CARD
#
# The last command also writes the next patterns. So you repeat the second and the third, six to
# eight times: ltcl first needs to see white and black to know how long to expose, then stripes to
# know where each pixel lands, then the patterns of the scan. ``ltcl acquire run scan`` can be
# stopped at any time, and goes on where it was.
#
# * Each pattern on the list needs one photograph, with the exposure that stands there, in that
#   order.
# * ``--take`` copies new files in the order in which the camera took them. Older ones may stay in
#   CARD. There must be as many new ones as are missing: delete those that are too many. Of a camera
#   that saves a raw and a JPEG file of each photograph, leave the raw ones only.
# * A photograph that is refused: delete it in ``scan/photographs``, and in CARD. Then ``ltcl
#   acquire run scan`` asks for it again, and ``ltcl show scan`` shows its pattern alone.
#
# At the end
# ----------
#
# ``ltcl acquire run scan`` ends with a report, whose last line says what the measurement is good
# for. Do not move projector and camera: the walls can now be given any picture.
#
# .. code-block:: sh
#
#    ltcl compensate scan/transport.zarr picture.png --resize crop --out shown
#    ltcl show shown/picture_pattern.png
#    ltcl separate scan/transport.zarr shown/picture_appearance.exr --out shown
#
# The pattern has one pixel for each of ``projector_grid``. ``ltcl show`` makes them as large as
# they were in the scan, and puts them in the same place; another program would not.
# ``shown/separate.png`` has the bounces of light.
#
# The same in Python, with a stand-in for you
# -------------------------------------------
#
# ``camera`` is a corner of two white walls with a camera in front. ``photographer`` does what you
# would do: look at the list, show the pattern, take the photograph, save it under the name on the
# list.

import html
import io
import shutil
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import ltcl
from ltcl.acquisition import FolderRig, Report, Setup, VirtualRig, camera_map
from ltcl.errors import LtclError, PhotographMissing
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(8, albedo=0.7)
# 4 of its pixels to one.
place = camera_map(lambda x, y: ((x - 4) / 4, (y - 3) / 4), (38, 70), corner.grid)
camera = VirtualRig(
    corner.transport(), corner.grid, camera_grid=(38, 70), camera_map=place, ambient=0.01
)


def photographer(folder, rig):
    """Take all photographs that are on the list and not there yet."""
    for number in rig.missing():
        shot = rig.shots[number - 1]
        codes = np.asarray(Image.open(folder / shot.pattern)) / 255
        photograph = camera.photograph(codes, shot.seconds)
        Image.fromarray(photograph).save(folder / f"{shot.save_as}.png")


def scan(folder, photographer=None):
    """Acquire; where photographs are missing call the photographer, if there is one."""
    while True:
        rig = FolderRig(folder, corner.grid)
        try:
            return ltcl.acquire(rig, store=folder / "T.zarr", strategy="sketch")
        except PhotographMissing as missing:
            if photographer is None:
                raise
            print(
                f"{missing.missing:3} photographs, the first: "
                f"{str(missing).partition(': ')[2][:47]} ..."
            )
            photographer(folder, rig)


folder = Path(tempfile.mkdtemp()) / "scan"
T = scan(folder, photographer)

# %%
# These are some of the photographs. The dim light where a pattern is black has bounced, and is what
# the scan is about.

names = sorted((folder / "photographs").iterdir())
shown = {"white": 1, "stripes, to find places": 12, "a coarse pattern": 45, "a fine one": 60}
figure = pictures({name: ltcl.images.read(names[k]) for name, k in shown.items()})
figure

# %%
# What came of it
# ---------------

print(Report.of(folder / "T.zarr"))

# %%
# As this corner is simulated, its true transport is known, and so is the error:

setup = Setup.of(folder / "T.zarr")
(error,) = setup.relative_error(camera, T)
print(f"pictures by T are wrong by {error:.2%}")

# %%
# Now a picture goes onto the walls: a bright band across the corner. ``background`` is the light of
# the room, which was measured, too. ``setup.codes`` are what the projector must be fed, by its
# measured response.

wanted = np.full(corner.grid, 0.35) * T.first_bounce.mean()
wanted[2:6] *= 2
result = ltcl.compensate(T, wanted, background=setup.ambient, gain="auto")
print(f"error {result.error:.2%}")

before = ltcl.images.from_srgb(camera.photograph(wanted / wanted.max(), 1.0) / 255)
after = ltcl.images.from_srgb(camera.photograph(setup.codes(result.pattern), 1.0) / 255)
figure = pictures(
    {
        "wanted": wanted / wanted.max(),
        "projected as it is": before,
        "the pattern of ltcl projected": after,
    }
)
figure

# %%
# Every mistake, and what ltcl says then
# --------------------------------------
#
# For each line of the table the photographs were copied, and one mistake made in them. The message
# is what ltcl really said when this page was built. ltcl compares each group of photographs with
# what it knows already before it keeps them, so nothing is lost. Some mistakes can only be seen
# with the photographs of the next round. Exchange or delete what is named, and run the same command
# again.
#
# The code is long, as there are many mistakes. The table is below it.


def change(name, edit):
    """Replace a photograph by what `edit` makes of it."""

    def mistake(files):
        path = files[name - 1]
        Image.fromarray(edit(np.asarray(Image.open(path)))).save(path)

    return mistake


def exchange(files):
    """Photographs 45 and 47 have each other's name."""
    first, second = (files[k].read_bytes() for k in (44, 46))
    files[44].write_bytes(second)
    files[46].write_bytes(first)


def moved(files):
    """The camera looks elsewhere from photograph 60 on."""
    for path in files[59:]:
        Image.fromarray(np.roll(np.asarray(Image.open(path)), 2, axis=1)).save(path)


def as_jpeg(image):
    """The image after it was a JPEG."""
    memory = io.BytesIO()
    Image.fromarray(image).save(memory, "JPEG", quality=40)
    return np.asarray(Image.open(memory))


def auto_exposure(files):
    """The camera chose a time itself; it notes that in the file."""
    exif = Image.Exif()
    exif[33434] = 0.5
    Image.open(files[44]).save(files[44], exif=exif)


def saved_as_jpeg(files):
    """From photograph 20 on the camera saved JPEG."""
    for name in range(20, len(files) + 1):
        change(name, as_jpeg)(files)


LAMP = np.linspace(20, 90, 70)
MISTAKES = {
    "a photograph is missing": lambda files: files[44].unlink(),
    "two photographs exchanged": exchange,
    "the button pressed twice": lambda files: files[46].write_bytes(files[44].read_bytes()),
    "a light switched on": change(33, lambda image: np.minimum(image + LAMP, 255).astype(np.uint8)),
    "the camera was touched": moved,
    "JPEG in place of raw or PNG": saved_as_jpeg,
    "automatic exposure": auto_exposure,
    "the camera turned": change(45, np.rot90),
    "one name for two files": lambda files: files[44].with_suffix(".tif").write_bytes(b""),
    "a file is broken": lambda files: files[44].write_bytes(files[44].read_bytes()[:200]),
}


class Table(list):
    """Mistakes and messages; a notebook, and this page, show it as a table."""

    def _repr_html_(self):
        cell = "<td style='text-align: left'>{}</td>"
        lines = [("<b>mistake</b>", "<b>what ltcl says</b>")]
        lines += [(name, html.escape(said)) for name, said in self]
        rows = ["<tr>" + "".join(map(cell.format, line)) + "</tr>" for line in lines]
        return f"<table class='table'>{''.join(rows)}</table>"


table = Table()
for name, mistake in MISTAKES.items():
    copy = folder.with_name("copy")
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("T.zarr*"))
    mistake(sorted((copy / "photographs").iterdir()))
    try:
        scan(copy)
        table.append((name, "nothing: it did no harm"))
    except LtclError as error:
        table.append((name, str(error).replace(str(copy), "scan")))
    shutil.rmtree(copy)
table

# %%
# Where to go on: the same with :doc:`a webcam and a second display <4_webcam>`, which needs no
# person at all; what to do with T is in :doc:`2_my_matrix`.

# sphinx_gallery_thumbnail_number = 9
