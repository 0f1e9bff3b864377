# SPDX-License-Identifier: BSD-3-Clause
"""
Your first bounce of light
==========================

Ten minutes, no hardware. You throw a picture into the corner of a room, see why it looks wrong, and
let ltcl find the pattern that makes it look right. Then you take the light apart, bounce by bounce.

You need ltcl with its extra ``plots`` (:doc:`../install`) and a little Python. Each block below can
be copied into a Python prompt or a notebook, in this order. ``figure.show()`` shows a figure below
its block in a notebook, and from a prompt in the program that opens pictures on your computer.
"""

# %%
# A corner, and a picture for it
# ------------------------------
#
# ltcl can compute rooms. This one is the corner of a room: a red wall, a yellow wall and a pink
# floor. The numbers are the red, green and blue light that a wall gives back. Each wall has 256 x
# 256 *pixels* of the projector. Light that bounces is smooth, so it is computed between 32 x 32
# squares of each wall, ``box(32, ...)``, which ``refine(..., 8)`` divides into 8 x 8 pixels each.

import ltcl
from ltcl.plots import pictures

walls = [(0.85, 0.35, 0.25), (0.85, 0.75, 0.35), (0.85, 0.5, 0.7)]  # left, right, floor
corner = ltcl.scenes.refine(ltcl.scenes.box(32, sides=3, albedo=walls), 8)
photo = ltcl.scenes.landscape(800, 800)  # any picture, as numbers of linear light from 0 to 1
wanted = 0.25 + 0.75 * corner.sample(photo)  # its pixels on the three walls, as seen from in front


def view(light):
    """The corner as somebody sees it who stands in front of it."""
    return corner.view(light, size=500, supersample=2)


figure = pictures({"the picture": photo, "on the walls": view(wanted)})
figure.show()

# %%
# The picture looks flat, although it lies on three walls: this is what we want.
#
# What happens without ltcl
# -------------------------
#
# A projector now throws just this picture. ``transport`` knows what each pixel of the projector
# does to each pixel of the walls; ``@`` sends a pattern through it.

transport = corner.transport()
as_it_is = transport @ wanted

figure = pictures({"wanted": view(wanted), "seen": view(as_it_is)})
figure.show()

# %%
# Two things went wrong. The walls have colours. And they light each other: light that meets the red
# wall goes on to the floor and to the other wall, and makes them red, too. Most of it collects
# where the walls meet.
#
# What happens with ltcl
# ----------------------

result = ltcl.compensate(transport, wanted, gain="auto")
print(f"error {result.error:.1%}, at {result.gain:.0%} of the brightness")

then = result.appearance / result.gain
figure = pictures({"throw this pattern": view(result.pattern), "and this is seen": view(then)})
figure.show()

# %%
# The pattern is green and blue where the walls are red, and darker where other walls will add their
# light.
#
# ``gain="auto"`` makes the picture as bright as the projector can. It is darker than the one that
# we asked for, as a red wall gives back little blue. Here both are drawn with the same brightness.
#
# The first bounce
# ----------------
#
# Look at the wrong picture again. Some of its light has met one wall: from the projector to the
# wall, from the wall to your eye. This is the *direct light*. Other light has met two walls (one
# bounce), three walls (two bounces), and so on. A camera sees only their sum. ltcl takes the sum
# apart:

parts = ltcl.separate(transport, as_it_is, bounces=3)

shown = {"all light": view(as_it_is), "direct light": view(parts.direct)}
for number, light in enumerate(parts.bounces, start=1):
    times = float(f"{parts.direct.mean() / light.mean():.2g}")
    shown[f"bounce {number}\n{times:g} times as bright"] = view(times * light)

figure = pictures(shown)
figure.show()

# %%
# The direct light has all of the detail. Each bounce is smoother and redder than the one before it,
# since red is the colour that these walls give back best.
#
# Nothing was lost: the parts add up to the picture.

total = parts.direct + parts.bounces.sum(axis=0) + parts.rest
print(f"largest difference: {abs(total - as_it_is).max():.1g}")

# %%
# A room with less light between its walls
# ----------------------------------------
#
# Now the parts can be put together in another way. This is the same picture with all bounces
# switched off, and with the first one made three times stronger.

no_bounce = parts.direct
strong = parts.direct + 3 * parts.bounces[0]
figure = pictures(
    {
        "no bounces": view(no_bounce),
        "as it was": view(as_it_is),
        "first bounce × 3\nshown darker": view(0.6 * strong),
    }
)
figure.show()

# %%
# What you have done, in the words of the paper
# ---------------------------------------------
#
# ===================  ======================  =================================================
# in this page         in the paper            what it is
# ===================  ======================  =================================================
# ``transport``        T                       picture = T pattern; one column per projector pixel
# ``result.pattern``   p                       the pattern, so that T p is the picture that you want
# ``parts.direct``     l\ :sub:`d`             the direct light
# ``parts.bounces``    A l\ :sub:`d`, ...      bounce 1, bounce 2 and so on
# ===================  ======================  =================================================
#
# Where to go on: :doc:`with a matrix that you have <2_my_matrix>`, :doc:`with a corner of your own
# <3_photograph_a_corner>`, or ``ltcl view`` in a terminal, which shows all of this in the browser
# with sliders. A picture made with photographs alone, of 256 x 512 pixels, stands at the end of
# :doc:`another page <6_large>`.

# sphinx_gallery_thumbnail_number = 9
