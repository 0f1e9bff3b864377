# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl align`: a transport of any camera, and its photographs, on the projector's grid."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from ltcl import store
from ltcl.cli import loading, options, pictures
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, out_option
from ltcl.cli.reports.transports import AlignReport
from ltcl.store import formats


@command(*options.READ_OPTIONS, options.picture_options)
def align(
    context: Context,
    file: options.TransportFile,
    out: Annotated[Path, out_option("The transport on the projector's grid: .npz or .zarr.")],
    picture: Annotated[
        list[Path] | None, argument("PICTURE", "Photographs of the camera of TRANSPORT.")
    ] = None,
) -> Answer:
    """Bring TRANSPORT onto the projector's grid, so that 'ltcl separate' finds its bounces.

    The camera has other pixels than the projector; T tells which of them each camera pixel sees.
    Each PICTURE is brought onto that grid, too, as NAME_aligned.exr beside OUT: 'ltcl separate OUT
    NAME_aligned.exr' takes it. Projector pixels that no camera pixel shows stay unlit.
    """
    from ltcl import images
    from ltcl.acquisition import align as align_transport

    formats.find(out)
    T = loading.load(context, file)
    photographs = pictures.read_all(
        context, picture or [], T.camera_grid, "the camera", upright=False
    )
    context.progress("aligning")
    alignment = align_transport(T)
    store.save(out, alignment.transport)
    aligned = []
    for name, photograph in photographs.items():
        path = out.parent / f"{name}_aligned.exr"
        images.write(path, alignment.resampling.apply(photograph))
        aligned.append(path)
    seen = float(np.mean(alignment.resampling.seen))
    report = AlignReport(
        **loading.heading(context, file, T),
        out=out,
        seen=seen,
        decoded=alignment.mapping.decoded,
        pictures=aligned,
    )
    height, width = T.grid
    lines = [f"{out}: {height} x {width} pixels, {100 * seen:.3g} % of them seen by the camera"]
    return Answer(report, [*lines, *map(str, aligned)])
