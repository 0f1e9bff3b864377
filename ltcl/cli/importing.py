# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire import`: the map and the direct light of photographs taken elsewhere."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import scipy.sparse

from ltcl import store
from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, option, picture_option
from ltcl.cli.reports.acquisition import ImportReport
from ltcl.cli.tables import percent
from ltcl.device import open_device

MAP = "map.npz"
DIRECT = "direct.npz"


@command()
def import_photographs(
    context: Context,
    folder: Annotated[
        Path, argument("FOLDER", "Folder with photographs of Gray code, of one exposure.")
    ],
    out: options.OutFolder,
    # Not a tuple: typer would ask for two words.
    grid: Annotated[
        Any,
        option("Pixels of the projector.", "--grid", parser=options.parse_grid, metavar="HxW"),
    ],
    order: Annotated[
        str,
        option(
            "Order of the files: opencv (columns, then rows, coarsest first, each "
            "followed by its inverse; white; black), scan3d (that of Moreno and Taubin), or a TOML "
            "file.",
            metavar="opencv|scan3d|FILE",
        ),
    ] = "opencv",
    encoding: Annotated[
        Literal["auto", "srgb", "linear"],
        picture_option("Encoding of the photographs; auto: integers are sRGB, floats linear."),
    ] = "auto",
    device: options.DeviceName = None,
) -> Answer:
    """Read photographs of Gray code that another program took.

    OUT gets map.npz, which projector pixel each camera pixel sees; and with a photograph of white
    direct.npz, a transport of direct light alone, for blending and colours. Light that bounces is
    not in it: that takes a scan.
    """
    from ltcl.acquisition import import_gray_code
    from ltcl.acquisition.captures.map_file import write_map
    from ltcl.files import fill_folder

    context.progress(f"reading {folder}")
    capture = import_gray_code(folder, grid, order, encoding=encoding)
    transport = None
    if capture.direct is not None:
        transport = _direct_transport(capture.direct, open_device(device))
    files = [MAP]
    with fill_folder(out) as temporary:
        write_map(temporary / MAP, capture.mapping)
        if transport is not None:
            store.save(temporary / DIRECT, transport)
            files.append(DIRECT)
    report = ImportReport(
        folder=out,
        photographs=capture.photographs,
        grid=capture.mapping.grid,
        camera_grid=capture.mapping.camera_grid,
        decoded=capture.mapping.decoded,
        seen=capture.seen,
        saturated=None if transport is None else capture.saturated,
        indirect=None if math.isnan(capture.indirect) else capture.indirect,
        files=files,
    )
    return Answer(report, _lines(report))


def _direct_transport(direct: np.ndarray, device: Any) -> Any:
    """Make the transport that holds direct light alone, (h, w[, 3])."""
    from ltcl.transport.transport import Transport

    grid = direct.shape[:2]
    light = direct.reshape(grid[0] * grid[1], -1)
    matrices = [scipy.sparse.diags_array(column, format="csr") for column in light.T]
    matrix: Any = matrices if len(matrices) > 1 else matrices[0]
    return Transport(matrix, grid, on_dark="mask", device=device)


def _lines(report: ImportReport) -> list[str]:
    height, width = report.camera_grid
    lines = [
        f"{report.folder / MAP}: {percent(report.decoded, 1)} of {height} x {width} camera pixels "
        f"from {report.photographs} photographs; the camera sees {percent(report.seen, 1)} of the "
        "projector"
    ]
    if DIRECT not in report.files:
        lines.append("no direct light, for want of a photograph of white")
        return lines
    lines.append(
        f"{report.folder / DIRECT}: direct light; {percent(report.indirect or 0.0, 1)} of the "
        "light of white is not direct, at the median pixel, and is not in it"
    )
    if report.saturated:
        lines.append(f"{percent(report.saturated, 1)} of the lit camera pixels are saturated")
    return lines
