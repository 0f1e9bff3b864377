# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl separate`: each bounce of light of a picture as a picture of its own."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ltcl import checks, report
from ltcl.cli import console, options, pictures, results, transports
from ltcl.cli.command import Answer, Context
from ltcl.separation import Separation

_Bounces = Annotated[int, options.option("Indirect bounces to tell apart.", min=0)]


def separate(
    context: Context,
    transport: options.Matrix,
    picture: options.Pictures,
    out: options.Out,
    bounces: _Bounces = 4,
    grid: options.Grid = None,
    variable: options.Variable = None,
    method: options.Method = "auto",
    rtol: options.TaskRtol = None,
    inverse: options.Inverse = None,
    exact: options.Exact = None,
    samples: options.Samples = None,
    seed: options.Seed = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    resize: options.Resize = False,
    encoding: options.Encoding = "auto",
    device: options.Device = None,
) -> Answer:
    """Split PICTURE, taken of the scene under projector light, into direct light and bounces.

    Writes direct, indirect, bounce_1, bounce_2, ... and the rest exactly as .exr (measured ones may be a
    little negative), and for the eye as .png, all at one exposure, which separate.json names; and
    separate.png with all of them. Several pictures get a folder each.
    """
    from ltcl.separation import RTOL, separate
    from ltcl.transport import default_rtol

    sampled = options.sampling(context.options)
    T = transports.load(context, transport)
    judges = transports.load_judges(context, T)
    rtol = default_rtol(RTOL, T, judges["exact"], judges["inverse"]) if rtol is None else rtol
    images = pictures.Reader(T.grid, "the camera", encoding, resize, upright=False).read_all(picture)
    factor, solves = pictures.exposure(*images.values()), options.solves(method, T.channels) * (bounces + 1)
    text = transports.heading(context, transport, T, rtol=rtol, **sampled) | {"exposure": factor}
    text["pictures"], rows = [], []
    with results.fill(out, text) as folder:
        for name, file in zip(context.progress.each(list(images)), picture, strict=True):
            solving = {"method": method, "rtol": rtol, "callback": context.progress.solve(rtol, solves)}
            found = separate(T, images[name], bounces, **solving, **judges, **sampled)
            parts, panels = _write(folder, f"{name}/" * (len(images) > 1), found, images[name], factor)
            error = found.transport_error
            text["pictures"].append({"file": str(file), "transport_error": error, "parts": parts})
            first = [pictures.panel(pictures.shades(images[name], factor), name), *panels[:2]]
            rows += [row for row in (first, panels[2:], pictures.amplified(_parts(found), factor)) if row]
        pictures.contact_sheet(rows).save(folder / "separate.png")
    note = transports.caveat("all of this is", T, exact)
    return Answer({"folder": out, **text}, partial(_show, out, text["pictures"], note))


def _parts(found: Separation) -> dict[str, np.ndarray]:
    bounces = {f"bounce_{k}": part for k, part in enumerate(found.bounces, 1)}
    return {"direct": found.direct, "indirect": found.indirect, **bounces, "rest": found.rest}


def _write(
    folder: Path, place: str, found: Separation, image: np.ndarray, factor: float
) -> tuple[list[dict[str, Any]], list[Any]]:
    """All parts of one picture as files, with their share of the light and their solves; and their panels."""
    entries, panels, whole = [], [], _light(image)
    names = ["direct", *(f"bounce_{k}" for k, _ in enumerate(found.bounces, 1))]
    solutions = dict(zip(names, found.solutions, strict=True))
    for name, part in _parts(found).items():
        panels.append(pictures.panel(pictures.shades(part, factor), name))
        entry = {"part": name, **pictures.write(folder, place + name, part, panels[-1])}
        entry |= {"share": _light(part) / whole if whole else None, "lowest": float(part.min())}
        entries.append(entry | {"channels": report.solution(solutions[name]) if name in solutions else []})
    return entries, panels


def _light(part: np.ndarray) -> float:
    """The sum over pixels and three colours."""
    return float(np.sum(part, dtype=np.float64)) * (1 if part.ndim == 3 else 3)


def _show(out: Path, entries: list[dict[str, Any]], note: str) -> None:
    rows = []
    for entry in entries:
        for part in entry["parts"]:
            share = None if part["share"] is None else f"{100 * part['share']:.2f} %"
            products = sum(channel["products"] for channel in part["channels"]) or None
            residual = max((c["residual"] for c in part["channels"] if c["error"] is None), default=None)
            rows.append((Path(entry["file"]).name, part["part"], share, products, residual))
    console.table(("picture", "part", "share of light", "products", "residual"), rows)
    typer.echo(
        f"\neach part as .exr and .png in {out}; look at {out / 'separate.png'}"
        + (f"\n{note}" if note else "")
    )
    channels = [channel for entry in entries for part in entry["parts"] for channel in part["channels"]]
    if bounds := [channel["error"] for channel in channels if channel["error"] is not None]:
        worst = 100 * float(checks.upwards(max(bounds)))
        typer.echo(f"the relative error of each part by the inverse is at most {worst:.2g} %")
