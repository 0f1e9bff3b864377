# SPDX-License-Identifier: BSD-3-Clause
"""Options of the control of a show by OSC, and its server."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from ltcl.cli.command import Context, note
from ltcl.cli.options import option, parse_path
from ltcl.errors import FileError, InputError

control_option = partial(option, panel="Control by OSC")


def control_options(
    osc: Annotated[
        int | None,
        control_option(
            "UDP port on which OSC controls gain, bounds, picture, blackout, freeze and projector; "
            "0 for a free one. This needs the extra show.",
            metavar="PORT",
            min=0,
            max=65535,
        ),
    ] = None,
    osc_host: Annotated[
        str,
        control_option(
            "Address that OSC listens on; beyond 127.0.0.1 whoever reaches it controls the show.",
            metavar="HOST",
        ),
    ] = "127.0.0.1",
    pictures: Annotated[
        Path | None,
        control_option(
            "Folder of the pictures that OSC may show in place of the film.",
            parser=parse_path,
            metavar="DIR",
        ),
    ] = None,
) -> None:
    """Options of the control of a show."""


@contextlib.contextmanager
def controlled(context: Context) -> Iterator[Any]:
    """Give the control of a show, which OSC has while the block runs if it is asked for."""
    from ltcl.show.control import OscServer, ShowControl

    asked = context.options
    if asked["osc"] is None:
        if asked["pictures"] is not None:
            raise InputError("--pictures is given, but --osc is not; they belong together")
        yield ShowControl()
        return
    if asked["pictures"] is not None and not asked["pictures"].is_dir():
        raise FileError(f"{asked['pictures']}: is not a folder; --pictures needs one")
    # python-osc logs by functions of the root logger, which would get a handler of its own.
    logging.getLogger().addHandler(logging.NullHandler())
    control = ShowControl(asked["pictures"])
    with OscServer(control, asked["osc"], asked["osc_host"]) as server:
        note(f"OSC on {server.host}:{server.port}")
        yield control
