# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl relight`: what the camera sees under given patterns."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.cli import console, options, pictures, results, transports
from ltcl.cli.command import Answer, Context

_Patterns = Annotated[list[Path], options.argument("PATTERN...", "Pictures of patterns.")]


def relight(
    context: Context,
    transport: options.Matrix,
    pattern: _Patterns,
    out: options.Out,
    grid: options.Grid = None,
    camera_grid: options.CameraGrid = None,
    variable: options.Variable = None,
    on_dark: options.OnDark = "auto",
    resize: options.Resize = False,
    encoding: options.Encoding = "auto",
    device: options.Device = None,
) -> Answer:
    """Show what the camera will see when PATTERN is projected.

    With a TRANSPORT of 'ltcl acquire' a PATTERN of integers, as .png, holds the codes for its projector, and
    the result is what the pattern adds to the ambient light.

    Writes pictures exactly as .exr, and for the eye as .png at one exposure, which relight.json names.
    """
    from ltcl.relighting import relight

    T = transports.load(context, transport, "T")
    reader = pictures.Reader(T.grid, "the projector", encoding, resize, transports.setup_of(transport))
    seen = {name: relight(T, light) for name, light in reader.read_all(pattern).items()}
    factor, entries = pictures.exposure(*seen.values()), []
    text = transports.heading(context, transport, T) | {"exposure": factor, "pictures": entries}
    with results.fill(out, text) as folder:
        for (name, picture), file in zip(seen.items(), pattern, strict=True):
            panel = pictures.panel(pictures.shades(picture, factor), f"{file.name}, relit")
            files = pictures.write(folder, f"{name}_relit", picture, panel)
            entries.append({"file": str(file), "brightest": float(picture.max()), **files})
    return Answer({"folder": out, **text}, partial(_show, out, entries, transports.caveat("they are", T)))


def _show(out: Path, entries: list[dict[str, Any]], note: str) -> None:
    rows = [(Path(entry["file"]).name, entry["brightest"], entry["exr"]) for entry in entries]
    console.table(("pattern", "brightest in picture", "picture"), rows)
    typer.echo(f"\npictures as .exr and .png in {out}" + (f"\n{note}" if note else ""))
