# SPDX-License-Identifier: BSD-3-Clause
"""`view`: light transport in the browser; `ltcl view` on the command line."""

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
    url: str = "",
    setup: Any = None,
    title: str = "",
) -> Viewer:
    """Show T in the browser: probe it, separate bounces, relight, compensate; feed a projector.

    Parameters
    ----------
    T : Transport
    picture : array or dict of arrays, optional
        Linear light (h, w[, 3]), or a dict of such pictures by names, to compensate for, separate
        or relight with. Those of other proportions than the grid are cropped, until Fit on the page
        says otherwise.
    host, port : str, int
        Address of the page; by default a free port of this machine. Beyond this machine whoever has
        the URL can look and compute. A page of a viewer that ended finds the next one on the same
        port.
    open_browser : bool
        Whether to open the page in the browser.
    url : str
        Address at which the browser finds the page behind a proxy or on a forwarded port, such as
        "http://localhost:9000" or "https://hub.example.org/user/me/proxy/8123"; other addresses
        than this one and the viewer's own are refused.
    setup : ltcl.acquisition.Setup, optional
        Measured projector of T, whose codes projector windows then show; else they show sRGB.
    title : str
        Title of the page.

    Returns
    -------
    Viewer
        It has a `url` and `close()`, and is a context manager; a notebook shows it as a frame.

    Raises
    ------
    InputError
        The address is not available, `url` is none, or the extra `view` is not installed.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(4, albedo=0.5).transport()
    >>> with ltcl.view(T, open_browser=False) as viewer:
    ...     viewer.url.startswith("http://127.0.0.1:")
    True
    """
    from ltcl.viewer.answers import ViewerScene
    from ltcl.viewer.server import Viewer

    check_transport(T, square=False)
    pictures = {}
    if isinstance(picture, Mapping):
        pictures = picture
    elif picture is not None:
        pictures = {"picture": picture}
    if not title:
        title = repr(T).strip("<>")
    scene = ViewerScene(T, title, pictures, setup)
    return Viewer(scene, host, port, open_browser, url)
