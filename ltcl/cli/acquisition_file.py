# SPDX-License-Identifier: BSD-3-Clause
"""The acquisition.toml that `ltcl simulate` writes: what it was told, and as comments what else there is."""

from __future__ import annotations

import json
from typing import Any

_HEAD = """\
# What 'ltcl acquire' photographs in this folder, and how. The keys of [rig] are the arguments of
# ltcl.acquisition.VirtualRig, MitsubaRig, FolderRig or LiveRig, those of [acquire] the arguments of
# ltcl.acquire; "none" stands for None. Once photographs are taken, [acquire] must stay as it is.

"""
_COMMENTS = {
    "kind": "virtual, mitsuba, folder or live",
    "transport": "what is to be found again",
    "camera_map": "what each pixel of the camera sees of it",
    "scene": "a scene of ltcl.acquisition.mitsuba_scene, or a file",
    "response": "of the camera: linear, srgb, gamma2.2 or film",
    "projector_response": "of the projector, likewise",
    "bits": "of the photographs, 8 to 16",
    "ambient": "light without the projector",
    "seed": "of the noise",
    "geometry": "graycode measures which projector pixel a camera pixel sees; aligned: the same one",
    "strategy": "auto, adaptive, pixel, block or hadamard: see 'ltcl acquire plan'",
}
_VIRTUAL = """\
# black = 0.004                    # offset of the codes, of full scale
# projector_black = 0.0            # light at code 0, of full white
# gain = 10000.0                   # electrons at full scale; "none": no photon noise
# read = 0.0005                    # read noise, of full scale
# exposures = [0.1, 0.2, 0.4]      # seconds that the camera offers; left out: any
"""
_TAIL = """\
# exposures = [0.5, 8.0]           # seconds of the photographs of each pattern; left out: chosen
# response = "linear"              # of the camera where it is known; left out: measured
# frames = 16                      # photographs to average for black
# block = 2                        # side of the blocks of "block"

# Other rigs. A projector and a camera that you work by hand: patterns, the shooting list and the photographs
# are in this folder.
#
# [rig]
# kind = "folder"
# projector_grid = [48, 64]        # height, width
# channels = 3
#
# A camera on a cable before a display of this computer (extras camera and projector):
#
# [rig]
# kind = "live"
# period = "display"               # "none": the projector's light is steady
# [rig.camera]
# kind = "opencv"                  # or "gphoto2"
# source = 0
# [rig.display]
# grid = [48, 64]
# index = 1
"""


def text(rig: dict[str, Any], acquire: dict[str, Any]) -> str:
    """All of the file.

    >>> made = text({"kind": "virtual", "bits": 12}, {"strategy": "auto"})
    >>> made.splitlines()[5]
    'kind = "virtual"                   # virtual, mitsuba, folder or live'
    """
    more = _VIRTUAL if rig["kind"] == "virtual" else ""
    return f"{_HEAD}[rig]\n{_lines(rig)}{more}\n[acquire]\n{_lines(acquire)}{_TAIL}"


def _lines(table: dict[str, Any]) -> str:
    found = []
    for key, value in table.items():
        line = f"{key} = {json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)}"
        found.append(f"{line:<34} # {_COMMENTS[key]}" if key in _COMMENTS else line)
    return "".join(f"{line}\n" for line in found)
