# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`: the patterns under which a scene looks like given pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ltcl import checks, report
from ltcl.cli import console, options, pictures, results, transports
from ltcl.compensation import Compensation
from ltcl.errors import InputError
from ltcl.transport import Transport


def _gain(text: str) -> float | str:
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no gain; write a number, or auto") from None


_GAIN = Annotated[
    str,
    typer.Option(
        parser=_gain,
        metavar="FACTOR",
        help="Match FACTOR times the picture; auto: the largest that the projector reaches.",
    ),
]
_LOSS = Annotated[
    float | None,
    typer.Option(
        metavar="FRACTION",
        help="Error that --gain auto may cost. Default: none if possible, else RTOL or 1.1 times the least.",
        show_default=False,
    ),
]
_WEIGHTS = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Picture of how much the error at each pixel counts.", show_default=False
    ),
]
_LOW = Annotated[float, typer.Option(metavar="LIGHT", help="Darkest light of the projector.")]
_HIGH = Annotated[float, typer.Option(metavar="LIGHT", help="Brightest light of the projector.")]
_CLAMP = Annotated[
    bool,
    typer.Option(
        "--clamp",
        help="Clamp what exceeds the projector's light, and do not make up for it elsewhere: quick.",
    ),
]
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
    camera_grid: options.CameraGrid = None,
    method: options.Method = "auto",
    rtol: options.Rtol = 1e-2,
    inverse: options.Inverse = None,
    samples: options.Samples = None,
    seed: options.Seed = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "raise",
    gain: _GAIN = "1",
    loss: _LOSS = None,
    low: _LOW = 0.0,
    high: _HIGH = 1.0,
    clamp: _CLAMP = False,
    background: _BACKGROUND = None,
    weights: _WEIGHTS = None,
    resize: options.Resize = False,
    encoding: options.Encoding = "auto",
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Find the projector patterns that make a scene look like PICTURE.

    Writes for each picture the pattern, how the scene will look under it and what is out of the projector's
    reach, exactly as .exr and for the eye as .png, and compensate.json. What is out of reach is grey where
    nothing is, orange where the scene stays too dark and blue where it stays too bright.
    """
    from ltcl.compensation import compensate

    _check(gain, loss)
    drawn = options.sampling(method, samples, seed)
    T = transports.load(
        transport,
        device,
        needs="light",
        grid=grid,
        camera_grid=camera_grid,
        first_bounce=first_bounce,
        on_dark=on_dark,
    )
    known = transports.load_inverse(inverse, T)
    reader = pictures.Reader(T.camera_grid, "the camera", encoding, resize)
    desired = reader.read_all(picture)
    dark, counts = (None if file is None else reader.read(file) for file in (background, weights))
    text = transports.heading(
        "compensate",
        transport,
        T,
        grid=grid,
        camera_grid=camera_grid,
        method=method,
        rtol=rtol,
        inverse=inverse,
        **drawn,
        first_bounce=first_bounce,
        on_dark=on_dark,
        gain=gain,
        loss=loss,
        low=low,
        high=high,
        clamp=clamp,
        background=background,
        weights=weights,
        resize=resize,
        encoding=encoding,
        device=device,
    )
    settings = {"bounds": (low, high), "gain": gain, "loss": loss, "method": method, "rtol": rtol, **drawn}
    settings |= {"inverse": known, "clamp": clamp}
    entries = text["pictures"] = []
    with console.Steps(len(desired), T.channels) as steps, results.fill(out, text) as folder:
        for (name, wanted), file in zip(desired.items(), picture, strict=True):
            steps.item(file.name)
            pictured = {"background": dark, "weights": counts}
            with _named({"desired": file, "gain": file, "background": background, "weights": weights}):
                done = compensate(T, wanted, callback=steps.solve(rtol), **pictured, **settings)
            entries.append(
                {"file": str(file), **_entry(T, done, low, high), **_under(done, dark)}
                | _write(folder, name, done, high)
            )
    if json:
        console.answer({"folder": out, **text})
    else:
        _show(out, entries, advise=gain != "auto")


def _check(gain: float | str, loss: float | None) -> None:
    """What the library refuses of a gain and a loss, in the words of the command line."""
    if gain != "auto":
        checks.number("--gain", gain, above=0.0)
        if loss is not None:
            raise InputError(f"--loss is {loss:g}, but --gain is {gain:g}; --loss is for --gain auto only")
    elif loss is not None:
        checks.number("--loss", loss, least=1e-6, below=1.0)


@contextmanager
def _named(files: dict[str, Path | None]) -> Iterator[None]:
    """Refusals that begin with the name of an argument begin with its file."""
    try:
        yield
    except InputError as error:
        text = str(error).replace("gain is 'auto', but", "--gain is auto, but")
        file = files.get(str(error).partition(" ")[0])
        raise InputError(text if file is None else f"{file}: {text}") from None


def _entry(T: Transport, done: Compensation, low: float, high: float) -> dict[str, Any]:
    """What the report says of one picture; `asks_below` to `brightest` are of the light without bounds."""
    solutions = done.solution if isinstance(done.solution, tuple) else (done.solution,)
    light = [done.pattern]  # of a T that has no S, so that there is no other
    if T.is_square:
        light = T.to_light([solution.x.reshape(len(solution.x), -1) for solution in solutions])
    return {
        "gain": done.gain,
        "clipped": done.clipped,
        "too_dark": float(np.mean(done.out_of_reach > 0)),
        "too_bright": float(np.mean(done.out_of_reach < 0)),
        "asks_below": float(np.mean(np.less(light, low))),
        "asks_above": float(np.mean(np.greater(light, high))),
        "brightest": float(np.max(light)),
        "error": done.error,
        "gap": done.gap,
        "channels": report.solution(solutions),
        "limited": report.solution(done.limited),
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
    missing, shown = done.out_of_reach, _diverging(done.out_of_reach / done.gain) * done.gain
    return {
        "pattern": pictures.write(folder, f"{name}_pattern", done.pattern, high if high > 0 else 1.0),
        "appearance": pictures.write(folder, f"{name}_appearance", done.appearance, done.gain),
        "out_of_reach": pictures.write(folder, f"{name}_out_of_reach", missing, done.gain, shown),
    }


def _diverging(missing: np.ndarray) -> np.ndarray:
    """Linear (h, w, 3): grey for 0, to orange for 1 and to blue for -1; of colours that most off."""
    from ltcl import images

    if missing.ndim == 3:
        most = np.argmax(np.abs(missing), axis=-1)[..., None]
        missing = np.take_along_axis(missing, most, axis=-1)[..., 0]
    shade = np.clip(missing, -1.0, 1.0)[..., None] * [0.5, 0.0, -0.5]
    return images.from_srgb(0.5 + shade)


def _show(out: Path, entries: list[dict[str, Any]], advise: bool) -> None:
    console.table(
        ("picture", "method", "products", "gain", "clipped", "error", "pattern"),
        [
            (
                Path(entry["file"]).name,
                ", ".join(dict.fromkeys(solve["method"] for solve in _solves(entry))),
                sum(solve["products"] for solve in _solves(entry)),
                entry["gain"],
                f"{100 * entry['clipped']:.1f} %",
                f"{100 * entry['error']:.2f} %",
                entry["pattern"]["exr"],
            )
            for entry in entries
        ],
    )
    typer.echo(f"\npatterns, appearances and what is out of reach as .exr and .png in {out}")
    if any(entry["too_dark"] or entry["too_bright"] for entry in entries):
        typer.echo("out of reach: orange stays too dark, blue too bright")
    for entry in entries if advise else ():
        _advise(entry)


def _solves(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """Those without bounds and those within; of a T without S, they are the same."""
    return entry["channels"] + [solve for solve in entry["limited"] if solve not in entry["channels"]]


def _advise(entry: dict[str, Any]) -> None:
    """Say what would keep a pattern within the projector's light."""
    under = entry["under_background"]
    if under > _MANY:
        console.note(
            f"{entry['file']}: {100 * under:.0f} % of it is no brighter than the background; "
            "darken the room, or brighten the picture"
        )
    bounced = entry["asks_below"] - under
    if bounced > _MANY:
        console.note(
            f"{entry['file']}: {100 * bounced:.0f} % of it is darker than the light that bounces "
            "there from the rest of the picture; brighten its dark parts"
        )
    if entry["asks_above"] > _MANY and entry["brightest"] > 0:
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
