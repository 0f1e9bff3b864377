# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl view`: light transport in the browser; `ltcl play`, `ltcl show`: films and patterns projected."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.compensate import GAIN, parse_gain
from ltcl.cli.options import argument, option
from ltcl.device import open_device
from ltcl.errors import InputError
from ltcl.tasks import compensation

_SHOWN = f"{options.FORMATS} Or the folder of an acquisition."
_HOST = "Address to listen on; beyond 127.0.0.1 whoever has the URL can look and compute."
_PORT = "Port, where pages of the last viewer find this one. Default: a free one."
_BROWSER = "In a projector window of the browser, for any display."
_ARRIVAL = "Next pattern when its photograph is in the folder of the acquisition."


def _address_options(
    host: Annotated[str, option(_HOST)] = "127.0.0.1",
    port: Annotated[int, option(_PORT, min=0, max=65535)] = 0,
    no_browser: Annotated[bool, option("Print the URL only.", "--no-browser")] = False,
) -> None:
    """Where a page is served."""


def _address(context: Context) -> dict[str, Any]:
    host, port, no_browser = (context.options[name] for name in ("host", "port", "no_browser"))
    return {"host": host, "port": port, "open_browser": not no_browser}


@command(*options.TRANSPORT, _address_options)
def view(
    context: Context,
    transport: Annotated[Path, argument("TRANSPORT", _SHOWN)],
    picture: Annotated[list[Path] | None, argument("PICTURE...", "Pictures to start with.")] = None,
) -> Answer:
    """Look at TRANSPORT in the browser: probe, bounces, relight, compensate, projector. Ctrl-C ends it.

    Of the folder of an acquisition, while it runs or afterwards: photographs as they come, their
    exposure, coverage, time left and warnings; and its transport as soon as that is finished.
    """
    from ltcl import images
    from ltcl.viewer.answers import Scene
    from ltcl.viewer.server import Viewer

    if (transport / "acquisition.toml").exists():
        from ltcl.viewer.scan import Scan

        if picture:
            raise InputError(
                f"PICTURE is {picture[0]}, but {transport} is an acquisition; it takes none"
            )
        scene: Scene = Scan(transport, open_device(context.options["device"]))
    else:
        T = options.load(context, transport)
        pictures = {each.name: images.read(each) for each in picture or []}
        scene = Scene(T, transport.name, pictures, options.setup(transport))
    with Viewer(scene, **_address(context)) as viewer:
        typer.echo(f"{viewer.url} shows {transport}; Ctrl-C ends it", err=True)
        context.progress(f"showing {transport}")
        with contextlib.suppress(KeyboardInterrupt):  # which is how it ends
            viewer.wait()
    return Answer({"url": viewer.url}, [])


@command(*options.TRANSPORT, options.solve_options, _address_options)
def play(
    context: Context,
    film: Annotated[
        Path, argument("FILM", "A video, whose sound is left out, or a folder of pictures.")
    ],
    transport: options.Matrix,
    gain: Annotated[str | None, option(GAIN, parser=parse_gain, metavar="FACTOR")] = None,
) -> Answer:
    """Play FILM in a projector window of the browser, compensated for TRANSPORT. Ctrl-C ends it.

    Frames that would be late are dropped. An --inverse, or a compressed TRANSPORT, makes it fast.
    """
    from ltcl.images.frames import open_frames
    from ltcl.show.window import Window, play
    from ltcl.viewer.answers import Scene

    source, T, setup = open_frames(film), options.load(context, transport), options.setup(transport)
    settings = options.solving(context, T, compensation.RTOL)
    settings |= {"callback": None, "background": None if setup is None else setup.ambient}
    with Window(film.name, **_address(context)) as window:
        typer.echo(f"{window.url} plays {film}; Ctrl-C ends it", err=True)
        facts = {}
        with contextlib.suppress(KeyboardInterrupt):
            scene, factor = Scene(T, transport.name, {}, setup), gain or ("auto" if setup else 1.0)
            facts = play(scene, source, window, factor, context.progress, **settings)
    line = "{shown} frames shown, {frames_per_second:.1f} a second, {latency:.3f} s late; {dropped} dropped"
    return Answer({"film": film, **facts}, [line.format(**facts)] if facts else [])


@command()
def show(
    context: Context,
    folder: Annotated[Path, argument("FOLDER", "Pictures, one or a folder; or an acquisition.")],
    display: Annotated[int, option("Number of the display, from 0.", metavar="N", min=0)] = 1,
    every: Annotated[
        float | None, option("Next picture after so many seconds.", metavar="SECONDS")
    ] = None,
    arrival: Annotated[bool, option(_ARRIVAL, "--arrival")] = False,
    browser: Annotated[bool, option(_BROWSER, "--browser")] = False,
) -> Answer:
    """Show patterns full screen, next by key, timer or photograph; Escape ends it. Needs extra projector.

    With --browser Ctrl-C ends it, and it needs extra view.
    """
    if every is not None and arrival:
        raise InputError(
            f"--every is {every:g}, but --arrival is given; one of them decides what comes next"
        )
    from ltcl.acquisition import rigs
    from ltcl.show.window import Window

    def progress(shot: Any, done: int, total: int) -> None:
        nonlocal count
        context.progress(
            f"photograph {shot.number}: {shot.seconds:g} s, {shot.save_as}", done, total
        )
        count = done + 1

    advance, count = "arrival" if arrival else "key" if every is None else every, 0
    with Window(str(folder)) if browser else contextlib.nullcontext(display) as screen:
        if isinstance(screen, Window):
            typer.echo(f"{screen.url} shows {folder}; Ctrl-C ends it", err=True)
        with contextlib.suppress(*[KeyboardInterrupt] * browser):
            count = rigs.show(folder, display=screen, advance=advance, progress=progress)
    return Answer({"folder": folder, "shown": count}, [f"{count} pattern(s) were shown"])
