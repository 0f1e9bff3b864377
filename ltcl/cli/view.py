# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl view`: light transport in the browser."""

from __future__ import annotations

import contextlib
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from ltcl.cli import loading, options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, option
from ltcl.cli.reports.program import ViewReport
from ltcl.cli.streams import print_line
from ltcl.device import open_device
from ltcl.errors import InputError

PROJECT = "acquisition.toml"

address_option = partial(option, panel="Address of the page")


def address_options(
    host: Annotated[
        str,
        address_option(
            "Address to listen on; beyond 127.0.0.1 whoever has the URL can look and compute."
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int,
        address_option(
            "Port of the page; a page left open finds the next viewer on the "
            "same port. Default: a free one.",
            min=0,
            max=65535,
        ),
    ] = 0,
    origin: Annotated[
        str,
        address_option(
            "URL of the page behind a proxy or on a forwarded port, such as http://localhost:9000.",
            metavar="URL",
        ),
    ] = "",
    no_browser: Annotated[
        bool, address_option("Print the URL, and open no browser.", "--no-browser")
    ] = False,
) -> None:
    """Options of the address of a page."""


def address(context: Context) -> dict[str, Any]:
    """Return the address as arguments of a viewer or a window."""
    return {
        "host": context.options["host"],
        "port": context.options["port"],
        "origin": context.options["origin"],
        "open_browser": not context.options["no_browser"],
    }


@command(*options.READ_OPTIONS, address_options)
def view(
    context: Context,
    transport: Annotated[
        Path, argument("TRANSPORT", f"{options.FORMATS} The folder of an acquisition will do, too.")
    ],
    picture: Annotated[list[Path] | None, argument("PICTURE", "Pictures to start with.")] = None,
) -> Answer:
    """Look at TRANSPORT in the browser: probe, bounces, relight, compensate, projector.

    Ctrl-C ends it.

    The folder of an acquisition shows, while it runs or afterwards, photographs as they come, their
    exposure, coverage, time left and warnings; and its transport as soon as that is finished. One
    of several projectors shows them combined, once all are scanned.
    """
    from ltcl.viewer.server import Viewer

    paths = [] if picture is None else picture
    scene = _make_scene(context, transport, paths)
    with Viewer(scene, **address(context)) as viewer, contextlib.suppress(KeyboardInterrupt):
        print_line(f"{viewer.url} shows {transport}; Ctrl-C ends it")
        context.progress(f"showing {transport}")
        viewer.wait()
    return Answer(ViewReport(url=viewer.url), [])


def _make_scene(context: Context, transport: Path, paths: list[Path]) -> Any:
    """Return what the viewer shows: a transport with pictures, or an acquisition."""
    from ltcl import images
    from ltcl.viewer.answers import ViewerScene
    from ltcl.viewer.scan import Scan

    if not (transport / PROJECT).exists():
        T = loading.load(context, transport)
        pictures = {path.name: images.read(path) for path in paths}
        return ViewerScene(T, transport.name, pictures, loading.load_setup(transport))
    if _has_several(transport):
        T = _combine(context, transport)
        pictures = {path.name: images.read(path) for path in paths}
        return ViewerScene(T, transport.name, pictures, None)
    if paths:
        problem = f"PICTURE is {paths[0]}, but {transport} is an acquisition"
        raise InputError(f"{problem}; it takes none")
    return Scan(transport, open_device(context.options["device"]))


def _has_several(folder: Path) -> bool:
    """True if an acquisition is of several projectors."""
    from ltcl.acquisition import Project

    return len(Project.open_all(folder)) > 1


def _combine(context: Context, folder: Path) -> Any:
    """Combine the scans of several projectors, as `ltcl combine` does."""
    from ltcl.acquisition.projectors import combine_scans
    from ltcl.acquisition.several import scanned_stores

    stores = scanned_stores(folder)
    device = open_device(context.options["device"])
    context.progress("combining")
    return combine_scans(stores, device=device)
