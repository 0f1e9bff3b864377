# SPDX-License-Identifier: BSD-3-Clause
"""Pictures that `ltcl compensate` is given one by one: their patterns, what became of each, advice."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import typer

from ltcl import report
from ltcl.cli import console, options, pictures, results
from ltcl.compensation import Compensation
from ltcl.errors import InputError
from ltcl.transport import Transport

_MANY = 0.01  # of the pattern beyond the projector's light: worth a word


def run(
    T: Transport,
    files: Sequence[Path],
    desired: Mapping[str, np.ndarray],
    out: Path,
    text: dict[str, Any],
    names: dict[str, Path | None],
    settings: dict[str, Any],
    setup: Any = None,
) -> list[dict[str, Any]]:
    """Fill the folder `out` with the results of all pictures; returns what the report says of each.

    Parameters
    ----------
    desired
        The pictures by the names of their results, in the order of `files`.
    text
        The beginning of the report, which gets the rest here.
    names
        Files of other arguments of `compensate`, for refusals.
    settings
        Of `compensate`.
    setup : ltcl.acquisition.Setup, optional
        That T was measured with: patterns are written as its projector is fed.
    """
    from ltcl.compensation import compensate

    entries = text["pictures"] = []
    dark, (low, high) = settings["background"], settings["bounds"]
    solves = options.solves(settings["method"], T.channels)
    with console.Steps(len(desired), solves) as steps, results.fill(out, text) as folder:
        for (name, wanted), file in zip(desired.items(), files, strict=True):
            steps.item(file.name)
            with _named({"desired": file, "gain": file, **names}):
                done = compensate(T, wanted, callback=steps.solve(settings["rtol"]), **settings)
            entries.append(
                {"file": str(file), "high": high, **_entry(T, done, low, high), **_under(done, dark)}
                | _write(folder, name, done, high, setup)
            )
    return entries


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
        "transport_error": done.transport_error,
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


def _write(folder: Path, name: str, done: Compensation, high: float, setup: Any) -> dict[str, Any]:
    white = high if high > 0 else 1.0
    # Appearance / gain compares with the picture that was asked for, whatever the units of T.
    missing, shown = done.out_of_reach, _diverging(done.out_of_reach / done.gain) * done.gain
    return {
        "pattern": pictures.write_pattern(folder, f"{name}_pattern", done.pattern, white, setup),
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


def show(out: Path, entries: list[dict[str, Any]], told: str, advise: bool) -> None:
    """Print what came out, what is `told` of the errors, and on stderr what would help."""
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
    if told:
        typer.echo(told)
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
        high = entry["high"]
        gain = entry["gain"] * high / entry["brightest"]
        console.note(
            f"{entry['file']}: the pattern needs light of {entry['brightest']:.3g}, "
            f"the projector gives {high:g}; try --gain {_rounded_down(gain)}"
        )


def _rounded_down(value: float) -> str:
    """Two digits of a positive number, never above it: a gain that is to clip nothing."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.floor(value / step * (1 + 1e-9)) * step:.2g}"
