# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl view`: the viewer in the browser."""

from __future__ import annotations

import contextlib
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command, note
from ltcl.cli.options import argument, option
from ltcl.images import read

_HOST = "Address to listen on; beyond 127.0.0.1, whoever has the URL can look and compute."
_PICTURE = "Pictures to compensate for, separate or relight with."


@command(*options.TRANSPORT)
def view(
    context: Context,
    transport: options.Matrix,
    picture: Annotated[list[Path] | None, argument("PICTURE...", _PICTURE)] = None,
    host: Annotated[str, option(_HOST)] = "127.0.0.1",
    port: Annotated[int, option("Port to listen on. Default: a free one.", min=0, max=65535)] = 0,
    no_browser: Annotated[bool, option("Print the URL only.", "--no-browser")] = False,
) -> Answer:
    """Look at TRANSPORT in the browser: probe, bounces, relighting, compensation. Ctrl-C ends it."""
    from ltcl.acquisition import Setup
    from ltcl.viewer import Viewer

    T = options.load(context, transport)
    setup = Setup.of(transport) if options.is_measured(transport) else None
    pictures = {path.name: read(path) for path in picture or []}
    with Viewer(T, transport.name, pictures, setup, host=host, port=port) as viewer:
        typer.echo(f"{viewer.url}\nCtrl-C ends it", err=True)
        if not viewer.is_local:
            note("this address is open to the network, unencrypted: whoever has the URL can look and compute")
        if not no_browser:
            webbrowser.open(viewer.url)
        context.progress(f"showing {transport}")
        with contextlib.suppress(KeyboardInterrupt):  # which is how it ends
            viewer.wait()
    return Answer({"url": viewer.url}, [])
