# SPDX-License-Identifier: BSD-3-Clause
"""MPCDI, VESA's format of projector calibrations: a zip of mpcdi.xml and the maps that it names.

The profile is 2d: a buffer is the picture in the camera's pixels, each region is a projector that
shows all of it, and its warp map (PFM, rows from below) has for each projector pixel the place in
the buffer, from 0 to 1 to the right and up, as in OpenGL. Alpha maps (PNG) are the share of the
light, beta maps the light that is added for an even black. Both are codes of one exponent:

    light = (code / largest code) ** gammaEmbedded

Readers of version 1.0 know other names of some attributes, and the reference library takes each
byte of a PNG for a pixel, so that there are two versions.

Known limit: readers disagree on the first row of a PFM, which is the lowest one of the picture in
the reference library and the highest one in some others. The definition of PFM decides.
"""

from __future__ import annotations

import datetime
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ltcl.files import replace_file
from ltcl.show.export.maps import mask_codes
from ltcl.show.export.projector import ExportedProjector

BUFFER = "camera"
EXTENSION = "ltcl"


@dataclass(frozen=True, kw_only=True)
class Dialect:
    """The differences between versions.

    Attributes
    ----------
    width, height, origin : str
        Names of attributes and elements.
    root : dict of str to str
        Levels of quality: warp maps of all pixels, with beta maps.
    bits : {8, 16}
        Bits of the masks.
    gamma : float
        Exponent of the masks.
    has_beta_gamma : bool
        Whether a beta map states its exponent. Else that of the alpha map counts.
    """

    width: str
    height: str
    origin: str
    root: dict[str, str]
    bits: int
    gamma: float
    has_beta_gamma: bool


VERSIONS = {
    "1.0": Dialect(
        width="Xresolution",
        height="Yresolution",
        origin="originof3DData",
        root={"level": "4"},
        bits=8,
        gamma=2.2,
        has_beta_gamma=True,
    ),
    "2.0": Dialect(
        width="xResolution",
        height="yResolution",
        origin="originOf3DData",
        root={"geometry": "2", "color": "2"},
        bits=16,
        gamma=1.0,
        has_beta_gamma=False,
    ),
}


def write_mpcdi(
    path: Path, projectors: Sequence[ExportedProjector], remark: str, version: str = "2.0"
) -> None:
    """Write projectors of one camera as the regions of an MPCDI file.

    `remark` stands in it as a comment, and as an extension where the version has these.
    """
    dialect = VERSIONS[version]
    with replace_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        _add(archive, "mpcdi.xml", _document(projectors, remark, version))
        for projector in projectors:
            _add(archive, f"{projector.name}_warp.pfm", _warp(projector))
            _add(archive, f"{projector.name}_alpha.png", _png(projector.blend, dialect))
            _add(archive, f"{projector.name}_beta.png", _png(projector.black, dialect))


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a file, compressed, and without the time of its making."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, content)


def _document(projectors: Sequence[ExportedProjector], remark: str, version: str) -> bytes:
    dialect = VERSIONS[version]
    now = datetime.datetime.now(datetime.UTC)
    root = ElementTree.Element("MPCDI")
    root.set("profile", "2d")
    for name, value in dialect.root.items():
        root.set(name, value)
    root.set("date", f"{now:%Y-%m-%d %H:%M:%S}")
    root.set("version", version)
    # Two hyphens would end a comment.
    root.append(ElementTree.Comment(f" {remark.replace('--', '- -')} "))
    display = ElementTree.SubElement(root, "display")
    height, width = projectors[0].camera_grid
    buffer = ElementTree.SubElement(display, "buffer", id=BUFFER)
    buffer.set(dialect.width, str(width))
    buffer.set(dialect.height, str(height))
    files = ElementTree.SubElement(root, "files")
    for projector in projectors:
        _add_region(buffer, projector, dialect)
        _add_fileset(files, projector, dialect)
    if version != "1.0":
        extensions = ElementTree.SubElement(root, "extensionSet")
        extension = ElementTree.SubElement(extensions, "extension")
        extension.set("Name", EXTENSION)
        extension.set("hasExternalFiles", "false")
        _add_text(extension, "generatedBy", "ltcl")
        _add_text(extension, "remark", remark)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _add_region(
    buffer: ElementTree.Element, projector: ExportedProjector, dialect: Dialect
) -> None:
    height, width = projector.grid
    region = ElementTree.SubElement(buffer, "region", id=projector.name)
    region.set(dialect.width, str(width))
    region.set(dialect.height, str(height))
    for name, value in (("x", 0), ("y", 0), ("xsize", 1), ("ysize", 1)):
        region.set(name, str(value))


def _add_fileset(
    files: ElementTree.Element, projector: ExportedProjector, dialect: Dialect
) -> None:
    fileset = ElementTree.SubElement(files, "fileset", region=projector.name)
    warp = ElementTree.SubElement(fileset, "geometryWarpFile")
    _add_text(warp, "path", f"{projector.name}_warp.pfm")
    _add_text(warp, "geometricUnit", "unknown")
    _add_text(warp, "interpolation", "linear")
    _add_text(warp, dialect.origin, "unknown")
    for kind in ("alpha", "beta"):
        element = ElementTree.SubElement(fileset, f"{kind}Map")
        _add_text(element, "path", f"{projector.name}_{kind}.png")
        _add_text(element, "componentDepth", "1")
        _add_text(element, "bitDepth", str(dialect.bits))
        if kind == "alpha" or dialect.has_beta_gamma:
            _add_text(element, "gammaEmbedded", str(dialect.gamma))


def _add_text(parent: ElementTree.Element, name: str, text: str) -> None:
    ElementTree.SubElement(parent, name).text = text


def _warp(projector: ExportedProjector) -> bytes:
    """A PFM of places in the buffer; NaN where a pixel is not seen, and as the third value.

    Places that lie beyond the camera's picture move to its border: readers that find one outside
    of [0, 1] take all of them for pixels.
    """
    height, width = projector.camera_grid
    x = np.clip((projector.camera_x + 0.5) / width, 0.0, 1.0)
    y = np.clip(1.0 - (projector.camera_y + 0.5) / height, 0.0, 1.0)
    values = np.stack([x, y, np.full_like(x, np.nan)], axis=-1).astype("<f4")
    rows, columns = projector.grid
    header = f"PF\n{columns} {rows}\n-1.000000\n".encode()
    return header + values[::-1].tobytes()


def _png(mask: np.ndarray, dialect: Dialect) -> bytes:
    """A PNG of one channel."""
    codes = mask_codes(mask ** (1.0 / dialect.gamma), dialect.bits)
    _, data = cv2.imencode(".png", codes)
    return data.tobytes()
