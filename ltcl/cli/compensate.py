# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`: the patterns under which a scene looks like given pictures, or like a film."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ltcl import checks
from ltcl.cli import compensate_frames, compensate_pictures, console, options, pictures, transports
from ltcl.errors import InputError


def _gain(text: str) -> float | str:
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no gain; write a number, or auto") from None


_GAIN = Annotated[
    str | None,
    typer.Option(
        parser=_gain,
        metavar="FACTOR",
        help="Match FACTOR times the picture; auto: the largest that the projector reaches. Default: 1, but "
        "auto with a TRANSPORT of 'ltcl acquire', whose light has the camera's own unit.",
        show_default=False,
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
_CALIBRATION = Annotated[
    Path | None,
    typer.Option(
        metavar="STORE",
        help="Of 'ltcl acquire': the transport.zarr that TRANSPORT was made of, where that does not keep how "
        "projector and ambient light were measured.",
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
        help="Picture of the scene under the light that the projector cannot take away. Default: what "
        "'ltcl acquire' measured of it, else none.",
        show_default=False,
    ),
]
_PANEL = "Options of frames: a folder or a video"
_BATCH = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Frames solved at once. Patterns depend on it, within RTOL, so --resume needs the same. "
        "Default: 8.",
        show_default=False,
        rich_help_panel=_PANEL,
    ),
]
_RESUME = Annotated[
    bool,
    typer.Option("--resume", help="Go on where the last run into DIR ended.", rich_help_panel=_PANEL),
]
_FRAMES = Annotated[
    int | None,
    typer.Option(
        min=1, metavar="N", help="Only the first N frames.", show_default=False, rich_help_panel=_PANEL
    ),
]
_VIDEO = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Also a video of the patterns: .mkv or .avi (lossless), or .mp4.",
        show_default=False,
        rich_help_panel=_PANEL,
    ),
]
_FPS = Annotated[
    float | None,
    typer.Option(
        metavar="RATE",
        help="Frames a second of that video. Default: those of the video that was read, else 25.",
        show_default=False,
        rich_help_panel=_PANEL,
    ),
]
_FORMAT = Annotated[
    Literal["png", "exr"] | None,
    typer.Option(
        help="Of the patterns: png, 16 bits in sRGB, or exr, the light as it is. Default: png.",
        show_default=False,
        rich_help_panel=_PANEL,
    ),
]
_APPEARANCE = Annotated[
    bool,
    typer.Option("--appearance", help="Write how the scene will look, too.", rich_help_panel=_PANEL),
]


