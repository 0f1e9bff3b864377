# SPDX-License-Identifier: BSD-3-Clause
"""OpenEXR files of one part with R, G, B or a single channel, of 16 or 32 bits.

Known limit: OpenEXR also writes to stderr about some damage.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR

from ltcl import checks
from ltcl.errors import FileError
from ltcl.images.utf8_names import name_to_read, name_to_write

DTYPES = {"HALF": np.float16, "FLOAT": np.float32}


def read_exr(path: Path, bytes_per_pixel: int, memory: int) -> np.ndarray:
    """Codes (h, w, channels), float16 or float32; MemoryLimitError beyond `memory`."""
    with name_to_read(path) as name:
        names, h, w = _channels(name)
        checks.fits_host("the picture", bytes_per_pixel * h * w, memory)
        # `OpenEXR.File` prints on sys.stdout what is wrong with pixels; `InputFile` crashes on
        # headers that `_channels` refuses.
        file = OpenEXR.InputFile(str(name))
        planes = file.channels(names)
        channels = file.header()["channels"]
    types = sorted({str(channels[name].type) for name in names})
    if len(types) > 1 or types[0] not in DTYPES:
        raise FileError(f"holds {', '.join(types)} channels; they must be all HALF or all FLOAT")
    codes = np.stack([np.frombuffer(plane, DTYPES[types[0]]) for plane in planes], axis=-1)
    return codes.reshape(h, w, len(names))


def _channels(path: Path) -> tuple[list[str], int, int]:
    """Names of the channels, R, G and B first, and height and width."""
    file = OpenEXR.File(str(path), header_only=True)
    header = file.header()
    is_plain = header["type"] in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
    if len(file.parts) > 1 or not is_plain:
        raise FileError("is a deep or multi-part EXR; it must hold one plain picture")
    window = np.array(header["dataWindow"], int)
    display = np.array(header["displayWindow"], int)
    if not np.array_equal(window, display):
        raise FileError(f"has the data window {window.tolist()}; it must be the display window")
    w, h = (window[1] - window[0] + 1).tolist()
    names = sorted((channel.name for channel in header["channels"]), key="RGBA".find)
    if len(names) != 1 and names not in ([*"RGB"], [*"RGBA"]):
        raise FileError(f"holds the channels {names}; they must be R, G, B, or one")
    return names, h, w


def write_exr(path: Path, codes: np.ndarray) -> None:
    """Write codes (h, w) or (h, w, 3), float16 or float32."""
    name = "Y" if codes.ndim == 2 else "RGB"
    with name_to_write(path) as file:
        OpenEXR.File({}, {name: codes}).write(str(file))
