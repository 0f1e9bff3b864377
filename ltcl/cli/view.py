# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl view`: light transport in the browser."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, option

_HOST = "Address to listen on; beyond 127.0.0.1 whoever has the URL can look and compute."


@command(*options.TRANSPORT)
def view(
    context: Context,
    transport: options.Matrix,
    picture: Annotated[list[Path] | None, argument("PICTURE...", "Pictures to start with.")] = None,
    host: Annotated[str, option(_HOST)] = "127.0.0.1",
    port: Annotated[int, option("Port. Default: a free one.", min=0, max=65535)] = 0,
    no_browser: Annotated[bool, option("Print the URL only.", "--no-browser")] = False,
) -> Answer:
    """Look at TRANSPORT in the browser: probe, bounces, relight, compensate, projector. Ctrl-C ends it."""
    from ltcl import images
    from ltcl.viewer import view

    T, setup = options.load(context, transport), None
    if options.is_measured(transport):
        from ltcl.acquisition import Setup  # which takes a second

        setup = Setup.of(transport)
    pictures, title = {path.name: images.read(path) for path in picture or []}, transport.name
    address = {"host": host, "port": port, "open_browser": not no_browser}
    with view(T, pictures, setup=setup, title=title, **address) as viewer:
        typer.echo(f"{viewer.url} shows {transport}; Ctrl-C ends it", err=True)
        context.progress(f"showing {transport}")
        with contextlib.suppress(KeyboardInterrupt):  # which is how it ends
            viewer.wait()
    return Answer({"url": viewer.url}, [])