def run(
    transport: options.Matrix,
    picture: options.PicturesOrFrames,
    out: options.Out,
    grid: options.Grid = None,
    camera_grid: options.CameraGrid = None,
    method: options.Method = "auto",
    rtol: options.TaskRtol = None,
    inverse: options.Inverse = None,
    exact: options.Exact = None,
    samples: options.Samples = None,
    seed: options.Seed = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    gain: _GAIN = None,
    loss: _LOSS = None,
    low: _LOW = 0.0,
    high: _HIGH = 1.0,
    clamp: _CLAMP = False,
    background: _BACKGROUND = None,
    calibration: _CALIBRATION = None,
    weights: _WEIGHTS = None,
    resize: options.Resize = False,
    encoding: options.Encoding = "auto",
    device: options.Device = None,
    json: options.Json = False,
    batch: _BATCH = None,
    resume: _RESUME = False,
    frames: _FRAMES = None,
    video: _VIDEO = None,
    fps: _FPS = None,
    format: _FORMAT = None,
    appearance: _APPEARANCE = False,
) -> None:
    """Find the projector patterns that make a scene look like PICTURE.

    Writes for each picture the pattern, how the scene will look under it and what is out of the projector's
    reach, exactly as .exr and for the eye as .png, and compensate.json. What is out of reach is grey where
    nothing is, orange where the scene stays too dark and blue where it stays too bright.

    With a TRANSPORT of 'ltcl acquire' pattern .png and video hold the codes that its projector is fed, by the
    measured response; else they are sRGB. Its ambient light is the background, and the gain is auto.

    Of a folder or a video of frames, writes the numbered patterns and frames.json batch by batch, with one
    gain for all; Ctrl-C keeps what is done, for --resume.
    """
    from ltcl.compensation import RTOL
    from ltcl.transport import default_rtol

    setup = transports.setup_of(transport, calibration)
    sought: Any = ("auto" if setup else 1.0) if gain is None else gain
    _check(sought, loss)
    _check_measured(setup, low, high)
    drawn = options.sampling(method, samples, seed)
    film = {"batch": batch, "resume": resume, "frames": frames, "video": video, "fps": fps}
    film |= {"format": format, "appearance": appearance}
    source = compensate_frames.source(picture, film)
    T = transports.load(
        transport,
        device,
        needs="light",
        grid=grid,
        camera_grid=camera_grid,
        first_bounce=first_bounce,
        on_dark=on_dark,
    )
    transports.refuse_other(setup, calibration, T)
    known = transports.load_inverse(inverse, T)
    judge = transports.load_exact(exact, T, grid=grid, on_dark=on_dark)
    rtol = default_rtol(RTOL, T, judge, known) if rtol is None else rtol
    reader = pictures.Reader(T.camera_grid, "the camera", encoding, resize)
    desired = {} if source else reader.read_all(picture)
    photographs = pictures.Reader(T.camera_grid, "the camera", encoding, resize, upright=False)
    dark, counts = (None if file is None else photographs.read(file) for file in (background, weights))
    if dark is None and setup is not None:
        dark = setup.ambient
    text = transports.heading(
        "compensate",
        transport,
        T,
        grid=grid,
        camera_grid=camera_grid,
        method=method,
        rtol=rtol,
        inverse=inverse,
        exact=exact,
        **drawn,
        first_bounce=first_bounce,
        on_dark=on_dark,
        gain=sought,
        loss=loss,
        low=low,
        high=high,
        clamp=clamp,
        background="measured" if background is None and setup is not None else background,
        calibration=calibration,
        weights=weights,
        resize=resize,
        encoding=encoding,
        device=device,
    )
    text["pattern_png"] = "sRGB" if setup is None else "codes of the measured projector"
    settings: dict[str, Any] = {"bounds": (low, high), "gain": sought, "loss": loss, "method": method}
    settings |= {"rtol": rtol, **drawn, "background": dark, "weights": counts}
    settings |= {"inverse": known, "exact": judge, "clamp": clamp}
    told = [transports.caveat("errors are", T, exact), *_measured(setup, background)]
    told = "\n".join(filter(None, told))
    if source:
        settings |= {"resize": resize, "encoding": encoding, "codes": setup and setup.codes}
        done = compensate_frames.run(T, source, out, {**film, **settings})
        if json:
            console.answer({"folder": out, **text, **compensate_frames.entry(source, done)})
        else:
            compensate_frames.show(done, told, gain == "auto")
        return
    names = {"background": background, "weights": weights}
    entries = compensate_pictures.run(T, picture, desired, out, text, names, settings, setup)
    if json:
        console.answer({"folder": out, **text})
    else:
        compensate_pictures.show(out, entries, told, advise=sought != "auto")


def _check_measured(setup: Any, low: float, high: float) -> None:
    """The light of a projector that was measured is relative to its black and its white."""
    for name, bound in (("--low", low), ("--high", high)):
        if setup is not None and not 0.0 <= bound <= 1.0:
            raise InputError(
                f"{name} is {bound:g}; it must be from 0 to 1, the black and the white of the projector that "
                "'ltcl acquire' measured"
            )


def _measured(setup: Any, background: Path | None) -> list[str]:
    """What the calibration in the transport was used for, in words."""
    if setup is None:
        return []
    used = "; the background is the ambient light that was measured" if background is None else ""
    return [f"pattern .png holds the codes to feed to the measured projector as they are{used}"]


def _check(gain: float | str, loss: float | None) -> None:
    """What the library refuses of a gain and a loss, in the words of the command line."""
    if gain != "auto":
        checks.number("--gain", gain, above=0.0)
        if loss is not None:
            raise InputError(f"--loss is {loss:g}, but --gain is {gain:g}; --loss is for --gain auto only")
    elif loss is not None:
        checks.number("--loss", loss, least=1e-6, below=1.0)
