# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`: the patterns under which a scene looks like given pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ltcl import report
from ltcl.cli import console, options, pictures, results, transports
from ltcl.compensation import Compensation
from ltcl.transport import Transport

_GAIN = Annotated[float, typer.Option(metavar="FACTOR", help="Match FACTOR times the picture.")]
_LOW = Annotated[float, typer.Option(metavar="LIGHT", help="Darkest light of the projector.")]
_HIGH = Annotated[float, typer.Option(metavar="LIGHT", help="Brightest light of the projector.")]
_BACKGROUND = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Picture of the scene under the light that the projector cannot take away.",
        show_default=False,
    ),
]
_MANY = 0.01  # of the pattern beyond the projector's light: worth a word


def run(
    transport: options.Matrix,
    picture: options.Pictures,
    out: options.Out,
    grid: options.Grid = None,
    method: options.Method = "auto",
    rtol: options.Rtol = 1e-2,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "raise",
    gain: _GAIN = 1.0,
    low: _LOW = 0.0,
    high: _HIGH = 1.0,
    background: _BACKGROUND = None,
    resize: options.Resize = False,
    encoding: options.Encoding = "auto",
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Find the projector patterns that make a scene look like PICTURE.

    Writes for each picture the pattern and how the scene will look under it, exactly as .exr and for the eye
    as .png, and compensate.json.
    """
    from ltcl.compensation import compensate

    T = transports.load(transport, device, grid=grid, first_bounce=first_bounce, on_dark=on_dark)
    reader = pictures.Reader(T.grid, "the projector", encoding, resize)
    desired = reader.read_all(picture)
    dark = None if background is None else reader.read(background)
    text = transports.heading(
        "compensate",
        transport,
        T,
        grid=grid,
        method=method,
        rtol=rtol,
        first_bounce=first_bounce,
        on_dark=on_dark,
        gain=gain,
        low=low,
        high=high,
        background=background,
        resize=resize,
        encoding=encoding,
        device=device,
    )
    settings = {"bounds": (low, high), "gain": gain, "method": method, "rtol": rtol}
    entries = text["pictures"] = []
    with console.Steps(len(desired), T.channels) as steps, results.fill(out, text) as folder:
        for (name, wanted), file in zip(desired.items(), picture, strict=True):
            steps.item(file.name)
            done = compensate(T, wanted, background=dark, callback=steps.solve(rtol), **settings)
            entries.append(
                {"file": str(file), **_entry(T, done, low, high), **_under(done, dark)}
                | _write(folder, name, done, high)
            )
    if json:
        console.answer({"folder": out, **text})
    else:
        _show(out, entries)


def _entry(T: Transport, done: Compensation, low: float, high: float) -> dict[str, Any]:
    """What the report says of one picture; `too_dark` to `brightest` are of the light before clipping."""
    solutions = done.solution if isinstance(done.solution, tuple) else (done.solution,)
    light = T.to_light([solution.x.reshape(len(solution.x), -1) for solution in solutions])
    return {
        "gain": done.gain,
        "clipped": done.clipped,
        "too_dark": float(np.mean(np.less(light, low))),
        "too_bright": float(np.mean(np.greater(light, high))),
        "brightest": float(np.max(light)),
        "error": done.error,
        "channels": report.solution(solutions),
    }


def _under(done: Compensation, dark: np.ndarray | None) -> dict[str, float]:
    """The share of the target that is no brighter than the background: no light at all is left for it."""
    if dark is None:
        return {"under_background": 0.0}
    target = done.target
    if target.ndim != dark.ndim:
        target, dark = (part.reshape(*part.shape[:2], -1) for part in (target, dark))
    return {"under_background": float(np.mean(target <= dark * np.float32(1 + 1e-6)))}


def _write(folder: Path, name: str, done: Compensation, high: float) -> dict[str, Any]:
    # Appearance / gain compares with the picture that was asked for, whatever the units of T.
    return {
        "pattern": pictures.write(folder, f"{name}_pattern", done.pattern, high if high > 0 else 1.0),
        "appearance": pictures.write(folder, f"{name}_appearance", done.appearance, done.gain),
    }


def _show(out: Path, entries: list[dict[str, Any]]) -> None:
    console.table(
        ("picture", "method", "products", "residual", "clipped", "error", "pattern"),
        [
            (
                Path(entry["file"]).name,
                ", ".join(sorted({channel["method"] for channel in entry["channels"]})),
                sum(channel["products"] for channel in entry["channels"]),
                max(channel["residual"] for channel in entry["channels"]),
                f"{100 * entry['clipped']:.1f} %",
                f"{100 * entry['error']:.2f} %",
                entry["pattern"]["exr"],
            )
            for entry in entries
        ],
    )
    typer.echo(f"\npatterns and appearances as .exr and .png in {out}")
    for entry in entries:
        _advise(entry)


def _advise(entry: dict[str, Any]) -> None:
    """Say what would keep a pattern within the projector's light."""
    under = entry["under_background"]
    if under > _MANY:
        console.note(
            f"{entry['file']}: {100 * under:.0f} % of it is no brighter than the background; "
            "darken the room, or brighten the picture"
        )
    bounced = entry["too_dark"] - under
    if bounced > _MANY:
        console.note(
            f"{entry['file']}: {100 * bounced:.0f} % of it is darker than the light that bounces "
            "there from the rest of the picture; brighten its dark parts"
        )
    if entry["too_bright"] > _MANY and entry["brightest"] > 0:
        high = entry["pattern"]["png_scale"]
        gain = entry["gain"] * high / entry["brightest"]
        console.note(
            f"{entry['file']}: the pattern needs light of {entry['brightest']:.3g}, "
            f"the projector gives {high:g}; try --gain {_rounded_down(gain)}"
        )


def _rounded_down(value: float) -> str:
    """Two digits of a positive number, never above it: a gain that is to clip nothing."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.floor(value / step * (1 + 1e-9)) * step:.2g}"
