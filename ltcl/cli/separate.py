# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl separate`: each bounce of light of a picture as a picture of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ltcl import checks, report
from ltcl.cli import console, options, pictures, results, transports
from ltcl.separation import Separation

_BOUNCES = Annotated[int, typer.Option(metavar="N", min=0, help="Indirect bounces to tell apart.")]


def run(
    transport: options.Matrix,
    picture: options.Pictures,
    out: options.Out,
    bounces: _BOUNCES = 4,
    grid: options.Grid = None,
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
    json: options.Json = False,
) -> None:
    """Split PICTURE, taken of the scene under projector light, into direct light and bounces.

    Writes direct, indirect, bounce_1, bounce_2, ... and the rest exactly as .exr (measured ones may be a
    little negative) and for the eye as .png, each at its own brightness, which separate.json tells. Several
    pictures get a folder each.
    """
    from ltcl.separation import RTOL, separate
    from ltcl.transport import default_rtol

    drawn = options.sampling(method, samples, seed)
    T = transports.load(transport, device, grid=grid, first_bounce=first_bounce, on_dark=on_dark)
    known = transports.load_inverse(inverse, T)
    judge = transports.load_exact(exact, T, grid=grid, on_dark=on_dark)
    rtol = default_rtol(RTOL, T, judge, known) if rtol is None else rtol
    seen = pictures.Reader(T.grid, "the camera", encoding, resize, upright=False).read_all(picture)
    text = transports.heading(
        "separate",
        transport,
        T,
        bounces=bounces,
        grid=grid,
        method=method,
        rtol=rtol,
        inverse=inverse,
        exact=exact,
        **drawn,
        first_bounce=first_bounce,
        on_dark=on_dark,
        resize=resize,
        encoding=encoding,
        device=device,
    )
    entries = text["pictures"] = []
    solves = options.solves(method, T.channels) * (bounces + 1)
    with console.Steps(len(seen), solves) as steps, results.fill(out, text) as folder:
        for (name, image), file in zip(seen.items(), picture, strict=True):
            steps.item(file.name)
            settings = {"method": method, "rtol": rtol, "inverse": known, "exact": judge, **drawn}
            done = separate(T, image, bounces, callback=steps.solve(rtol), **settings)
            # Several pictures get a folder each.
            place = f"{name}/" if len(seen) > 1 else ""
            parts = _write(folder, place, done, image)
            entries.append({"file": str(file), "transport_error": done.transport_error, "parts": parts})
    if json:
        console.answer({"folder": out, **text})
    else:
        _show(out, entries, transports.caveat("all of this is", T, exact))


def _write(folder: Path, place: str, done: Separation, image: np.ndarray) -> list[dict[str, Any]]:
    """All parts of one picture as files; for the report their share of the light and their solves."""
    parts = {"direct": done.direct, "indirect": done.indirect}
    parts |= {f"bounce_{k}": part for k, part in enumerate(done.bounces, 1)}
    parts["rest"] = done.rest
    solved = {"direct": done.solutions[0]}
    solved |= {f"bounce_{k}": solution for k, solution in enumerate(done.solutions[1:], 1)}
    whole = float(np.sum(np.broadcast_to(image.reshape(*image.shape[:2], -1), (*image.shape[:2], 3))))
    return [
        {
            "part": name,
            **pictures.write(folder, place + name, part, pictures.brightness(part)),
            "share": _light(part) / whole if whole else None,
            "lowest": float(part.min()),
            "channels": report.solution(solved[name]) if name in solved else [],
        }
        for name, part in parts.items()
    ]


def _light(part: np.ndarray) -> float:
    """The sum over pixels and three colours."""
    return float(np.sum(part, dtype=np.float64)) * (1 if part.ndim == 3 else 3)


def _show(out: Path, entries: list[dict[str, Any]], told: str) -> None:
    console.table(
        ("picture", "part", "share of light", "products", "residual", "white in png"),
        [
            (
                Path(entry["file"]).name,
                part["part"],
                None if part["share"] is None else f"{100 * part['share']:.2f} %",
                sum(channel["products"] for channel in part["channels"]) if part["channels"] else None,
                _residual(part["channels"]),
                part["png_scale"],
            )
            for entry in entries
            for part in entry["parts"]
        ],
    )
    places = [out / Path(entry["parts"][0]["exr"]).parent for entry in entries]
    typer.echo(f"\neach part as .exr and .png in {', '.join(map(str, places))}")
    if told:
        typer.echo(told)
    channels = [channel for entry in entries for part in entry["parts"] for channel in part["channels"]]
    bounds = [channel["error"] for channel in channels if channel["error"] is not None]
    if bounds:
        worst = 100 * float(checks.upwards(max(bounds)))
        typer.echo(f"by the inverse, each part is off by up to {worst:.2g} %")


def _residual(channels: list[dict[str, Any]]) -> float | None:
    """The largest; None where there is none, as of an inverse."""
    return max((c["residual"] for c in channels if c["error"] is None), default=None)
