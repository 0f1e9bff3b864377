# SPDX-License-Identifier: BSD-3-Clause
"""`view`: light transport in the browser, to be touched; `ltcl view` on the command line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ltcl.transport.transport import Transport, check_transport

if TYPE_CHECKING:
    from ltcl.viewer.server import Viewer


def view(
    T: Transport,
    picture: Any = None,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = True,
    setup: Any = None,
    title: str = "",
) -> Viewer:
    """Show T in the browser: probe it, separate bounces, relight, compensate; feed a projector.

    `picture` is linear light (h, w[, 3]), or a dict of such by names, to compensate for, separate
    or relight with. `host` and `port` are the address: beyond this machine whoever has the URL can
    look and compute; pages of a viewer that ended find the next one on the same `port`. `setup` is
    the `ltcl.acquisition.Setup` of a measured T, whose codes projector windows then show, else
    sRGB. Returns a `Viewer`: its `url`, `close()`, a with block; a notebook shows it as a frame.
    InputError for an address that cannot be had, or without the extra `view`.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(4, albedo=0.5).transport()
    >>> with ltcl.view(T, open_browser=False) as viewer:
    ...     viewer.url.startswith("http://127.0.0.1:")
    True
    """
    from ltcl.viewer.answers import Scene
    from ltcl.viewer.server import Viewer

    check_transport(T, square=False)
    pictures = (
        picture if isinstance(picture, Mapping) else {} if picture is None else {"picture": picture}
    )
    return Viewer(Scene(T, title or repr(T).strip("<>"), pictures, setup), host, port, open_browser)
