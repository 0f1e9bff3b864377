# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl relight`: what the camera sees under given patterns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from ltcl.cli import console, options, pictures, results, transports


def run(
    transport: options.Matrix,
    pattern: options.Patterns,
    out: options.Out,
    grid: options.Grid = None,
    camera_grid: options.CameraGrid = None,
    on_dark: options.OnDark = "auto",
    resize: options.Resize = False,
    encoding: options.Encoding = "auto",
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Show what the camera will see when PATTERN is projected.

    With a TRANSPORT of 'ltcl acquire' a PATTERN of integers, as .png, holds the codes that its projector is
    fed, and what is shown is what it adds to the ambient light.

    Writes each picture exactly as .exr and for the eye as .png, at its own brightness, which
    relight.json tells.
    """
    from ltcl.relighting import relight

    T = transports.load(transport, device, needs="T", grid=grid, camera_grid=camera_grid, on_dark=on_dark)
    setup = transports.setup_of(transport)
    patterns = pictures.Reader(T.grid, "the projector", encoding, resize, setup).read_all(pattern)
    text = transports.heading(
        "relight",
        transport,
        T,
        grid=grid,
        camera_grid=camera_grid,
        on_dark=on_dark,
        resize=resize,
        encoding=encoding,
        device=device,
    )
    entries: list[dict[str, Any]] = []
    text["pictures"] = entries
    with console.Steps(len(patterns)) as steps, results.fill(out, text) as folder:
        for (name, light), file in zip(patterns.items(), pattern, strict=True):
            steps.item(file.name)
            seen = relight(T, light)
            files = pictures.write(folder, f"{name}_relit", seen, pictures.brightness(seen))
            entries.append({"file": str(file), "brightest": float(seen.max()), **files})
    if json:
        console.answer({"folder": out, **text})
        return
    rows = [
        (Path(entry["file"]).name, entry["brightest"], entry["png_scale"], entry["exr"]) for entry in entries
    ]
    console.table(("pattern", "brightest in picture", "white in png", "picture"), rows)
    typer.echo(f"\npictures as .exr and .png in {out}")
    if told := transports.caveat("they are", T):
        typer.echo(told)
