# SPDX-License-Identifier: BSD-3-Clause
"""MPCDI, VESA's format of projector calibrations: a zip of mpcdi.xml and the maps that it names.

The profile is 2d: a buffer is the picture in the camera's pixels, each region is a projector that
shows all of it, and its warp map (PFM, rows from below) has for each projector pixel the place in
the buffer, from 0 to 1 to the right and down. Alpha maps (PNG, 16 bits) are the share of the light,
beta maps the light that is added for an even black, both linear: gammaEmbedded is 1.

Readers of version 1.0 know other names of some attributes, so that there are two versions.
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
class Names:
    """Names that differ between versions."""

    width: str
    height: str
    origin: str
    root: dict[str, str]


VERSIONS = {
    "1.0": Names(
        width="Xresolution", height="Yresolution", origin="originof3DData", root={"level": "1"}
    ),
    "2.0": Names(
        width="xResolution",
        height="yResolution",
        origin="originOf3DData",
        root={"geometry": "1", "color": "1"},
    ),
}


def write_mpcdi(
    path: Path, projectors: Sequence[ExportedProjector], remark: str, version: str = "2.0"
) -> None:
    """Write projectors of one camera as the regions of an MPCDI file.

    `remark` stands in it as a comment, and as an extension where the version has these.
    """
    with replace_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        _add(archive, "mpcdi.xml", _document(projectors, remark, version))
        for projector in projectors:
            _add(archive, f"{projector.name}_warp.pfm", _warp(projector))
            _add(archive, f"{projector.name}_alpha.png", _png(projector.blend))
            _add(archive, f"{projector.name}_beta.png", _png(projector.black))


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a file, compressed, and without the time of its making."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, content)


def _document(projectors: Sequence[ExportedProjector], remark: str, version: str) -> bytes:
    names = VERSIONS[version]
    now = datetime.datetime.now(datetime.UTC)
    root = ElementTree.Element("MPCDI")
    root.set("profile", "2d")
    for name, value in names.root.items():
        root.set(name, value)
    root.set("date", f"{now:%Y-%m-%d %H:%M:%S}")
    root.set("version", version)
    # Two hyphens would end a comment.
    root.append(ElementTree.Comment(f" {remark.replace('--', '- -')} "))
    display = ElementTree.SubElement(root, "display")
    height, width = projectors[0].camera_grid
    buffer = ElementTree.SubElement(display, "buffer", id=BUFFER)
    buffer.set(names.width, str(width))
    buffer.set(names.height, str(height))
    files = ElementTree.SubElement(root, "files")
    for projector in projectors:
        _add_region(buffer, projector, names)
        _add_fileset(files, projector, names)
    if version != "1.0":
        extensions = ElementTree.SubElement(root, "extensionSet")
        extension = ElementTree.SubElement(extensions, "extension")
        extension.set("Name", EXTENSION)
        extension.set("hasExternalFiles", "false")
        _add_text(extension, "generatedBy", "ltcl")
        _add_text(extension, "remark", remark)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _add_region(buffer: ElementTree.Element, projector: ExportedProjector, names: Names) -> None:
    height, width = projector.grid
    region = ElementTree.SubElement(buffer, "region", id=projector.name)
    region.set(names.width, str(width))
    region.set(names.height, str(height))
    for name, value in (("x", 0), ("y", 0), ("xsize", 1), ("ysize", 1)):
        region.set(name, str(value))


def _add_fileset(files: ElementTree.Element, projector: ExportedProjector, names: Names) -> None:
    fileset = ElementTree.SubElement(files, "fileset", region=projector.name)
    warp = ElementTree.SubElement(fileset, "geometryWarpFile")
    _add_text(warp, "path", f"{projector.name}_warp.pfm")
    _add_text(warp, "geometricUnit", "unknown")
    _add_text(warp, "interpolation", "linear")
    _add_text(warp, names.origin, "unknown")
    for kind in ("alpha", "beta"):
        element = ElementTree.SubElement(fileset, f"{kind}Map")
        _add_text(element, "path", f"{projector.name}_{kind}.png")
        _add_text(element, "componentDepth", "1")
        _add_text(element, "bitDepth", "16")
        _add_text(element, "gammaEmbedded", "1.0")


def _add_text(parent: ElementTree.Element, name: str, text: str) -> None:
    ElementTree.SubElement(parent, name).text = text


def _warp(projector: ExportedProjector) -> bytes:
    """A PFM of places in the buffer; NaN where a pixel is not seen, and as the third value."""
    height, width = projector.camera_grid
    x = (projector.camera_x + 0.5) / width
    y = (projector.camera_y + 0.5) / height
    values = np.stack([x, y, np.full_like(x, np.nan)], axis=-1).astype("<f4")
    rows, columns = projector.grid
    header = f"PF\n{columns} {rows}\n-1.000000\n".encode()
    return header + values[::-1].tobytes()


def _png(mask: np.ndarray) -> bytes:
    """A PNG of 16 bits, linear."""
    _, data = cv2.imencode(".png", mask_codes(mask))
    return data.tobytes()
