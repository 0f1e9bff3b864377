# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl play` and `ltcl show`: films and patterns on a projector."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from ltcl.cli import compensation, control, loading, options, pipe
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, option, picture_option
from ltcl.cli.reports.program import PlayReport, ShowReport
from ltcl.cli.streams import print_line
from ltcl.cli.view import address, address_options
from ltcl.errors import InputError


@command(
    *options.READ_OPTIONS,
    options.frame_options,
    address_options,
    pipe.pipe_options,
    control.control_options,
)
def play(
    context: Context,
    film: Annotated[
        Path,
        argument(
            "FILM", "A video, whose sound is left out, a folder of pictures, or - with --pipe."
        ),
    ],
    transport: options.TransportFile,
    gain: compensation.FilmGain = None,
    resize: Annotated[
        Literal["crop", "letterbox", "stretch"],
        picture_option(
            "Frames of another size are scaled to the camera's grid. With other proportions, cut "
            "off what is too much, add black bars, or distort them."
        ),
    ] = "letterbox",
) -> Answer:
    """Play FILM in a projector window of the browser, compensated for TRANSPORT.

    A film of other proportions lies between black bars, unless --resize says otherwise. Ctrl-C ends
    it. Frames that would be late are dropped. An --inverse, or a compressed TRANSPORT, makes it
    fast.

    With --pipe frames come as raw video from stdin, and their codes go to stdout, for other
    programs: ffmpeg ... -f rawvideo - | ltcl play --pipe ... - TRANSPORT | ffplay ...
    With --osc other programs control the show.
    """
    is_stdin = str(film) == "-"
    if context.options["pipe"] != is_stdin:
        given = "given" if context.options["pipe"] else "not given"
        raise InputError(f"FILM is {film}, but --pipe is {given}; raw video on stdin takes both")
    if context.options["video_size"] is not None and not is_stdin:
        raise InputError(
            f"--video-size is {context.options['video_size']}, but --pipe is not given; they "
            "belong together"
        )
    if is_stdin:
        pipe.check(context, gain)
    with control.controlled(context) as asked:
        if is_stdin:
            scene, settings = _load_scene(context, transport)
            return pipe.run(context, scene, gain, resize, {**settings, "control": asked})
        return _play_in_window(context, film, transport, gain, resize, asked)


def _load_scene(context: Context, transport: Path) -> tuple[Any, dict[str, Any]]:
    """Load the transport and its set-up, and the settings of frames."""
    from ltcl.viewer.answers import ViewerScene

    T = loading.load(context, transport)
    setup = loading.load_setup(transport) or loading.setup_of_several(T)
    settings: dict[str, Any] = {
        "rtol": context.options["rtol"],
        "inverse": loading.load_inverse(context, T),
        "background": None if setup is None else setup.ambient,
        "bounces_every": context.options["bounces_every"],
    }
    return ViewerScene(T, transport.name, {}, setup), settings


def _play_in_window(
    context: Context, film: Path, transport: Path, gain: Any, resize: str, control: Any
) -> Answer:
    """Play a film in a projector window."""
    from ltcl.images.frames import open_frames
    from ltcl.show.player import play as run_film
    from ltcl.show.window import Window

    source = open_frames(film)
    scene, settings = _load_scene(context, transport)
    report = PlayReport(film=film)
    with (
        Window(film.name, **address(context)) as window,
        contextlib.suppress(KeyboardInterrupt),
    ):
        print_line(f"{window.url} plays {film}; Ctrl-C ends it")
        pace = run_film(
            scene,
            source,
            window,
            compensation.resolve_gain(gain, scene.setup),
            context.progress,
            resize,
            control=control,
            **settings,
        )
        report = PlayReport(film=film, **dataclasses.asdict(pace))
    if report.shown is None:
        return Answer(report, [])
    line = (
        f"{report.shown} frames shown, {report.frames_per_second:.1f} a second, "
        f"{report.latency:.3f} s late; {report.dropped} dropped; "
        f"99 % computed within {1e3 * (report.computing_p99 or 0.0):.1f} ms"
    )
    return Answer(report, [line])


@command()
def show(
    context: Context,
    folder: Annotated[
        Path,
        argument(
            "FOLDER",
            "A picture, a folder of pictures, the folder of an acquisition, or the results of "
            "'ltcl compensate'.",
        ),
    ],
    display: Annotated[
        int, option("Number of the display; the first one is 0.", metavar="N", min=0)
    ] = 1,
    every: Annotated[
        float | None,
        option("Seconds between two pictures. Default: until a key is pressed.", metavar="SECONDS"),
    ] = None,
    arrival: Annotated[
        bool,
        option(
            "Show the next pattern when its photograph is in the folder of the acquisition.",
            "--arrival",
        ),
    ] = False,
    browser: Annotated[
        bool,
        option(
            "Show the patterns in a projector window of the browser, for any display.",
            "--browser",
        ),
    ] = False,
    resize: Annotated[
        Literal["crop", "letterbox", "stretch"] | None,
        picture_option(
            "Scale pictures to the pixels of the display, with --browser to those of the first "
            "picture. With other proportions, cut off what is too much, add black bars, or distort "
            "them. Default: square blocks of pixels, with black around. Patterns of an acquisition "
            "stay as they are."
        ),
    ] = None,
) -> Answer:
    """Show patterns full screen, next by key, timer or photograph; Escape ends it.

    This needs the extra projector. With --browser Ctrl-C ends it, and it needs the extra view.
    """
    if every is not None and arrival:
        problem = f"--every is {every:g}, but --arrival is given"
        raise InputError(f"{problem}; one of them decides what comes next")
    from ltcl.acquisition import rigs

    advance: Any = "key"
    if arrival:
        advance = "arrival"
    elif every is not None:
        advance = every
    counter = _ShotCounter(context)
    if not browser:
        shown = rigs.show(folder, display=display, advance=advance, progress=counter, resize=resize)
    else:
        shown = _show_in_browser(folder, advance, counter, resize)
    report = ShowReport(folder=folder, shown=shown)
    return Answer(report, [f"{shown} pattern(s) were shown"])


class _ShotCounter:
    """Shows the progress of `ltcl.acquisition.rigs.show`, and counts patterns."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self.count = 0

    def __call__(self, shot: Any, done: int, total: int) -> None:
        step = f"photograph {shot.number}: {shot.seconds:g} s, {shot.save_as}"
        self._context.progress(step, done, total)
        self.count = done + 1


def _show_in_browser(folder: Path, advance: Any, counter: _ShotCounter, resize: str | None) -> int:
    """Show patterns in a window until they or Ctrl-C end it; return how many were shown."""
    from ltcl.acquisition import rigs
    from ltcl.show.window import Window

    with Window(str(folder)) as window, contextlib.suppress(KeyboardInterrupt):
        print_line(f"{window.url} shows {folder}; Ctrl-C ends it")
        return rigs.show(folder, display=window, advance=advance, progress=counter, resize=resize)
    return counter.count
